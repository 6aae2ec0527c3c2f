"""Drawings that need no script: small maps of chosen moments and the uncertainty over time, as SVG text.

Colours come from the style sheet's classes (see `page.css`), so that they follow light, dark and print.
"""

import math
from collections.abc import Sequence
from html import escape

import numpy as np

from pipeline.report.analysis import Analysis, FanShape
from pipeline.report.clock import Clock
from pipeline.report.mission import Fan, Floats, Ints, Mission, Obstacle, WindowRow

MAP_WIDTH, MAP_HEIGHT = 400, 300
MAX_STATIC_HYPOTHESES = 40
MAX_STATIC_POINTS = 250

CHART_WIDTH, LABEL_WIDTH, MARGIN_RIGHT = 1200, 150, 14
ROW_HEIGHT, TICK_HEIGHT, ROW_GAP = 84, 9, 15


class View:
    """From mission metres to the pixels of a small map: equal scales, north up."""

    def __init__(self, position_m: Floats, margin: float = 0.08) -> None:
        low, high = position_m.min(axis=0), position_m.max(axis=0)
        size = np.maximum(high - low, max(float((high - low).max()) * 0.05, 1.0))
        self.pixel_per_m = float(min(MAP_WIDTH / size[0], MAP_HEIGHT / size[1]) * (1 - 2 * margin))
        self._centre_m = (low + high) / 2

    def pixels(self, position_m: Floats) -> Floats:
        """[..., 2] metres to [..., 2] pixels."""
        shifted = (np.asarray(position_m, dtype=np.float64) - self._centre_m) * self.pixel_per_m
        return shifted * (1, -1) + (MAP_WIDTH / 2, MAP_HEIGHT / 2)


def moment_map(mission: Mission, fan: Fan, shape: FanShape, label: str) -> str:
    """The map of one fan: obstacles, truth, hypotheses, mean, detections and the place at the origin."""
    first_ns, last_ns = int(fan.time_ns[0]), int(fan.time_ns[-1])
    detections = mission.detections.of(fan.agent).between(first_ns, last_ns)
    track_m = fan.offset_m.astype(np.float64) + fan.datum_m
    heaviest = np.argsort(-fan.weight, kind="stable")[:MAX_STATIC_HYPOTHESES]
    # A single stray hypothesis must not shrink all others to a dot.
    low, high = np.percentile(track_m.reshape(-1, 2), [1, 99], axis=0)
    view = View(np.concatenate([low[None], high[None], shape.mean_m, detections.position_m]))
    now = fan.origin_index
    parts = [_obstacle(item, view) for item in mission.obstacles]
    if mission.truth is not None:
        truth = mission.truth.of(fan.agent).between(first_ns, last_ns)
        parts.append(_line(view.pixels(truth.position_m), "truth"))
    strongest = float(fan.weight.max())
    base = min(0.8, max(0.16, 2.4 / math.sqrt(len(heaviest))))
    for k in sorted(heaviest.tolist()):
        opacity = max(0.05, base * float(fan.weight[k]) / strongest)
        pixels = view.pixels(track_m[k])
        parts.append(_line(pixels[: now + 1], "past", opacity))
        parts.append(_line(pixels[now:], "future", opacity))
    mean = view.pixels(shape.mean_m)
    parts += [_line(mean[: now + 1], "past mean"), _line(mean[now:], "future mean")]
    age = np.clip((fan.origin_ns - detections.time_ns) / max(fan.origin_ns - first_ns, 1), None, 1)
    for (x, y), share in list(zip(view.pixels(detections.position_m), age, strict=True))[-MAX_STATIC_POINTS:]:
        if share < 0:
            parts.append(f'<circle class="later" cx="{x:.1f}" cy="{y:.1f}" r="3"/>')
        else:
            parts.append(f'<circle class="detection" cx="{x:.1f}" cy="{y:.1f}" r="3.2" fill-opacity="{1 - 0.75 * share:.2f}"/>')
    parts.append(f'<circle class="now" cx="{mean[now][0]:.1f}" cy="{mean[now][1]:.1f}" r="6"/>')
    parts += [scale_bar(view.pixel_per_m), NORTH_ARROW]
    return f'<svg class="map" viewBox="0 0 {MAP_WIDTH} {MAP_HEIGHT}" role="img" aria-label="{escape(label)}">{"".join(parts)}</svg>'


NORTH_ARROW = (
    f'<g class="furniture" transform="translate({MAP_WIDTH - 20} 26)"><path d="M0 -14 L5 2 L0 -2 L-5 2 Z"/>'
    '<text y="15" text-anchor="middle">N</text></g>'
)


def nice_length(length: float) -> float:
    """The largest 1, 2 or 5 times a power of ten that is not over `length`."""
    power = 10.0 ** math.floor(math.log10(length))
    return max(factor * power for factor in (1, 2, 5) if factor * power <= length * (1 + 1e-9))


def metres(length_m: float) -> str:
    """A length for people: three digits, in km from 1000 m on."""
    if not math.isfinite(length_m):
        return "unknown"
    return (
        f"{length_m / 1000:,.3g} km"
        if 999.5 <= length_m < 999_500
        else f"{length_m / 1000:,.0f} km"
        if length_m >= 999_500
        else f"{length_m:.3g} m"
    )


def scale_bar(pixel_per_m: float) -> str:
    """A bar of a round length at the lower left."""
    length_m = nice_length(MAP_WIDTH * 0.28 / pixel_per_m)
    width = length_m * pixel_per_m
    bottom = MAP_HEIGHT - 12
    return (
        f'<g class="furniture"><path class="bar" d="M12 {bottom - 5} v5 h{width:.1f} v-5"/>'
        f'<text x="{12 + width / 2:.1f}" y="{bottom - 7}" text-anchor="middle">{metres(length_m)}</text></g>'
    )


def _line(pixels: Floats, kind: str, opacity: float | None = None) -> str:
    if len(pixels) < 2:
        return ""
    kept = _simplify(pixels)
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in kept)
    faded = f' stroke-opacity="{opacity:.2f}"' if opacity is not None else ""
    return f'<polyline class="{kind}" points="{points}"{faded}/>'


def _simplify(pixels: Floats, tolerance: float = 0.4) -> Floats:
    """Without the points that lie closer than `tolerance` pixels to the chord (Douglas and Peucker, 1973)."""
    keep = np.zeros(len(pixels), dtype=bool)
    keep[[0, -1]] = True
    spans = [(0, len(pixels) - 1)]
    while spans:
        first, last = spans.pop()
        if last - first < 2:
            continue
        chord = pixels[last] - pixels[first]
        inner = pixels[first + 1 : last] - pixels[first]
        along = np.clip(inner @ chord / max(float(chord @ chord), 1e-12), 0, 1)
        distance = np.hypot(*(inner - along[:, None] * chord).T)
        if distance.max() > tolerance:
            middle = first + 1 + int(distance.argmax())
            keep[middle] = True
            spans += [(first, middle), (middle, last)]
    return pixels[keep]


def _obstacle(item: Obstacle, view: View) -> str:
    title = f"<title>{escape(item.name)}</title>" if item.name else ""
    if item.centre_m is not None:
        x, y = view.pixels(np.array(item.centre_m))
        return f'<circle class="obstacle" cx="{x:.1f}" cy="{y:.1f}" r="{item.radius_m * view.pixel_per_m:.1f}">{title}</circle>'
    rings = [" L".join(f"{x:.1f} {y:.1f}" for x, y in _simplify(view.pixels(ring))) for ring in item.rings_m if len(ring)]
    return f'<path class="obstacle" d="{" ".join(f"M{ring} Z" for ring in rings)}">{title}</path>'


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

    def pixels(self, time_ns: Ints | int) -> Floats:
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

    def pixels(self, spread_m: Floats) -> Floats:
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
        parts.append(
            f'<path class="grid" d="M{x:.1f} 6 V{height - 22}"/><text x="{x:.1f}" y="{height - 7}" text-anchor="middle">{escape(label)}</text>'
        )
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
    name = mission.agents[agent]
    short = name if len(name) <= 18 else name[:17] + "…"
    parts = [f'<text class="name" x="0" y="14"><title>{escape(name)}</title>{escape(short)}</text>']
    right = CHART_WIDTH - MARGIN_RIGHT
    for value in spread.decades():
        y = float(spread.pixels(np.array(value)))
        parts.append(f'<path class="grid" d="M{LABEL_WIDTH} {y:.1f} H{right}"/>')
        parts.append(f'<text class="unit" x="{LABEL_WIDTH - 6}" y="{y + 4:.1f}" text-anchor="end">{metres(value)}</text>')
    x = axis.pixels(np.array([row.origin_ns for row in rows], dtype=np.int64))
    found = [place.get((row.window, row.agent)) for row in rows]
    for kind, values in (("future", analysis.spread_end_m), ("past", analysis.spread_now_m)):
        y_m = np.array([np.nan if index is None else values[index] for index in found])
        parts.append(_broken_line(x, np.where(np.isfinite(y_m), spread.pixels(np.nan_to_num(y_m)), np.nan), kind))
    silent = [float(at) for at, index in zip(x, found, strict=True) if index is None]
    parts += [f'<path class="trouble" d="M{at - 3:.1f} {ROW_HEIGHT - 7} l6 6 m0 -6 l-6 6"/>' for at in silent]
    ticks = np.unique(np.round(axis.pixels(mission.detections.of(agent).time_ns) * 2) / 2)
    path = "".join(f"M{at:g} {ROW_HEIGHT + 2}v{TICK_HEIGHT}" for at in ticks)
    parts.append(f'<path class="tick" d="{path}"/>')
    return "".join(parts)


def _broken_line(x: Floats, y: Floats, kind: str) -> str:
    """A line that is interrupted where a value is missing or windows are farther apart than usual; lone points as dots."""
    usual = float(np.median(np.diff(x))) if len(x) > 1 else 0.0
    parts, run = [], []
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
