"""The damped oscillator about a centre: transition and noise of models with a home, in closed form."""

import torch
from torch import Tensor

NODES = torch.tensor([0.0694318442029737, 0.3300094782075719, 0.6699905217924281, 0.9305681557970263], dtype=torch.float64)
WEIGHTS = torch.tensor([0.1739274225687269, 0.3260725774312731, 0.3260725774312731, 0.1739274225687269], dtype=torch.float64)
"""Nodes and weights of Gauss and Legendre on [0, 1]."""
_SMALL = 0.1


def oscillator(relaxation_rate: Tensor, speed: Tensor, home_range: Tensor, duration: Tensor) -> tuple[Tensor, Tensor]:
    """Transition and noise of the state (x, y, vx, vy, centre x, centre y), [..., 6, 6] each.

    Args:
        relaxation_rate: of the velocity.
        speed: stationary deviation an axis of the velocity.
        home_range: that of the position.
        duration: not negative; all of one shape [...].
    """
    response = _response(relaxation_rate, speed, home_range, duration)
    pp, pv, vp, vv = response
    eye = torch.eye(2, dtype=torch.float64)
    zero, one = torch.zeros_like(pp), torch.ones_like(pp)
    matrix = _blocks([[pp, pv, one - pp], [vp, vv, -vp], [zero, zero, one]], eye)
    # What the stationary law has and the past does not explain; it cancels for short durations, where quadrature is exact.
    far = (home_range**2 * (1.0 - pp**2) - speed**2 * pv**2, -(home_range**2 * pp * vp + speed**2 * pv * vv),
           speed**2 * (1.0 - vv**2) - home_range**2 * vp**2)  # fmt: skip
    at = duration[..., None] * NODES
    _, short_pv, _, short_vv = _response(relaxation_rate[..., None], speed[..., None], home_range[..., None], at)
    weight = 2.0 * (relaxation_rate * speed**2 * duration)[..., None] * WEIGHTS
    near = tuple(
        (weight * one * two).sum(-1) for one, two in ((short_pv, short_pv), (short_pv, short_vv), (short_vv, short_vv))
    )
    is_short = duration * torch.maximum(relaxation_rate, speed / home_range) < _SMALL
    noise_pp, noise_pv, noise_vv = (torch.where(is_short, short, long) for short, long in zip(near, far, strict=True))
    noise = _blocks([[noise_pp, noise_pv, zero], [noise_pv, noise_vv, zero], [zero, zero, zero]], eye)
    return matrix, noise


def _response(relaxation_rate: Tensor, speed: Tensor, home_range: Tensor, duration: Tensor) -> tuple[Tensor, ...]:
    """Exponential of [[0, 1], [-w^2, -r]] over the duration, w = speed / home_range: its four entries, row by row."""
    half, stiffness = 0.5 * relaxation_rate, (speed / home_range) ** 2
    # real below and above critical damping: cosine and sine of a real or an imaginary angle
    frequency = torch.sqrt(torch.complex(stiffness - half**2, torch.zeros_like(half)))
    angle = frequency * duration
    decay = torch.exp(-half * duration)
    is_small = angle.abs() < 1e-4
    safe = torch.where(is_small, torch.ones_like(angle), angle)
    sine = duration * torch.where(is_small, 1.0 - angle**2 / 6.0, torch.sin(safe) / safe)
    even, odd = (decay * torch.cos(angle)).real, (decay * sine).real
    return even + half * odd, odd, -stiffness * odd, even - half * odd


def _blocks(rows: list[list[Tensor]], block: Tensor) -> Tensor:
    """Matrices [..., 6, 6] whose entries are scalar blocks."""
    scalars = torch.stack([torch.stack(row, -1) for row in rows], -2)
    return (scalars[..., :, None, :, None] * block[:, None, :]).flatten(-4, -3).flatten(-2, -1)
