"""Episodes of recorded or simulated targets: what forecasts are trained on and scored against."""
