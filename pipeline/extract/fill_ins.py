"""What stands where no position is known: receivers and trackers write zeros and the like, and call them valid."""

from collections import Counter
from collections.abc import Iterator
from typing import Final

import numpy as np

from cadence.arrays import Bools
from pipeline.counted import counted
from pipeline.extract.positions import Positions
from pipeline.frames import DEGREE_M, stands_still
from pipeline.suspicions import Suspicions

_FILL_INS: Final = ((0, 0), (-1, -1), (90, 180), (-90, -180), (180, 180), (999, 999), (9999, 9999), (99999, 99999))
_MIN_REPEATS: Final = 2
_MAX_PLACES: Final = 16
"""So many places of one kind would be a way along an axis or a diagonal, not what a device writes instead of a place."""
_MAX_LATITUDE_DEG: Final = 90.0
_MIN_APART_M: Final = 10.0
_MIN_JUMP_MPS: Final = 10.0
_MIN_TIMES: Final = 3
_MAX_SHARE: Final = 0.3
_MAX_OWN_SHARE: Final = 0.95
"""Of messages with something at the sensor itself, which none of its targets can be at."""
_FAR: Final = 0.1
"""Of several targets without names one may stand at 0, 0, but then it is seen there for long, or others pass."""
_MIN_HELD: Final = 5
_MIN_HELD_M: Final = 1e4
_MAX_REACH_MPS: Final = 1e3
"""A receiver may begin with the place of its maker, or the last one that it knew, and be elsewhere with its first fix."""
_JUMP_RATIO: Final = 10.0
"""A robot that starts at 0, 0 goes on from there. What comes there ten times as fast as it ever moves was not there."""


def without_fill_ins(rows: Positions, role: str, suspicions: Suspicions) -> Positions:
    """The rows of one reader without those at 0, 0 and the like, which are told as a suspicion."""
    if len(rows) == 0 or not suspicions.looks_for("place"):
        return rows
    is_fill_in = _held_at_start(rows)
    for first, second in _candidates(rows):
        is_value = (rows.first == first) & (rows.second == second)
        for of_agent in _by_agent(rows, is_value):
            is_alone = bool(is_value[of_agent].all())
            if is_alone and rows.is_geodetic[0] and (first, second) in _FILL_INS:
                is_fill_in |= is_value & of_agent
            elif not is_alone and _jumps(rows[of_agent], is_value[of_agent]):
                is_fill_in |= is_value & of_agent
            elif (first, second) in _FILL_INS and _are_none(rows[of_agent], is_value[of_agent], len(rows)):
                is_fill_in |= is_value & of_agent
    if not is_fill_in.any():
        return rows
    places = sorted(set(zip(rows.first[is_fill_in], rows.second[is_fill_in], strict=True)))
    found = counted(int(is_fill_in.sum()), f"of {len(rows)} positions is", f"of {len(rows)} positions are")
    at = " and ".join(f"{first:g}, {second:g}" for first, second in places)
    suspicions.add(
        "place", str(rows.topic[0]),
        seen=f"{found} at {at}, where none of the others could come from or go to",
        done="left out",
        setting=f'where in its [[extract.{role}]] (a condition that tells them), or extract.trusted = ["place"]',
    )  # fmt: skip
    return rows[~is_fill_in]


def _candidates(rows: Positions) -> list[tuple[float, float]]:
    """Places of rows that may be fill-ins: known ones, and such as several rows have that look written rather than measured.

    There a coordinate is zero, or both are alike but for a sign.
    """
    size = np.abs(rows.first)
    is_odd = (size == 0) | (rows.second == 0) | (size == np.abs(rows.second)) | (size == _MAX_LATITUDE_DEG)
    is_odd &= np.where(rows.is_geodetic, size <= _MAX_LATITUDE_DEG, np.isfinite(size))  # others are lost anyway
    counts = Counter(zip(rows.first[is_odd].tolist(), rows.second[is_odd].tolist(), strict=True))
    known = [place for place in counts if place in _FILL_INS]
    written = [place for place, count in counts.items() if count >= _MIN_REPEATS and place not in known]
    return known + (written if len(written) <= _MAX_PLACES else [])


def _held_at_start(rows: Positions) -> Bools:
    """Which rows [N] in degrees repeat an agent's first position to the last digit, from where nothing gets to its others."""
    found = np.zeros(len(rows), np.bool_)
    if not rows.is_geodetic[0]:
        return found
    places = np.column_stack([rows.first, rows.second])
    for of_agent in (*rows.agents.rows(), np.flatnonzero(rows.agents.number < 0)):
        is_held = (places[of_agent[:_MIN_HELD]] == places[of_agent[:1]]).all(axis=1)
        if is_held.sum() < _MIN_HELD:
            continue
        step_m = DEGREE_M * np.hypot(*(places[of_agent] - places[of_agent[0]]).T)
        num = int((step_m > 0).argmax())
        way_s = (rows.time_ns[of_agent[num]] - rows.time_ns[of_agent[num - 1]]) * 1e-9
        least_m = max(_MIN_HELD_M, _MAX_REACH_MPS * way_s)
        found[of_agent[:num]] = bool((step_m[num:] > least_m).all()) and num > 0
    return found


def _by_agent(rows: Positions, is_value: Bools) -> Iterator[Bools]:
    """The rows [N] of each agent that has some of a value."""
    for number in np.unique(rows.agents.number[is_value]):
        yield rows.agents.number == number


def _are_none(rows: Positions, is_value: Bools, num_rows: int) -> bool:
    """Whether rows of one name, or without any, of a reader that has `num_rows` are no targets where they are at a place."""
    if is_value.sum() == num_rows:
        return False
    checks = (_fill_lists, _flickers, _at_sensor) if rows.agents.number[0] < 0 else (_fill_lists,)
    return any(check(rows, is_value) for check in checks)


def _flickers(rows: Positions, is_value: Bools) -> bool:
    """Whether rows without a name are at one place now and then, and no others of theirs come near it."""
    times, share = _comings(rows, is_value)
    if times < _MIN_TIMES or share > _MAX_SHARE or is_value.all():
        return False
    unit_m = DEGREE_M if rows.is_geodetic[0] else 1.0
    place, others = (np.column_stack([rows.first, rows.second])[mask] for mask in (is_value, ~is_value))
    others = others[np.isfinite(others).all(axis=1)]
    if not len(others):
        return False
    least_m = unit_m * float(np.hypot(*(others - place[0]).T).min())
    return least_m > max(_MIN_APART_M, _FAR * unit_m * float(np.hypot(*np.ptp(others, axis=0))))


def _at_sensor(rows: Positions, is_value: Bools) -> bool:
    """Whether rows without a name are to the last digit, now and then, where the sensor is in whose frame they are.

    So write cameras that found no depth, and radars with empty places in their lists.
    """
    zeros = rows[is_value]
    is_zero = not (np.any(zeros.first) or np.any(zeros.second) or np.any(np.nan_to_num(zeros.z_m)))
    if not is_zero or rows.is_geodetic[0] or any(not name or stands_still(name) for name in zeros.frames.names):
        return False
    times, share = _comings(rows, is_value)
    return times >= _MIN_TIMES and share < _MAX_OWN_SHARE


def _fill_lists(rows: Positions, is_value: Bools) -> bool:
    """Whether messages have several rows of a name, or without one, at a place: lists of a fixed length that are not full."""
    _, num = np.unique(rows.message[is_value], return_counts=True)
    return len(num) >= _MIN_TIMES and bool(np.median(num) > 1)


def _comings(rows: Positions, is_value: Bools) -> tuple[int, float]:
    """How often rows of a place come up, and the share of the messages that hold some."""
    messages, message = np.unique(rows.message, return_inverse=True)
    is_there = np.zeros(len(messages), np.bool_)
    is_there[message[is_value]] = True
    return int((np.diff(is_there.astype(np.int8), prepend=0) == 1).sum()), float(is_there.mean())


def _jumps(rows: Positions, is_value: Bools) -> bool:
    """Whether the rows of an agent at one place are beyond reach of its others."""
    unit_m = DEGREE_M if rows.is_geodetic[0] else 1.0
    order = np.argsort(rows.time_ns, kind="stable")
    step_m = unit_m * np.hypot(np.diff(rows.first[order]), np.diff(rows.second[order]))
    duration_s = np.diff(rows.time_ns[order]) * 1e-9
    is_pair = np.isfinite(step_m) & (duration_s > 0)
    speed_mps = step_m[is_pair] / duration_s[is_pair]
    is_jump, is_own = (np.diff(is_value[order])[is_pair], ~(is_value[order][1:] | is_value[order][:-1])[is_pair])
    if not is_jump.any():
        return False
    own_mps = float(np.quantile(speed_mps[is_own], 0.95)) if is_own.any() else 0.0
    is_far = float(step_m[is_pair][is_jump].min()) > _MIN_APART_M
    return is_far and bool(np.median(speed_mps[is_jump]) > max(_JUMP_RATIO * own_mps, _MIN_JUMP_MPS))
