"""Geodetic positions ↔ the mission frame's metres (x east, y north).

The projection is azimuthal equidistant (`+proj=aeqd`) on WGS 84 about the mission's datum. It has no zones, no central
scale factor and no singularity inside a mission: distances and bearings from the datum are exact on the ellipsoid, and a
circle about the datum is stretched by c / sin(c) with c = distance / earth radius, that is by distance² / (6 R²): 1e-5 at
50 km (1 cm in a kilometre), 4e-5 at 100 km, 1e-3 at 500 km. Universal Transverse Mercator is off by 4e-4 at its very centre
and tears missions at zone edges; a tangent plane shortens distances by distance² / (2 R²), and drops below the horizon.
Covariances stated in local east and north are used as they are: their axes turn against the frame's by the convergence of
the meridians, about (longitude difference) · sin(latitude): 0.5° at 50 km and 50° latitude.
"""

import functools
import re

import numpy as np
from pyproj import Transformer

from cadence.arrays import Float64s
from cadence.errors import InputError
from pipeline.tables import Frame

GEOREFERENCED_FRAME_ID = "mission"
DEFAULT_FRAME_ID = "map"
EARTH_CENTRED = frozenset({"earth", "ecef"})
"""Frames that REP 105 and receivers have at the centre of the earth: their x and y are no plane."""
_FIXED_WORDS = frozenset({
    "map", "odom", "world", "mission", "enu", "ned", "local", "origin", "fixed", "global", "utm", "earth", "ecef", "wgs84",
    "vicon", "mocap", "optitrack", "qualisys",
})  # fmt: skip
DEGREE_M = 111_195.0
"""Of latitude, on a sphere: for what need not be exact."""
DATUM_DECIMALS = 4
"""The datum is rounded to 1e-4 degrees (11 m): easy to state, and equal for small changes of the input."""


def georeferenced_frame(latitude_deg: Float64s, longitude_deg: Float64s, datum: tuple[float, float] | None = None) -> Frame:
    """The mission frame about `datum` (latitude, longitude; degrees), or about the median of the positions [N].

    Raises `InputError` without either.
    """
    if datum is not None:
        return Frame(GEOREFERENCED_FRAME_ID, datum[0], datum[1])
    if latitude_deg.size == 0:
        raise InputError("no position in latitude and longitude to choose a datum from; set extract.datum")
    # Longitudes are counted from the first one, so that a mission across 180° has its middle there, not at 0°.
    offset = (longitude_deg - longitude_deg[0] + 180.0) % 360.0 - 180.0
    longitude = (float(longitude_deg[0] + np.median(offset)) + 180.0) % 360.0 - 180.0
    latitude = round(float(np.median(latitude_deg)), DATUM_DECIMALS)
    return Frame(GEOREFERENCED_FRAME_ID, latitude, round(longitude, DATUM_DECIMALS))


def words_of_frame(name: str) -> set[str]:
    """The words of a frame's name, in small letters."""
    return set(re.split(r"[^a-z0-9]+", name.lower()))


def stands_still(name: str) -> bool:
    """Whether a frame is one that stands still, by the words of its name."""
    return not _FIXED_WORDS.isdisjoint(words_of_frame(name))


def to_local(frame: Frame, latitude_deg: Float64s, longitude_deg: Float64s) -> tuple[Float64s, Float64s]:
    """x_m (east) and y_m (north) in `frame` of positions [N] in degrees."""
    x_m, y_m = _transformer(frame).transform(longitude_deg, latitude_deg)
    return np.asarray(x_m, dtype=np.float64), np.asarray(y_m, dtype=np.float64)


def to_geodetic(frame: Frame, x_m: Float64s, y_m: Float64s) -> tuple[Float64s, Float64s]:
    """latitude_deg and longitude_deg of positions [N] in `frame`."""
    longitude, latitude = _transformer(frame).transform(x_m, y_m, direction="INVERSE")
    return np.asarray(latitude, dtype=np.float64), np.asarray(longitude, dtype=np.float64)


def from_earth_centred(x_m: Float64s, y_m: Float64s, z_m: Float64s) -> tuple[Float64s, Float64s, Float64s]:
    """latitude_deg, longitude_deg and height_m above the ellipsoid of earth-centred positions [N] (ECEF, WGS 84)."""
    transformer = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    longitude, latitude, height_m = transformer.transform(x_m, y_m, z_m)
    return (
        np.asarray(latitude, dtype=np.float64), np.asarray(longitude, dtype=np.float64), np.asarray(height_m, dtype=np.float64)
    )  # fmt: skip


def east_north_up(latitude_deg: Float64s, longitude_deg: Float64s) -> Float64s:
    """Rotations [N, 3, 3] from the axes of the earth (ECEF) to east, north and up at places [N]."""
    latitude, longitude = np.radians(latitude_deg), np.radians(longitude_deg)
    sin_lat, cos_lat, sin_lon, cos_lon = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    rows = [
        [-sin_lon, cos_lon, np.zeros_like(sin_lon)],
        [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
        [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
    ]
    return np.ascontiguousarray(np.moveaxis(np.array(rows), -1, 0))


@functools.cache  # building one takes milliseconds
def _transformer(frame: Frame) -> Transformer:
    if not frame.is_georeferenced:
        raise InputError(f"the mission frame {frame.frame_id!r} has no datum; set extract.datum")
    local = f"+proj=aeqd +lat_0={frame.latitude_deg!r} +lon_0={frame.longitude_deg!r} +datum=WGS84 +units=m +no_defs"
    return Transformer.from_crs("EPSG:4326", local, always_xy=True)
