"""Fans as the page holds them: how finely, and as integers relative to a centre each."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from cadence.arrays import Float32s, Float64s, Indices
from pipeline.report.mission import Fan, Mission
from pipeline.report.modes import DIRECTIONS, Strand

QUANTA = 32_000
"""Integers either side of a fan's centre; int16 holds them."""

FAN_OVERHEAD_BYTES = 64
STRAND_BYTES = 14
STRANDS_A_VERTEX = 1.5
"""Bands of hypotheses that go several ways stand side by side at their steps: so many are room enough."""
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
        vertex = 2 + 12 * STRANDS_A_VERTEX + 4 * self.num_hypotheses
        fan = FAN_OVERHEAD_BYTES + 4 * STRAND_BYTES + 4 * self.num_hypotheses + self.num_vertices * vertex
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


def choose_vertices(track_m: Float64s, wanted: Iterable[int], count: int) -> Indices:
    """Steps of [K, T, 2] tracks by which straight lines follow all of them: the ends, those `wanted`, and more up to `count`.

    They are the denser the more the tracks bend: a chord is off by its length squared times the second difference.
    """
    num_steps = track_m.shape[1]
    if num_steps <= count:
        return np.arange(num_steps)
    bend = np.diff(track_m, n=2, axis=1)
    density = np.zeros(num_steps)
    density[1:-1] = np.sqrt(np.hypot(bend[..., 0], bend[..., 1]).max(axis=0))
    density += density.mean() / 4 + 1e-9
    chosen = {0, *wanted, num_steps - 1}
    room = max(count - len(chosen), 0)
    total = np.cumsum(density)
    chosen |= set(np.searchsorted(total, (np.arange(room) + 0.5) / max(room, 1) * total[-1]).tolist())
    for step in np.argsort(-density, kind="stable").tolist():
        if len(chosen) >= count:
            break
        chosen.add(step)
    return np.array(sorted(chosen))


@dataclass(frozen=True, eq=False)
class FanCode:
    """One fan as the page holds it: header numbers, steps of its vertices [V], weights [K] and quantised positions [K, V, 2].

    strand   [R, 6] of each: first and last vertex, drawn hypothesis (-1: the mean), share in per mille, vertex where the ways
             are furthest apart (-1: one way), direction there (index of `DIRECTIONS`)
    summary  for each strand and vertex of it [6]: mean, axes of the 90 % band, their angle, 50 % band / 90 % band
    """

    window: int
    agent: int
    centre_m: Float64s
    scale_m: float
    step: npt.NDArray[np.int16]
    weight: Float32s
    hypothesis: npt.NDArray[np.int16]
    strand: npt.NDArray[np.int16]
    summary: npt.NDArray[np.int16]


def encode_fan(fan: Fan, strands: Sequence[Strand], detail: Detail) -> FanCode:
    """The heaviest hypotheses of a fan, those that stand for a way, and the bands."""
    drawn = {strand.hypothesis for strand in strands} - {None}
    heaviest = np.argsort(-fan.weight, kind="stable")[: detail.num_hypotheses]
    shown = np.array(sorted({*heaviest.tolist(), *drawn}))
    track_m = fan.offset_m[shown].astype(np.float64)
    now = min(max(fan.origin_index, 0), track_m.shape[1] - 1)
    bounds = {step for strand in strands for step in (strand.first, strand.last, strand.apart) if step >= 0}
    step = choose_vertices(track_m, {now, *bounds}, detail.num_vertices)
    position_m = track_m[:, step] + fan.datum_m
    inner = [step[(step >= strand.first) & (step <= strand.last)] - strand.first for strand in strands]
    mean_m = np.concatenate([strand.shape.mean_m[at] for strand, at in zip(strands, inner, strict=True)])
    reach_m = np.concatenate(
        [strand.shape.axes_m[at] * strand.shape.radius[1][at, None] for strand, at in zip(strands, inner, strict=True)]
    )
    low = np.minimum(position_m.min(axis=(0, 1)), mean_m.min(axis=0))
    high = np.maximum(position_m.max(axis=(0, 1)), mean_m.max(axis=0))
    centre_m = (low + high) / 2
    scale_m = max(float((high - low).max()) / 2, float(reach_m.max()), 1e-3) / QUANTA
    turn = np.concatenate([_turn(strand, at) for strand, at in zip(strands, inner, strict=True)])
    return FanCode(
        fan.window,
        fan.agent,
        centre_m,
        scale_m,
        step.astype(np.int16),
        fan.weight[shown].astype(np.float32),
        np.rint((position_m - centre_m) / scale_m).astype(np.int16),
        np.array([_strand_code(strand, step, shown) for strand in strands], dtype=np.int16),
        np.rint(np.column_stack([(mean_m - centre_m) / scale_m, reach_m / scale_m, turn])).astype(np.int16),
    )


def _turn(strand: Strand, at: Indices) -> Float64s:
    """Angle of the bands, and the 50 % band over the 90 % band, in ten-thousandths [S, 2]."""
    half, most = strand.shape.radius[:, at]
    inner = np.divide(half, most, out=np.ones(len(at)), where=most > 0)
    angle = np.mod(strand.shape.angle_rad[at] + np.pi / 2, np.pi) - np.pi / 2
    return np.column_stack([angle * 10_000, inner * 10_000])


def _strand_code(strand: Strand, step: Indices, shown: Indices) -> list[int]:
    first, last = np.searchsorted(step, [strand.first, strand.last])
    hypothesis = -1 if strand.hypothesis is None else int(np.searchsorted(shown, strand.hypothesis))
    apart = -1 if strand.apart < 0 else int(np.searchsorted(step, strand.apart))
    direction = DIRECTIONS.index(strand.direction) if strand.direction else -1
    return [int(first), int(last), hypothesis, round(1000 * strand.share), apart, direction]
