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
_MOST_VALUES = 65_536
"""Of a quantity that is computed for many ways at once: half a megabyte."""


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
class Ways:
    """What every mode does on ways between neighbouring nodes [..., R, C].

    to    what it makes of height and rate
    stay  log probabilities that it goes on to the end of the way; end that it does not
    """

    to: Steps
    stay: Tensor
    end: Tensor

    @staticmethod
    def of(modes: Modes, time_s: Tensor) -> "Ways":
        """All ways between nodes at times [R, M], W = M - 1 a row: [W, R, C]. Many at once cost little more than one."""
        duration = time_s.diff(dim=1).T.flatten()
        rate = duration[:, None] * modes.end_rate
        values = (*vars(steps(modes, duration)).values(), -rate, torch.log(-torch.expm1(-rate.clamp_min(_TINY))))
        *to, stay, end = (value.view(time_s.shape[1] - 1, len(time_s), len(modes)) for value in values)
        return Ways(Steps(*to), stay, end)

    def __getitem__(self, number: int) -> "Ways":
        """The ways of one number, of all rows."""
        return Ways(Steps(*(value[number] for value in vars(self.to).values())), self.stay[number], self.end[number])


def blocks(num_nodes: int, num_values: int) -> list[tuple[int, int]]:
    """The ways between nodes in pieces, first and behind the last: what is computed of a piece at once has bounded size.

    `num_values` are those of one way, of all rows and modes.
    """
    size = max(1, _MOST_VALUES // max(num_values, 1))
    return [(begin, min(begin + size, num_nodes - 1)) for begin in range(0, num_nodes - 1, size)]


@dataclass(frozen=True, eq=False)
class Fresh:
    """What all modes that end after a node leave: mean and variance of height, and the log of their weight, [R, 1] each."""

    mean: Tensor
    variance: Tensor
    log_weight: Tensor

    @staticmethod
    def of(state: State, end: Tensor) -> "Fresh":
        """Of states [R, C], and the log probabilities that they end."""
        ended = state.log_weight + end
        share = torch.softmax(ended, 1)
        mean = (share * state.z).sum(1, keepdim=True)
        variance = (share * (state.zz + (state.z - mean) ** 2)).sum(1, keepdim=True)
        return Fresh(mean, variance, torch.logsumexp(ended, 1, keepdim=True))


@dataclass(frozen=True, eq=False)
class Filtered:
    """What the filter makes of M nodes.

    states          [R, C] after each node, by the mode that led there
    fresh           what modes leave that end at a node, of all but the last; None where no row has a detection
    log_likelihood  [R] of the detections
    """

    states: list[State]
    fresh: list[Fresh | None]
    log_likelihood: Tensor


def filter_forward(switching: Switching, nodes: Nodes, diffuse_m: float) -> Filtered:
    """The filter over the nodes; `diffuse_m` is the standard deviation of height where a row starts."""
    modes, num_rows, num_nodes = switching.modes, *nodes.time_s.shape
    first = nodes.is_observed.to(torch.int64).argmax(1, keepdim=True)
    zero = torch.zeros(num_rows, len(modes), dtype=torch.float64)
    start_m = nodes.height_m.gather(1, first).expand_as(zero)
    state = State(start_m, zero, zero + diffuse_m**2, zero, zero + modes.initial_rate**2, zero + switching.log_weight)
    seen = [(bool(some.any()), bool(some.all())) for some in nodes.is_observed.unbind(1)]
    total, leaves = torch.zeros(num_rows, dtype=torch.float64), list[Fresh | None]()

    def after(m: int, state: State) -> State:
        nonlocal total
        if not seen[m][0]:
            return state
        found, gained = _updated(state, nodes.height_m[:, m], nodes.variance_m2[:, m])
        if seen[m][1]:
            total = total + gained
            return found
        observed = nodes.is_observed[:, m]
        total = total + torch.where(observed, gained, 0.0)
        return found.where(observed[:, None], state)

    states = [after(0, state)]
    for begin, end in blocks(num_nodes, zero.numel()):
        ways = Ways.of(modes, nodes.time_s[:, begin : end + 1])
        for m in range(begin, end):
            state, way, left = states[-1], ways[m - begin], None
            if seen[m][0]:
                left = Fresh.of(state, way.end)
                begun = _entered(switching, state, way, left)
                state = begun if seen[m][1] else begun.where(nodes.is_observed[:, m][:, None], state)
            leaves.append(left)
            states.append(after(m + 1, predicted(state, way.to)))
    return Filtered(states, leaves, total)


def new_modes(switching: Switching, left: Fresh) -> State:
    """States [R, C] of modes that begin: the height of all that end together, a rate of each new mode's law."""
    zero = torch.zeros(len(left.mean), len(switching.modes), dtype=torch.float64)
    return State(
        zero + left.mean, zero, zero + left.variance, zero, zero + switching.modes.initial_rate**2,
        zero + switching.log_weight + left.log_weight,
    )  # fmt: skip


def _entered(switching: Switching, state: State, way: Ways, left: Fresh) -> State:
    """States [R, C] at the beginning of a way: of modes that go on and of new ones, as one Gaussian each."""
    other = new_modes(switching, left)
    kept, new = state.log_weight + way.stay, other.log_weight
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


def _updated(s: State, height_m: Tensor, noise_m2: Tensor) -> tuple[State, Tensor]:
    """States given a height, and the log likelihood [R] of it."""
    noise_m2 = noise_m2[:, None]
    variance = s.zz + noise_m2
    offset = height_m[:, None] - s.z
    log_weight = s.log_weight - 0.5 * (offset**2 / variance + variance.log() + math.log(2.0 * math.pi))
    total = torch.logsumexp(log_weight, 1, keepdim=True)
    before = torch.logsumexp(s.log_weight, 1, keepdim=True)
    found = State(
        s.z + s.zz / variance * offset, s.v + s.zv / variance * offset, s.zz * noise_m2 / variance,
        s.zv * noise_m2 / variance, s.vv - s.zv**2 / variance, log_weight - total,
    )  # fmt: skip
    return found, (total - before)[:, 0]
