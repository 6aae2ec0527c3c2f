"""How agents move between detections: a few integrated Ornstein-Uhlenbeck models, of which each agent follows one for a while.

With velocity v and position p of one axis, dv = -v / relaxation dt + noise that keeps the standard deviation of v at `speed`,
and dp = v dt; all integrals in closed form (Särkkä and Solin, "Applied Stochastic Differential Equations", 2019, ch. 6).
"""

from dataclasses import dataclass

import numpy as np

from cadence.arrays import Float64s


@dataclass(frozen=True, eq=False)
class Modes:
    """C ways to move.

    relaxation_s  [C] how long a velocity lasts
    speed_mps     [C] standard deviation of the velocity of an axis
    share         [C] how often a mode is met with, sums to one
    switch_share  an agent takes up a mode anew, by `share`, at this share of its detections
    """

    relaxation_s: Float64s
    speed_mps: Float64s
    share: Float64s
    switch_share: float

    def __post_init__(self) -> None:
        shape = (len(self.share),)
        if self.relaxation_s.shape != shape or self.speed_mps.shape != shape or abs(float(self.share.sum()) - 1.0) > 1e-6:
            raise ValueError("Modes: one relaxation time, speed and share a mode; shares sum to one")

    def __len__(self) -> int:
        return len(self.share)


@dataclass(frozen=True, eq=False)
class Motion:
    """Moments of the way between two moments: p' = p + gain v, v' = decay v, and the noise; each [..., C]."""

    gain: Float64s
    decay: Float64s
    noise_pp: Float64s
    noise_pv: Float64s
    noise_vv: Float64s


def motion(modes: Modes, duration_s: Float64s) -> Motion:
    """Moments over durations [...], one for every mode."""
    x = duration_s[..., None] / modes.relaxation_s
    forgotten = -np.expm1(-x)
    variance = modes.speed_mps**2
    # the closed form cancels for short durations; there the series is exact to the digits that matter
    series = x**3 * (1 / 3 - x * (1 / 4 - x * (7 / 60 - x * (1 / 24 - x * 31 / 2520))))
    closed = x - 2.0 * forgotten - 0.5 * np.expm1(-2.0 * x)
    return Motion(
        gain=modes.relaxation_s * forgotten,
        decay=1.0 - forgotten,
        noise_pp=2.0 * variance * modes.relaxation_s**2 * np.where(x < 0.02, series, closed),
        noise_pv=variance * modes.relaxation_s * forgotten**2,
        noise_vv=-variance * np.expm1(-2.0 * x),
    )
