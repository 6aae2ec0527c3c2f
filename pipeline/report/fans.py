"""Fans as the page holds them: how finely, and as integers relative to a centre each."""

import itertools
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from cadence.arrays import Float32s, Float64s, Indices
from pipeline.report.analysis import FanShape
from pipeline.report.mission import Fan, Mission

QUANTA = 32_000
"""Integers either side of a fan's centre; int16 holds them."""

FAN_OVERHEAD_BYTES = 64
BASE64_GROWTH = 4 / 3


@dataclass(frozen=True)
class Detail:
    """How finely the fans are shown: numbers of windows, agents, hypotheses of a fan, and vertices of a hypothesis."""

    num_windows: int
    num_agents: int
    num_hypotheses: int
    num_vertices: int

    def num_bytes(self, fans_per_window_and_agent: float) -> float:
        """Size of the encoded fans in the page."""
        fan = FAN_OVERHEAD_BYTES + 4 * self.num_hypotheses + self.num_vertices * (2 + 12 + 4 * self.num_hypotheses)
        return self.num_windows * self.num_agents * fans_per_window_and_agent * fan * BASE64_GROWTH


LADDER = ((40, 64), (30, 48), (30, 40), (20, 32), (15, 28), (12, 24), (10, 20), (8, 18))
"""Hypotheses of a fan and vertices of a hypothesis, from fine to coarse; below it windows are left out, then agents."""

FEWEST_WINDOWS = 12


def choose_detail(mission: Mission, budget_bytes: float, wanted: Detail) -> Detail:
    """The finest detail within the budget: first fewer hypotheses and vertices, then windows, then agents."""
    density = len(mission.fans) / max(1, wanted.num_windows * wanted.num_agents)
    detail = wanted
    for num_hypotheses, num_vertices in ((wanted.num_hypotheses, wanted.num_vertices), *LADDER):
        detail = replace(
            wanted,
            num_hypotheses=min(wanted.num_hypotheses, num_hypotheses),
            num_vertices=min(wanted.num_vertices, num_vertices),
        )
        if detail.num_bytes(density) <= budget_bytes:
            return detail
    a_window = replace(detail, num_windows=1).num_bytes(density)
    fewest = min(wanted.num_windows, FEWEST_WINDOWS)
    detail = replace(detail, num_windows=max(fewest, min(wanted.num_windows, int(budget_bytes / a_window))))
    an_agent = replace(detail, num_agents=1).num_bytes(density)
    return replace(detail, num_agents=max(1, min(wanted.num_agents, int(budget_bytes / an_agent))))


def choose_vertices(track_m: Float64s, origin_index: int, count: int) -> Indices:
    """At most `count` steps of [K, T, 2] tracks which together follow all of them best, ends and origin included.

    Greedy: the step farthest from the chords between its chosen neighbours, over all hypotheses, joins next.
    """
    num_steps = track_m.shape[1]
    if num_steps <= count:
        return np.arange(num_steps)
    chosen = sorted({0, min(max(origin_index, 0), num_steps - 1), num_steps - 1})
    deviation = np.zeros(num_steps)
    for first, last in itertools.pairwise(chosen):
        _measure(track_m, first, last, deviation)
    while len(chosen) < count:
        step = int(deviation.argmax())
        if deviation[step] <= 0:
            step = next(step for step in range(num_steps) if step not in chosen)
        place = int(np.searchsorted(chosen, step))
        chosen.insert(place, step)
        _measure(track_m, chosen[place - 1], step, deviation)
        _measure(track_m, step, chosen[place + 1], deviation)
    return np.array(chosen)


def _measure(track_m: Float64s, first: int, last: int, deviation: Float64s) -> None:
    deviation[[first, last]] = 0.0
    if last - first < 2:
        return
    share = (np.arange(first + 1, last) - first)[:, None] / (last - first)
    chord = track_m[:, first, None] + share * (track_m[:, last] - track_m[:, first])[:, None]
    away = track_m[:, first + 1 : last] - chord
    deviation[first + 1 : last] = np.hypot(away[..., 0], away[..., 1]).max(axis=0)


@dataclass(frozen=True, eq=False)
class FanCode:
    """One fan as the page holds it: header numbers, steps of its vertices, weights and quantised positions."""

    window: int
    agent: int
    centre_m: Float64s
    scale_m: float
    step: npt.NDArray[np.int16]
    weight: Float32s
    hypothesis: npt.NDArray[np.int16]
    summary: npt.NDArray[np.int16]


def encode_fan(fan: Fan, shape: FanShape, detail: Detail) -> FanCode:
    """The heaviest hypotheses and the envelopes of a fan, [K, S, 2] and [S, 6] (mean, 90 % axes, angle, 50 % / 90 %)."""
    heaviest = np.sort(np.argsort(-fan.weight, kind="stable")[: detail.num_hypotheses])
    track_m = fan.offset_m[heaviest].astype(np.float64)
    step = choose_vertices(track_m, fan.origin_index, detail.num_vertices)
    mean_m = shape.mean_m[step]
    reach_m = shape.axes_m[step] * shape.radius[1][step, None]
    position_m = track_m[:, step] + fan.datum_m
    low = np.minimum(position_m.min(axis=(0, 1)), mean_m.min(axis=0))
    high = np.maximum(position_m.max(axis=(0, 1)), mean_m.max(axis=0))
    centre_m = (low + high) / 2
    scale_m = max(float((high - low).max()) / 2, float(reach_m.max()), 1e-3) / QUANTA
    inner = np.divide(shape.radius[0][step], shape.radius[1][step], out=np.ones(len(step)), where=shape.radius[1][step] > 0)
    angle = np.mod(shape.angle_rad[step] + np.pi / 2, np.pi) - np.pi / 2
    summary = np.column_stack([(mean_m - centre_m) / scale_m, reach_m / scale_m, angle * 10_000, inner * 10_000])
    return FanCode(
        fan.window,
        fan.agent,
        centre_m,
        scale_m,
        step.astype(np.int16),
        fan.weight[heaviest].astype(np.float32),
        np.rint((position_m - centre_m) / scale_m).astype(np.int16),
        np.rint(summary).astype(np.int16),
    )
