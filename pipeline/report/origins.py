"""The section on detections of unknown origin: which agents were found, how many detections are theirs, how sure that is."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from pipeline.clock import Clock
from pipeline.presence import presence_words
from pipeline.report.markup import section, table, text

SURE = 0.9
OPEN_ROWS, MAX_ROWS = 12, 200


@dataclass(frozen=True)
class FoundAgent:
    """An agent that was found among detections of unknown origin.

    num_detections  of which it is the likeliest source, in the end; num_sure of these at least 90 % likely
    num_expected    sum of the probabilities that it caused a detection
    start_ns, end_ns  of the detections of which it is the likeliest source
    """

    agent_id: str
    num_detections: int
    num_sure: int
    num_expected: float
    start_ns: int
    end_ns: int


@dataclass(frozen=True)
class Origins:
    """Detections of unknown origin: how many there are, how many are taken for clutter, and the agents that were found."""

    num_detections: int
    num_clutter: int
    agents: tuple[FoundAgent, ...]


def likeliest_sources(associations: pa.Table) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of every detection in ASSOCIATIONS: row in DETECTIONS [N], likeliest source (None: clutter) [N], and how likely [N]."""
    detection, probability = associations["detection"].to_numpy(), associations["probability"].to_numpy()
    order = np.lexsort((-probability, detection))
    first = order[np.append(True, np.diff(detection[order]) > 0)] if len(order) else order
    names = np.array(associations["agent_id"].to_pylist(), dtype=object)
    return detection[first], names[first], probability[first]


def with_likeliest(detections: pa.Table, associations: pa.Table) -> pa.Table:
    """The detections with the likeliest agent, as known in the end, as the agent of those that have none."""
    row, name, _ = likeliest_sources(associations)
    names = np.array(detections["agent_id"].to_pylist(), dtype=object)
    names[row] = name
    column = detections.schema.get_field_index("agent_id")
    return detections.set_column(column, detections.schema.field("agent_id"), pa.array(names.tolist(), pa.string()))


def origins_of(detections: pa.Table, associations: pa.Table) -> Origins:
    """What the page tells of the agents that were found."""
    row, name, probability = likeliest_sources(associations)
    time_ns = detections["time_ns"].to_numpy()[row]
    source, chance = np.array(associations["agent_id"].to_pylist(), dtype=object), associations["probability"].to_numpy()
    found = []
    for agent_id in sorted({agent for agent in name if agent is not None}):
        mine = name == agent_id
        times = time_ns[mine]
        expected = float(chance[source == agent_id].sum())
        sure = int((probability[mine] >= SURE).sum())
        found.append(FoundAgent(agent_id, int(mine.sum()), sure, expected, int(times.min()), int(times.max())))
    found.sort(key=lambda agent: (-agent.num_detections, agent.agent_id))
    return Origins(len(row), sum(agent is None for agent in name), tuple(found))


def origins_section(
    origins: Origins | None, start_ns: int, end_ns: int, presence: Mapping[str, float | None], num_tracked: int, found: str
) -> str:
    """A table of the agents that were found, with how likely they are there; empty where the log names its agents.

    `found` says what the stream turned out to be.
    """
    if origins is None:
        return ""
    clock = Clock(start_ns, end_ns)
    rows = [_row(agent, presence.get(agent.agent_id), origins.num_detections, clock) for agent in origins.agents]
    heads = ["agent", "there at best", "detections", "of these 90 % sure", "expected", "first", "last"]
    content = table(heads, rows[:OPEN_ROWS], numeric=(1, 2, 3, 4))
    if len(rows) > OPEN_ROWS:
        rest = table(heads, rows[OPEN_ROWS:MAX_ROWS], numeric=(1, 2, 3, 4))
        content += f"<details><summary>{len(rows) - OPEN_ROWS} more agents</summary>{rest}</details>"
    sure = sum(agent.num_sure for agent in origins.agents)
    lead = (
        f"The log does not say who caused {origins.num_detections:,} of its detections. {num_tracked:,} agents were "
        f"found, {len(origins.agents):,} of them the likeliest source of a detection; {origins.num_clutter:,} detections "
        f"are rather nobody’s. Of {sure:,} it is at least 90 % sure whose they are, as known at the end of the log. Hypotheses "
        "differ in whose the others are; elsewhere on this page each is shown with its likeliest agent."
    )
    told = f"<p>{text(found[:1].upper() + found[1:])}.</p>" if found else ""
    return section("Agents that were found", told + content, lead)


def _row(agent: FoundAgent, chance: float | None, num_detections: int, clock: Clock) -> Sequence[str]:
    return [
        text(agent.agent_id), text(presence_words(chance)), f"{agent.num_detections:,} of {num_detections:,}",
        f"{agent.num_sure:,}", f"{agent.num_expected:.1f}",
        text(clock.moment(agent.start_ns)), text(clock.moment(agent.end_ns)),
    ]  # fmt: skip
