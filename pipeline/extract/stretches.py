"""The stretches of a recording between which its own clock was set: their times do not join, and one of them is kept."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from cadence.arrays import Int64s
from pipeline.counted import counted
from pipeline.extract.channel_reader import ChannelReader
from pipeline.extract.mission_clock import TRUSTED
from pipeline.extract.positions import Positions
from pipeline.logs.health import utc
from pipeline.suspicions import Suspicions

_MIN_GAP_S: Final = 86400.0
_GAP_FACTOR: Final = 100.0
_STEP_FACTOR: Final = 1000.0
"""A recorder that is switched off for a day between two passes is believed. One that was off for over a hundred times as long
as everything that it recorded, and a thousand times the usual step, has had its clock set."""
_MIN_BACK_S: Final = 1.0
_MAX_SET: Final = 3
_MAX_LOST: Final = 0.05
"""Of the messages of a channel: so many may be missing where its count is taken to go on."""
_MIN_LEAP_S: Final = 30.0
_LEAP_STEPS: Final = 20.0
_REACH: Final = 1.5
"""Of the usual step of a target: so near to where one more step would have taken it does no chance bring it after a silence of
twenty and more."""
_COURSE_ROWS: Final = 4
_STEADY: Final = 2.0


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
    if not 0 < is_back.sum() <= _MAX_SET or (steps[log_s != 0] < 1).any() or not is_counted[is_back].all():
        return stretch
    stretch[order[1:]] = np.cumsum(is_back)
    return stretch


def without_unjoined(rows: Mapping[str, Positions], primary: str, suspicions: Suspicions) -> dict[str, Positions]:
    """The rows, each role sorted by time, of the stretch of time with most rows of the role `primary`.

    There are several where the clock of the recorder was set by years, or forward by less while targets moved on as if nothing
    had happened: nobody knows how much time lay between them.
    """
    if not suspicions.looks_for("time") or not any(map(len, rows.values())):
        return dict(rows)
    time_ns = np.sort(np.concatenate([found.time_ns for found in rows.values()]))
    edges_ns, why = _edges(time_ns), f"lie over {_GAP_FACTOR:.0f} times their length apart"
    if not len(edges_ns):
        edges_ns, why = _leaps(rows[primary], time_ns), "lie apart, but targets moved on as if no time had passed between them"
    if not len(edges_ns):
        return dict(rows)
    counts = np.bincount(np.searchsorted(edges_ns, rows[primary].time_ns, side="right"), minlength=len(edges_ns) + 1)
    kept = int(counts.argmax())
    found = {role: each[np.searchsorted(edges_ns, each.time_ns, side="right") == kept] for role, each in rows.items()}
    num_lost = sum(len(each) - len(found[role]) for role, each in rows.items())
    first_ns, last_ns = int(found[primary].time_ns[0]), int(found[primary].time_ns[-1])
    lost = counted(num_lost, "position outside is", "positions outside are")
    suspicions.add(
        "time", "the whole log",
        seen=f"{len(counts)} stretches of {', '.join(map(str, counts))} {primary} {why}, as where a clock is set during the "
        "recording",
        done=f"only that from {utc(first_ns)} to {utc(last_ns)} is used, {lost} left out",
        setting=f"extract.start and extract.end choose another, {TRUSTED} takes all",
    )  # fmt: skip
    return found


def _edges(time_ns: Int64s) -> Int64s:
    """The first moments of all stretches but the first, of sorted times, that lie too far apart to be one recording."""
    if time_ns[-1] - time_ns[0] <= _MIN_GAP_S * 1e9:
        return time_ns[:0]
    steps_s = np.diff(time_ns).astype(np.float64) * 1e-9
    is_pause = steps_s > _MIN_GAP_S
    if not is_pause.any():
        return time_ns[:0]
    least_s = max(_GAP_FACTOR * float(steps_s[~is_pause].sum()), _STEP_FACTOR * float(np.median(steps_s)))
    return time_ns[1:][steps_s > max(_MIN_GAP_S, least_s)]


def _leaps(rows: Positions, time_ns: Int64s) -> Int64s:
    """The moments before which all is silent [of `time_ns`, sorted], though the targets of `rows` moved on by one step."""
    steps_ns = np.diff(time_ns)
    is_silent = steps_ns > _MIN_LEAP_S * 1e9
    if not is_silent.any():
        return time_ns[:0]
    is_silent &= steps_ns > _LEAP_STEPS * np.median(steps_ns)
    if not 0 < is_silent.sum() <= _MAX_SET:
        return time_ns[:0]
    names = rows.agents if rows.agents.names else rows.topics
    tracks = [rows[of_name] for of_name in names.rows()]
    return np.array([edge_ns for edge_ns in time_ns[1:][is_silent] if _move_on(tracks, edge_ns)], np.int64)


def _move_on(tracks: Sequence[Positions], edge_ns: int) -> bool:
    """Whether all tracks that tell of it were, at the first row from `edge_ns` on, one step further than before."""
    told = [verdict for track in tracks if (verdict := _moves_on(track, edge_ns)) is not None]
    return bool(told) and all(told)


def _moves_on(track: Positions, edge_ns: int) -> bool | None:
    return moves_on(track, int(np.searchsorted(track.time_ns, edge_ns)))


def moves_on(track: Positions, after: int) -> bool | None:
    """Whether a target was, at the row `after`, one step further than before, whatever the times say that passed there.

    None where its track has too few rows, no steady beat, or does not go straight on.
    """
    if not _COURSE_ROWS <= after <= len(track) - _COURSE_ROWS:
        return None
    place, time_s = track.first + 1j * track.second, (track.time_ns - track.time_ns[0]) * 1e-9
    step, step_s = (np.delete(np.diff(values), after - 1) for values in (place, time_s))
    usual, usual_s = float(np.median(np.abs(step))), float(np.median(step_s))
    near = slice(after - _COURSE_ROWS, after + _COURSE_ROWS - 2)
    courses = step[near].reshape(2, -1).mean(axis=1)
    is_steady = np.quantile(step_s, 0.9) <= _STEADY * usual_s and (usual / _STEADY <= np.abs(courses)).all()
    if not usual > 0 or not is_steady or abs(courses[1] - courses[0]) > usual:
        return None
    return bool(abs(place[after] - place[after - 1] - courses[0]) <= _REACH * usual)
