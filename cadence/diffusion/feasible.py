"""Constraints on hypotheses: guidance of clean estimates while sampling, repair and weights at the end."""

from dataclasses import dataclass
from typing import Literal, Self

import torch
from torch import Tensor

from cadence.constraints import Constraint
from cadence.constraints.motion import SpeedConstraint
from cadence.constraints.obstacles import ObstacleConstraint, Obstacles
from cadence.constraints.repair import repair
from cadence.diffusion.guidance import clean_estimate_guidance
from cadence.resampling import systematic
from cadence.types import WindowBatch

_PINNED_SHARE = 0.05
_LEAST_WEIGHT = 1e-3


@dataclass(frozen=True)
class GuidanceConfig:
    """How constraints act on hypotheses.

    mode           "clean" guides while sampling and repairs at the end; "repair" only repairs; "none" ignores constraints;
                   of the scene preset only "none" counts (infer.scene says how it guides), and the paper preset has infer.paper
    margin_m       distance to keep from obstacles
    max_speed_mps  a speed that the target cannot exceed; None = no limit
    """

    mode: Literal["clean", "repair", "none"] = "clean"
    margin_m: float = 0.0
    max_speed_mps: float | None = None

    def __post_init__(self) -> None:
        if self.margin_m < 0 or (self.max_speed_mps is not None and not self.max_speed_mps > 0):
            raise ValueError("margin_m must not be negative, max_speed_mps must be positive")


@dataclass(frozen=True, eq=False)
class Feasibility:
    """What hypotheses must obey, for R rows whose datum is `offset_m` [R, 1, 1, 2] in the obstacles' frame.

    obstacles      may be empty
    margin_m       kept from them
    max_speed_mps  None for no limit
    step_s         of the grid
    num_steps      of guidance on each clean estimate
    """

    obstacles: Obstacles
    margin_m: float
    max_speed_mps: float | None
    step_s: float
    offset_m: Tensor
    num_steps: int = 3

    @classmethod
    def of(cls, windows: WindowBatch, config: GuidanceConfig) -> Self:
        """What the active agents of windows, one a row, must obey; without a context there are no obstacles."""
        window = windows.is_active.nonzero()[:, 0]
        context = windows.context
        datum_m = torch.zeros(windows.num_windows, 2, dtype=torch.float64) if context is None else context.datum_m
        obstacles = Obstacles.none() if context is None else context.obstacles
        offset_m = datum_m[window, None, None]
        return cls(obstacles, config.margin_m, config.max_speed_mps, windows.step_s, offset_m)

    @property
    def is_limited(self) -> bool:
        """Whether there is anything to obey."""
        return self.obstacles.count > 0 or self.max_speed_mps is not None

    def guide(self, position_m: Tensor, sigma_m: Tensor, rows: slice) -> Tensor:
        """Clean estimates [R', K, T, 2] moved towards the feasible, as far as the bank is uncertain there."""
        constraints: list[Constraint] = []
        if self.obstacles.count:
            constraints.append(ObstacleConstraint(self.obstacles, self.margin_m, self.offset_m[rows]))
        if self.max_speed_mps is not None:
            constraints.append(SpeedConstraint(self.max_speed_mps, self.step_s))
        return clean_estimate_guidance(position_m, constraints, sigma_m[:, None, :, None], self.num_steps)

    def finish(self, position_m: Tensor, sigma_m: Tensor, length_m: float) -> tuple[Tensor, Tensor, Tensor]:
        """Final repair of hypotheses [R, K, T, 2].

        Steps that the detections pin (bank sigma under a twentieth of a step length) stay exactly.

        Returns:
            Positions, weight of each hypothesis of a row [R, K] — one that had to be moved by many sigmas counts
            less — and whether it is free of collisions [R, K].
        """
        if not self.obstacles.count:
            even = torch.full(position_m.shape[:2], 1.0 / position_m.shape[1], dtype=torch.float64)
            return position_m, even, torch.ones_like(even, dtype=torch.bool)
        is_pinned = (sigma_m <= _PINNED_SHARE * length_m)[:, None].expand(position_m.shape[:3])
        moved, is_feasible = repair(position_m, self.obstacles, is_pinned, self.margin_m, offset_m=self.offset_m)
        shift = (moved - position_m).norm(dim=-1) / (sigma_m[:, None] + _PINNED_SHARE * length_m)
        log_weight = -0.5 * (shift**2).mean(-1)
        weight = torch.where(is_feasible, torch.exp(log_weight - log_weight.amax(1, keepdim=True)), 0.0).clamp_min(
            _LEAST_WEIGHT
        )
        return moved, weight / weight.sum(1, keepdim=True), is_feasible


def resampled(position_m: Tensor, weight: Tensor, seeds: Tensor) -> Tensor:
    """Rows [R, K, T, 2] drawn again by their weights [R, K] (systematic), so that all count the same.

    For several independent agents: each has weights of its own, but a joint hypothesis has only one.
    """
    num_hypotheses = weight.shape[1]
    out = position_m.clone()
    for row, seed in enumerate(seeds.tolist()):
        if float(weight[row].max() - weight[row].min()) > 1e-9:
            generator = torch.Generator().manual_seed(seed)
            uniform = torch.rand(1, generator=generator, dtype=torch.float64).item()
            pick = torch.from_numpy(systematic(weight[row].numpy(), num_hypotheses, uniform))
            out[row] = position_m[row, pick[torch.randperm(num_hypotheses, generator=generator)]]
    return out
