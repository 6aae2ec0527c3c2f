"""How a scene looks: colours, lines for hypotheses, marks for detections, outlines for obstacles."""

import colorsys
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cadence.arrays import Bools, Float64s, Int64s
from cadence.stories import Stories
from pipeline.export import numbers
from pipeline.export.playback import HEIGHT_COUNTS, LiveAgent, Scene
from pipeline.export.scene import Entity, Label, Lines, LineType, Spheres, round_positions
from pipeline.export.sizes import reach_m
from pipeline.export.vertices import visible_vertices
from pipeline.presence import with_presence

# Okabe and Ito (2008), "Color Universal Design": told apart with any colour vision; black is left out (dark backgrounds).
PALETTE = ("#56B4E9", "#E69F00", "#009E73", "#F0E442", "#CC79A7", "#D55E00", "#0072B2")

_GOLDEN_SHARE = 0.618034
_SHADES = ((0.4, 1.0), (1.0, 0.95), (0.6, 0.5), (0.3, 0.75), (0.8, 0.75))
"""Saturation and value of the colours after those."""

_ALPHA_FLOOR, _ALPHA_TOP = 0.10, 0.65
_FUTURE_TINT, _FUTURE_FADE = 0.55, 0.7
_THIN_PX, _THICK_PX = (1.5, 1.0), (4.0, 2.5)
"""Of hypotheses and of the central one: past and future."""

_SEEN_SHARE = 1.0 / 400.0
"""Of what an agent's hypotheses reach: two or three pixels where they fill the screen."""

_STORY_VERTICES = 256
"""Points of a mission hypothesis, in the mean at most: it is drawn once, and far longer than a window."""

_LARGEST_BALL = 2.5
"""How far the ball of an agent grows with its uncertainty, in sizes of its marks."""

_OBSTACLE_COLOR = np.array([0.75, 0.75, 0.75, 0.9])
_MAX_MARKS = 256
_CIRCLE_POINTS = 48


def agent_hue(index: int) -> str:
    """The colour #RRGGBB of agent `index`: first those of `PALETTE`, then more, each far from its neighbours on the wheel."""
    if index < len(PALETTE):
        return PALETTE[index]
    more = index - len(PALETTE)
    rgb = colorsys.hsv_to_rgb(more * _GOLDEN_SHARE % 1.0, *_SHADES[more % len(_SHADES)])
    return "#" + "".join(f"{round(255 * value):02X}" for value in rgb)


@dataclass(frozen=True, eq=False)
class Marks:
    """Detections of one agent, sorted: time_ns [N], position_m [N, 2] in the mission frame.

    height_m  [N] NaN where unknown; None where heights are not used
    """

    agent_id: str
    time_ns: Int64s
    position_m: Float64s
    height_m: Float64s | None = None


@dataclass(frozen=True)
class Style:
    """What the whole mission has in common: colours by agent, sizes, height, detail.

    center_m, extent_m  of all detections: where the camera looks, and from how far
    mark_m              diameter of the marks of each agent that has hypotheses
    plotted_ids         agents with hypotheses, those detected most first: the order in which plots take them
    named_ids           agents whose detections say whose they are
    uncertain_ids       agents that may not be there at all: the log does not say whose its detections are
    z_m                 height of what has none of its own: the mean of all detections, or the lowest where heights are used
    high_ids            agents whose hypotheses have heights
    """

    agent_ids: tuple[str, ...]
    center_m: tuple[float, float]
    extent_m: float
    z_m: float
    num_hypotheses: int
    max_vertices: int
    mark_m: Mapping[str, float]
    plotted_ids: tuple[str, ...] = ()
    named_ids: frozenset[str] = frozenset()
    uncertain_ids: frozenset[str] = frozenset()
    high_ids: frozenset[str] = frozenset()

    def hue(self, agent_id: str) -> str:
        """The colour of an agent as #RRGGBB; grey for one that was never inferred."""
        return agent_hue(self.agent_ids.index(agent_id)) if agent_id in self.agent_ids else "#999999"

    def color(self, agent_id: str) -> Float64s:
        """Red, green, blue and alpha (0..1) of an agent: the same in the whole file."""
        text = self.hue(agent_id)
        return np.array([*(int(text[i : i + 2], 16) / 255.0 for i in (1, 3, 5)), 1.0])

    def size_m(self, agent_id: str) -> float:
        """Diameter of the marks of an agent; of one that was never inferred that of a middling other."""
        if agent_id in self.mark_m:
            return self.mark_m[agent_id]
        return float(np.median(list(self.mark_m.values()))) if self.mark_m else 0.005 * self.extent_m

    def place(self, position_m: Float64s, reach_m: float, height_m: Float64s | None = None) -> Float64s:
        """Positions [..., 2] rounded for the eye, as part of a drawing so wide, with their height or the scene's [..., 3]."""
        flat = round_positions(position_m, reach_m)
        if height_m is None:
            return np.concatenate([flat, np.full((*flat.shape[:-1], 1), self.z_m)], axis=-1)
        known_m = np.where(np.isnan(height_m), self.z_m, height_m)
        return np.concatenate([flat, round_positions(known_m, reach_m / HEIGHT_COUNTS)[..., None]], axis=-1)


def hypothesis_entities(scene: Scene, marks: Sequence[Marks], style: Style) -> list[Entity]:
    """What does not change while a scene is shown: the lines of each live agent, and the detections that they rest on."""
    entities = [Entity(f"agent/{live.agent.agent_id}", lines=_hypothesis_lines(live, style)) for live in scene.live]
    return entities + _detections(marks, scene.start_ns, scene.origin_ns, style)


def present_entities(scene: Scene, time_ns: int, marks: Sequence[Marks], style: Style) -> list[Entity]:
    """What moves: where each live agent is by now, with its name, and the detections since the scene began."""
    found = [_ball(live, time_ns, style) for live in scene.live]
    return found + _detections(marks, scene.origin_ns + 1, time_ns, style)


def _detections(marks: Sequence[Marks], start_ns: int, end_ns: int, style: Style) -> list[Entity]:
    """A sphere a detection from one time to another, the last ones of each agent; half as wide as its other marks."""
    entities = []
    for found in marks:
        first, last = np.searchsorted(found.time_ns, [start_ns, end_ns + 1])
        first = max(first, last - _MAX_MARKS)
        if first < last:
            size_m = 0.5 * style.size_m(found.agent_id)
            height_m = None if found.height_m is None else found.height_m[first:last]
            place_m = style.place(found.position_m[first:last], 256.0 * size_m, height_m)
            entities.append(
                Entity(f"detections/{found.agent_id}", spheres=(Spheres(place_m, size_m, style.color(found.agent_id)),))
            )
    return entities


def _ball(live: LiveAgent, time_ns: int, style: Style) -> Entity:
    """A ball about where the central hypothesis is now, as wide as the hypotheses lie apart, within limits."""
    size_m, color = style.size_m(live.agent.agent_id), style.color(live.agent.agent_id)
    now_m, height_m = live.at(time_ns), live.height_at(time_ns)
    place_m = style.place(now_m[live.central], 256.0 * size_m, None if height_m is None else height_m[live.central])
    wide_m = float(np.clip(2.0 * numbers.spread_m(now_m, live.weight), size_m, _LARGEST_BALL * size_m))
    called = with_presence(live.agent.agent_id, live.agent.probability)
    return Entity(
        f"agent/{live.agent.agent_id}",
        spheres=(Spheres(place_m[None], wide_m, np.array([*color[:3], 0.8])),),
        labels=(Label(place_m + np.array([0.0, 0.75 * wide_m, 0.0]), called, color),),
    )


def _hypothesis_lines(live: LiveAgent, style: Style) -> tuple[Lines, ...]:
    """The past in the agent's colour; the future lighter, thinner and fainter; the central hypothesis thicker than all."""
    # The heaviest ones; the order of drawing stays that of their numbers.
    chosen = np.sort(np.argsort(-live.weight, kind="stable")[: style.num_hypotheses])
    alpha = _ALPHA_FLOOR + (_ALPHA_TOP - _ALPHA_FLOOR) * live.weight[chosen] / live.weight[chosen].max()
    drawn = [*chosen, live.central]
    track_m, height_m = live.position_m[drawn], None if live.height_m is None else live.height_m[drawn]
    seen_m = track_m if height_m is None else np.concatenate([track_m, HEIGHT_COUNTS * height_m[..., None]], axis=-1)
    is_vertex = _vertices(seen_m, live.window.origin_index, style.max_vertices)
    place_m, groups = style.place(track_m, reach_m(live), height_m), []
    for is_future, steps in enumerate((slice(None, live.window.origin_index + 1), slice(live.window.origin_index, None))):
        hue = style.color(live.agent.agent_id)[:3]
        hue = hue + is_future * _FUTURE_TINT * (1.0 - hue)
        # Alpha as one of 64 levels: long runs of equal bytes compress.
        faint = np.round(alpha * (_FUTURE_FADE if is_future else 1.0) * 64.0) / 64.0
        color = np.column_stack([np.tile(hue, (len(track_m), 1)), [*faint, 1.0]])
        for rows, thickness_px in ((slice(None, -1), _THIN_PX), (slice(-1, None), _THICK_PX)):
            groups += _lines(place_m[rows, steps], is_vertex[rows, steps], color[rows], thickness_px[is_future])
    return tuple(groups)


def story_entities(stories: Stories, style: Style) -> list[Entity]:
    """The mission hypotheses of each agent as whole lines in its colour, as far as it is part of them."""
    entities = []
    for agent, name in enumerate(stories.agent_ids):
        is_there = stories.is_present[:, agent]
        rows = np.flatnonzero(is_there.any(axis=1))
        if not len(rows):
            continue
        # Before its beginning and behind its end a line stays where it is, without a point there.
        first, last = is_there[rows].argmax(axis=1), is_there.shape[1] - 1 - is_there[rows, ::-1].argmax(axis=1)
        step = np.clip(np.arange(is_there.shape[1]), first[:, None], last[:, None])
        track_m = seen_m = stories.position_m[rows[:, None], agent, step]
        height_m = None
        if stories.height_m is not None and np.isfinite(stories.height_m[:, agent]).any():
            height_m = stories.height_m[rows[:, None], agent, step]
            seen_m = np.concatenate([track_m, HEIGHT_COUNTS * np.nan_to_num(height_m, nan=style.z_m)[..., None]], axis=-1)
        place_m = style.place(track_m, max(float(np.ptp(track_m, axis=(0, 1)).max()), 1e-3), height_m)
        is_vertex = _vertices(seen_m, 0, _STORY_VERTICES)
        alpha = _ALPHA_FLOOR + (_ALPHA_TOP - _ALPHA_FLOOR) * stories.weight[rows] / stories.weight[rows].max()
        color = np.column_stack([np.tile(style.color(name)[:3], (len(rows), 1)), np.round(alpha * 64.0) / 64.0])
        entities.append(Entity(f"mission/{name}", tuple(_lines(place_m, is_vertex, color, _THIN_PX[0]))))
    return entities


def _vertices(track_m: Float64s, origin_index: int, max_vertices: int) -> Bools:
    """Steps [K, T] at which lines [K, T, D] have points: as few as nobody can tell, and `max_vertices` in the mean at most."""
    tolerance_m = _SEEN_SHARE * max(float(np.ptp(track_m, axis=(0, 1)).max()), 1e-3)
    while True:
        is_vertex = visible_vertices(track_m, origin_index, tolerance_m)
        if is_vertex.sum(axis=1).mean() <= max_vertices:
            return is_vertex
        tolerance_m *= 2.0


def _lines(place_m: Float64s, is_vertex: Bools, color: Float64s, thickness_px: float) -> list[Lines]:
    """Lines through those steps of tracks [K, T, 3] that are vertices, in groups of as many points; none of single points."""
    count = is_vertex.sum(axis=1)
    groups = []
    for num in np.unique(count[count > 1]).tolist():
        rows = count == num
        groups.append(Lines(place_m[rows][is_vertex[rows]].reshape(-1, num, 3), color[rows], thickness_px))
    return groups


def obstacle_entities(obstacles: Sequence[dict[str, Any]], style: Style) -> list[Entity]:
    """Outlines of obstacles, drawn twice (one above the other) with uprights between: to be seen from any side."""
    entities = []
    for number, obstacle in enumerate(obstacles):
        rings = _rings(obstacle)
        wide_m = max((float(np.ptp(ring, axis=0).max()) for ring in rings), default=0.0)
        height_m = min(0.1 * wide_m, 0.02 * style.extent_m)
        outlines = [style.place(ring, wide_m) for ring in rings]
        groups = []
        for ring in outlines:
            roof = ring + np.array([0.0, 0.0, height_m])
            groups += [Lines(level[None], _OBSTACLE_COLOR[None], 2.0, LineType.LOOP) for level in (ring, roof)]
            uprights = np.stack([ring, roof], axis=1)[:: max(1, len(ring) // 12)].reshape(1, -1, 3)
            groups.append(Lines(uprights, _OBSTACLE_COLOR[None], 1.0, LineType.LIST))
        entities.append(Entity(f"obstacle/{number}/{obstacle.get('name') or obstacle['kind']}", tuple(groups)))
    return entities


def _rings(obstacle: dict[str, Any]) -> list[Float64s]:
    """Outline and holes [N, 2], not closed."""
    if obstacle["kind"] == "circle":
        angle = np.linspace(0.0, 2.0 * math.pi, _CIRCLE_POINTS, endpoint=False)
        center = np.array([obstacle["x_m"], obstacle["y_m"]])
        return [center + obstacle["radius_m"] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)]
    rings = [np.asarray(ring, dtype=np.float64).reshape(-1, 2) for ring in obstacle["rings_m"]]
    return [ring[:-1] if len(ring) > 1 and np.array_equal(ring[0], ring[-1]) else ring for ring in rings if len(ring)]
