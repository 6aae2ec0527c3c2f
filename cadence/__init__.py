"""CADENCE: diffusion models for sparse, adversarial multi-target tracking. Pure torch and numpy; no files, no clocks."""
