"""Sources in degrees that change in the midst of a log: to another unit, to exchanged coordinates, or to another sign.

A receiver's software is updated, or two programs write to one topic. Each part by itself looks sound; one target cannot be in
both of the places.
"""

from collections.abc import Callable, Mapping
from typing import Final

import numpy as np

from cadence.arrays import Bools, Float64s
from pipeline.counted import counted
from pipeline.extract.positions import Positions
from pipeline.frames import DEGREE_M
from pipeline.suspicions import Suspicions

_MIN_ROWS: Final = 3
_NEAR_DEG: Final = 1.0
_FAR_DEG: Final = 5.0
_TURN_DEG: Final = 360.0
_MAX_TURNS: Final = 3
"""Of sources that go from one reading to the other more often each may be another target's."""
_MAX_REACH_MPS: Final = 1e3
_MIN_SCALED: Final = 1e5
_UNITS: Final[Mapping[str, Callable[[Float64s], Float64s]]] = {
    "radians": lambda places: np.where((np.abs(places) <= [np.pi / 2, np.pi]).all(), np.degrees(places), np.nan),
    "1e-7 degrees": lambda places: np.where(np.abs(places).max() > _MIN_SCALED, places / 1e7, np.nan),
}
"""Latitudes and longitudes [N, 2] in degrees; NaN where they cannot be in that unit."""
_MIRRORS: Final[Mapping[str, Callable[[Float64s], Float64s]]] = {
    "exchanged": lambda places: places[:, ::-1],
    "of the other side of Greenwich": lambda places: places * [1, -1],
    "of the other side of the equator": lambda places: places * [-1, 1],
}


def in_one_reading(rows: Positions, role: str, suspicions: Suspicions) -> Positions:
    """The rows of one reader in degrees, those in another unit converted, and without those that are mirrored.

    Only where one target would have to leap between the two.
    """
    if np.ptp(rows.first) < _FAR_DEG and np.ptp(rows.second) < _FAR_DEG:  # as of nearly every source
        return rows
    places = np.column_stack([rows.first, rows.second])
    is_told = np.isfinite(places).all(axis=1) & (places != 0).any(axis=1)
    told = np.flatnonzero(is_told)
    if len(told) < 2 * _MIN_ROWS:
        return rows
    able = told[(np.abs(places[told]) <= [90, 360]).all(axis=1)]
    is_far = (_apart_deg(places[told], places[able[:1]]) > _FAR_DEG).any(axis=1)
    if not len(able) or min(is_far.sum(), (~is_far).sum()) < _MIN_ROWS:
        return rows
    groups = [told[~is_far], told[is_far]]
    turns = _leaps(rows[told], np.asarray(is_far))
    for one, other in (groups, groups[::-1]) if turns else ():
        centre = np.median(places[other], axis=0)
        for word, made in {**_UNITS, **(_MIRRORS if turns <= _MAX_TURNS else {})}.items():
            if not (_apart_deg(made(places[one]), centre) < _NEAR_DEG).all():
                continue
            is_mirror = word in _MIRRORS
            if is_mirror and len(one) > len(other):
                continue
            _tell(rows, role, len(one), word, is_mirror, suspicions)
            if is_mirror:
                return rows[np.setdiff1d(np.arange(len(rows)), one)]
            places[one] = made(places[one])
            return rows.changed(first=places[:, 0].copy(), second=places[:, 1].copy())
    return rows


def _apart_deg(places: Float64s, others: Float64s) -> Float64s:
    """Differences [N, 2] of latitudes and longitudes; 179 and -179 are 2 apart, as 359 and 1 are."""
    apart = np.abs(places - others)
    apart[:, 1] = np.where(apart[:, 1] <= _TURN_DEG, np.minimum(apart[:, 1], _TURN_DEG - apart[:, 1]), apart[:, 1])
    return apart


def _leaps(rows: Positions, is_far: Bools) -> int:
    """How often a target goes over to the other group of rows [N]; 0 where one could, or none does."""
    order = np.lexsort((rows.time_ns, rows.agents.number))
    turns = np.flatnonzero((np.diff(is_far[order]) != 0) & (np.diff(rows.agents.number[order]) == 0))
    before, after = order[turns], order[turns + 1]
    places = np.column_stack([rows.first, rows.second])
    way_m = DEGREE_M * _apart_deg(places[after], places[before]).sum(axis=1)
    is_leap = way_m > _MAX_REACH_MPS * (rows.time_ns[after] - rows.time_ns[before]) * 1e-9
    return len(turns) if is_leap.all() else 0


def _tell(rows: Positions, role: str, number: int, word: str, is_mirror: bool, suspicions: Suspicions) -> None:
    lies = counted(number, f"of {len(rows)} positions lies", f"of {len(rows)} positions lie")
    suspicions.add(
        "place", str(rows.topic[0]),
        seen=f"{lies} where the others would lie if they were {word}, and nothing gets from these to those",
        done="left out" if is_mirror else f"read as {word}",
        setting=f'unit = "deg" in its [[extract.{role}]], or where (a condition that tells them)',
    )  # fmt: skip
