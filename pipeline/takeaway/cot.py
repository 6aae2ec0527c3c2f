"""Cursor on Target 2.0: where each agent is in the mean, an event a line, as such servers stream them.

`ce` is the radius that holds 68 % of the hypotheses (the schema's one-sigma circle), `stale` when the next event of the agent
comes. The type is an unknown on the ground: who an agent is, and in what it moves, no log says.
"""

from collections.abc import Iterator
from xml.sax.saxutils import quoteattr

import numpy as np

from cadence.arrays import Float64s
from pipeline.takeaway.answer import Answer, Track
from pipeline.takeaway.degrees import DECIMALS, HEIGHT_DECIMALS, coordinates, iso
from pipeline.takeaway.thinned import thin_means

_TYPE, _HOW = "a-u-G", "m-f"
_UNKNOWN = "9999999.0"
_LAST_S = 60
"""The last event of an agent is good for so long."""


def cot_text(answer: Answer) -> Iterator[str]:
    """Events of all agents by time."""
    events = [event for track in thin_means(answer) for event in _events(answer, track)]
    for _, line in sorted(events, key=lambda event: event[0]):
        yield line


def _events(answer: Answer, track: Track) -> Iterator[tuple[int, str]]:
    place = coordinates(answer.frame, track.position_m)
    times = track.time_ns.tolist()
    ends = [*times[1:], times[-1] + _LAST_S * 10**9]
    height = _column(track.height_m, len(track), HEIGHT_DECIMALS)
    radius = _column(track.radius_m, len(track), 1)
    for (lon, lat), time_ns, end_ns, up, ce in zip(place.tolist(), times, ends, height, radius, strict=True):
        point = f'<point lat="{lat:.{DECIMALS}f}" lon="{lon:.{DECIMALS}f}" hae="{up}" ce="{ce}" le="{_UNKNOWN}"/>'
        head = f'uid={quoteattr(f"cadence.{answer.log_id}.{track.agent_id}")} type="{_TYPE}" how="{_HOW}"'
        stamps = f'time="{iso(time_ns)}" start="{iso(time_ns)}" stale="{iso(end_ns)}"'
        detail = f"<detail><contact callsign={quoteattr(track.agent_id)}/></detail>"
        yield time_ns, f'<event version="2.0" {head} {stamps}>{point}{detail}</event>\n'


def _column(values: Float64s | None, num: int, decimals: int) -> list[str]:
    if values is None:
        return [_UNKNOWN] * num
    return [f"{value:.{decimals}f}" if np.isfinite(value) else _UNKNOWN for value in values.tolist()]
