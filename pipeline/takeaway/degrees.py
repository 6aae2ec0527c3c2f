"""Tracks and regions in latitude and longitude, cut where they cross 180°; times as text."""

import itertools
from collections.abc import Iterator
from datetime import UTC, datetime

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from cadence.arrays import Float64s
from pipeline.frames import to_geodetic
from pipeline.tables import Frame
from pipeline.takeaway.answer import Track

DECIMALS = 7
"""Of degrees: a centimetre."""
HEIGHT_DECIMALS = 2


def coordinates(frame: Frame, position_m: Float64s) -> Float64s:
    """Longitude and latitude [N, 2] in degrees of positions [N, 2]."""
    latitude, longitude = to_geodetic(frame, position_m[:, 0], position_m[:, 1])
    place = np.stack([longitude, latitude], axis=-1)
    return np.asarray(np.round(place, DECIMALS), dtype=np.float64)


def pieces(frame: Frame, track: Track) -> Iterator[tuple[Track, Float64s]]:
    """The track with its longitudes and latitudes [T, 2], cut where it crosses 180°: a line would go round the earth."""
    place = coordinates(frame, track.position_m)
    cuts = np.flatnonzero(np.abs(np.diff(place[:, 0])) > 180.0) + 1
    for first, stop in itertools.pairwise([0, *cuts.tolist(), len(track)]):
        yield track.at(slice(first, stop)), place[first:stop]


def region_in_degrees(frame: Frame, shape_m: BaseGeometry) -> BaseGeometry:
    """A region in longitude and latitude, cut at 180° (RFC 7946, section 3.1.9)."""

    def placed(point: Float64s) -> Float64s:
        found = coordinates(frame, point)
        found[:, 0] = (frame.longitude_deg or 0.0) + (found[:, 0] - (frame.longitude_deg or 0.0) + 180.0) % 360.0 - 180.0
        return found

    whole = shapely.make_valid(shapely.transform(shape_m, placed))
    parts = []
    for turn in (-360.0, 0.0, 360.0):
        part = shapely.intersection(whole, shapely.box(-180.0 + turn, -90.0, 180.0 + turn, 90.0))
        if part.area > 0:
            parts.append(shapely.transform(part, lambda point, turn=turn: point - np.array([turn, 0.0])))
    return shapely.union_all(parts) if len(parts) > 1 else parts[0] if parts else whole


def rings(shape: BaseGeometry) -> Iterator[tuple[Float64s, list[Float64s]]]:
    """Outline and holes of each polygon in a region."""
    for part in shapely.get_parts(shape):
        if part.geom_type == "Polygon" and not part.is_empty:
            yield shapely.get_coordinates(part.exterior), [shapely.get_coordinates(hole) for hole in part.interiors]


def iso(time_ns: int) -> str:
    """A time as ISO 8601, UTC, to the millisecond, or to the microsecond where it needs that."""
    second, rest = divmod(int(time_ns), 10**9)
    micros = rest // 1000
    text = datetime.fromtimestamp(second, UTC).strftime("%Y-%m-%dT%H:%M:%S")
    return f"{text}.{micros // 1000:03d}Z" if micros % 1000 == 0 else f"{text}.{micros:06d}Z"
