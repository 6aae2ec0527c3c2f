"""What a network adds to the bank's tracks, as a smooth displacement: it may bend a track, but not shake it.

The network answers in units of the bank's sigma, which far from detections is tens of step lengths: a hundredth of it between
neighbouring steps, which the training loss hardly sees, is a jump that no target could make.
"""

import torch
from torch import Tensor

_TRUST = 0.1
"""The network's answer at one step is believed to this many sigmas of the bank; its course over many steps is what counts."""

_PINNED_M = 1e-6
"""Least standard deviation of a displacement: where the bank is certain, it is nothing."""


def smoothed_displacement(displacement_m: Tensor, sigma_m: Tensor, bend_m: Tensor) -> Tensor:
    """The displacement with the least sum of squared misfits and second differences (Whittaker 1923), each in its own unit.

    Args:
        displacement_m: [R, K, T, 2] what the network moved each hypothesis by.
        sigma_m: [R, T] standard deviation of the bank; a misfit counts in tenths of it.
        bend_m: [R] how much the bank's own tracks bend: root mean square of their second differences in a coordinate.

    Returns:
        [R, K, T, 2]; zero stays zero, and so does what is linear in time.
    """
    num_rows, num_hypotheses, num_steps = displacement_m.shape[:3]
    if num_steps < 3 or not num_rows:
        return displacement_m
    weight = (_TRUST * sigma_m).clamp_min(_PINNED_M).double().square().reciprocal()  # [R, T]
    second = torch.zeros(num_steps - 2, num_steps, dtype=torch.float64)
    index = torch.arange(num_steps - 2)
    second[index, index], second[index, index + 1], second[index, index + 2] = 1.0, -2.0, 1.0
    stiffness = bend_m.double().clamp_min(_PINNED_M).square().reciprocal()  # [R]
    # in units of the weight, so that certain steps do not swamp the others in rounding
    scale = weight.rsqrt()
    roughness = (second.T @ second)[None] * stiffness[:, None, None]
    system = scale[:, :, None] * roughness * scale[:, None, :] + torch.eye(num_steps, dtype=torch.float64)
    known = displacement_m.double().permute(0, 2, 1, 3).reshape(num_rows, num_steps, -1) * weight.sqrt()[:, :, None]
    solved = scale[:, :, None] * torch.cholesky_solve(known, torch.linalg.cholesky(system))
    return solved.reshape(num_rows, num_steps, num_hypotheses, 2).permute(0, 2, 1, 3)


def bend_of(sample_m: Tensor) -> Tensor:
    """How much tracks [R, K, T, 2] bend: root mean square of the second differences of a coordinate [R]."""
    return sample_m.double().diff(n=2, dim=2).square().mean(dim=(1, 2, 3)).sqrt()
