"""Positions in the unit that they are in: sources have radians, 1e-7 degrees or earth-centred metres where others are expected.

A unit that a source states is taken as it is. Otherwise numbers that cannot be degrees, or can hardly be metres, are recognised
by their range and by how fast they would move, and told as a suspicion.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from cadence.errors import ConfigError
from pipeline.arrays import Bools, Float64s
from pipeline.extract.covariances import rotated
from pipeline.extract.positions import Positions, numbered
from pipeline.frames import from_earth_centred
from pipeline.mapping.sources import SourceConfig, Unit
from pipeline.suspicions import Suspicions

EARTH_CENTRED: Final = {"earth", "ecef"}
"""Frames that REP 105 and receivers have at the centre of the earth: their x and y are no plane."""

_DEGREE_M: Final = 111_195.0
_AIS_NONE: Final = (91.0, 181.0)
_RADII_M: Final = (6.335e6, 6.41e6)
"""From the centre of the earth to the deepest sea, and to the highest flight."""
_MAX_ORBIT_M: Final = 5e7
_UTM_EASTING_M: Final = (1e5, 9e5)
_MAX_HEIGHT_M: Final = 2e4
_MAX_RADIAN_SPEED_MPS: Final = 260.0
"""What would be faster in radians is no vehicle in radians, but a slower one in degrees."""
_MAX_DEGREE_SPEED_MPS: Final = 3e3
"""No aircraft is faster; a walk of 1 m/s in fields of degrees would make 111 km/s."""
_NULL_ISLAND_DEG: Final = 0.1
"""Simulators without a place are at 0, 0."""
_MIN_SCALED: Final = 1e5
_MOST: Final = 0.9
_MIN_ROWS: Final = 10
_MAX_ROWS: Final = 4096
"""More rows of a source would not tell more."""
_SMOOTH: Final = 0.1
"""Rows without a name are one target's where the median step is a smaller share of their extent than this."""
_MAX_WAY_M: Final = 0.5
_MIN_WAY_RATIO: Final = 20.0
_CRAWL_MPS: Final = (5e-6, 3e-3)
"""Nothing is followed over a mission on a way of under half a metre, but smooth to a twentieth of it, at a speed that would be
that of a vehicle in degrees a second."""


@dataclass(frozen=True)
class _Finding:
    """What was seen, what is done with the rows, in words and as a function, and what may be written."""

    seen: str
    done: str
    mend: Callable[[Positions], Positions]
    setting: str


def in_true_units(source: SourceConfig, role: str, rows: Positions, suspicions: Suspicions) -> Positions:
    """The rows of one reader in degrees or metres; those that are neither are left out.

    Raises `ConfigError` where the source states a unit that its positions cannot have.
    """
    if len(rows) == 0:
        return rows
    is_geodetic = bool(rows.is_geodetic.all())
    if source.unit is not None:
        wanted = ("deg", "rad", "1e-7 deg") if is_geodetic else ("m", "ecef")
        if source.unit not in wanted:
            kind, known = "latitude and longitude" if is_geodetic else "x and y", " or ".join(f'"{unit}"' for unit in wanted)
            raise ConfigError(f"extract.{role}, topic {source.topic}: unit {source.unit!r} is none of {kind}; expected {known}")
        return _UNITS[source.unit](rows)
    rows = _named_centre(rows)
    if not suspicions.looks_for("place"):
        return rows
    some = rows[:: 1 + len(rows) // _MAX_ROWS]
    found = _of_degrees(some) if is_geodetic else _of_metres(some)
    if found is None:
        return rows
    setting = f"{found.setting} in its [[extract.{role}]]"
    suspicions.add("place", str(rows.topic[0]), seen=found.seen, done=found.done, setting=setting)
    return found.mend(rows)


def _of_degrees(rows: Positions) -> _Finding | None:
    """What fields of degrees hold, where it is not degrees."""
    is_stated = np.isfinite(rows.first) & np.isfinite(rows.second) & ((rows.first != 0) | (rows.second != 0))
    rows = rows[is_stated & (np.abs(rows.first) != _AIS_NONE[0]) & (np.abs(rows.second) != _AIS_NONE[1])]
    if len(rows) < 2:
        return None
    latitude, longitude = np.abs(rows.first), np.abs(rows.second)
    speed_mps = _speed_mps(rows[(latitude <= 90) & (longitude <= 360)], _DEGREE_M)
    seen = f"latitudes {_range(rows.first)}, longitudes {_range(rows.second)}"
    are_whole = (np.concatenate([latitude, longitude]) % 1 == 0).mean() >= _MOST
    share_off = np.mean(latitude > 90)
    if are_whole and np.median(latitude) > _MIN_SCALED and np.quantile(latitude, _MOST) <= 9e8:
        return _Finding(f"{seen}, whole numbers", "read as 1e-7 degrees", _UNITS["1e-7 deg"], 'unit = "1e-7 deg" or "deg"')
    if share_off >= _MOST and longitude.max() <= 90 and latitude.max() <= 180:
        done = "latitude and longitude are exchanged"
        return _Finding(f"{seen}, and no latitude is beyond 90", done, _exchanged, 'latitude and longitude, or unit = "deg"')
    if share_off >= 0.5 or (speed_mps or 0.0) > _MAX_DEGREE_SPEED_MPS:
        seen += "" if speed_mps is None else f", which would move at {speed_mps:.3g} m/s"
        return _Finding(f"{seen}, may be metres", "left out", lambda rows: rows[:0], 'x and y, or unit = "deg"')
    is_anywhere = np.median(np.hypot(latitude, longitude)) > _NULL_ISLAND_DEG
    if latitude.max() <= np.pi / 2 and longitude.max() <= np.pi and is_anywhere:
        radian_mps = _speed_mps(_UNITS["rad"](rows), _DEGREE_M) or 0.0
        if radian_mps <= _MAX_RADIAN_SPEED_MPS and not (_has_decimals(latitude) and _has_decimals(longitude)):
            seen += ": off Africa, where no land is, or anywhere if these are radians"
            seen += "" if speed_mps is None else f" ({speed_mps:.3g} m/s in degrees, {radian_mps:.3g} m/s in radians)"
            return _Finding(seen, "read as radians", _UNITS["rad"], 'unit = "rad" or "deg"')
    return None


def _of_metres(rows: Positions) -> _Finding | None:
    """What fields of metres hold, where it is not metres of a plane."""
    rows = rows[np.isfinite(rows.first) & np.isfinite(rows.second) & ~rows.is_geodetic]
    if len(rows) < 2:
        return None
    radius_m = np.sqrt(rows.first**2 + rows.second**2 + np.nan_to_num(rows.z_m) ** 2)
    low, high = _RADII_M
    is_utm = (rows.first > _UTM_EASTING_M[0]) & (rows.first < _UTM_EASTING_M[1]) & (np.abs(rows.z_m) < _MAX_HEIGHT_M)
    if np.mean((radius_m > low) & (radius_m < high)) >= _MOST and not is_utm.all() and np.isfinite(rows.z_m).all():
        seen = f"positions {np.median(radius_m) / 1e3:.0f} km from zero, as from the centre of the earth to its surface"
        return _Finding(seen, "read as earth-centred", _UNITS["ecef"], 'unit = "ecef" or "m"')
    named = rows.frame_id[_is_named_centre(rows)]
    if len(named):
        seen = f"frame {named[0]}, the earth's centre by its name, but positions {np.median(radius_m):.4g} m from zero"
        return _Finding(seen, "used as metres of a plane", _UNITS["m"], 'unit = "m"')
    way_m, speed_mps = np.hypot(np.ptp(rows.first), np.ptp(rows.second)), _speed_mps(rows, 1.0) or 0.0
    is_crawl = len(rows) >= _MIN_ROWS and way_m < _MAX_WAY_M and _CRAWL_MPS[0] < speed_mps < _CRAWL_MPS[1]
    is_on_earth = np.abs(rows.first).max() <= 180 and np.abs(rows.second).max() <= 180
    if is_crawl and is_on_earth and min(np.abs(rows.first).max(), np.abs(rows.second).max()) > 1 and _is_smooth(rows, way_m):
        seen = f"x {_range(rows.first)}, y {_range(rows.second)}: a way of {way_m:.2g} m, which may be degrees"
        return _Finding(seen, "used as metres", _UNITS["m"], 'latitude and longitude, or unit = "m"')
    return None


def _range(values: Float64s) -> str:
    return f"from {values.min():.7g} to {values.max():.7g}"


def _has_decimals(values: Float64s) -> bool:
    """Whether all values are given to 1e-7 at most, as degrees mostly are; radians come out of a division."""
    scaled = values * 1e7
    return bool((np.abs(scaled - np.round(scaled)) < 1e-3).all())


def _is_smooth(rows: Positions, way_m: float) -> bool:
    """Whether the rows, by time, are a way whose scatter is far smaller than it."""
    order = np.argsort(rows.time_ns, kind="stable")
    bend_m = np.hypot(np.diff(rows.first[order], 2), np.diff(rows.second[order], 2))
    return bool(np.median(bend_m) * _MIN_WAY_RATIO < way_m)


def _speed_mps(rows: Positions, unit_m: float) -> float | None:
    """Median speed between successive rows of an agent; None where rows without a name are not one target's."""
    if len(rows) < 2:
        return None
    agent = numbered(rows.agent)
    order = np.lexsort((rows.time_ns, agent))
    scale = np.cos(np.radians(np.clip(rows.first[order], -89, 89)[1:])) if rows.is_geodetic[0] else 1.0
    step_m = unit_m * np.hypot(np.diff(rows.first[order]), scale * np.diff(rows.second[order]))
    duration_s = np.diff(rows.time_ns[order]) * 1e-9
    is_pair = (np.diff(agent[order]) == 0) & (duration_s > 0)
    if not is_pair.any():
        return None
    extent_m = unit_m * np.hypot(np.ptp(rows.first), np.ptp(rows.second))
    if (agent < 0).any() and np.median(step_m[is_pair]) > _SMOOTH * extent_m:
        return None
    return float(np.median(step_m[is_pair] / duration_s[is_pair]))


def _exchanged(rows: Positions) -> Positions:
    return replace(rows, first=rows.second, second=rows.first)


def _named_centre(rows: Positions) -> Positions:
    """The rows with those of a frame at the earth's centre in degrees, as far as they are that far from zero."""
    is_named = _is_named_centre(rows)
    if not is_named.any():
        return rows
    radius_m = np.sqrt(rows.first**2 + rows.second**2 + rows.z_m**2)
    return _from_centre(rows, is_named & (radius_m > _RADII_M[0]) & (radius_m < _MAX_ORBIT_M))


def _is_named_centre(rows: Positions) -> Bools:
    named = [name for name in set(rows.frame_id) if str(name).rpartition("/")[2].lower() in EARTH_CENTRED]
    return np.isin(rows.frame_id.astype(np.str_), named) if named else np.zeros(len(rows), np.bool_)


def _from_centre(rows: Positions, is_centred: Bools) -> Positions:
    """The rows with those that are earth-centred in latitude, longitude and height, their covariances east, north, up."""
    is_centred = is_centred & ~rows.is_geodetic
    if not is_centred.any():
        return rows
    found = {name: getattr(rows, name).copy() for name in ("first", "second", "z_m", "covariance_m2", "height_covariance_m2")}
    latitude, longitude, height_m = from_earth_centred(rows.first[is_centred], rows.second[is_centred], rows.z_m[is_centred])
    found["first"][is_centred], found["second"][is_centred], found["z_m"][is_centred] = latitude, longitude, height_m
    full = np.concatenate([rows.covariance_m2[is_centred], rows.height_covariance_m2[is_centred]], axis=1)
    turned = rotated(full, _to_east_north_up(np.radians(latitude), np.radians(longitude)))
    found["covariance_m2"][is_centred], found["height_covariance_m2"][is_centred] = turned[:, :3], turned[:, 3:]
    return replace(rows, is_geodetic=rows.is_geodetic | is_centred, **found)


def _to_east_north_up(latitude: Float64s, longitude: Float64s) -> Float64s:
    """Rotations [N, 3, 3] from the earth's axes to east, north and up at places in radians [N]."""
    sin_lat, cos_lat, sin_lon, cos_lon = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    rows = [
        [-sin_lon, cos_lon, np.zeros_like(sin_lon)],
        [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
        [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
    ]
    return np.ascontiguousarray(np.moveaxis(np.array(rows), -1, 0))


_UNITS: Final[dict[Unit, Callable[[Positions], Positions]]] = {
    "m": lambda rows: rows,
    "ecef": lambda rows: _from_centre(rows, np.ones(len(rows), np.bool_)),
    "deg": lambda rows: rows,
    "rad": lambda rows: replace(rows, first=np.degrees(rows.first), second=np.degrees(rows.second)),
    "1e-7 deg": lambda rows: replace(rows, first=rows.first / 1e7, second=rows.second / 1e7),
}
