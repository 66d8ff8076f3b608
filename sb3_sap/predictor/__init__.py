"""Labels, the knowledge buffer K and the AP predictor E; nothing here chooses actions."""
