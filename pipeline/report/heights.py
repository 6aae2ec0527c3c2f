"""Height over time as SVG text: a row an agent, what was known at each moment, and the future of the last window."""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Final

import numpy as np

from cadence.arrays import Float64s, Int64s
from pipeline.height_words import DATA
from pipeline.report.charts import CHART_WIDTH, LABEL_WIDTH, MARGIN_RIGHT, TimeAxis
from pipeline.report.markup import legend, section
from pipeline.report.mission import Mission
from pipeline.results import AgentHypotheses, WindowHypotheses

_ROW_HEIGHT, _ROW_GAP = 96, 18
_MAX_ROWS: Final = 24
_SHARES: Final = (0.05, 0.5, 0.95)


@dataclass(frozen=True, eq=False)
class _Stretch:
    """Times [N], and the heights [3, N] below which 5, 50 and 95 % of the weight lie."""

    time_ns: Int64s
    height_m: Float64s
    is_future: bool


def height_section(mission: Mission) -> str:
    """A chart row for each agent whose height is known; nothing where there is none."""
    names = sorted({a.agent_id for w in mission.stored.windows for a in w.agents if a.height_m is not None})
    if not names:
        return ""
    axis = TimeAxis(mission)
    pitch = _ROW_HEIGHT + _ROW_GAP
    shown = names[:_MAX_ROWS]
    total = 10 + pitch * len(shown) + 22
    parts = []
    for x, words in axis.ticks():
        parts.append(f'<path class="grid" d="M{x:.1f} 6 V{total - 22}"/>')
        if x < CHART_WIDTH - 4 * len(words):
            parts.append(f'<text x="{x:.1f}" y="{total - 7}" text-anchor="middle">{escape(words)}</text>')
    for number, name in enumerate(shown):
        parts.append(f'<g transform="translate(0 {10 + number * pitch})">{_row(mission, name, axis)}</g>')
    chart = (
        f'<svg class="chart" viewBox="0 0 {CHART_WIDTH} {total}" role="img" '
        f'aria-label="Height over time, a row for each agent">{"".join(parts)}</svg>'
    )
    if len(names) > len(shown):
        chart += f'<p class="note">{len(names) - len(shown)} more agents are not drawn; all are in hypotheses.parquet.</p>'
    keys = (
        ('<polyline class="past mean" points="0,8 26,8"/>', "median of the hypotheses, as known at the next window’s moment"),
        ('<rect class="heights past" x="0" y="3" width="26" height="10"/>', "90 % of the weight"),
        ('<polyline class="future mean solid" points="0,8 26,8"/>', "the future of the last window"),
        ('<circle class="detection" cx="13" cy="8" r="2.6"/>', "detection"),
    )
    datum = DATA.get(mission.frame.vertical_datum or "", "")
    return section("Height over time", chart + legend(keys), f"Metres {datum}; every row has a scale of its own.")


def _row(mission: Mission, name: str, axis: TimeAxis) -> str:
    stretches = _stretches(mission.stored.windows, name, mission.start_ns)
    seen = mission.detections.of(mission.agents.index(name))
    known = np.isfinite(seen.height_m) if seen.height_m is not None else np.zeros(len(seen), bool)
    seen_m = seen.height_m[known] if seen.height_m is not None else np.zeros(0)
    every = np.concatenate([seen_m, *(stretch.height_m.ravel() for stretch in stretches)])
    low, high = float(every.min()), float(every.max())
    middle, half = (low + high) / 2, max((high - low) / 2, 0.5)

    def pixels(height_m: Float64s) -> Float64s:
        return np.asarray(_ROW_HEIGHT * (1.0 - (height_m - middle + half) / (2.0 * half)))

    short = name if len(name) <= 18 else name[:17] + "…"
    parts = [f'<text class="name" x="0" y="14"><title>{escape(name)}</title>{escape(short)}</text>']
    for value in (middle - half, middle + half):
        y = float(pixels(np.array(value)))
        parts.append(f'<path class="grid" d="M{LABEL_WIDTH} {y:.1f} H{CHART_WIDTH - MARGIN_RIGHT}"/>')
        parts.append(f'<text class="unit" x="{LABEL_WIDTH - 6}" y="{y + 4:.1f}" text-anchor="end">{round(value):,} m</text>')
    for stretch in stretches:
        x, (bottom, median, top) = axis.pixels(stretch.time_ns), pixels(stretch.height_m)
        kind = "future" if stretch.is_future else "past"
        outline = _points(np.append(x, x[::-1]), np.append(top, bottom[::-1]))
        parts.append(f'<polygon class="heights {kind}" points="{outline}"/>')
        parts.append(f'<polyline class="{kind} mean" points="{_points(x, median)}"/>')
    for x, y in zip(axis.pixels(seen.time_ns[known]).tolist(), pixels(seen_m).tolist(), strict=True):
        parts.append(f'<circle class="detection" cx="{x:.1f}" cy="{y:.1f}" r="2.2"/>')
    return "".join(parts)


def _points(x: Float64s, y: Float64s) -> str:
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x.tolist(), y.tolist(), strict=True))


def _stretches(windows: Sequence[WindowHypotheses], name: str, start_ns: int) -> list[_Stretch]:
    """Each moment from the log's start on once: from the origin before to a window's own, and after the last one its future."""
    found, before_ns = [], start_ns
    own = [(w, a) for w in windows for a in w.agents if a.agent_id == name and a.height_m is not None]
    for number, (window, agent) in enumerate(own):
        steps = np.arange(window.num_steps) - window.origin_index
        time_ns = window.origin_ns + steps * window.step_ns
        is_own = (steps <= 0) & (time_ns >= before_ns)
        found.append(_Stretch(time_ns[is_own], _quantiles(window, agent)[:, is_own], False))
        if number == len(own) - 1 and (steps > 0).any():
            found.append(_Stretch(time_ns[steps >= 0], _quantiles(window, agent)[:, steps >= 0], True))
        before_ns = window.origin_ns
    return [stretch for stretch in found if len(stretch.time_ns) > 1]


def _quantiles(window: WindowHypotheses, agent: AgentHypotheses) -> Float64s:
    """Heights [3, T] below which the shares of the weight lie, of the hypotheses that the agent is part of."""
    assert agent.height_m is not None
    is_there = np.isfinite(agent.height_m).all(axis=1)
    height_m, weight = agent.height_m[is_there].astype(np.float64), window.weight[is_there].astype(np.float64)
    order = np.argsort(height_m, axis=0, kind="stable")
    below = np.cumsum(weight[order], axis=0) / max(float(weight.sum()), 1e-300)
    rows = [np.argmax(below >= share - 1e-9, axis=0) for share in _SHARES]
    ordered = np.take_along_axis(height_m, order, 0)
    return np.stack([np.take_along_axis(ordered, row[None], 0)[0] for row in rows])
