"""Settings, checks and helpers for all other packages; nothing here imports the predictor or the guidance."""
