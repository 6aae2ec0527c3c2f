"""GeoJSON (RFC 7946): a collection of points, one feature, or a line a feature; their properties are columns."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pyarrow as pa

from cadence.errors import InputError

AXES = ("coordinates longitude", "coordinates latitude", "coordinates altitude")
_CRS84 = ("CRS84", "EPSG::4326", "EPSG:4326")


def read_features(path: Path) -> tuple[dict[str, pa.ChunkedArray], tuple[str, ...]]:
    """The columns of the points in a file, coordinates first, and what was left out; `InputError` where there is none."""
    features = _features(path)
    points = [feature for feature in features if _is_point(feature)]
    if not points:
        kinds = sorted({str(_geometry(feature).get("type")) for feature in features})
        seen = f"its features are {', '.join(kinds)}" if kinds else "it has no features"
        raise InputError(f"{path}: holds no points ({seen}); give a FeatureCollection of points, each with its time")
    places = [_geometry(feature)["coordinates"] for feature in points]
    columns = {
        name: _column([place[axis] if len(place) > axis else None for place in places]) for axis, name in enumerate(AXES)
    }
    if all(len(place) < 3 for place in places):
        del columns[AXES[2]]
    properties = [feature.get("properties") or {} for feature in points]
    if any("id" in feature for feature in points) and not any("id" in each for each in properties):
        columns["id"] = _column([feature.get("id") for feature in points])
    for name in dict.fromkeys(name for each in properties for name in each):
        columns[name if name not in columns else f"properties {name}"] = _column([each.get(name) for each in properties])
    num_left_out = len(features) - len(points)
    return columns, (f"{num_left_out} features are no points",) * (num_left_out > 0)


def _features(path: Path) -> list[dict[str, Any]]:
    try:
        text = path.read_text(encoding="utf-8-sig")
        try:
            document = json.loads(text)
        except ValueError:  # a line a feature (GeoJSON text sequences, RFC 8142)
            document = [json.loads(line.lstrip("\x1e")) for line in text.splitlines() if line.strip("\x1e \t")]
    except (OSError, UnicodeDecodeError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: cannot be read as GeoJSON ({error}); export it again") from error
    if isinstance(document, dict):
        _check_crs(path, document)
        document = document.get("features") if document.get("type") == "FeatureCollection" else [document]
    if not isinstance(document, list) or not all(isinstance(item, dict) and item.get("type") == "Feature" for item in document):
        raise InputError(f"{path}: is JSON, but no GeoJSON; give a FeatureCollection of points, each with its time")
    return document


def _check_crs(path: Path, document: dict[str, Any]) -> None:
    """Files of before 2016 may be in another system than longitude and latitude."""
    crs = document.get("crs")
    name = str((crs.get("properties") or {}).get("name")) if isinstance(crs, dict) else ""
    if name and not name.endswith(_CRS84):
        raise InputError(f"{path}: its coordinates are in {name}; write it in longitude and latitude (WGS 84)")


def _geometry(feature: dict[str, Any]) -> dict[str, Any]:
    geometry = feature.get("geometry")
    return geometry if isinstance(geometry, dict) else {}


def _is_point(feature: dict[str, Any]) -> bool:
    geometry = _geometry(feature)
    place = geometry.get("coordinates")
    is_place = isinstance(place, list) and len(place) >= 2 and all(type(number) in (int, float) for number in place)
    return geometry.get("type") == "Point" and is_place


def _column(values: Iterable[Any]) -> pa.ChunkedArray:
    """Numbers as numbers, truth values as such, everything else as text."""
    found = list(values)
    kinds = {type(value) for value in found} - {type(None)}
    if kinds == {bool} or kinds == {int}:
        try:
            return pa.chunked_array([pa.array(found)])
        except (OverflowError, pa.ArrowInvalid):
            kinds = {str}
    if kinds and kinds <= {int, float}:
        return pa.chunked_array([pa.array(found, pa.float64(), from_pandas=True)])
    return pa.chunked_array([pa.array([None if value is None else str(value) for value in found], pa.string())])
