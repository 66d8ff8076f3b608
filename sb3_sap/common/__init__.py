"""What every other package here builds on; it knows neither predictor nor guidance."""
