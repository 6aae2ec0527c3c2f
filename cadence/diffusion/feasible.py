"""Constraints on hypotheses: guidance of clean estimates while sampling, repair and weights at the end."""

import math
from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor

from cadence.constraints import Constraint
from cadence.constraints.agility import Agility, calmed
from cadence.constraints.limits import KeepOut, within_limits
from cadence.constraints.motion import SpeedConstraint
from cadence.constraints.obstacles import ObstacleConstraint, Obstacles
from cadence.constraints.speed import exceeds
from cadence.diffusion.guidance import clean_estimate_guidance
from cadence.diffusion.settings import GuidanceConfig
from cadence.resampling import systematic
from cadence.types import WindowBatch

_PINNED_SHARE = 0.05
_HELD_SHARE = 0.5
"""Steps that the bank knows to within so many step lengths stay where they are when a track is slowed down."""

_MOST_SIGMAS = 3.0
"""A track that was smoothed still passes a detection within so many of them."""

_CALMING_ROUNDS = 3
"""A way round an obstacle has corners, and a corner that is smoothed may touch the obstacle: in turns."""

_HURRIES = 1.3
"""A way round an obstacle makes steps longer. Tracks up to so many times as fast as is plausible are kept nevertheless: with
others drawn in their place (8 % of all) the 90 % regions of twelve patrols held 5 % less of the truth."""

_LEAST_WEIGHT = 1e-3


@dataclass(frozen=True, eq=False)
class Feasibility:
    """What hypotheses must obey.

    keep_out       what is in the way; its obstacles may be none
    step_s         of the grid
    max_speed_mps  that is stated, None for no limit
    plausible_mps  [K] top speed of each hypothesis, as the log's own detections let one believe; tracks keep it, but are not
                   guided by it
    max_acceleration_mps2, max_turn_rate_dps  that are stated, None for no limit; tracks are smoothed until they keep them
    num_steps      of guidance on each clean estimate
    """

    keep_out: KeepOut
    step_s: float
    max_speed_mps: float | None = None
    plausible_mps: Tensor | None = None
    max_acceleration_mps2: float | None = None
    max_turn_rate_dps: float | None = None
    num_steps: int = 3

    @classmethod
    def of(cls, windows: WindowBatch, config: GuidanceConfig, plausible_mps: Tensor | None = None) -> Self:
        """What the active agents of windows, one a row, must obey; without a context there are no obstacles."""
        context = windows.context
        datum_m = torch.zeros(windows.num_windows, 2, dtype=torch.float64) if context is None else context.datum_m
        offset_m = datum_m[windows.is_active.nonzero()[:, 0], None, None]
        if config.mode == "none":
            return cls(KeepOut(Obstacles.none(), 0.0, offset_m), windows.step_s)
        obstacles = Obstacles.none() if context is None else context.obstacles
        keep_out = KeepOut(obstacles, config.margin_m, offset_m)
        agility = config.max_acceleration_mps2, config.max_turn_rate_dps
        return cls(keep_out, windows.step_s, config.max_speed_mps, plausible_mps, *agility)

    @property
    def is_stated(self) -> bool:
        """Whether there is anything to be guided by."""
        return self.keep_out.obstacles.count > 0 or self.max_speed_mps is not None

    @property
    def longest_m(self) -> float | Tensor | None:
        """How long a step may be, of all hypotheses or of each [K, 1]."""
        if self.plausible_mps is not None:
            most_mps = math.inf if self.max_speed_mps is None else self.max_speed_mps
            return self.plausible_mps.clamp(max=most_mps)[:, None] * self.step_s
        return None if self.max_speed_mps is None else self.max_speed_mps * self.step_s

    def guide(self, position_m: Tensor, sigma_m: Tensor, rows: slice) -> Tensor:
        """Clean estimates [R', K, T, 2] moved towards the feasible, as far as the bank is uncertain there."""
        constraints: list[Constraint] = []
        keep_out = self.keep_out
        if keep_out.obstacles.count:
            constraints.append(ObstacleConstraint(keep_out.obstacles, keep_out.margin_m, keep_out.offset_m[rows]))
        if self.max_speed_mps is not None:
            constraints.append(SpeedConstraint(self.max_speed_mps, self.step_s))
        return clean_estimate_guidance(position_m, constraints, sigma_m[:, None, :, None], self.num_steps)

    def finish(self, position_m: Tensor, sigma_m: Tensor, length_m: float) -> tuple[Tensor, Tensor, Tensor]:
        """Hypotheses [R, K, T, 2] as they may be: no step too long, no segment through an obstacle.

        Steps that the detections pin (bank sigma under a twentieth of a step length) stay exactly.

        Returns:
            Positions, weight of each hypothesis of a row [R, K] — one that had to be moved by many sigmas counts
            less — and which of them are to be kept [R, K]: those within all stated limits and not much faster than is
            plausible, or where there are none in a row, those within the stated ones; none at all where every one breaks these.
        """
        agility = self._agility(length_m)
        if not self.keep_out.obstacles.count and self.longest_m is None and not agility.is_limited:
            even = torch.full(position_m.shape[:2], 1.0 / position_m.shape[1], dtype=torch.float64)
            return position_m, even, torch.ones_like(even, dtype=torch.bool)
        moved, is_feasible = self._within_limits(position_m, sigma_m, length_m, agility)
        if self.plausible_mps is not None:
            is_plausible = is_feasible & ~exceeds(moved, _HURRIES * float(self.plausible_mps.max()) * self.step_s)
            is_feasible = torch.where(is_plausible.any(1, keepdim=True), is_plausible, is_feasible)
        shift = (moved - position_m).norm(dim=-1) / (sigma_m[:, None] + _PINNED_SHARE * length_m)
        log_weight = -0.5 * (shift**2).mean(-1)
        weight = torch.where(is_feasible, torch.exp(log_weight - log_weight.amax(1, keepdim=True)), 0.0).clamp_min(
            _LEAST_WEIGHT
        )
        return moved, weight / weight.sum(1, keepdim=True), is_feasible

    def _agility(self, length_m: float) -> Agility:
        limits = self.max_acceleration_mps2, self.max_turn_rate_dps, self.longest_m
        return Agility.stated(*limits, self.step_s, length_m)

    def _within_limits(self, position_m: Tensor, sigma_m: Tensor, length_m: float, agility: Agility) -> tuple[Tensor, Tensor]:
        is_pinned = (sigma_m <= _PINNED_SHARE * length_m)[:, None].expand(position_m.shape[:3])
        is_held = (sigma_m <= _HELD_SHARE * length_m) | (sigma_m == sigma_m.amin(dim=1, keepdim=True))
        held = is_held[:, None].expand(position_m.shape[:3])
        moved, is_feasible = within_limits(position_m, self.keep_out, is_pinned, self.longest_m, held)
        for _ in range(_CALMING_ROUNDS if agility.is_limited else 0):
            moved = calmed(moved, sigma_m, agility)
            moved, is_feasible = within_limits(moved, self.keep_out, is_pinned, self.longest_m, held)
            if not bool((agility.exceeds(moved) | ~is_feasible).any()):
                break
        if self.max_speed_mps is not None:
            is_feasible = is_feasible & ~exceeds(moved, self.max_speed_mps * self.step_s)
        if agility.is_limited:
            is_near = (moved - position_m).norm(dim=-1) <= _MOST_SIGMAS * sigma_m[:, None] + _PINNED_SHARE * length_m
            is_calm = ~replace(agility, longest_m=None).exceeds(moved)  # what is only faster than plausible may be kept
            is_feasible = is_feasible & is_calm & (is_near | ~held).all(-1)
        return moved, is_feasible


def redrawn(position_m: Tensor, weight: Tensor, is_kept: Tensor, seeds: Tensor, are_all: bool = False) -> tuple[Tensor, Tensor]:
    """Hypotheses [R, K, T, 2], those that are not kept drawn again from those of their row that are; rows without any stay.

    Args:
        position_m: the hypotheses.
        weight: [R, K] their chances to be drawn.
        is_kept: [R, K] which may be.
        seeds: [R] of the draws.
        are_all: draw all rows anew by weight, not only those that need it.

    Returns:
        The hypotheses, and which rows were drawn anew and count evenly since [R].
    """
    is_hopeless = ~is_kept.any(1)
    chance = torch.where(is_kept | is_hopeless[:, None], weight, 0.0)
    is_redrawn = torch.ones_like(is_hopeless) if are_all else ~is_kept.all(1) & ~is_hopeless
    out = position_m.clone()
    chance = chance[is_redrawn] / chance[is_redrawn].sum(1, keepdim=True)
    out[is_redrawn] = resampled(position_m[is_redrawn], chance, seeds[is_redrawn])
    return out, is_redrawn


def resampled(position_m: Tensor, weight: Tensor, seeds: Tensor, num_hypotheses: int | None = None) -> Tensor:
    """Rows [R, K, T, 2] drawn again by their weights [R, K] (systematic), so that all count the same; `num_hypotheses` of each.

    For several independent agents: each has weights of its own, but a joint hypothesis has only one.
    """
    num = num_hypotheses or weight.shape[1]
    out = position_m[:, :num].clone()
    for row, seed in enumerate(seeds.tolist()):
        if num != weight.shape[1] or float(weight[row].max() - weight[row].min()) > 1e-9:
            generator = torch.Generator().manual_seed(seed)
            uniform = torch.rand(1, generator=generator, dtype=torch.float64).item()
            pick = torch.from_numpy(systematic(weight[row].numpy(), num, uniform))
            out[row] = position_m[row, pick[torch.randperm(num, generator=generator)]]
    return out
