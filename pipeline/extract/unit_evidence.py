"""In which unit positions can be meant, by their range and by how fast they would move in it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from cadence.arrays import Bools, Float64s
from pipeline.extract.positions import Positions
from pipeline.frames import DEGREE_M, EARTH_CENTRED
from pipeline.mapping.sources import Unit

MIN_RADIUS_M, MAX_RADIUS_M = 6.335e6, 6.41e6
"""From the centre of the earth to the deepest sea, and to the highest flight."""

_RADIUS_M: Final = 6.371e6
_AIS_NONE: Final = (91.0, 181.0)
_UTM_EASTING_M: Final = (1e5, 9e5)
_MAX_HEIGHT_M: Final = 2e4
_MAX_RADIAN_SPEED_MPS: Final = 260.0
"""What would be faster in radians is no vehicle in radians, but a slower one in degrees."""
_MIN_VEHICLE_MPS: Final = 0.3
_MAX_DEGREE_SPEED_MPS: Final = 3e3
"""No aircraft is faster; a walk of 1 m/s in fields of degrees would make 111 km/s."""
_MAX_METRE_SPEED_MPS: Final = 1e3
"""What is faster on the whole of its way flies in space, or is a slower one in millimetres."""
_NULL_ISLAND_DEG: Final = 0.1
"""Simulators without a place are at 0, 0."""
_MIN_SCALED: Final = 1e5
_MAX_SCALED: Final = (9e8, 1.8e9)
_MAX_SCALED_6: Final = (9e7, 1.8e8)
"""Latitude and longitude in 1e-7 and in 1e-6 degrees. Whole numbers within the latter may be either, or parts of minutes."""
_MAX_PLANE_M: Final = 2e7
"""From anywhere on the earth to its other side: no plane is as large."""
_MAX_MINUTES: Final = (9000.0, 18000.0)
_MOST: Final = 0.9
_MIN_ROWS: Final = 10
_SMOOTH: Final = 0.1
"""Rows without a name are one target's where the median step is a smaller share of their extent than this."""
_MAX_WAY_M: Final = 0.5
_MAX_RADIAN_WAY_M: Final = 0.01
_MIN_WAY_RATIO: Final = 20.0
_CRAWL_MPS: Final = (5e-6, 3e-3)
"""Nothing is followed over a mission on a way of under half a metre, but smooth to a twentieth of it, at a speed that would be
that of a vehicle in degrees a second."""

Made = Literal["rad", "1e-7 deg", "ddmm.mm", "ecef", "exchanged", "left out", "as they are"]


@dataclass(frozen=True)
class Evidence:
    """What was seen, what is to be made of the rows, in words too, and what may be written."""

    seen: str
    made: Made
    done: str
    setting: str


def _of_minutes(values: Float64s) -> Float64s:
    """Degrees of degrees and minutes in one number, as NMEA 0183 writes them: 4806.5 is 48° 6.5'."""
    whole = np.trunc(values / 100)
    return np.asarray(whole + (values - 100 * whole) / 60)


TO_DEGREES: Final[Mapping[Unit, Callable[[Float64s], Float64s]]] = {
    "deg": lambda values: values,
    "rad": np.degrees,
    "1e-7 deg": lambda values: values / 1e7,
    "ddmm.mm": _of_minutes,
}


def in_degrees(rows: Positions, unit: Unit) -> Positions:
    """The rows, whose latitudes and longitudes are in `unit`, in degrees."""
    return rows.changed(first=TO_DEGREES[unit](rows.first), second=TO_DEGREES[unit](rows.second))


def of_degrees(rows: Positions) -> Evidence | None:
    """What fields of degrees hold, where it is not degrees."""
    is_stated = np.isfinite(rows.first) & np.isfinite(rows.second) & ((rows.first != 0) | (rows.second != 0))
    is_stated &= rows.first != rows.second  # as devices write what they do not know: -1, 999, -2e10
    rows = rows[is_stated & (np.abs(rows.first) != _AIS_NONE[0]) & (np.abs(rows.second) != _AIS_NONE[1])]
    if len(rows) < 2:
        return None
    seen = f"latitudes {_range(rows.first)}, longitudes {_range(rows.second)}"
    return (
        _of_whole_numbers(rows, seen) or _of_far_numbers(rows, seen) or _of_radians(rows, seen) or _of_cut_numbers(rows, seen)
    )


def of_metres(rows: Positions) -> Evidence | None:
    """What fields of metres hold, where it is not metres of a plane."""
    rows = rows[np.isfinite(rows.first) & np.isfinite(rows.second) & ~rows.is_geodetic]
    if len(rows) < 2:
        return None
    radius_m = np.hypot(np.hypot(rows.first, rows.second), np.nan_to_num(rows.z_m))
    is_utm = (rows.first > _UTM_EASTING_M[0]) & (rows.first < _UTM_EASTING_M[1]) & (np.abs(rows.z_m) < _MAX_HEIGHT_M)
    is_on_ground = (radius_m > MIN_RADIUS_M) & (radius_m < MAX_RADIUS_M)
    if np.mean(is_on_ground) >= _MOST and not is_utm.all() and np.isfinite(rows.z_m).all():
        seen = f"positions {np.median(radius_m) / 1e3:.0f} km from zero, as from the centre of the earth to its surface"
        return Evidence(seen, "ecef", "read as earth-centred", 'unit = "ecef" or "m"')
    named = rows.frame_id[are_earth_centred(rows)]
    if len(named) and np.any(radius_m):  # zeros alone are what stands for none
        seen = f"frame {named[0]}, the earth's centre by its name, but positions {np.median(radius_m):.4g} m from zero"
        return Evidence(seen, "as they are", "used as metres of a plane", 'unit = "m"')
    return _of_far_metres(rows, radius_m) or _of_crawling(rows)


def are_earth_centred(rows: Positions) -> Bools:
    """Which rows [N] are in a frame that is at the centre of the earth by its name."""
    are_named = [name.rpartition("/")[2].lower() in EARTH_CENTRED for name in rows.frames.names]
    return np.array(are_named)[rows.frames.number] if any(are_named) else np.zeros(len(rows), np.bool_)


def _of_whole_numbers(rows: Positions, seen: str) -> Evidence | None:
    """Degrees times a power of ten, in integers."""
    latitude, longitude = np.abs(rows.first), np.abs(rows.second)
    are_whole = (np.concatenate([latitude, longitude]) % 1 == 0).mean() >= _MOST
    if not are_whole or np.median(latitude) <= _MIN_SCALED or np.quantile(latitude, _MOST) > _MAX_SCALED[0]:
        return None
    if np.median(latitude) > _MAX_SCALED_6[0] or np.median(longitude) > _MAX_SCALED_6[1]:
        return Evidence(f"{seen}, whole numbers", "1e-7 deg", "read as 1e-7 degrees", 'unit = "1e-7 deg" or "deg"')
    seen += ", whole numbers: 1e-7 or 1e-6 degrees, parts of minutes, or metres (UTM)"
    return Evidence(seen, "left out", "left out", 'unit = "1e-7 deg", latitude = "PATH.@mul(1e-6)" and so on, or x and y,')


def _of_far_numbers(rows: Positions, seen: str) -> Evidence | None:
    """Numbers beyond those of degrees, or that move as no degrees do."""
    latitude, longitude = np.abs(rows.first), np.abs(rows.second)
    speed_mps = _speed_mps(rows[(latitude <= 90) & (longitude <= 360)], DEGREE_M)
    share_off = np.mean(latitude > 90)
    if share_off >= _MOST and longitude.max() <= 90 and latitude.max() <= 180:
        done = "latitude and longitude are exchanged"
        return Evidence(f"{seen}, and no latitude is beyond 90", "exchanged", done, 'latitude and longitude, or unit = "deg"')
    if np.mean((latitude > 90) | (longitude > 360)) >= _MOST and _are_minutes(rows):
        seen += ", with no minutes beyond 59 and the speed of a vehicle as degrees and minutes (NMEA)"
        return Evidence(seen, "ddmm.mm", "read as degrees and minutes", 'unit = "ddmm.mm" or "deg"')
    if share_off >= 0.5 or (speed_mps or 0.0) > _MAX_DEGREE_SPEED_MPS:
        seen += "" if speed_mps is None else f", which would move at {speed_mps:.3g} m/s"
        minutes = 'unit = "ddmm.mm" (degrees and minutes), ' * bool(((latitude % 100 < 60) & (longitude % 100 < 60)).all())
        return Evidence(f"{seen}, may be metres", "left out", "left out", f'x and y, {minutes}or unit = "deg"')
    return None


def _are_minutes(rows: Positions) -> bool:
    """Whether numbers can be degrees and minutes in one, of something that moves."""
    latitude, longitude = np.abs(rows.first), np.abs(rows.second)
    if latitude.max() > _MAX_MINUTES[0] or longitude.max() > _MAX_MINUTES[1]:
        return False
    speed_mps = _speed_mps(in_degrees(rows, "ddmm.mm"), DEGREE_M) or 0.0
    return bool(((latitude % 100 < 60) & (longitude % 100 < 60)).all() and _MIN_VEHICLE_MPS < speed_mps < _MAX_RADIAN_SPEED_MPS)


def _of_radians(rows: Positions, seen: str) -> Evidence | None:
    latitude, longitude = np.abs(rows.first), np.abs(rows.second)
    is_anywhere = np.median(np.hypot(latitude, longitude)) > _NULL_ISLAND_DEG
    if latitude.max() > np.pi / 2 or longitude.max() > np.pi or not is_anywhere:
        return None
    speed_mps, radian_mps = _speed_mps(rows, DEGREE_M), _speed_mps(in_degrees(rows, "rad"), DEGREE_M) or 0.0
    if radian_mps > _MAX_RADIAN_SPEED_MPS or (_has_decimals(latitude) and _has_decimals(longitude)):
        return None
    seen += ": off Africa, where no land is, or anywhere if these are radians"
    seen += "" if speed_mps is None else f" ({speed_mps:.3g} m/s in degrees, {radian_mps:.3g} m/s in radians)"
    return Evidence(seen, "rad", "read as radians", 'unit = "rad" or "deg"')


def _of_cut_numbers(rows: Positions, seen: str) -> Evidence | None:
    """Whole degrees, of which the decimals were lost: each is a hundred kilometres wide."""
    if len(rows) < _MIN_ROWS or (rows.first % 1 != 0).any() or (rows.second % 1 != 0).any():
        return None
    return Evidence(f"{seen}, all without decimals", "as they are", "used as they stand", 'unit = "deg"')


def _of_far_metres(rows: Positions, radius_m: Float64s) -> Evidence | None:
    """Whole numbers beyond any plane, and what would be too fast all the way."""
    both = np.abs(np.column_stack([rows.first, rows.second]))
    if (both % 1 == 0).all() and np.median(radius_m) > _MAX_PLANE_M and both.max() <= _MAX_SCALED[1]:
        seen = f"x {_range(rows.first)}, y {_range(rows.second)}, whole numbers, which may be 1e-7 degrees"
        return Evidence(seen, "left out", "left out", 'latitude and longitude with unit = "1e-7 deg", or unit = "m"')
    speed_mps = _progress_mps(rows, float(np.hypot(np.ptp(rows.first), np.ptp(rows.second))))
    if speed_mps > _MAX_METRE_SPEED_MPS:
        seen = f"x {_range(rows.first)}, y {_range(rows.second)}, which move on at {speed_mps:.4g} m/s: may be millimetres"
        return Evidence(seen, "as they are", "used as metres", 'x = "PATH.@mul(0.001)" and so on, or unit = "m",')
    return None


def _of_crawling(rows: Positions) -> Evidence | None:
    """Degrees, or radians, in fields of metres: a smooth way that is too small, of the target with most rows."""
    number = rows.agents.number
    rows = rows[number == np.bincount(number + 1).argmax() - 1]
    way_m, speed_mps = np.hypot(np.ptp(rows.first), np.ptp(rows.second)), _speed_mps(rows, 1.0) or 0.0
    largest = np.abs(rows.first).max(), np.abs(rows.second).max()
    if len(rows) < _MIN_ROWS or way_m >= _MAX_WAY_M or max(largest) > 180 or not _is_smooth(rows, way_m):
        return None
    are_degrees = min(largest) > 1 and _CRAWL_MPS[0] < speed_mps < _CRAWL_MPS[1]
    are_radians = max(largest) <= np.pi and way_m < _MAX_RADIAN_WAY_M and _is_straight(rows, way_m)
    are_radians &= _MIN_VEHICLE_MPS < speed_mps * _RADIUS_M < _MAX_RADIAN_SPEED_MPS
    if not are_degrees and not are_radians:
        return None
    unit, more = ("degrees", "") if are_degrees else ("radians", ' with unit = "rad"')
    seen = f"x {_range(rows.first)}, y {_range(rows.second)}: a way of {way_m:.2g} m, which may be {unit}"
    return Evidence(seen, "as they are", "used as metres", f'latitude and longitude{more}, or unit = "m"')


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
    return len(bend_m) > 0 and bool(np.median(bend_m) * _MIN_WAY_RATIO < way_m)


def _is_straight(rows: Positions, way_m: float) -> bool:
    """Whether the rows, by time, go on steadily: what stands still and drifts does not."""
    order = np.argsort(rows.time_ns, kind="stable")
    steps_m = np.hypot(np.diff(rows.first[order]), np.diff(rows.second[order]))
    return bool(way_m > _MOST * steps_m.sum() and np.quantile(steps_m, 1 - _MOST) > np.median(steps_m) / 2)


def _progress_mps(rows: Positions, way_m: float) -> float:
    """How fast the target with most rows gets on over half of its rows; 0 where that cannot be said.

    Rows without a name are one target's where they are a smooth way of `way_m`.
    """
    agent = rows.agents.number
    if (agent < 0).any() and ((agent >= 0).any() or not _is_smooth(rows, way_m)):
        return 0.0
    track = np.flatnonzero(agent == np.bincount(agent + 1).argmax() - 1)
    track = track[np.argsort(rows.time_ns[track], kind="stable")]
    half = len(track) // 2
    if half < _MIN_ROWS:
        return 0.0
    before, after = track[: len(track) - half], track[half:]
    gone_m = np.hypot(rows.first[after] - rows.first[before], rows.second[after] - rows.second[before])
    return float(np.median(gone_m / np.maximum((rows.time_ns[after] - rows.time_ns[before]) * 1e-9, 1e-9)))


def _speed_mps(rows: Positions, unit_m: float) -> float | None:
    """Median speed between successive rows of an agent; None where rows without a name are not one target's."""
    if len(rows) < 2:
        return None
    agent = rows.agents.number
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
