"""Positions in the unit that they are in: sources have radians, 1e-7 degrees or earth-centred metres where others are expected.

A unit that a source states is taken as it is. Otherwise `unit_evidence` tells what the numbers can be, which is told as a
suspicion.
"""

from typing import Final

import numpy as np

from cadence.arrays import Bools
from cadence.errors import ConfigError
from pipeline.extract.covariances import rotated
from pipeline.extract.mixed_units import in_one_reading
from pipeline.extract.positions import Positions
from pipeline.extract.unit_evidence import (
    MIN_RADIUS_M,
    TO_DEGREES,
    Made,
    are_earth_centred,
    in_degrees,
    of_degrees,
    of_metres,
)
from pipeline.frames import east_north_up, from_earth_centred
from pipeline.mapping.sources import SourceConfig, Unit
from pipeline.suspicions import Suspicions

_MAX_ORBIT_M: Final = 5e7
_MAX_ROWS: Final = 2048
"""More rows of a source would not tell more."""


def in_true_units(source: SourceConfig, role: str, rows: Positions, suspicions: Suspicions) -> Positions:
    """The rows of one reader in degrees or metres; those that are neither are left out.

    Raises `ConfigError` where the source states a unit that its positions cannot have.
    """
    if len(rows) == 0:
        return rows
    is_geodetic = bool(rows.is_geodetic.all())
    if source.unit is not None:
        wanted = tuple(TO_DEGREES) if is_geodetic else ("m", "ecef")
        if source.unit not in wanted:
            kind, known = "latitude and longitude" if is_geodetic else "x and y", " or ".join(f'"{unit}"' for unit in wanted)
            raise ConfigError(f"extract.{role}, topic {source.topic}: unit {source.unit!r} is none of {kind}; expected {known}")
        return _made(source.unit, rows)
    rows = _named_centre(rows)
    if not suspicions.looks_for("place"):
        return rows
    some = rows[:: 1 + len(rows) // _MAX_ROWS]
    found = of_degrees(some) if is_geodetic else of_metres(some)
    if found is None:
        return in_one_reading(rows, role, suspicions) if is_geodetic else rows
    setting = f"{found.setting} in its [[extract.{role}]]"
    suspicions.add("place", str(rows.topic[0]), seen=found.seen, done=found.done, setting=setting)
    return _made(found.made, rows)


def _made(what: Made | Unit, rows: Positions) -> Positions:
    """The rows as they are to be read."""
    match what:
        case "rad" | "1e-7 deg" | "ddmm.mm":
            return in_degrees(rows, what)
        case "ecef":
            return _from_centre(rows, np.ones(len(rows), np.bool_))
        case "exchanged":
            return rows.changed(first=rows.second, second=rows.first)
        case "left out":
            return rows[:0]
        case _:
            return rows


def _named_centre(rows: Positions) -> Positions:
    """The rows with those of a frame at the earth's centre in degrees, as far as they are that far from zero."""
    is_named = are_earth_centred(rows)
    if not is_named.any():
        return rows
    radius_m = np.hypot(np.hypot(rows.first, rows.second), rows.z_m)
    return _from_centre(rows, is_named & (radius_m > MIN_RADIUS_M) & (radius_m < _MAX_ORBIT_M))


def _from_centre(rows: Positions, is_centred: Bools) -> Positions:
    """The rows with those that are earth-centred in latitude, longitude and height, their covariances east, north, up."""
    is_centred = is_centred & ~rows.is_geodetic
    if not is_centred.any():
        return rows
    found = {name: getattr(rows, name).copy() for name in ("first", "second", "z_m", "covariance_m2", "height_covariance_m2")}
    latitude, longitude, height_m = from_earth_centred(rows.first[is_centred], rows.second[is_centred], rows.z_m[is_centred])
    found["first"][is_centred], found["second"][is_centred], found["z_m"][is_centred] = latitude, longitude, height_m
    full = np.concatenate([rows.covariance_m2[is_centred], rows.height_covariance_m2[is_centred]], axis=1)
    turned = rotated(full, east_north_up(latitude, longitude))
    found["covariance_m2"][is_centred], found["height_covariance_m2"][is_centred] = turned[:, :3], turned[:, 3:]
    return rows.changed(is_geodetic=rows.is_geodetic | is_centred, **found)
