"""Ways to move, as processes of one axis: a velocity, or an acceleration, that is forgotten after a while.

Where velocities are forgotten at once a target walks at random; where accelerations last it flies smooth turns. What the noise
of detections is said to be must not depend on which of them it was. Times are in typical gaps between detections.
"""

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from cadence.arrays import Float64s, Int64s

_VELOCITY_LASTS: Final = np.array([0.02, 1.0, 10.0])
_ACCELERATION_LASTS: Final = np.array([3.0, 20.0])
_AMPLITUDES: Final = 2.0 ** np.arange(-9.0, 5.0)
"""Standard deviations of the displacement that nobody could foresee over one gap, in units of length."""
_NUM_NODES: Final = 6


class Transitions(NamedTuple):
    """How position, velocity and acceleration follow from those one gap before: [..., F], F families.

    x_of_v ... a_of_a  entries of the transition matrix; a position stays, but for these
    xx ... aa          covariance of the noise, where what is forgotten has a variance of one
    """

    x_of_v: Float64s
    x_of_a: Float64s
    v_of_v: Float64s
    v_of_a: Float64s
    a_of_a: Float64s
    xx: Float64s
    xv: Float64s
    xa: Float64s
    vv: Float64s
    va: Float64s
    aa: Float64s


@dataclass(frozen=True, eq=False)
class Processes:
    """M processes: the family of each [M], and the variance of what it forgets [M]."""

    family: Int64s
    variance: Float64s

    def __getitem__(self, chosen: Int64s) -> "Processes":
        """Some of them."""
        return Processes(self.family[chosen], self.variance[chosen])

    def __len__(self) -> int:
        return len(self.family)

    @property
    def has_acceleration(self) -> Float64s:
        """One where it is the acceleration that lasts [M], else zero."""
        return np.asarray(self.family >= len(_VELOCITY_LASTS), dtype=np.float64)


def all_processes() -> Processes:
    """Every family with every amplitude."""
    unit = transitions(np.ones(1)).xx[0]
    family, amplitude = np.divmod(np.arange(len(unit) * len(_AMPLITUDES)), len(_AMPLITUDES))
    return Processes(family, _AMPLITUDES[amplitude] ** 2 / unit[family])


def transitions(gap: Float64s) -> Transitions:
    """All families over gaps [...]."""
    velocity, acceleration = _of_velocity(gap[..., None]), _of_acceleration(gap[..., None])
    return Transitions(*(np.concatenate(pair, -1) for pair in zip(velocity, acceleration, strict=True)))


def _of_velocity(gap: Float64s) -> Transitions:
    """Integrated Ornstein-Uhlenbeck velocity."""
    x = gap / _VELOCITY_LASTS
    forgotten = -np.expm1(-x)
    # the closed form cancels for short gaps; there the series is exact to the digits that matter
    series = x**3 * (1 / 3 - x * (1 / 4 - x * (7 / 60 - x * (1 / 24 - x * 31 / 2520))))
    closed = x - 2.0 * forgotten - 0.5 * np.expm1(-2.0 * x)
    none = np.zeros_like(x)
    return Transitions(
        x_of_v=_VELOCITY_LASTS * forgotten, x_of_a=none, v_of_v=1.0 - forgotten, v_of_a=none, a_of_a=none,
        xx=2.0 * _VELOCITY_LASTS**2 * np.where(x < 0.02, series, closed), xv=_VELOCITY_LASTS * forgotten**2, xa=none,
        vv=-np.expm1(-2.0 * x), va=none, aa=none,
    )  # fmt: skip


def _of_acceleration(gap: Float64s) -> Transitions:
    """Twice integrated Ornstein-Uhlenbeck acceleration (Singer 1970); the integrals of its noise by Gauss's rule."""
    node, weight = np.polynomial.legendre.leggauss(_NUM_NODES)
    to_x, to_v, to_a = _after(0.5 * (node + 1.0) * gap)
    weight = weight * gap  # half the gap for the rule, twice for the noise of a variance of one
    xx, xv, xa, vv, va, aa = (
        np.einsum("...nf,...n->...f", one * other, weight) / _ACCELERATION_LASTS
        for one, other in ((to_x, to_x), (to_x, to_v), (to_x, to_a), (to_v, to_v), (to_v, to_a), (to_a, to_a))
    )
    of_a = _after(gap)
    x_of_a, v_of_a, a_of_a = (np.asarray(value[..., 0, :]) for value in of_a)
    one = np.ones_like(x_of_a)
    return Transitions(gap * one, x_of_a, one, v_of_a, a_of_a, xx, xv, xa, vv, va, aa)


def _after(time: Float64s) -> tuple[Float64s, Float64s, Float64s]:
    """What an acceleration of one makes of position, velocity and itself after times [..., N]: each [..., N, F]."""
    x = time[..., None] / _ACCELERATION_LASTS
    forgotten = -np.expm1(-x)
    moved = np.where(x < 1e-2, x**2 * (1 / 2 - x * (1 / 6 - x / 24)), x - forgotten)
    return _ACCELERATION_LASTS**2 * moved, _ACCELERATION_LASTS * forgotten, 1.0 - forgotten
