"""Forecasts of checkpoints by the paper's protocol, on folders of logs or simulated episodes."""
