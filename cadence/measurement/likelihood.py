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
    """Mean [..., 2] in fixed axes, covariances [..., 2] along and across the course, of the three states."""

    x: Float64s
    v: Float64s
    a: Float64s
    xx: Float64s
    xv: Float64s
    xa: Float64s
    vv: Float64s
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
    shape = (len(stretches.time), len(sigma), len(processes), 2)
    steps = transitions(np.diff(stretches.time, axis=1))
    noise = _noise(stretches, sigma, along)
    zero = np.zeros(shape)
    aa = zero + (processes.has_acceleration * processes.variance)[:, None]
    state = _State(zero, zero, zero, zero + noise[:, 0], zero, zero, zero + (_SPEEDS * stretches.velocity) ** 2, zero, aa)
    found = np.zeros(shape[:-1])
    for number in range(1, stretches.time.shape[1]):
        step = Transitions(*(value[:, number - 1, processes.family][:, None, :, None] for value in steps))
        state = _predicted(state, step, processes.variance[:, None])
        course = stretches.course[:, number][:, None, None]
        offset = _turned(stretches.position[:, number][:, None, None] - state.x, course)
        variance = state.xx + noise[:, number]
        gained = -0.5 * (offset**2 / variance + np.log(variance)).sum(-1)
        found += np.where(stretches.is_seen[:, number][:, None, None], gained, 0.0)
        state = _updated(state, offset / variance, variance, course)
    return found


def _noise(stretches: Stretches, sigma: Float64s, along: Float64s) -> Float64s:
    """Variance of the detections [S, N, G, 1, 2]: along and across. What noise adds to a speed is no speed."""
    speed2 = np.maximum(stretches.speed2[..., None] - sigma**2 * stretches.doubt2[..., None], 0.0)
    across = np.broadcast_to(sigma**2, speed2.shape)
    return np.stack([across + along**2 * speed2, across], -1)[..., None, :]


def _turned(vector: Float64s, course: Float64s) -> Float64s:
    """A vector in fixed axes as one along and across the course; the same again turns it back."""
    east, north = course[..., 0], course[..., 1]
    return np.stack([east * vector[..., 0] + north * vector[..., 1], north * vector[..., 0] - east * vector[..., 1]], axis=-1)


def _predicted(s: _State, to: Transitions, variance: Float64s) -> _State:
    xx, xv = s.xx + to.x_of_v * s.xv + to.x_of_a * s.xa, s.xv + to.x_of_v * s.vv + to.x_of_a * s.va
    xa = s.xa + to.x_of_v * s.va + to.x_of_a * s.aa
    vv, va = to.v_of_v * s.vv + to.v_of_a * s.va, to.v_of_v * s.va + to.v_of_a * s.aa
    return _State(
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
    return _State(
        x=s.x + _turned(s.xx * weighed, course),
        v=s.v + _turned(s.xv * weighed, course),
        a=s.a + _turned(s.xa * weighed, course),
        xx=s.xx - of_x * s.xx,
        xv=s.xv - of_x * s.xv,
        xa=s.xa - of_x * s.xa,
        vv=s.vv - of_v * s.xv,
        va=s.va - of_v * s.xa,
        aa=s.aa - s.xa * s.xa / variance,
    )
