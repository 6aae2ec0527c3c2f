"""Step lengths of tracks, and the cost of moving faster than the target can."""

from dataclasses import dataclass

import torch
from torch import Tensor


def step_lengths(position_m: Tensor) -> Tensor:
    """Distance between consecutive steps [..., T-1] in metres, of tracks [..., T, 2]."""
    length: Tensor = torch.linalg.vector_norm(position_m[..., 1:, :] - position_m[..., :-1, :], dim=-1)
    return length


@dataclass(frozen=True)
class SpeedConstraint:
    """Stay at or below a maximum speed: a quarter of half the squared hinge of (step length - longest step), summed.

    A hinge, not the paper's mean step length, which is smallest for a track that does not move. The quarter makes
    a unit descent step stable: every step pulls on two positions, and every position is pulled by two steps.
    """

    max_speed_mps: float
    step_s: float

    def __post_init__(self) -> None:
        if not self.max_speed_mps > 0 or not self.step_s > 0:
            raise ValueError(f"SpeedConstraint needs speed and step above zero, got {self.max_speed_mps} and {self.step_s}")

    def cost(self, position_m: Tensor) -> Tensor:
        """Cost [...] in m² of tracks position_m [..., T, 2]; differentiable."""
        return 0.125 * self._excess(step_lengths(position_m)).square().sum(dim=-1)

    def gradient(self, position_m: Tensor) -> Tensor:
        """Analytic gradient of `cost`, like position_m, in metres; zero (not NaN) where a step has no length."""
        step = position_m[..., 1:, :] - position_m[..., :-1, :]
        length = torch.linalg.vector_norm(step, dim=-1)
        # Only steps longer than the maximum, hence longer than zero, have a pull.
        pull = 0.25 * self._excess(length) / length.clamp_min(torch.finfo(length.dtype).tiny)
        pull = pull[..., None] * step
        pad = torch.zeros_like(position_m[..., :1, :])
        return torch.cat([pad, pull], dim=-2) - torch.cat([pull, pad], dim=-2)

    def _excess(self, length: Tensor) -> Tensor:
        return (length - self.max_speed_mps * self.step_s).clamp_min(0)
