"""Small maps of chosen moments as SVG text, readable without scripts and on paper.

Colours come from the style sheet's classes (see `page.css`), so that they follow light, dark and print.
"""

import math
from collections.abc import Sequence
from html import escape

import numpy as np

from cadence.arrays import Float64s
from pipeline.lengths import metres, nice_length
from pipeline.report.mission import Fan, Mission, Obstacle, Points
from pipeline.report.modes import Strand

MAP_WIDTH, MAP_HEIGHT = 400, 300
MAX_STATIC_HYPOTHESES = 40


class View:
    """From mission metres to the pixels of a map, a small one by default: equal scales, north up."""

    def __init__(self, position_m: Float64s, margin: float = 0.08, pixels: tuple[int, int] = (MAP_WIDTH, MAP_HEIGHT)) -> None:
        low, high = position_m.min(axis=0), position_m.max(axis=0)
        size = np.maximum(high - low, max(float((high - low).max()) * 0.05, 1.0))
        self.pixel_per_m = float(min(pixels[0] / size[0], pixels[1] / size[1]) * (1 - 2 * margin))
        self._centre_m, self._middle = (low + high) / 2, (pixels[0] / 2, pixels[1] / 2)

    def pixels(self, position_m: Float64s) -> Float64s:
        """[..., 2] metres to [..., 2] pixels."""
        shifted = (np.asarray(position_m, dtype=np.float64) - self._centre_m) * self.pixel_per_m
        return np.asarray(shifted * (1, -1) + self._middle)

    def metres(self, pixels: Float64s) -> Float64s:
        """[..., 2] pixels to [..., 2] metres."""
        shifted = (np.asarray(pixels, dtype=np.float64) - self._middle) * (1, -1)
        return np.asarray(shifted / self.pixel_per_m + self._centre_m)


def moment_map(
    mission: Mission, fan: Fan, strands: Sequence[Strand], truth: Points | None, steps: tuple[int, int], label: str
) -> str:
    """The map of one fan from the first to the last of `steps`.

    Obstacles, truth, hypotheses, detections, and where they are at the moment: their mean, or each way with its share.
    """
    shown, now = slice(steps[0], steps[1] + 1), fan.origin_index - steps[0]
    first_ns, last_ns = int(fan.time_ns[steps[0]]), int(fan.time_ns[steps[1]])
    detections = mission.detections.of(fan.agent).between(first_ns, last_ns)
    track_m = fan.offset_m[:, shown].astype(np.float64) + fan.datum_m
    lines = [(strand, *_between(strand, *steps)) for strand in strands if _between(strand, *steps)[1].size]
    # A few stray hypotheses must not shrink all others to a dot; they are cut at the border.
    low, high = np.percentile(track_m, [4, 96], axis=(0, 1))
    seen_m = detections.position_m
    is_near = ((seen_m >= track_m.min(axis=(0, 1))) & (seen_m <= track_m.max(axis=(0, 1)))).all(axis=1)
    view = View(np.concatenate([low[None], high[None], *(line_m for _, _, line_m in lines), seen_m[is_near]]))
    parts = [draw_obstacle(item, view) for item in mission.obstacles]
    if truth is not None:
        parts.append(draw_line(view.pixels(truth.between(first_ns, last_ns).position_m), "truth"))
    parts += _hypotheses(view.pixels(track_m), fan.weight, now)
    for _, first, line_m in lines:
        line, split = view.pixels(line_m), fan.origin_index - first
        parts += [draw_line(line[: max(split, 0) + 1], "past mean"), draw_line(line[max(split, 0) :], "future mean")]
    age = (fan.origin_ns - detections.time_ns) / max(fan.origin_ns - first_ns, 1)
    parts += _dots(view.pixels(detections.position_m), age)
    parts += [f'<circle class="now" cx="{x:.1f}" cy="{y:.1f}" r="6"/>' for x, y in _now(lines, fan.origin_index, view)]
    parts += [_share(strand, first, view.pixels(line_m)) for strand, first, line_m in lines]
    parts += [scale_bar(view.pixel_per_m), north_arrow()]
    opening = f'<svg class="map" viewBox="0 0 {MAP_WIDTH} {MAP_HEIGHT}" role="img" aria-label="{escape(label)}">'
    return f"{opening}{''.join(parts)}</svg>"


def _between(strand: Strand, first: int, last: int) -> tuple[int, Float64s]:
    """The part of a strand's line within the steps: the step where it begins, and the line [S, 2]."""
    begin = max(strand.first, first)
    return begin, strand.line_m[begin - strand.first : max(last + 1 - strand.first, 0)]


def _now(lines: Sequence[tuple[Strand, int, Float64s]], now: int, view: View) -> list[Float64s]:
    """Where the agent is at the moment: a place for each way."""
    there = [(strand, line_m[now - first]) for strand, first, line_m in lines if first <= now < first + len(line_m)]
    ways = [place_m for strand, place_m in there if strand.hypothesis is not None]
    return [view.pixels(place_m) for place_m in ways or [place_m for _, place_m in there]]


def _share(strand: Strand, first: int, line: Float64s) -> str:
    """How many of the hypotheses go this way, where the ways are furthest apart."""
    if strand.share == 1.0 or not first <= strand.apart < first + len(line):
        return ""
    x, y = np.clip(line[strand.apart - first] + (6, -4), (4, 14), (MAP_WIDTH - 4, MAP_HEIGHT - 30))
    is_right = x > MAP_WIDTH - 110
    x, anchor = (min(x - 12, MAP_WIDTH - 36), "end") if is_right else (x, "start")
    words = f"{100 * strand.share:.0f} % {strand.direction}"
    return f'<text class="share" x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{words}</text>'


def _hypotheses(pixels: Float64s, weight: Float64s, now: int) -> list[str]:
    """The heaviest hypotheses [K, T, 2], stronger where heavier; step `now` is the origin."""
    heaviest = np.sort(np.argsort(-weight, kind="stable")[:MAX_STATIC_HYPOTHESES])
    base = min(0.8, max(0.16, 2.4 / math.sqrt(len(heaviest))))
    parts = []
    for k in heaviest.tolist():
        opacity = max(0.05, base * float(weight[k] / weight.max()))
        parts += [draw_line(pixels[k, : now + 1], "past", opacity), draw_line(pixels[k, now:], "future", opacity)]
    return parts


def _dots(pixels: Float64s, age: Float64s) -> list[str]:
    """Detections of [N, 2] pixels, fading with age [N] (negative: after the origin); of those that cover each other one."""
    parts: list[str] = []
    latest: tuple[float, float, bool] | None = None
    for (x, y), share in zip(pixels.tolist(), age.tolist(), strict=True):
        is_later = share < 0
        if latest is not None and latest[2] == is_later and math.hypot(x - latest[0], y - latest[1]) < 5:
            continue
        latest = (x, y, is_later)
        look = 'class="later"' if is_later else f'class="detection" fill-opacity="{1 - 0.75 * min(share, 1):.2f}"'
        parts.append(f'<circle {look} cx="{x:.1f}" cy="{y:.1f}" r="3.2"/>')
    return parts


def north_arrow(width: int = MAP_WIDTH) -> str:
    """An arrow at the upper right."""
    return (
        f'<g class="furniture" transform="translate({width - 20} 26)"><path d="M0 -14 L5 2 L0 -2 L-5 2 Z"/>'
        '<text y="15" text-anchor="middle">N</text></g>'
    )


def scale_bar(pixel_per_m: float, height: int = MAP_HEIGHT) -> str:
    """A bar of a round length at the lower left."""
    length_m = nice_length(MAP_WIDTH * 0.28 / pixel_per_m)
    width = length_m * pixel_per_m
    bottom = height - 12
    return (
        f'<g class="furniture"><path class="bar" d="M12 {bottom - 5} v5 h{width:.1f} v-5"/>'
        f'<text x="{12 + width / 2:.1f}" y="{bottom - 7}" text-anchor="middle">{metres(length_m)}</text></g>'
    )


def draw_line(pixels: Float64s, kind: str, opacity: float | None = None) -> str:
    """A polyline of [N, 2] pixels and a class of the style sheet; empty for less than two points."""
    if len(pixels) < 2:
        return ""
    kept = simplify(pixels)
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in kept)
    faded = f' stroke-opacity="{opacity:.2f}"' if opacity is not None else ""
    return f'<polyline class="{kind}" points="{points}"{faded}/>'


def simplify(pixels: Float64s, tolerance: float = 0.4) -> Float64s:
    """[N, 2] without the points that lie closer than `tolerance` pixels to the chord (Douglas and Peucker, 1973)."""
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


def draw_obstacle(item: Obstacle, view: View) -> str:
    """Its outline and holes, or its circle, with its name where a pointer rests."""
    title = f"<title>{escape(item.name)}</title>" if item.name else ""
    if item.centre_m is not None:
        x, y = view.pixels(np.array(item.centre_m))
        return f'<circle class="obstacle" cx="{x:.1f}" cy="{y:.1f}" r="{item.radius_m * view.pixel_per_m:.1f}">{title}</circle>'
    rings = [" L".join(f"{x:.1f} {y:.1f}" for x, y in simplify(view.pixels(ring))) for ring in item.rings_m if len(ring)]
    return f'<path class="obstacle" d="{" ".join(f"M{ring} Z" for ring in rings)}">{title}</path>'
