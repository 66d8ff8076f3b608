"""Labels, the knowledge buffer K and the AP predictor E: what is learned of permissibility, whoever acts."""
