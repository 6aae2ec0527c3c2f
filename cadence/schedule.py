"""Noise schedules and the three parameterisations.

A noise level is an angle: a noisy trajectory is cos(angle) times the clean one plus sin(angle) times noise, so that the
variance is preserved. The paper's discrete cosine schedule (Nichol, Dhariwal, 2021) is a list of such angles.
"""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

Prediction = Literal["epsilon", "x0", "v"]
"""What a network answers: the noise, the clean trajectory, or the velocity cos(angle) noise - sin(angle) clean."""

MAX_ANGLE = 0.5 * math.pi


@dataclass(frozen=True, eq=False)
class Schedule:
    """Angles [S] of the sampling steps, from little noise (index 0) to nearly pure noise."""

    angle: Tensor

    def __len__(self) -> int:
        return len(self.angle)

    @property
    def alpha_bar(self) -> Tensor:
        """The share of variance that is signal, [S]: DDPM's cumulative product."""
        return torch.cos(self.angle) ** 2


def cosine_schedule(num_steps: int = 100, offset: float = 0.008) -> Schedule:
    """The cosine schedule with betas clipped at 0.999 (Nichol, Dhariwal, equation 17)."""
    at = torch.arange(num_steps + 1, dtype=torch.float64) / num_steps
    level = torch.cos((at + offset) / (1.0 + offset) * MAX_ANGLE) ** 2
    beta = (1.0 - level[1:] / level[:-1]).clamp(0.0, 0.999)
    return Schedule(torch.acos(torch.cumprod(1.0 - beta, 0).sqrt()))


def clean_from(prediction: Prediction, answer: Tensor, noisy: Tensor, angle: Tensor) -> Tensor:
    """The clean estimate that a network's answer means; `angle` broadcasts against the trajectories."""
    if prediction == "x0":
        return answer
    if prediction == "v":
        return torch.cos(angle) * noisy - torch.sin(angle) * answer
    return (noisy - torch.sin(angle) * answer) / torch.cos(angle).clamp_min(1e-4)


def target_of(prediction: Prediction, clean: Tensor, noise: Tensor, angle: Tensor) -> Tensor:
    """What the network should answer for a clean trajectory and its noise."""
    if prediction == "x0":
        return clean
    if prediction == "v":
        return torch.cos(angle) * noise - torch.sin(angle) * clean
    return noise


def noise_from(clean: Tensor, noisy: Tensor, angle: Tensor) -> Tensor:
    """The noise that, with this clean estimate, makes the noisy trajectory."""
    return (noisy - torch.cos(angle) * clean) / torch.sin(angle).clamp_min(1e-4)
