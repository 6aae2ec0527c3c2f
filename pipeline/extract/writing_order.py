"""A clock that was set back in a log whose messages are not numbered: only the order in which they were written tells."""

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from cadence.arrays import Int64s
from pipeline.counted import counted
from pipeline.extract.channel_reader import ChannelReader
from pipeline.extract.mission_clock import TRUSTED
from pipeline.extract.positions import Positions
from pipeline.extract.stretches import moves_on
from pipeline.logs.reader import MissionLog
from pipeline.logs.timeline import BACK_NS
from pipeline.suspicions import Suspicions

_MAX_SET: Final = 3

Parts = dict[str, list[tuple[ChannelReader, Positions]]]


def without_set_back_unnumbered(parts: Parts, log: MissionLog, suspicions: Suspicions) -> Parts:
    """The rows of every reader by role, of the longest stretch in which messages were written by time.

    Where log times step back in the order of writing, while targets move on over the step as if no time had passed, the clock
    was set. Messages that somebody sorted in another way, one agent after the other, have no target that moves on over a step.
    Nothing is said where messages are numbered (`stretches` knows), where no target tells, and where steps are many.
    """
    found = [pair for role in parts.values() for pair in role]
    if not suspicions.looks_for("time") or any(np.ptp(rows.sequence) for _, rows in found if len(rows)):
        return parts
    channel, log_time_ns = log.written({reader.channel.topic for reader, _ in found})
    is_back = np.diff(log_time_ns, prepend=log_time_ns[:1]) < -BACK_NS
    edges = np.flatnonzero(is_back)
    if not 0 < len(edges) <= _MAX_SET:
        return parts
    places = [_places(reader, rows, channel, log_time_ns) for reader, rows in found]
    if any(place is None for place in places):
        return parts
    known = [place for place in places if place is not None]
    if not all(_moves_on(found, known, edge) for edge in edges.tolist()):
        return parts
    stretch = np.cumsum(is_back)
    kept = int(np.bincount(np.concatenate([stretch[place] for place in known])).argmax())
    is_kept = {id(reader): stretch[place] == kept for (reader, _), place in zip(found, known, strict=True)}
    num_lost = sum(int((~mask).sum()) for mask in is_kept.values())
    lost = counted(num_lost, "position in another is", "positions in others are")
    suspicions.add(
        "time", "the whole log",
        seen=f"log times step back {counted(len(edges), 'time')} in the order in which messages were written, by "
        f"{_steps(log_time_ns, edges)}, while targets move on, as where a clock is set during the recording",
        done=f"only the longest stretch between two steps is used, {lost} left out",
        setting=f"extract.start and extract.end choose another, {TRUSTED} takes all",
    )  # fmt: skip
    return {role: [(reader, rows[is_kept[id(reader)]]) for reader, rows in each] for role, each in parts.items()}


def _places(reader: ChannelReader, rows: Positions, channel: Int64s, log_time_ns: Int64s) -> Int64s | None:
    """Of each row [N] the place of its message in the order of writing; None where messages are missing among those read."""
    written = np.flatnonzero(channel == reader.channel.id)
    if reader.counts["messages"] != len(written):
        return None
    read = written[np.argsort(log_time_ns[written], kind="stable")]
    return np.asarray(read[rows.message - 1])


def _moves_on(found: Sequence[tuple[ChannelReader, Positions]], places: Sequence[Int64s], edge: int) -> bool:
    """Whether some track moves on over a step back, and none does not."""
    told = [verdict for track, after in _tracks(found, places, edge) if (verdict := moves_on(track, after)) is not None]
    return bool(told) and all(told)


def _tracks(
    found: Sequence[tuple[ChannelReader, Positions]], places: Sequence[Int64s], edge: int
) -> Iterator[tuple[Positions, int]]:
    """Every target's rows in the order of writing, and which of them is the first from `edge` on."""
    for (_, rows), place in zip(found, places, strict=True):
        order = np.argsort(place, kind="stable")
        names = rows[order].agents if rows.agents.names else rows[order].topics
        for of_name in names.rows():
            chosen = order[of_name]
            yield rows[chosen], int(np.searchsorted(place[chosen], edge))


def _steps(log_time_ns: Int64s, edges: Int64s) -> str:
    return ", ".join(f"{(log_time_ns[edge - 1] - log_time_ns[edge]) * 1e-9:.3g} s" for edge in edges.tolist())
