"""The times of a mission hypothesis, in stretches within which a target keeps its model of motion."""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Timeline:
    """T steps at which tracks are drawn, and where one stretch ends and the next begins.

    time_s  [T] float64, increasing
    first   [J] int64, ascending: the first step of each stretch; the first one is 0
    step_s  seconds of the unit in which models of motion are stated: the usual step
    """

    time_s: Tensor
    first: Tensor
    step_s: float

    def __post_init__(self) -> None:
        if self.time_s.ndim != 1 or len(self.time_s) == 0 or bool((self.time_s.diff() <= 0).any()):
            raise ValueError("Timeline.time_s must be [T] and increase")
        is_ascending = bool((self.first.diff() > 0).all()) and int(self.first[0]) == 0
        if not is_ascending or int(self.first[-1]) >= len(self.time_s):
            raise ValueError("Timeline.first must ascend from 0 and lie among the steps")

    @property
    def num_stretches(self) -> int:
        """Number of stretches J."""
        return len(self.first)

    @property
    def begin_s(self) -> Tensor:
        """When each stretch begins [J]: at its first step."""
        return self.time_s[self.first]

    def steps(self, stretch: int) -> tuple[int, int]:
        """First step of a stretch, and the one behind its last."""
        last = stretch + 1 == self.num_stretches
        return int(self.first[stretch]), len(self.time_s) if last else int(self.first[stretch + 1])

    def stretch_of(self, time_s: Tensor) -> Tensor:
        """The stretch in which times lie; those before the first step belong to the first one."""
        return (torch.searchsorted(self.begin_s, time_s.contiguous(), right=True) - 1).clamp_min(0)

    def step_before(self, time_s: Tensor) -> Tensor:
        """The time of the last step at or before each time, or of the first one."""
        return self.time_s[(torch.searchsorted(self.time_s, time_s.contiguous(), right=True) - 1).clamp_min(0)]

    def step_after(self, time_s: Tensor) -> Tensor:
        """The time of the first step at or after each time, or of the last one."""
        return self.time_s[torch.searchsorted(self.time_s, time_s.contiguous()).clamp(max=len(self.time_s) - 1)]
