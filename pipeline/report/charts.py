"""Uncertainty over time as SVG text: a row an agent, detections as ticks beneath."""

import itertools
import math
from collections.abc import Sequence
from html import escape

import numpy as np

from cadence.arrays import Float64s, Int64s
from pipeline.clock import Clock
from pipeline.lengths import metres
from pipeline.report.analysis import Analysis
from pipeline.report.mission import Mission, WindowRow

CHART_WIDTH, LABEL_WIDTH, MARGIN_RIGHT = 1200, 150, 14
ROW_HEIGHT, TICK_HEIGHT, ROW_GAP = 84, 9, 15

MAX_TICKS = 2 * (CHART_WIDTH - LABEL_WIDTH)
"""Ticks of a row: those less than half a pixel apart are one."""


class TimeAxis:
    """From mission time to the pixels of the charts."""

    def __init__(self, mission: Mission) -> None:
        last_ns = max([mission.end_ns, *(int(fan.time_ns[-1]) for fan in mission.fans[-len(mission.agents) :])])
        self._start_ns, self._end_ns = mission.start_ns, max(last_ns, mission.start_ns + 1)
        self._clock = Clock(mission.start_ns, mission.end_ns)

    @property
    def pixel_per_s(self) -> float:
        """Scale of the axis."""
        return (CHART_WIDTH - LABEL_WIDTH - MARGIN_RIGHT) / ((self._end_ns - self._start_ns) / 1e9)

    def pixels(self, time_ns: Int64s | int) -> Float64s:
        """Horizontal pixels of times."""
        seconds = (np.asarray(time_ns, dtype=np.int64) - self._start_ns) / 1e9
        return np.asarray(LABEL_WIDTH + seconds * self.pixel_per_s, dtype=np.float64)

    def ticks(self) -> list[tuple[float, str]]:
        """Pixel and label of about eight round times."""
        return [(float(self.pixels(time_ns)), label) for time_ns, label in self._clock.ticks(self._start_ns, self._end_ns, 8)]


class SpreadAxis:
    """Decades of metres, the same for every agent, so that rows can be compared."""

    def __init__(self, analysis: Analysis) -> None:
        values = np.concatenate([analysis.spread_now_m, analysis.spread_end_m])
        values = values[np.isfinite(values) & (values > 0)]
        low, high = (np.percentile(values, 1), values.max()) if len(values) else (1.0, 10.0)
        self._low = math.floor(math.log10(max(low, high * 1e-5, 1e-3)))
        self._high = max(math.ceil(math.log10(high)), self._low + 1)

    def pixels(self, spread_m: Float64s) -> Float64s:
        """Vertical pixels below the top of a row; values under the axis lie on it."""
        share = (np.log10(np.maximum(spread_m, 10.0**self._low)) - self._low) / (self._high - self._low)
        return np.asarray(ROW_HEIGHT * (1 - np.clip(share, 0, 1)))

    def decades(self) -> list[float]:
        """Values of the grid lines."""
        every = 1 if self._high - self._low <= 4 else 2
        return [10.0**power for power in range(self._low, self._high + 1, every)]


def uncertainty_chart(mission: Mission, analysis: Analysis, agents: Sequence[int], axis: TimeAxis, spread: SpreadAxis) -> str:
    """A row an agent: spread at the origin and at the end of the horizon over the origins, ticks for detections."""
    pitch = ROW_HEIGHT + TICK_HEIGHT + ROW_GAP
    height = 10 + pitch * len(agents) + 22
    parts = []
    for x, label in axis.ticks():
        parts.append(f'<path class="grid" d="M{x:.1f} 6 V{height - 22}"/>')
        if x < CHART_WIDTH - 4 * len(label):
            parts.append(f'<text x="{x:.1f}" y="{height - 7}" text-anchor="middle">{escape(label)}</text>')
    rows_of: dict[int, list[WindowRow]] = {}
    for row in mission.rows:
        rows_of.setdefault(row.agent, []).append(row)
    place = {(fan.window, fan.agent): index for index, fan in enumerate(mission.fans)}
    for number, agent in enumerate(agents):
        parts.append(f'<g transform="translate(0 {10 + number * pitch})">')
        parts.append(_chart_row(mission, analysis, agent, rows_of.get(agent, []), place, axis, spread))
        parts.append("</g>")
    parts.append(f'<path class="cursor" d="M{LABEL_WIDTH} 4 V{height - 20}" visibility="hidden"/>')
    data = f'data-left="{LABEL_WIDTH}" data-scale="{axis.pixel_per_s:.9g}"'
    return (
        f'<svg class="chart" viewBox="0 0 {CHART_WIDTH} {height}" role="img" {data} '
        f'aria-label="Spread of the hypotheses over time, a row for each agent">{"".join(parts)}</svg>'
    )


def _chart_row(
    mission: Mission,
    analysis: Analysis,
    agent: int,
    rows: Sequence[WindowRow],
    place: dict[tuple[int, int], int],
    axis: TimeAxis,
    spread: SpreadAxis,
) -> str:
    name, called = mission.agents[agent], mission.called(agent, rows)
    short = name if len(name) <= 18 else name[:17] + "…"
    parts = [f'<text class="name" x="0" y="14"><title>{escape(called)}</title>{escape(short)}</text>']
    if called != name:
        parts.append(f'<text class="unit" x="0" y="28">{escape(called.removeprefix(name).strip(" ()"))}</text>')
    right = CHART_WIDTH - MARGIN_RIGHT
    x = axis.pixels(np.array([row.origin_ns for row in rows], dtype=np.int64))
    found = [place.get((row.window, row.agent)) for row in rows]
    for first, last in _silent_spans(x, found):
        parts.append(f'<rect class="void" x="{first:.1f}" y="0" width="{last - first:.1f}" height="{ROW_HEIGHT}"/>')
    for value in spread.decades():
        y = float(spread.pixels(np.array(value)))
        parts.append(f'<path class="grid" d="M{LABEL_WIDTH} {y:.1f} H{right}"/>')
        parts.append(f'<text class="unit" x="{LABEL_WIDTH - 6}" y="{y + 4:.1f}" text-anchor="end">{metres(value)}</text>')
    for kind, values in (("future", analysis.spread_end_m), ("past", analysis.spread_now_m)):
        y_m = np.array([np.nan if index is None else values[index] for index in found])
        parts.append(_broken_line(x, np.where(np.isfinite(y_m), spread.pixels(np.nan_to_num(y_m)), np.nan), kind))
    ticks = np.unique(np.round(axis.pixels(mission.detections.of(agent).time_ns) * 2) / 2)
    path = "".join(f"M{at:g} {ROW_HEIGHT + 2}v{TICK_HEIGHT}" for at in ticks)
    parts.append(f'<path class="tick" d="{path}"/>')
    return "".join(parts)


def _silent_spans(x: Float64s, found: Sequence[int | None]) -> list[tuple[float, float]]:
    """Where windows have no hypotheses: from halfway to the window before to halfway to the window after."""
    if len(x) == 0:
        return []
    middles = (x[1:] + x[:-1]) / 2
    edges = np.concatenate([[max(x[0] - 4, LABEL_WIDTH)], middles, [min(x[-1] + 4, CHART_WIDTH - MARGIN_RIGHT)]])
    spans: list[tuple[float, float]] = []
    for index, (first, last) in enumerate(itertools.pairwise(edges.tolist())):
        if found[index] is None:
            joins = index > 0 and found[index - 1] is None
            spans.append((spans.pop()[0] if joins else first, last))
    return spans


def _broken_line(x: Float64s, y: Float64s, kind: str) -> str:
    """A line that is interrupted where a value is missing or windows are farther apart than usual; lone points as dots."""
    usual = float(np.median(np.diff(x))) if len(x) > 1 else 0.0
    parts: list[str] = []
    run: list[int] = []
    for index in range(len(x) + 1):
        ends = index == len(x) or not np.isfinite(y[index]) or (run and x[index] - x[run[-1]] > 3 * usual)
        if ends and run:
            if len(run) == 1:
                parts.append(f'<circle class="{kind} dot" cx="{x[run[0]]:.1f}" cy="{y[run[0]]:.1f}" r="2.2"/>')
            else:
                parts.append(f'<polyline class="{kind} mean" points="{" ".join(f"{x[i]:.1f},{y[i]:.1f}" for i in run)}"/>')
            run = []
        if index < len(x) and np.isfinite(y[index]):
            run.append(index)
    return "".join(parts)
