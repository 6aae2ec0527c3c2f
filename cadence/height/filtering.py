"""What detections say of height: a filter over modes that may change at every detection, and joint samples drawn backwards.

Between two detections one mode is at work, and all is exact. At a detection the mode may change, and the new one begins with a
rate of its own law; there the mixture that leads into each mode is taken as one Gaussian (interacting multiple models; Blom and
Bar-Shalom, 1988), which costs little, as detections are what height is known best at. Samples are drawn backwards through the
filter (Kim, 1994; Godsill, Doucet and West, 2004), and forwards after the last detection.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from cadence.height.modes import Modes, Steps, steps

_TINY = 1e-12
"""Of a probability, so that its logarithm is a number."""


@dataclass(frozen=True, eq=False)
class Nodes:
    """Times and detections of R rows in time order: time_s, height_m, variance_m2, is_observed [R, M]; padding is last."""

    time_s: Tensor
    height_m: Tensor
    variance_m2: Tensor
    is_observed: Tensor

    @property
    def last(self) -> Tensor:
        """Node of the last detection [R]."""
        return (self.is_observed * torch.arange(1, self.time_s.shape[1] + 1)).argmax(1)


@dataclass(frozen=True, eq=False)
class Switching:
    """C modes in seconds and metres, and log weights [C] of those that follow where one ends."""

    modes: Modes
    log_weight: Tensor


@dataclass(frozen=True, eq=False)
class State:
    """Moments of height and rate [...], and the log weight of each."""

    z: Tensor
    v: Tensor
    zz: Tensor
    zv: Tensor
    vv: Tensor
    log_weight: Tensor

    def of_mode(self, mode: Tensor) -> "State":
        """Of states [R, C] those of the modes [R, K]."""
        return State(*(value.gather(1, mode) for value in vars(self).values()))

    def where(self, chosen: Tensor, other: "State") -> "State":
        """These where `chosen`, the others elsewhere."""
        return State(*(torch.where(chosen, a, b) for a, b in zip(vars(self).values(), vars(other).values(), strict=True)))


@dataclass(frozen=True, eq=False)
class Filtered:
    """States [R, C] after each of M nodes, by the mode that led there, and the log likelihood [R] of the detections."""

    states: list[State]
    log_likelihood: Tensor


def filter_forward(switching: Switching, nodes: Nodes, diffuse_m: float) -> Filtered:
    """The filter over the nodes; `diffuse_m` is the standard deviation of height where a row starts."""
    modes, num_rows, num_nodes = switching.modes, *nodes.time_s.shape
    first = nodes.is_observed.to(torch.int64).argmax(1, keepdim=True)
    zero = torch.zeros(num_rows, len(modes), dtype=torch.float64)
    start_m = nodes.height_m.gather(1, first).expand_as(zero)
    state = State(start_m, zero, zero + diffuse_m**2, zero, zero + modes.initial_rate**2, zero + switching.log_weight)
    total, states = torch.zeros(num_rows, dtype=torch.float64), []
    for m in range(num_nodes):
        if m:
            duration = nodes.time_s[:, m] - nodes.time_s[:, m - 1]
            begun = entered(switching, state, duration)
            state = predicted(begun.where(nodes.is_observed[:, m - 1][:, None], state), steps(modes, duration))
        observed = nodes.is_observed[:, m]
        if bool(observed.any()):
            state, gained = _updated(state, nodes.height_m[:, m], nodes.variance_m2[:, m], observed)
            total = total + gained
        states.append(state)
    return Filtered(states, total)


def staying(switching: Switching, duration: Tensor) -> tuple[Tensor, Tensor]:
    """Log probabilities [R, C] that a mode goes on over durations [R], and that it ends."""
    rate = duration[:, None] * switching.modes.end_rate
    return -rate, torch.log(-torch.expm1(-rate.clamp_min(_TINY)))


def fresh(switching: Switching, state: State, duration: Tensor) -> State:
    """What modes that end make of states [R, C]: the height of all together, a rate of each new mode's law."""
    ended = state.log_weight + staying(switching, duration)[1]
    share = torch.softmax(ended, 1)
    mean = (share * state.z).sum(1, keepdim=True)
    variance = (share * (state.zz + (state.z - mean) ** 2)).sum(1, keepdim=True)
    zero = torch.zeros_like(state.z)
    return State(
        zero + mean, zero, zero + variance, zero, zero + switching.modes.initial_rate**2,
        zero + switching.log_weight + torch.logsumexp(ended, 1, keepdim=True),
    )  # fmt: skip


def entered(switching: Switching, state: State, duration: Tensor) -> State:
    """States [R, C] at the beginning of the way to the next node: of modes that go on and of new ones, as one Gaussian each."""
    other = fresh(switching, state, duration)
    kept, new = state.log_weight + staying(switching, duration)[0], other.log_weight
    total = torch.logaddexp(kept, new)
    a, b = torch.exp(kept - total), torch.exp(new - total)
    z, v = a * state.z + b * other.z, a * state.v
    apart_z, apart_v = state.z - other.z, state.v - other.v
    return State(
        z, v,
        a * state.zz + b * other.zz + a * b * apart_z**2,
        a * state.zv + a * b * apart_z * apart_v,
        a * state.vv + b * other.vv + a * b * apart_v**2,
        total,
    )  # fmt: skip


def predicted(s: State, to: Steps) -> State:
    """States after a duration."""
    zv = s.zv + to.gain * s.vv
    return State(
        s.z + to.gain * s.v,
        to.keep * s.v,
        s.zz + to.gain * (s.zv + zv) + to.noise_zz,
        to.keep * zv + to.noise_zv,
        to.keep**2 * s.vv + to.noise_vv,
        s.log_weight,
    )


def _updated(s: State, height_m: Tensor, noise_m2: Tensor, observed: Tensor) -> tuple[State, Tensor]:
    variance = s.zz + noise_m2[:, None]
    offset = height_m[:, None] - s.z
    log_weight = s.log_weight - 0.5 * (offset**2 / variance + variance.log() + math.log(2.0 * math.pi))
    total = torch.logsumexp(log_weight, 1, keepdim=True)
    before = torch.logsumexp(s.log_weight, 1, keepdim=True)
    found = State(
        s.z + s.zz / variance * offset, s.v + s.zv / variance * offset, s.zz * noise_m2[:, None] / variance,
        s.zv * noise_m2[:, None] / variance, s.vv - s.zv**2 / variance, log_weight - total,
    )  # fmt: skip
    return found.where(observed[:, None], s), torch.where(observed, (total - before)[:, 0], 0.0)
