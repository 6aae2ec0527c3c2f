"""Training: windows with known truth, and the loop."""
