"""The stretches of a recording during which its own clock was set: their times do not join, and one of them is kept."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from pipeline.arrays import Int64s
from pipeline.extract.mission_clock import TRUSTED
from pipeline.extract.positions import ChannelReader, Positions
from pipeline.logs.health import utc
from pipeline.suspicions import Suspicions

_MIN_GAP_S: Final = 86400.0
_GAP_FACTOR: Final = 100.0
_STEP_FACTOR: Final = 1000.0
"""A recorder that is switched off for a day between two passes is believed. One that was off for over a hundred times as long
as everything that it recorded, and a thousand times the usual step, has had its clock set."""
_MIN_BACK_S: Final = 1.0
_MAX_BACK: Final = 3
_MAX_LOST: Final = 0.05
"""Of the messages of a channel: so many may be missing where its count is taken to go on."""


def without_set_back(
    parts: Mapping[str, Sequence[tuple[ChannelReader, Positions]]], suspicions: Suspicions
) -> dict[str, list[tuple[ChannelReader, Positions]]]:
    """The rows of every reader by role, of the longest stretch of the recording during which its clock was not set back.

    A count of messages that goes on where times step back tells of it. Before and after the step the times do not join.
    """
    if not suspicions.looks_for("time"):
        return {role: list(found) for role, found in parts.items()}
    stretches = {id(reader): _stretches(rows) for found in parts.values() for reader, rows in found}
    num_rows = sum((Counter(each.tolist()) for each in stretches.values() if each.any()), Counter[int]())
    kept = max(num_rows, key=lambda stretch: num_rows[stretch], default=0)

    def of_one(reader: ChannelReader, rows: Positions) -> Positions:
        stretch = stretches[id(reader)]
        if not stretch.any():
            return rows
        is_kept = stretch == kept
        suspicions.add(
            "time", reader.channel.topic,
            seen=f"the count of its messages goes on while log times step back {int(stretch.max())} times, as where a clock is "
            "set during the recording",
            done=f"only {int(is_kept.sum())} positions between two steps are used, {int((~is_kept).sum())} are left out",
            setting=f"extract.start and extract.end choose others, {TRUSTED} takes all",
        )  # fmt: skip
        return rows[is_kept]

    return {role: [(reader, of_one(reader, rows)) for reader, rows in found] for role, found in parts.items()}


def _stretches(rows: Positions) -> Int64s:
    """Of each row [N] of a reader the number of steps back of the log time before it, by the count of messages; else zeros."""
    stretch = np.zeros(len(rows), np.int64)
    if (np.diff(rows.sequence) >= 0).all():  # rows are in the order of the log
        return stretch
    order = np.argsort(rows.sequence, kind="stable")
    steps, log_s = np.diff(rows.sequence[order]), np.diff(rows.log_time_ns[order]).astype(np.float64) * 1e-9
    is_counted = steps <= 1 + _MAX_LOST * len(rows)
    is_back = log_s < -_MIN_BACK_S
    if not 0 < is_back.sum() <= _MAX_BACK or (steps[log_s != 0] < 1).any() or not is_counted[is_back].all():
        return stretch
    stretch[order[1:]] = np.cumsum(is_back)
    return stretch


def without_unjoined(rows: Mapping[str, Positions], primary: str, suspicions: Suspicions) -> dict[str, Positions]:
    """The rows, each role sorted by time, of the stretch of time with most rows of the role `primary`.

    There are several where the clock of the recorder was set by years: nobody knows how much time lay between them.
    """
    extent_ns = [time_ns for found in rows.values() if len(found) for time_ns in (found.time_ns[0], found.time_ns[-1])]
    if not extent_ns or max(extent_ns) - min(extent_ns) <= _MIN_GAP_S * 1e9:
        return dict(rows)
    edges_ns = _edges(np.sort(np.concatenate([found.time_ns for found in rows.values()])))
    if not len(edges_ns) or not suspicions.looks_for("time"):
        return dict(rows)
    counts = np.bincount(np.searchsorted(edges_ns, rows[primary].time_ns, side="right"), minlength=len(edges_ns) + 1)
    kept = int(counts.argmax())
    found = {role: each[np.searchsorted(edges_ns, each.time_ns, side="right") == kept] for role, each in rows.items()}
    num_lost = sum(len(each) - len(found[role]) for role, each in rows.items())
    first_ns, last_ns = int(found[primary].time_ns[0]), int(found[primary].time_ns[-1])
    suspicions.add(
        "time", "the whole log",
        seen=f"{len(counts)} stretches of {', '.join(map(str, counts))} {primary} lie over {_GAP_FACTOR:.0f} times their "
        "length apart, as where a clock is set during the recording",
        done=f"only that from {utc(first_ns)} to {utc(last_ns)} is used, {num_lost} positions outside are left out",
        setting=f"extract.start and extract.end choose another, {TRUSTED} takes all",
    )  # fmt: skip
    return found


def _edges(time_ns: Int64s) -> Int64s:
    """The first moments of all stretches but the first, of sorted times."""
    steps_s = np.diff(time_ns).astype(np.float64) * 1e-9
    if not (steps_s > _MIN_GAP_S).any():
        return time_ns[:0]
    is_pause = steps_s > _MIN_GAP_S
    least_s = max(_GAP_FACTOR * float(steps_s[~is_pause].sum()), _STEP_FACTOR * float(np.median(steps_s)))
    return time_ns[1:][steps_s > max(_MIN_GAP_S, least_s)]
