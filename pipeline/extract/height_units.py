"""Heights in metres: what is in feet or flight levels, by what the source states or by what the numbers can be."""

from typing import Final

import numpy as np

from cadence.arrays import Float64s
from pipeline.extract.positions import Positions
from pipeline.mapping.sources import HeightUnit, SourceConfig
from pipeline.suspicions import Suspicions

_TO_METRES: Final[dict[HeightUnit, float]] = {"m": 1.0, "ft": 0.3048, "FL": 30.48}
_FEET: Final = 25.0
"""Transponders state multiples of 25 or 100 feet; metres are no multiples of 25."""
_MIN_VALUES: Final = 5
_MIN_FEET: Final = 1000.0
_MAX_HEIGHT_M: Final = 20_000.0
"""Higher than any aircraft in metres; in feet it is six kilometres."""


def heights_in_metres(source: SourceConfig, role: str, rows: Positions, suspicions: Suspicions) -> Positions:
    """The rows of one reader with heights in metres; those that can be none are left out, of the heights alone."""
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
