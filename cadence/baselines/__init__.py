"""Rivals of the diffusion model: the same call, joint samples out."""
