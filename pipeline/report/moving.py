"""Mission hypotheses that move over the map of the whole mission: what the page's script plays, small enough to embed."""

from string import Template
from typing import Any

import numpy as np

from cadence.arrays import Float64s, Indices
from pipeline.report.maps import View
from pipeline.report.markup import inline_json, numbers_as_base64
from pipeline.stories import MissionStories

_TOLERANCE, _UNIT = 0.7, 16.0
"""In pixels of the map: what a ball may be off by at any time; and so many whole numbers a pixel."""
_FARTHEST = 32767.0
_SHARE, _VERTEX_BYTES = 0.06, 10.7
"""Of the page's bytes; and what a vertex takes of them: four bytes for its step, four for its place, as base64."""

_PARTS = Template("""<div class="timeline only-script">
<button type="button" id="whole-play">Play</button>
<select id="whole-pace" aria-label="times as fast as it was"></select>
<input type="range" id="whole-time" min="0" max="1000" step="1" value="0" aria-label="time">
<output id="whole-moment" for="whole-time"></output>
</div>
<p class="note only-script">A ball is where an agent is in one of $stories of these tracks, its trail where it was before.</p>
<script type="application/json" id="moving">$data</script>
""")


def moving_parts(
    mission: MissionStories, num_stories: int, view: View, size: tuple[int, int], start_ns: int, max_bytes: float
) -> str:
    """The controls below the map and their data: the first `num_stories`, or as many as have room in a page of `max_bytes`."""
    content = moving_content(mission, num_stories, view, size, start_ns, max_bytes)
    return _PARTS.substitute(data=inline_json(content), stories=content["num_stories"])


def moving_content(
    mission: MissionStories, num_stories: int, view: View, size: tuple[int, int], start_ns: int, max_bytes: float
) -> dict[str, Any]:
    """Times as seconds since `start_ns`, and of each track its vertices: numbers of their times, and 16ths of pixels."""
    time_s = (mission.time_ns - start_ns) / 1e9
    counts, steps, places, last = list[int](), list[Indices](), list[Float64s](), 0
    for told, position_m in enumerate(mission.stories.position_m[:num_stories]):
        if told and sum(counts) * _VERTEX_BYTES > max_bytes * _SHARE * told / (told + 1):
            break
        last = told + 1
        for track_m in position_m:
            there = np.flatnonzero(np.isfinite(track_m[:, 0]))
            if len(there):
                pixels = view.pixels(track_m[there])
                kept = kept_steps(time_s[there], pixels, _TOLERANCE)
                counts.append(len(kept))
                steps.append(there[kept])
                places.append(np.clip(np.round(_UNIT * pixels[kept]), -_FARTHEST, _FARTHEST))
    return {
        "size": list(size),
        "num_stories": last,
        "time_s": numbers_as_base64(time_s, "<f8"),
        "num_vertices": numbers_as_base64(counts, "<i4"),
        "step": numbers_as_base64(np.concatenate(steps) if steps else [], "<i4"),
        "place": numbers_as_base64(np.concatenate(places) if places else [], "<i2"),
    }


def kept_steps(time_s: Float64s, place: Float64s, tolerance: float) -> Indices:
    """Steps [V] of a track [T, 2], so that even motion from one to the next is at no time farther off than `tolerance`.

    After Douglas and Peucker (1973), with the distance at the same time: Meratnia and de By (2004), "Spatiotemporal
    compression techniques for moving point objects".
    """
    keep = np.zeros(len(place), dtype=bool)
    keep[[0, -1]] = True
    spans = [(0, len(place) - 1)]
    while spans:
        first, last = spans.pop()
        if last - first < 2:
            continue
        share = (time_s[first + 1 : last] - time_s[first]) / (time_s[last] - time_s[first])
        even = place[first] + share[:, None] * (place[last] - place[first])
        away = np.hypot(*(place[first + 1 : last] - even).T)
        if away.max() > tolerance:
            middle = first + 1 + int(away.argmax())
            keep[middle] = True
            spans += [(first, middle), (middle, last)]
    return np.flatnonzero(keep)
