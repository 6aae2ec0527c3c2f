"""Ways to change height, as one linear stochastic differential equation.

Height z and vertical rate v follow

    dz = v dt + dW,    dv = -relaxation_rate v dt + dV

with white noises W of intensity `walk` and V of intensity `diffusion`. Without a rate to begin with this is level flight or a
random walk; without relaxation a climb or descent of constant rate; with it the rate forgets (integrated Ornstein-Uhlenbeck;
Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and Navigation", ch. 6). A mode that keeps about a level
of its own has v = -relaxation_rate (z - level), so that a noise of intensity `home` drives z and, with that factor, v as well.
Everything is closed form, so that detections may lie at any times.
"""

import itertools
from dataclasses import dataclass
from typing import Final

import torch
from torch import Tensor

_SMALL: Final = 0.02
"""Below this share of the relaxation time the closed form of the noise cancels; its series is exact to 1e-9 there."""
_LEVEL_ENDS, _CLIMB_ENDS, _FORGETS_ENDS, _HOME_ENDS = 1.0 / 32.0, 3.0 / 16.0, 1.0 / 16.0, 1.0 / 160.0
"""How often modes end, per step: climbs of constant rate soonest, as otherwise they would leave the sky."""


@dataclass(frozen=True, eq=False)
class Modes:
    """C modes, float64 tensors [C] in consistent units (seconds and metres, or steps and step lengths).

    relaxation_rate  1/s, zero where the rate is kept
    diffusion        m^2/s^3: intensity of the acceleration noise
    initial_rate     m/s: standard deviation of the vertical rate with which a mode begins
    walk             m^2/s: intensity of the noise of height itself
    home             m^2/s: the same where height is drawn back to a level
    end_rate         1/s: how often the mode ends
    """

    relaxation_rate: Tensor
    diffusion: Tensor
    initial_rate: Tensor
    walk: Tensor
    home: Tensor
    end_rate: Tensor

    def __post_init__(self) -> None:
        shapes = {tuple(value.shape) for value in vars(self).values()}
        if len(shapes) != 1 or self.relaxation_rate.ndim != 1:
            raise ValueError(f"Modes: parameters must share one shape [C], got {sorted(shapes)}")

    def __len__(self) -> int:
        return len(self.relaxation_rate)

    def scaled(self, step_s: float, rate_mps: float) -> "Modes":
        """The same modes brought from units of steps and step lengths (rate times step) to seconds and metres."""
        return Modes(
            self.relaxation_rate / step_s,
            self.diffusion * rate_mps**2 / step_s,
            self.initial_rate * rate_mps,
            self.walk * rate_mps**2 * step_s,
            self.home * rate_mps**2 * step_s,
            self.end_rate / step_s,
        )


@dataclass(frozen=True, eq=False)
class Steps:
    """What a duration does to height and rate: z' = z + gain v, v' = keep v, and the covariance of the noise; one shape all."""

    gain: Tensor
    keep: Tensor
    noise_zz: Tensor
    noise_zv: Tensor
    noise_vv: Tensor

    def of_mode(self, mode: Tensor) -> "Steps":
        """Of steps [R, C] those of the modes [R, K] that are at work."""
        return Steps(*(value.gather(1, mode) for value in vars(self).values()))


def default_modes() -> tuple[Modes, Tensor]:
    """The shipped modes in units of steps and step lengths, and prior weights [C]: wide, so that any log finds its own."""
    sizes = ((0.3, 1.0), (1.0, 0.5), (2.5, 0.1))
    rows: list[tuple[float, ...]] = []
    rows += [(0, 0, 0, size**2, 0, _LEVEL_ENDS, prior) for size, prior in ((0.0, 4), (0.01, 2), (0.05, 2))]
    rows += [(0, 0, 0, size**2, 0, _LEVEL_ENDS, prior) for size, prior in ((0.2, 4), (0.6, 2), (1.8, 1))]
    for diffusion, (size, prior) in itertools.product((0.0, 1e-3, 3e-2), sizes):
        rows.append((0, diffusion, size, 0, 0, _CLIMB_ENDS, prior))
    for time, (size, prior) in itertools.product((1.0, 4.0, 16.0), sizes):
        rows.append((1 / time, 2 * size**2 / time, size, 0, 0, _FORGETS_ENDS, prior))
    for time, size in itertools.product((4.0, 16.0), (1.0, 3.0, 9.0)):
        rows.append((1 / time, 0, size / time, 0, 2 * size**2 / time, _HOME_ENDS, 1))
    *columns, prior_weight = torch.tensor(rows, dtype=torch.float64).unbind(-1)
    return Modes(*columns), prior_weight / prior_weight.sum()


def steps(modes: Modes, duration: Tensor) -> Steps:
    """What every mode does over durations [R]: values [R, C]."""
    rate, time = modes.relaxation_rate, duration[:, None]
    x = rate * time
    is_small = x < _SMALL
    safe = torch.where(is_small, torch.ones_like(x), rate)
    keep = torch.exp(-x)
    gain = torch.where(is_small, time * (1.0 - x / 2 * (1.0 - x / 3 * (1.0 - x / 4))), (1.0 - keep) / safe)
    # the integrals of exp(-2 rate t) and of the squared response of height to a kick
    twice = torch.where(is_small, time * (1.0 - x * (1.0 - x * 2 / 3 * (1.0 - x / 2))), (1.0 - keep**2) / (2.0 * safe))
    series = time**3 / 3 * (1.0 - x * 3 / 4 * (1.0 - x * 7 / 15 * (1.0 - x * 5 / 14)))
    both = torch.where(is_small, series, (time - 2.0 * gain + twice) / safe**2)
    home = modes.home * twice
    return Steps(
        gain,
        keep,
        modes.diffusion * both + modes.walk * time + home,
        modes.diffusion * 0.5 * gain**2 - rate * home,
        modes.diffusion * twice + rate**2 * home,
    )
