"""The section of answers: a box a configured question, and events as a list that leads to their moments on the map."""

from collections.abc import Mapping, Sequence
from typing import Any

from pipeline.ask.events import Event
from pipeline.clock import Clock
from pipeline.report.markup import section, table, text
from pipeline.report.mission import Mission

_OPEN_ROWS, _MAX_ROWS = 20, 300


def answers_section(mission: Mission, boxes: Sequence[Mapping[str, Any]], events: Sequence[Event]) -> str:
    """Answers and events; empty where export has left none."""
    if not boxes and not events:
        return ""
    clock = Clock(mission.start_ns, mission.end_ns)
    content = "".join(_box(box) for box in boxes)
    if events:
        rows = [_row(mission, clock, event) for event in events]
        heads = ("from", "to", "what", "how likely", "in words", "")
        content += f"<h3>Events</h3>{table(heads, rows[:_OPEN_ROWS], kind='events')}"
        if len(rows) > _OPEN_ROWS:
            rest = table(heads, rows[_OPEN_ROWS:_MAX_ROWS], kind="events")
            content += f"<details><summary>{len(rows) - _OPEN_ROWS:,} more events</summary>{rest}</details>"
    lead = "From mission hypotheses, which know all that was detected. events.csv says how to compute each event again."
    return section("Answers", content, lead)


def _box(box: Mapping[str, Any]) -> str:
    lines = "".join(f"<li>{text(answer['sentence'])}</li>" for answer in box["answers"])
    return f"<h3>{text(box['name'])}</h3><ul>{lines}</ul>"


def _row(mission: Mission, clock: Clock, event: Event) -> list[str]:
    first = event.agents.split(" and ")[0]
    button = ""
    if first in mission.agents:
        seconds = (event.start_ns - mission.start_ns) / 1e9
        place = f'data-seconds="{seconds:.3f}" data-agent="{mission.agents.index(first)}"'
        button = f'<button type="button" class="only-script" {place}>On the map</button>'
    chance = "" if event.probability is None else _percent(event.probability)
    times = [text(clock.moment(time_ns)) for time_ns in (event.start_ns, event.end_ns)]
    return [*times, text(event.kind), text(chance), text(event.sentence), button]


def _percent(share: float) -> str:
    value = 100.0 * share
    return "< 1 %" if value < 1 else "> 99 %" if value > 99 else f"{value:.0f} %"
