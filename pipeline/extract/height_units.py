"""Heights in metres: what is in feet or flight levels, by what the source states or by what the numbers can be."""

from collections import Counter
from typing import Final

import numpy as np

from cadence.arrays import Bools, Float64s
from pipeline.counted import counted
from pipeline.extract.positions import Positions
from pipeline.mapping.sources import HeightUnit, SourceConfig
from pipeline.suspicions import Suspicions

_TO_METRES: Final[dict[HeightUnit, float]] = {"m": 1.0, "ft": 0.3048, "FL": 30.48}
_FILL_INS: Final = (0, -1, -999, -9999, -99999, -32768, -2e10, 999, 9999, 32767, 65535, 99999, 2147483.647)
_MIN_JUMP: Final = 50.0
_JUMP_RATIO: Final = 10.0
_MIN_CLIMB_MPS: Final = 30.0
_MOST: Final = 0.95
"""Aircraft take off and land, but not from one message to the next; in any unit."""
_FEET: Final = 25.0
"""Transponders state multiples of 25 or 100 feet; metres are no multiples of 25."""
_MIN_VALUES: Final = 5
_MIN_FEET: Final = 1000.0
_MAX_HEIGHT_M: Final = 20_000.0
"""Higher than any aircraft in metres; in feet it is six kilometres."""


def heights_in_metres(
    source: SourceConfig, role: str, rows: Positions, counts: Counter[str], suspicions: Suspicions
) -> Positions:
    """The rows of one reader with heights in metres; those that can be none are left out, of the heights alone."""
    rows = _without_fill_ins(rows, role, counts, suspicions)
    if source.height_unit is not None:
        return rows.changed(z_m=rows.z_m * _TO_METRES[source.height_unit])
    height = rows.z_m[np.isfinite(rows.z_m) & (rows.z_m != 0)]
    if not len(height) or not rows.is_geodetic.all() or not suspicions.looks_for("place"):
        return rows
    setting = f'height_unit = "ft" or "m" in its [[extract.{role}]]'
    seen = f"altitudes from {height.min():.6g} to {height.max():.6g}"
    if _are_feet(height):
        suspicions.add(
            "place", str(rows.topic[0]), seen=f"{seen}, all multiples of 25", done="altitudes are read as feet", setting=setting
        )
        return rows.changed(z_m=rows.z_m * _TO_METRES["ft"])
    if np.median(height) > _MAX_HEIGHT_M:
        suspicions.add(
            "place", str(rows.topic[0]), seen=f"{seen}, higher than aircraft fly in metres", done="altitudes are left out",
            setting=setting,
        )  # fmt: skip
        return rows.changed(z_m=np.full(len(rows), np.nan))
    return rows


def _are_feet(height: Float64s) -> bool:
    return bool((height % _FEET == 0).all() and len(np.unique(height)) >= _MIN_VALUES and height.max() > _MIN_FEET)


def _without_fill_ins(rows: Positions, role: str, counts: Counter[str], suspicions: Suspicions) -> Positions:
    """The rows without the heights that stand for none: some of the known values, from which nothing gets to the others.

    A transponder states no altitude on the ground, of which decoders make zero: where a track begins or ends that is counted,
    and no suspicion.
    """
    is_known = np.isin(rows.z_m, _FILL_INS)
    if not is_known.any() or not suspicions.looks_for("place"):
        return rows
    is_fill_in, is_grounded = np.zeros(len(rows), np.bool_), np.zeros(len(rows), np.bool_)
    for number in np.unique(rows.agents.number[is_known]).tolist():
        track = np.flatnonzero((rows.agents.number == number) & np.isfinite(rows.z_m))
        track = track[np.argsort(rows.time_ns[track], kind="stable")]
        for value in np.unique(rows.z_m[track][is_known[track]]).tolist():
            is_value = rows.z_m[track] == value
            time_s = (rows.time_ns[track] - rows.time_ns[track[0]]) * 1e-9
            if not is_value.all() and _jumps(rows.z_m[track], time_s, is_value):
                is_fault = value != 0 or bool(np.diff(np.flatnonzero(~is_value)).max(initial=1) > 1)
                (is_fill_in if is_fault else is_grounded)[track[is_value]] = True
    counts["ground_heights"] += int(is_grounded.sum())
    if is_fill_in.any():
        values = " and ".join(f"{value:g}" for value in np.unique(rows.z_m[is_fill_in]).tolist())
        number = counted(int(is_fill_in.sum()), f"of {len(rows)} altitudes is", f"of {len(rows)} altitudes are")
        suspicions.add(
            "place", str(rows.topic[0]), seen=f"{number} {values}, from where nothing gets to the others",
            done="these altitudes are left out",
            setting=f'altitude or z in its [[extract.{role}]], or extract.trusted = ["place"]',
        )  # fmt: skip
    is_none = is_fill_in | is_grounded
    return rows.changed(z_m=np.where(is_none, np.nan, rows.z_m)) if is_none.any() else rows


def _jumps(height: Float64s, time_s: Float64s, is_value: Bools) -> bool:
    """Whether the heights of a track change far more to a value and back than elsewhere, and faster than anything climbs."""
    step, is_change = np.abs(np.diff(height)), np.diff(is_value)
    if (step[is_change] < _MIN_CLIMB_MPS * np.diff(time_s)[is_change]).any():
        return False
    own = step[~is_change & ~is_value[1:]]
    usual = float(np.quantile(own, _MOST)) if len(own) else 0.0
    return bool(is_change.any()) and float(step[is_change].min()) > max(_MIN_JUMP, _JUMP_RATIO * usual)
