"""Positions that were not measured as they stand: repeated while the target went on, run over, or rounded degrees."""

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from cadence.arrays import Bools, Float64s, Int64s
from pipeline.counted import counted
from pipeline.extract.positions import Positions
from pipeline.frames import DEGREE_M
from pipeline.suspicions import Suspicions

_MIN_RUN: Final = 5
_MAX_REPEATS: Final = 0.1
"""Of the other steps: a source that repeats itself now and then tells the time of its positions badly, and nothing more."""
_LEAP: Final = 10.0
_PACE: Final = 3.0
"""After a repetition the target is many usual steps off, as far as its usual speed takes it meanwhile, within this factor."""
_DECIMALS: Final = (1, 2, 3)
_MIN_ROWS: Final = 10
_MIN_PLACES: Final = 3
_UNIFORM: Final = 12.0**0.5
_MIN_HELD: Final = 8
_MIN_REPEATED: Final = 0.5
_MAX_HELD: Final = 3.0
"""Of the places of a target at least so many, and half of them, are repeated; for three times as long as usual it stands."""
_GRIDS_M: Final = (1.0, 0.5, 0.1, 0.05, 0.01)
_GRIDS_DEG: Final = (1.0, 0.1, 0.01, 1e-3, 1e-4, 1e-5, 1e-6)
_GRID_STEPS: Final = 1.5
_GRID_TOLERANCE: Final = 1e-6
"""Of what is rounded, and moves by one step of that at a time, every row tells something."""
_STEPS_M: Final = (0.001, 0.01, 0.1, 1.0)
"""Units in which sensors count metres in 16 bits."""
_SMALL: Final = 0.1


def without_held(rows: Positions, role: str, suspicions: Suspicions) -> Positions:
    """The rows of one reader that tell something new, where most positions of its targets are told several times.

    A node that publishes faster than its receiver measures, or a list of all that was heard lately, tells the last position
    again with a fresh stamp. What is told for longer than as a rule may stand, and stays.
    """
    if role != "detections" or len(rows) < 2 * _MIN_HELD or not suspicions.looks_for("place"):
        return rows
    place, is_held = np.column_stack([rows.first, rows.second]), np.zeros(len(rows), np.bool_)
    grids = _GRIDS_DEG if rows.is_geodetic[0] else _GRIDS_M
    for track in _tracks(rows):
        moments = track[np.diff(rows.time_ns[track], prepend=-1) != 0]  # what is sent twice is no matter
        is_held[moments] = _held(place[moments], grids)
    if not is_held.any():
        return rows
    suspicions.add(
        "place", str(rows.topic[0]),
        seen=f"{int(is_held.sum())} of {len(rows)} positions tell the one before again to the last digit, while targets move "
        "on: it is published more often than measured",
        done="the first of each is used",
        setting=f'where in its [[extract.{role}]], or extract.trusted = ["place"]',
    )  # fmt: skip
    return rows[~is_held]


def _held(place: Float64s, grids: Sequence[float]) -> Bools:
    """Which rows [N] of a track tell again where a moving target was; what moves by steps of a grid does not."""
    found = np.zeros(len(place), np.bool_)
    begin = np.flatnonzero(np.concatenate([[True], (np.diff(place, axis=0) != 0).any(axis=1)]))
    length = np.diff(np.append(begin, len(place)))
    is_repeated = length > 1
    if is_repeated.sum() < max(_MIN_HELD, _MIN_REPEATED * len(begin)) or not np.isfinite(place).all():
        return found
    step = float(np.median(np.abs(np.diff(place[begin], axis=0)).max(axis=1)))
    if step <= _GRID_STEPS * next((grid for grid in grids if _are_multiples(place, grid)), 0.0):
        return found
    usual = float(np.median(length[is_repeated]))
    for first, number in zip(begin[is_repeated].tolist(), length[is_repeated].tolist(), strict=True):
        if number <= _MAX_HELD * usual:
            found[first + 1 : first + number] = True
    return found


def _are_multiples(place: Float64s, grid: float) -> bool:
    scaled = place / grid
    return bool((np.abs(scaled - np.rint(scaled)) < _GRID_TOLERANCE).all())


def without_frozen(rows: Positions, role: str, suspicions: Suspicions) -> Positions:
    """The rows of one reader without those that repeat one position to the last digit while the target went on.

    A receiver that lost its fix, or a tracker that holds what it lost, goes on telling the last position with fresh stamps. One
    that stands, and says so exactly, is found near there afterwards.
    """
    if len(rows) < 2 * _MIN_RUN or not suspicions.looks_for("place"):
        return rows
    place = _metres(rows)
    is_frozen = np.zeros(len(rows), np.bool_)
    for track in _tracks(rows):
        is_frozen[track] = _frozen(place[track], rows.time_ns[track].astype(np.float64) * 1e-9)
    if not is_frozen.any():
        return rows
    number = int(is_frozen.sum())
    repeat = counted(number, f"of {len(rows)} positions repeats", f"of {len(rows)} positions repeat")
    suspicions.add(
        "place", str(rows.topic[0]),
        seen=f"{repeat} the one before to the last digit, after which the target is where its speed has taken it meanwhile",
        done="the first of each is used, the others are left out",
        setting=f'where in its [[extract.{role}]] (a condition that tells them), or extract.trusted = ["place"]',
    )  # fmt: skip
    return rows[~is_frozen]


def check_wrapped(rows: Positions, role: str, suspicions: Suspicions) -> None:
    """Tell of metres that jump from one end of what 16 bits hold to the other: a number that ran over."""
    if len(rows) < _MIN_ROWS or rows.is_geodetic.any() or not suspicions.looks_for("place"):
        return
    for axis, values in (("x", rows.first), ("y", rows.second)):
        for step_m in _STEPS_M:
            number = sum(_wraps(values[track], 2**16 * step_m) for track in _tracks(rows))
            if number:
                times = counted(number, "time")
                suspicions.add(
                    "place", str(rows.topic[0]),
                    seen=f"{axis} jumps {times} by {2**16 * step_m:g} m, from one end of what 16 bits hold to the other",
                    done="used as it stands",
                    setting=f'{axis} in its [[extract.{role}]], of a field that is wide enough, or extract.trusted = ["place"]',
                )  # fmt: skip


def _wraps(values: Float64s, width_m: float) -> int:
    """How often a coordinate [N] of a track runs over, if it is in fields of that width; it moves in small steps else."""
    reach, step = np.abs(values), np.abs(np.diff(values))
    if not len(step) or not 0.45 * width_m < reach.max() <= 0.5 * width_m or np.quantile(step, 0.75) > _SMALL * width_m:
        return 0
    is_over = np.abs(step - width_m) < _SMALL * width_m
    return int((is_over & (np.minimum(reach[1:], reach[:-1]) > 0.4 * width_m)).sum())


def with_rounding(rows: Positions, role: str, is_told: bool, suspicions: Suspicions) -> Positions:
    """The rows of one reader in degrees, no more exact than their decimals are; `is_told`: the user states an accuracy."""
    if len(rows) < _MIN_ROWS or not rows.is_geodetic.all() or is_told or not suspicions.looks_for("place"):
        return rows
    places = np.column_stack([rows.first, rows.second])
    decimals = next((d for d in _DECIMALS if _has_decimals(places, d)), None)
    if decimals is None or _has_decimals(places, 0) or len(np.unique(places, axis=0)) < _MIN_PLACES:
        return rows
    step_m = DEGREE_M / 10**decimals
    north2 = (step_m / _UNIFORM) ** 2
    least = np.column_stack([north2 * np.cos(np.radians(rows.first)) ** 2, np.zeros(len(rows)), np.full(len(rows), north2)])
    is_finer = np.asarray(~(rows.covariance_m2[:, [0, 2]] >= least[:, [0, 2]]).all(axis=1))
    if not is_finer.any():
        return rows
    suspicions.add(
        "place", str(rows.topic[0]),
        seen=f"no position has more than {counted(decimals, 'decimal')} of a degree: they are rounded to {step_m:.0f} m",
        done=f"a standard deviation of {north2**0.5:.3g} m is taken",
        setting=f'sigma_m in its [[extract.{role}]], or extract.trusted = ["place"]',
    )  # fmt: skip
    return rows.changed(covariance_m2=np.where(is_finer[:, None], least, rows.covariance_m2))


def _has_decimals(places: Float64s, decimals: int) -> bool:
    scaled = places[np.isfinite(places).all(axis=1)] * 10**decimals
    return bool(len(scaled)) and bool((np.abs(scaled - np.rint(scaled)) < 1e-6).all())


def _metres(rows: Positions) -> Float64s:
    """Positions [N, 2] in metres, good for lengths of steps."""
    if not rows.is_geodetic[0]:
        return np.column_stack([rows.first, rows.second])
    return DEGREE_M * np.column_stack([rows.second * np.cos(np.radians(rows.first)), rows.first])


def _tracks(rows: Positions) -> Iterator[Int64s]:
    """Row numbers of what may be one target each: of a name, or of messages with one position that bear none."""
    if rows.agents.names:
        yield from rows.agents.rows()
    elif len(np.unique(rows.message)) == len(rows):
        yield np.arange(len(rows))


def _frozen(place_m: Float64s, time_s: Float64s) -> Bools:
    """Which rows of a track [N] repeat one position while the target went on; the first of each repetition does not."""
    found = np.zeros(len(place_m), np.bool_)
    step_m, step_s = np.hypot(*np.diff(place_m, axis=0).T), np.diff(time_s)
    is_same = step_m == 0
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_same, [False]]).astype(np.int8)))
    runs = [(begin, end) for begin, end in zip(edges[::2], edges[1::2], strict=True) if end - begin >= _MIN_RUN - 1]
    is_run = np.zeros(len(is_same), np.bool_)
    for begin, end in runs:
        is_run[begin:end] = True
    is_usual = ~is_run & (step_s > 0)
    for _, end in runs:
        is_usual[end : end + 1] = False
    if not runs or is_usual.sum() < 2 * _MIN_RUN or is_same[is_usual].mean() > _MAX_REPEATS:
        return found
    usual_s = float(np.median(step_s[is_usual]))
    usual_m, usual_mps = float(np.quantile(step_m[is_usual], 0.9)), float(np.median(step_m[is_usual] / step_s[is_usual]))
    for begin, end in runs:  # rows begin to end are alike, and the step `end` leads away
        if end < len(step_m) and step_s[end] <= _PACE * usual_s:  # after a silence it may as well have stood before
            pace = step_m[end] / max(time_s[end + 1] - time_s[begin], 1e-9)
            if step_m[end] > _LEAP * usual_m and usual_mps / _PACE < pace < usual_mps * _PACE:
                found[begin + 1 : end + 1] = True
    return found
