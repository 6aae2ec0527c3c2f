"""Areas and lines as people state them → the mission frame: GeoJSON, circles, points of a line, names of obstacles."""

import itertools
import re
from collections.abc import Mapping, Sequence
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import shapely

from cadence.answers.areas import Area, Disc, Path, Region
from cadence.arrays import Float64s
from cadence.errors import InputError, UsageError
from pipeline.documents import parse_json
from pipeline.frames import to_local
from pipeline.lengths import metres
from pipeline.suggestions import did_you_mean
from pipeline.tables import Frame

_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_CIRCLE = re.compile(rf"\s*({_NUMBER})\s*,\s*({_NUMBER})\s*,\s*({_NUMBER})\s*")
_POINTS = re.compile(rf"\s*{_NUMBER}\s*,\s*{_NUMBER}(?:\s+{_NUMBER}\s*,\s*{_NUMBER})+\s*")
_STRAIGHT_DEG = 0.05
"""Edges are straight in degrees (RFC 7946), and bent in metres: they are cut into pieces of at most so much."""
_FAR_M, _FAR_EXTENTS, _NEAR_SHARE = 100_000.0, 10.0, 0.2
"""Latitude and longitude look exchanged where a place lies further from the mission than this, and exchanged much nearer."""


class Places:
    """Understands places of one mission: `frame`, the entries of its obstacles.json, and where it took place [N, 2] metres."""

    def __init__(self, frame: Frame, obstacles: Sequence[Mapping[str, Any]], known_m: Float64s) -> None:
        self._frame, self._obstacles = frame, obstacles
        known_m = known_m[np.isfinite(known_m).all(axis=1)]
        self._centre_m = known_m.mean(axis=0) if len(known_m) else np.zeros(2)
        self._extent_m = float(np.ptp(known_m, axis=0).max()) if len(known_m) else 0.0

    def area(self, text: str) -> Area:
        """The area that a text means; `UsageError`, of a file `InputError`, with what is wrong and what would be understood."""
        circle = _CIRCLE.fullmatch(text)
        if circle:
            return self._circle(text, *map(float, circle.groups()))
        named = {str(entry["name"]): entry for entry in self._obstacles if entry.get("name")}
        if text in named:
            return _obstacle_area(named[text])
        geometry, where = self._geometry(text, ("Polygon", "MultiPolygon"), [*named])
        parts = [self._polygon(rings, where) for rings in _listed(geometry, "Polygon")]
        shape = shapely.union_all(parts)
        if shape.is_empty or shape.area <= 0:
            raise UsageError(f"{where}: encloses nothing; give a polygon of at least three different points")
        return Region(shape)

    def line(self, text: str) -> Path:
        """The line that a text means; errors as of `area`."""
        if _POINTS.fullmatch(text):
            points = np.array(
                [[float(number) for number in pair.split(",")] for pair in re.split(r"(?<=\d)\s+(?=[-+.\d])", text.strip())]
            )
            if self._frame.is_georeferenced:
                points = points[:, ::-1]  # people say latitude first, GeoJSON longitude
            lines, where = [points], text
        else:
            geometry, where = self._geometry(text, ("LineString", "MultiLineString"), [])
            lines = [_points(line, where) for line in _listed(geometry, "LineString")]
        if any(len(np.unique(line, axis=0)) < 2 for line in lines):
            raise UsageError(f"{_short(where)}: a line needs two different points at least")
        return Path.of([self._placed(line, where, is_given=text) for line in lines])

    def _circle(self, text: str, first: float, second: float, radius_m: float) -> Disc:
        if not radius_m > 0:
            raise UsageError(f"{text}: the radius, in metres, must be above zero")
        pair = np.array([[second, first]]) if self._frame.is_georeferenced else np.array([[first, second]])
        centre = self._placed(pair, text, is_given=text)[0]
        return Disc((float(centre[0]), float(centre[1])), radius_m)

    def _geometry(self, text: str, kinds: tuple[str, ...], names: Sequence[str]) -> tuple[Mapping[str, Any], str]:
        """The geometry in a GeoJSON file or text, several of them as one of many parts, and what to call it in errors."""
        if text.lstrip().startswith("{"):
            where, content = "the GeoJSON", text
        else:
            path = FilePath(text)
            where = text
            if not path.is_file():
                known = f"; the log's obstacles are called {', '.join(names[:8])}" if names else ""
                raise UsageError(
                    f"{text!r}: neither a file nor a place{did_you_mean(text, names)}; give GeoJSON, "
                    f"{'latitude,longitude' if self._frame.is_georeferenced else 'x,y'},"
                    f"{'metres' if kinds[0] == 'Polygon' else '... with at least two points'}{known}"
                )
            try:
                content = path.read_text(encoding="utf-8")
            except (OSError, UnicodeDecodeError) as error:
                raise InputError(f"{text}: cannot be read as text ({error}); give a GeoJSON file") from error
        try:
            found = [each for each in _geometries(parse_json(content)) if each.get("type") in kinds]
        except (ValueError, TypeError, LookupError, AttributeError) as error:
            raise InputError(f"{where}: not GeoJSON ({error})") from error
        if not found:
            raise InputError(
                f"{where}: holds no {kinds[0]}; this question is about {'an area' if kinds[0] == 'Polygon' else 'a line'}"
            )
        return {"type": "several", "parts": found}, where

    def _polygon(self, rings: Any, where: str) -> Any:
        given = [_points(ring, where) for ring in rings]
        if not given or any(len(np.unique(ring, axis=0)) < 3 for ring in given):
            raise UsageError(f"{where}: a ring needs three different points at least")
        placed = [self._placed(ring, where) for ring in given]
        shape = shapely.Polygon(placed[0], placed[1:])
        if not shape.is_valid:
            reason = shapely.is_valid_reason(shape).partition("[")[0].lower()
            raise UsageError(f"{where}: the area crosses or touches itself ({reason}); give its corners in order")
        return shape

    def _placed(self, points: Float64s, where: str, is_given: str | None = None) -> Float64s:
        """Points [N, 2] (longitude, latitude; or x, y in metres) in the mission frame, edges cut into short pieces."""
        if not self._frame.is_georeferenced:
            return points
        order = "latitude,longitude" if is_given is not None else "longitude first, then latitude, as GeoJSON has them"
        self._check_degrees(points, _short(where), order)
        if len(points) > 1:
            points = shapely.get_coordinates(shapely.segmentize(shapely.LineString(points), _STRAIGHT_DEG))
        return np.stack(to_local(self._frame, points[:, 1].copy(), points[:, 0].copy()), axis=1)

    def _check_degrees(self, points: Float64s, where: str, order: str) -> None:
        longitude, latitude = points.T
        exchanged = f"{where}: latitude and longitude look exchanged"
        if (np.abs(latitude) > 90).any():
            if (np.abs(longitude) <= 90).all() and (np.abs(latitude) <= 180).all():
                raise UsageError(f"{exchanged} (a latitude of {np.abs(latitude).max():g}°); give {order}")
            raise UsageError(f"{where}: {np.abs(latitude).max():g}° is no latitude; positions are in degrees, {order}")
        if (np.abs(longitude) > 180).any() or (np.abs(np.diff(longitude)) > 180).any():
            raise UsageError(f"{where}: crosses the antimeridian (longitude 180°); give its two sides as two polygons")
        far_m = self._distance_m(latitude, longitude)
        if far_m > _FAR_M + _FAR_EXTENTS * self._extent_m and (np.abs(longitude) <= 90).all():
            swapped_m = self._distance_m(longitude, latitude)
            if swapped_m < _NEAR_SHARE * far_m:
                raise UsageError(
                    f"{exchanged}: it lies {metres(far_m)} from the mission, exchanged {metres(swapped_m)}; give {order}"
                )

    def _distance_m(self, latitude: Float64s, longitude: Float64s) -> float:
        """From the middle of the mission to that of the points."""
        x, y = to_local(self._frame, latitude[:1].copy(), longitude[:1].copy())
        return float(np.hypot(x[0] - self._centre_m[0], y[0] - self._centre_m[1])) if np.isfinite(x[0]) else float("inf")


def _obstacle_area(entry: Mapping[str, Any]) -> Area:
    if entry["kind"] == "circle":
        return Disc((entry["x_m"], entry["y_m"]), entry["radius_m"])
    return Region(shapely.Polygon(entry["rings_m"][0], entry["rings_m"][1:]))


def _geometries(content: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """The geometries of a GeoJSON document."""
    kind = content["type"]
    if kind == "FeatureCollection":
        return list(itertools.chain.from_iterable(_geometries(feature) for feature in content["features"]))
    if kind == "Feature":
        return [] if content["geometry"] is None else _geometries(content["geometry"])
    if kind == "GeometryCollection":
        return list(itertools.chain.from_iterable(_geometries(each) for each in content["geometries"]))
    return [content]


def _listed(geometry: Mapping[str, Any], kind: str) -> list[Any]:
    """Coordinates of the single polygons or lines."""
    found = []
    for part in geometry["parts"]:
        found += [part["coordinates"]] if part["type"] == kind else list(part["coordinates"])
    return found


def _points(coordinates: Any, where: str) -> Float64s:
    try:
        points = np.array([[float(point[0]), float(point[1])] for point in coordinates])
    except (TypeError, ValueError, LookupError) as error:
        raise InputError(f"{where}: coordinates that are no positions ({error})") from error
    if points.ndim != 2 or not np.isfinite(points).all():
        raise InputError(f"{where}: coordinates that are no positions")
    return points


def _short(text: str) -> str:
    return text if len(text) <= 60 else f"{text[:57]}..."
