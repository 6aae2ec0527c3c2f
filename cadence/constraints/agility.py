"""How sharply a target can change its motion: a limit on acceleration, and one on the rate of turn."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from cadence.constraints.smoothing import smoothed
from cadence.constraints.speed import exceeds

_ROUNDING = 1.0 + 1e-6
_LEAST_SHARE = 0.05
_NUM_LEVELS = 24
"""Each level smooths a track over about a fifth more steps than the one before."""


@dataclass(frozen=True)
class Agility:
    """What two consecutive steps may differ by.

    max_bend_m    length of their difference: acceleration times the square of a step's time; None: any
    max_turn_rad  angle between them; None: any
    least_m       shorter steps have no direction
    longest_m     how long a step may be, of all or each track's [K, 1], which smoothing brings about as well; None: any
    """

    max_bend_m: float | None = None
    max_turn_rad: float | None = None
    least_m: float = 0.0
    longest_m: float | Tensor | None = None

    @classmethod
    def stated(
        cls,
        acceleration_mps2: float | None,
        turn_rate_dps: float | None,
        longest_m: float | Tensor | None,
        step_s: float,
        length_m: float,
    ) -> "Agility":
        """Limits as people state them, on steps of `step_s`; one of under a twentieth of `length_m` has no direction."""
        bend_m = None if acceleration_mps2 is None else acceleration_mps2 * step_s**2
        turn_rad = None if turn_rate_dps is None else math.radians(turn_rate_dps) * step_s
        return cls(bend_m, turn_rad, _LEAST_SHARE * length_m, longest_m)

    @property
    def is_limited(self) -> bool:
        """Whether there is a limit beside the speed."""
        return self.max_bend_m is not None or self.max_turn_rad is not None

    def exceeds(self, position_m: Tensor) -> Tensor:
        """Which tracks [..., T, 2] exceed a limit somewhere [...]; a rounding error does not."""
        step = position_m.diff(dim=-2)
        is_over = torch.zeros(position_m.shape[:-2], dtype=torch.bool)
        if self.longest_m is not None:
            is_over = is_over | exceeds(position_m, self.longest_m)
        if self.max_bend_m is not None:
            is_over = is_over | (step.diff(dim=-2).norm(dim=-1) > self.max_bend_m * _ROUNDING).any(-1)
        if self.max_turn_rad is not None:
            is_over = is_over | (turns(position_m, self.least_m) > self.max_turn_rad * _ROUNDING).any(-1)
        return is_over


def turns(position_m: Tensor, least_m: float) -> Tensor:
    """Angle [..., T - 2] in radians between consecutive steps of tracks [..., T, 2]; 0 where one is shorter than `least_m`."""
    step = position_m.diff(dim=-2)
    before, after = step[..., :-1, :], step[..., 1:, :]
    cross = before[..., 0] * after[..., 1] - before[..., 1] * after[..., 0]
    angle = torch.atan2(cross.abs(), (before * after).sum(-1))
    length = step.norm(dim=-1)
    has_direction = torch.minimum(length[..., :-1], length[..., 1:]) > least_m
    return torch.where(has_direction, angle, 0.0)


def calmed(position_m: Tensor, sigma_m: Tensor, agility: Agility) -> Tensor:
    """Tracks [R, K, T, 2] smoothed as little as keeps the limits; those within them, or that none saves, are as they were.

    Args:
        position_m: the tracks, float64.
        sigma_m: [R, T] how far off a step may be: detections hold a track, where nobody looked it gives way.
        agility: the limits.
    """
    is_over = agility.exceeds(position_m)
    out = position_m
    bend_m = position_m.diff(n=2, dim=2).norm(dim=-1).amax(dim=(1, 2))
    for level in range(1, _NUM_LEVELS):
        rows = is_over.any(1)
        if not bool(rows.any()):
            break
        shrink = math.exp(-0.36 * level)  # the curve bends over (sigma / bend)^1/2 steps
        calm = smoothed(position_m[rows], sigma_m[rows], shrink * bend_m[rows])
        is_saved = is_over[rows] & ~agility.exceeds(calm)
        if bool(is_saved.any()):
            out = out.clone() if out is position_m else out
            out[rows] = torch.where(is_saved[..., None, None], calm, out[rows])
            is_over = is_over.clone()
            is_over[rows] &= ~is_saved
    return out
