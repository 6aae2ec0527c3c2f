"""The first map of the page: the whole mission, by mission hypotheses, which know all that was detected."""

from collections.abc import Iterator
from html import escape

import numpy as np

from cadence.arrays import Float64s
from pipeline.report.maps import View, draw_line, draw_obstacle, north_arrow, scale_bar, simplify
from pipeline.report.markup import legend, section
from pipeline.report.mission import Mission, Points
from pipeline.report.moving import moving_parts
from pipeline.stories import MissionStories

_WIDTH, _HEIGHT = 800, 460
_MAX_LINES = 400
"""Of all agents together: more cannot be told apart."""
_MAX_NAMES = 12
_SHARE = 0.08
"""Of the page's bytes, for lines."""
_VERTEX_BYTES = 13
_TOLERANCE, _MAX_DOTS, _DOT_CELL = 0.5, 1500, 4.0
"""In pixels: what lines may be off by, and how close dots may be; cells grow until there are no more dots than that."""


def whole_section(mission: Mission, max_bytes: float) -> str:
    """The map of the whole mission in a page of `max_bytes`; empty where no mission hypotheses were drawn."""
    if mission.stories is None:
        return ""
    tracks = list(_tracks(mission.stories))
    if not tracks:
        return ""
    view = _view(mission, [line_m for lines in tracks for _, line_m in lines])
    num_stories, lines = _lines(tracks, len(mission.stories.stories.agent_ids), view, max_bytes * _SHARE / _VERTEX_BYTES)
    parts = [draw_obstacle(item, view) for item in mission.obstacles]
    parts += [*_sensors(mission, view), *lines, *_truth(mission, view), *_detections(mission, view)]
    parts += [*_names(mission, view), scale_bar(view.pixel_per_m, _HEIGHT), north_arrow(_WIDTH)]
    lead = _words(mission, num_stories)
    opening = f'<svg class="map whole" viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{escape(lead)}">'
    drawn = f'<div class="moving">{opening}{"".join(parts)}</svg><canvas id="whole-map" class="only-script"></canvas></div>'
    moving = moving_parts(mission.stories, num_stories, view, (_WIDTH, _HEIGHT), mission.start_ns, max_bytes)
    return section("The whole mission", f"{drawn}{moving}{legend(_keys(mission))}", lead)


def _words(mission: Mission, num_stories: int) -> str:
    """What the map shows and what it does not know."""
    told = mission.manifests.get("retrospect", {}).get("summary") or {}
    total = int(told.get("num_hypotheses") or 0)
    count = f"{num_stories} of {total} joint tracks" if total > num_stories else f"{num_stories} joint tracks"
    guidance = (mission.manifests.get("infer", {}).get("config") or {}).get("guidance") or {}
    is_kept_out = bool(mission.obstacles) and guidance.get("mode") != "none"
    known = "motion and obstacles" if is_kept_out else "motion"
    whose = " Whose a detection is differs from track to track." if mission.origins is not None else ""
    return (
        f"Mission hypotheses: {count}, each given all detections of the mission, also those after a moment.{whose} They are of "
        f"{known} alone: the network and evidence are not in them, as they are in the windows below."
    )


def _tracks(found: MissionStories) -> Iterator[list[tuple[int, Float64s]]]:
    """Of each story the agents that are part of it, with their lines [S, 2]."""
    for position_m in found.stories.position_m:
        known = ~np.isnan(position_m[..., 0])
        lines = [(agent, line_m[there]) for agent, (line_m, there) in enumerate(zip(position_m, known, strict=True))]
        if lines := [(agent, line_m) for agent, line_m in lines if len(line_m)]:
            yield lines


def _view(mission: Mission, lines_m: list[Float64s]) -> View:
    """All but a few stray hypotheses, which must not shrink all others to a dot; detections and truth as far as lines go."""
    joined = np.concatenate(lines_m)
    low, high = np.percentile(joined, [1, 99], axis=0)
    known = [mission.detections, *([] if mission.truth is None else [_told_truth(mission)])]
    known_m = np.concatenate([points.position_m for points in known])
    is_near = ((known_m >= joined.min(axis=0)) & (known_m <= joined.max(axis=0))).all(axis=1)
    return View(np.concatenate([low[None], high[None], known_m[is_near]]), 0.06, (_WIDTH, _HEIGHT))


def _lines(tracks: list[list[tuple[int, Float64s]]], num_agents: int, view: View, max_vertices: float) -> tuple[int, list[str]]:
    """How many stories are drawn, and their lines: the first, as they are in no order."""
    parts: list[str] = []
    num_stories, num_vertices = 0, 0
    for lines_m in tracks[: max(1, _MAX_LINES // num_agents)]:
        lines = [simplify(view.pixels(line_m), _TOLERANCE) for _, line_m in lines_m if len(line_m) > 1]
        num_vertices += sum(map(len, lines))
        if num_stories and num_vertices > max_vertices:
            break
        num_stories += 1
        parts += [draw_line(line, "past", 0.3) for line in lines]
    return num_stories, parts


def _sensors(mission: Mission, view: View) -> Iterator[str]:
    """The way of each sensor, and where it ends."""
    for sensor in range(len(mission.sensors)) if mission.poses is not None else ():
        points = mission.poses.of(sensor) if mission.poses is not None else None
        if points is None or not len(points):
            continue
        line = view.pixels(points.position_m)
        x, y = line[-1]
        title = f"<title>{escape(mission.sensors[sensor])}</title>"
        yield draw_line(line, "way")
        yield f'<path class="sensor" d="M{x:.1f} {y - 6:.1f} l6 11 h-12 Z">{title}</path>'


def _truth(mission: Mission, view: View) -> Iterator[str]:
    if mission.truth is None:
        return
    truth = _told_truth(mission)
    for agent in np.unique(truth.owner).tolist():
        yield draw_line(view.pixels(truth.of(agent).position_m), "truth")


def _told_truth(mission: Mission) -> Points:
    """As long as mission hypotheses last."""
    assert mission.truth is not None and mission.stories is not None
    time_ns = mission.stories.time_ns
    return mission.truth.between(int(time_ns[0]), int(time_ns[-1]))


def _detections(mission: Mission, view: View) -> Iterator[str]:
    """Dots; one stands for all in its cell."""
    pixels = view.pixels(mission.detections.position_m)
    pixels = pixels[((pixels >= 0) & (pixels <= (_WIDTH, _HEIGHT))).all(axis=1)]
    cell, chosen = _DOT_CELL / 2, np.arange(len(pixels))
    while len(chosen) > _MAX_DOTS or cell < _DOT_CELL:
        cell *= 2
        chosen = np.sort(np.unique((pixels // cell), axis=0, return_index=True)[1])
    for x, y in pixels[chosen].tolist():
        yield f'<circle class="detection" cx="{x:.1f}" cy="{y:.1f}" r="2.4"/>'


def _names(mission: Mission, view: View) -> Iterator[str]:
    """Of the agents of the stories, at their last detection, where there are several but few."""
    names = mission.stories.stories.agent_ids if mission.stories is not None else ()
    if not 1 < len(names) <= _MAX_NAMES:
        return
    for name in names:
        points = mission.detections.of(mission.agents.index(name)) if name in mission.agents else None
        if points is not None and len(points):
            shifted = view.pixels(points.position_m[-1]) + np.array((7, -6))
            x, y = np.clip(shifted, (4, 14), (_WIDTH - 40, _HEIGHT - 6))
            yield f'<text class="name" x="{x:.1f}" y="{y:.1f}">{escape(name)}</text>'


def _keys(mission: Mission) -> list[tuple[str, str]]:
    keys = [
        ('<polyline class="past" points="0,6 26,6" stroke-opacity=".5"/>', "mission hypotheses"),
        ('<circle class="detection" cx="8" cy="8" r="3"/>', "detections (one dot for those close together)"),
    ]
    keys += [('<polyline class="truth" points="0,8 26,8"/>', "truth")] if mission.truth is not None else []
    keys += [('<rect class="obstacle" x="3" y="2" width="20" height="12"/>', "obstacle")] if mission.obstacles else []
    sensor = '<polyline class="way" points="0,8 26,8"/><path class="sensor" d="M13 2 L19 13 L7 13 Z"/>'
    return [*keys, (sensor, "sensor: its way and where it ends")] if mission.poses is not None else keys
