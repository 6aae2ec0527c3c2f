"""How a scene looks: colours, lines for hypotheses, marks for detections, outlines for obstacles."""

import colorsys
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.arrays import Float64s, Int64s
from pipeline.export.playback import LiveAgent, Scene
from pipeline.export.scene import Entity, Label, Lines, LineType, Spheres, round_positions
from pipeline.presence import with_presence

# Okabe and Ito (2008), "Color Universal Design": told apart with any colour vision; black is left out (dark backgrounds).
PALETTE = ("#56B4E9", "#E69F00", "#009E73", "#F0E442", "#CC79A7", "#D55E00", "#0072B2")

_GOLDEN_SHARE = 0.618034
_SHADES = ((0.4, 1.0), (1.0, 0.95), (0.6, 0.5), (0.3, 0.75), (0.8, 0.75))
"""Saturation and value of the colours after those."""

_ALPHA_FLOOR, _ALPHA_TOP = 0.10, 0.65
_FUTURE_TINT = 0.5
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
    """Detections of one agent, sorted: time_ns [N], position_m [N, 2] in the mission frame."""

    agent_id: str
    time_ns: Int64s
    position_m: Float64s


@dataclass(frozen=True)
class Style:
    """What the whole mission has in common: colours by agent, size, height, detail, whether origins are unknown."""

    agent_ids: tuple[str, ...]
    center_m: tuple[float, float]
    extent_m: float
    z_m: float
    num_hypotheses: int
    max_vertices: int
    has_unknown_origin: bool = False

    def hue(self, agent_id: str) -> str:
        """The colour of an agent as #RRGGBB; grey for one that was never inferred."""
        return agent_hue(self.agent_ids.index(agent_id)) if agent_id in self.agent_ids else "#999999"

    def color(self, agent_id: str) -> Float64s:
        """Red, green, blue and alpha (0..1) of an agent: the same in the whole file."""
        text = self.hue(agent_id)
        return np.array([*(int(text[i : i + 2], 16) / 255.0 for i in (1, 3, 5)), 1.0])

    def place(self, position_m: Float64s) -> Float64s:
        """Positions [..., 2] rounded for the eye, with the height of the scene [..., 3]."""
        flat = round_positions(position_m, self.extent_m)
        return np.concatenate([flat, np.full((*flat.shape[:-1], 1), self.z_m)], axis=-1)


@dataclass(frozen=True, eq=False)
class Drawing:
    """What stays the same from tick to tick while a scene is shown: the lines of each live agent."""

    scene: Scene
    lines: tuple[tuple[Lines, ...], ...]


def draw(scene: Scene, style: Style) -> Drawing:
    """The drawing of a scene."""
    lines = tuple(_hypothesis_lines(live, style.color(live.agent.agent_id), style) for live in scene.live)
    return Drawing(scene, lines)


def scene_entities(drawing: Drawing | None, time_ns: int, marks: Sequence[Marks], style: Style) -> list[Entity]:
    """Everything to be seen at a time: an entity an agent that is live, and one for each agent's detections so far."""
    if drawing is None:
        return []
    scene = drawing.scene
    entities = [_agent_entity(live, lines, time_ns, style) for live, lines in zip(scene.live, drawing.lines, strict=True)]
    for found in marks:
        first, last = np.searchsorted(found.time_ns, [scene.start_ns, time_ns + 1])
        first = max(first, last - _MAX_MARKS)
        if first < last:
            spheres = Spheres(style.place(found.position_m[first:last]), style.extent_m * 0.008, style.color(found.agent_id))
            entities.append(Entity(f"detections/{found.agent_id}", spheres=(spheres,)))
    return entities


def _agent_entity(live: LiveAgent, lines: tuple[Lines, ...], time_ns: int, style: Style) -> Entity:
    color = style.color(live.agent.agent_id)
    now_m = style.place(live.weight @ live.at(time_ns))
    called = with_presence(live.agent.agent_id, live.agent.probability)
    return Entity(
        f"agent/{live.agent.agent_id}",
        lines=lines,
        spheres=(Spheres(now_m[None], style.extent_m * 0.012, np.array([*color[:3], 0.8])),),
        labels=(Label(now_m + np.array([0.0, style.extent_m * 0.015, 0.0]), called, color),),
    )


def _hypothesis_lines(live: LiveAgent, color: Float64s, style: Style) -> tuple[Lines, ...]:
    """The past solid; the future in a lighter hue and dashed; the mean thicker than the hypotheses."""
    past, future = _vertices(live.window.origin_index, live.window.num_steps, style.max_vertices)
    # The heaviest ones; the order of drawing stays that of their numbers.
    chosen = np.sort(np.argsort(-live.weight, kind="stable")[: style.num_hypotheses])
    track_m = live.position_m[chosen]
    alpha = _ALPHA_FLOOR + (_ALPHA_TOP - _ALPHA_FLOOR) * live.weight[chosen] / live.weight[chosen].max()
    # Alpha as one of 64 levels: long runs of equal bytes compress.
    alpha = np.round(alpha * 64.0) / 64.0
    lighter = color.copy()
    lighter[:3] += _FUTURE_TINT * (1.0 - color[:3])
    groups = []
    for steps, hue, kind in ((past, color, LineType.STRIP), (future, lighter, LineType.LIST)):
        if len(steps) >= 2:
            each = np.column_stack([np.tile(hue[:3], (len(chosen), 1)), alpha])
            groups.append(Lines(style.place(_at_steps(track_m, steps)), each, 1.5, kind))
            groups.append(Lines(style.place(_at_steps(live.mean_m[None], steps)), hue[None], 4.0, kind))
    return tuple(groups)


def _vertices(origin_index: int, num_steps: int, max_vertices: int) -> tuple[Float64s, Float64s]:
    """Steps (may lie between two) at which lines of the past and of the future have their points.

    The future has an even number of points: it is drawn as separate dashes.
    """
    num_past = int(np.clip(round(max_vertices * (origin_index + 1) / num_steps), 2, origin_index + 1)) if origin_index else 0
    room = max(2, max_vertices - num_past) // 2 * 2
    past = np.unique(np.round(np.linspace(0, origin_index, num_past))) if num_past else np.zeros(0)
    future = np.linspace(origin_index, num_steps - 1, room) if origin_index < num_steps - 1 else np.zeros(0)
    return past, future


def _at_steps(track_m: Float64s, steps: Float64s) -> Float64s:
    """Tracks [K, T, 2] at fractional steps [V]: [K, V, 2], linear in between."""
    low = np.floor(steps).astype(np.intp)
    high = np.minimum(low + 1, track_m.shape[1] - 1)
    share = (steps - low)[:, None]
    return np.asarray((1.0 - share) * track_m[:, low] + share * track_m[:, high])


def obstacle_entities(obstacles: Sequence[dict[str, Any]], style: Style) -> list[Entity]:
    """Outlines of obstacles, drawn twice (one above the other) with uprights between: to be seen from any side."""
    height_m = style.extent_m * 0.02
    entities = []
    for number, obstacle in enumerate(obstacles):
        outlines = [style.place(ring) for ring in _rings(obstacle)]
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
