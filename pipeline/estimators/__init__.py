"""Estimators out of checkpoints: what each preset needs and how it is loaded."""
