"""Diffusion: schedules, samplers, guidance, and the residual about the bank."""
