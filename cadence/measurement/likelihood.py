"""Likelihood of stretches of tracks under many processes and noises at once: Kalman filters that share their structure.

Both axes move alike, so that one filter of position, velocity and acceleration serves them. Noise along the course (detections
that come too early or too late) differs from that across it, so that covariances are kept in the target's own axes; that these
turn from one detection to the next changes them little and is left out.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from cadence.arrays import Bools, Float64s
from cadence.measurement.processes import Processes, Transitions, transitions

_BLOCK: Final = 16384
"""Numbers that are worked on at once: what a filter holds of them stays in the processor's cache."""
_SPEEDS: Final = 3.0
"""The first velocity of a stretch is free: so many times the root mean square velocity."""


@dataclass(frozen=True, eq=False)
class Stretches:
    """S stretches of N detections; times in typical gaps, lengths in a unit of their own, speeds in their root mean square.

    time, is_seen     [S, N] the last time is repeated where there are fewer
    position, course  [S, N, 2] course of length one
    speed2, doubt2    [S, N] square of the speed, and what noise of one unit adds to it
    velocity          root mean square of one axis, units a gap
    """

    time: Float64s
    is_seen: Bools
    position: Float64s
    course: Float64s
    speed2: Float64s
    doubt2: Float64s
    velocity: float

    def __getitem__(self, chosen: slice) -> "Stretches":
        """Some of them."""
        return Stretches(
            self.time[chosen], self.is_seen[chosen], self.position[chosen], self.course[chosen], self.speed2[chosen],
            self.doubt2[chosen], self.velocity,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _State:
    """Mean [2, ...] in fixed axes and covariances [2, ...] along and across the course, of position and velocity."""

    x: Float64s
    v: Float64s
    xx: Float64s
    xv: Float64s
    vv: Float64s


@dataclass(frozen=True, eq=False)
class _Turning(_State):
    """The same with an acceleration."""

    a: Float64s
    xa: Float64s
    va: Float64s
    aa: Float64s


def log_likelihoods(stretches: Stretches, sigma: Float64s, along: Float64s, processes: Processes) -> Float64s:
    """Log likelihood [S, G, M] of each stretch under G noises and M processes.

    Args:
        stretches: the detections.
        sigma: [G] standard deviation of an axis.
        along: [G] what errors in time add along the course at the typical speed.
        processes: the ways to move.
    """
    steps = transitions(np.diff(stretches.time, axis=1))
    found = np.empty((len(stretches.time), len(sigma), len(processes)))
    for group in (np.flatnonzero(processes.has_acceleration == 0), np.flatnonzero(processes.has_acceleration)):
        some = processes[group]
        of_some = Transitions(*(value[:, :, None, some.family] for value in steps))
        size = max(1, _BLOCK // max(1, 2 * len(stretches.time) * len(some)))
        for begin in range(0, len(sigma) if len(some) else 0, size):
            part = slice(begin, begin + size)
            found[:, part, group] = _of_alike(stretches, sigma[part], along[part], some, of_some)
    return found


def _of_alike(stretches: Stretches, sigma: Float64s, along: Float64s, processes: Processes, steps: Transitions) -> Float64s:
    """`log_likelihoods` of few noises, under processes of which all or none have an acceleration; steps [S, N - 1, 1, M]."""
    shape = (2, len(stretches.time), len(sigma), len(processes))
    noise = _noise(stretches, sigma, along)
    zero = np.zeros(shape)
    state = _State(zero, zero, zero + noise[:, :, 0], zero, zero + (_SPEEDS * stretches.velocity) ** 2)
    if processes.has_acceleration.any():
        state = _Turning(**vars(state), a=zero, xa=zero, va=zero, aa=zero + processes.variance)
    found = np.zeros(shape[1:])
    for number in range(1, stretches.time.shape[1]):
        state = _predicted(state, Transitions(*(value[:, number - 1] for value in steps)), processes.variance)
        course = stretches.course[:, number].T[..., None, None]
        offset = _turned(stretches.position[:, number].T[..., None, None] - state.x, course)
        variance = state.xx + noise[:, :, number]
        gained = -0.5 * (offset**2 / variance + np.log(variance)).sum(0)
        found += np.where(stretches.is_seen[:, number][:, None, None], gained, 0.0)
        state = _updated(state, offset / variance, variance, course)
    return found


def _noise(stretches: Stretches, sigma: Float64s, along: Float64s) -> Float64s:
    """Variance of the detections [2, S, N, G, 1]: along and across. What noise adds to a speed is no speed."""
    speed2 = np.maximum(stretches.speed2[..., None] - sigma**2 * stretches.doubt2[..., None], 0.0)
    across = np.broadcast_to(sigma**2, speed2.shape)
    return np.stack([across + along**2 * speed2, across])[..., None]


def _turned(vector: Float64s, course: Float64s) -> Float64s:
    """A vector in fixed axes as one along and across the course; the same again turns it back."""
    (east, north), (x, y) = course, vector
    return np.stack([east * x + north * y, north * x - east * y])


def _predicted(s: _State, to: Transitions, variance: Float64s) -> _State:
    if not isinstance(s, _Turning):
        xv = s.xv + to.x_of_v * s.vv
        return _State(
            x=s.x + to.x_of_v * s.v,
            v=to.v_of_v * s.v,
            xx=s.xx + to.x_of_v * s.xv + to.x_of_v * xv + to.xx * variance,
            xv=to.v_of_v * xv + to.xv * variance,
            vv=to.v_of_v * (to.v_of_v * s.vv) + to.vv * variance,
        )
    xx, xv = s.xx + to.x_of_v * s.xv + to.x_of_a * s.xa, s.xv + to.x_of_v * s.vv + to.x_of_a * s.va
    xa = s.xa + to.x_of_v * s.va + to.x_of_a * s.aa
    vv, va = to.v_of_v * s.vv + to.v_of_a * s.va, to.v_of_v * s.va + to.v_of_a * s.aa
    return _Turning(
        x=s.x + to.x_of_v * s.v + to.x_of_a * s.a,
        v=to.v_of_v * s.v + to.v_of_a * s.a,
        a=to.a_of_a * s.a,
        xx=xx + to.x_of_v * xv + to.x_of_a * xa + to.xx * variance,
        xv=to.v_of_v * xv + to.v_of_a * xa + to.xv * variance,
        xa=to.a_of_a * xa + to.xa * variance,
        vv=to.v_of_v * vv + to.v_of_a * va + to.vv * variance,
        va=to.a_of_a * va + to.va * variance,
        aa=to.a_of_a**2 * s.aa + to.aa * variance,
    )


def _updated(s: _State, weighed: Float64s, variance: Float64s, course: Float64s) -> _State:
    of_x, of_v = s.xx / variance, s.xv / variance
    moved = _State(
        x=s.x + _turned(s.xx * weighed, course),
        v=s.v + _turned(s.xv * weighed, course),
        xx=s.xx - of_x * s.xx,
        xv=s.xv - of_x * s.xv,
        vv=s.vv - of_v * s.xv,
    )
    if not isinstance(s, _Turning):
        return moved
    return _Turning(
        **vars(moved),
        a=s.a + _turned(s.xa * weighed, course),
        xa=s.xa - of_x * s.xa,
        va=s.va - of_v * s.xa,
        aa=s.aa - s.xa * s.xa / variance,
    )
