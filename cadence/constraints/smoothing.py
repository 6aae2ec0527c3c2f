"""Smooth curves through what is known of each step with a standard deviation of its own (Whittaker 1923)."""

import torch
from torch import Tensor

_LEAST_M = 1e-6
"""Least standard deviation and bend: where something is certain, the curve passes to within rounding."""


def smoothed(known_m: Tensor, sigma_m: Tensor, bend_m: Tensor) -> Tensor:
    """The curves with the least sum of squared misfits and second differences, each in its own unit.

    Args:
        known_m: [R, K, T, 2] what is to be smoothed.
        sigma_m: [R, T] how far off a step may be.
        bend_m: [R] how large the second difference of a coordinate may be.

    Returns:
        [R, K, T, 2]; zero stays zero, and so does what is linear in time.
    """
    num_rows, num_curves, num_steps = known_m.shape[:3]
    if num_steps < 3 or not num_rows:
        return known_m
    weight = sigma_m.double().clamp_min(_LEAST_M).square().reciprocal()  # [R, T]
    second = torch.zeros(num_steps - 2, num_steps, dtype=torch.float64)
    index = torch.arange(num_steps - 2)
    second[index, index], second[index, index + 1], second[index, index + 2] = 1.0, -2.0, 1.0
    stiffness = bend_m.double().clamp_min(_LEAST_M).square().reciprocal()  # [R]
    # in units of the weight, so that certain steps do not swamp the others in rounding
    scale = weight.rsqrt()
    roughness = (second.T @ second)[None] * stiffness[:, None, None]
    system = scale[:, :, None] * roughness * scale[:, None, :] + torch.eye(num_steps, dtype=torch.float64)
    known = known_m.double().permute(0, 2, 1, 3).reshape(num_rows, num_steps, -1) * weight.sqrt()[:, :, None]
    solved = scale[:, :, None] * torch.cholesky_solve(known, torch.linalg.cholesky(system))
    return solved.reshape(num_rows, num_steps, num_curves, 2).permute(0, 2, 1, 3)
