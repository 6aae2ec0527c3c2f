"""Where a type that is not known may keep positions: paths to fields with the names of coordinates, out of its schema."""

import json
from collections.abc import Iterator, Mapping
from typing import Any, Final

from rosbags.interfaces import Nodetype
from rosbags.typesys import get_types_from_msg

_PAIRS: Final = (  # of one structure, the likeliest first
    ("latitude", "longitude"), ("latitude_deg", "longitude_deg"), ("lat", "lon"), ("lat", "lng"), ("lat", "long"), ("x", "y"),
)  # fmt: skip
_MEASURED: Final = {
    "range": ("range", "range_m", "distance"),
    "bearing": (
        "bearing",
        "azimuth",
        "azimuth_angle",
        "doa",
        "aoa",
        "bearing_deg",
        "azimuth_deg",
        "bearing_rad",
        "azimuth_rad",
    ),
    "elevation": ("elevation", "elevation_angle", "elevation_deg", "elevation_rad"),
}
_MAX_DEPTH: Final = 6

Fields = Mapping[str, Any]
"""A structure's fields by name; of nested structures a mapping, of arrays of them a list with one, of all others None."""


def coordinate_paths(schema_name: str, schema_data: bytes) -> tuple[str, str] | None:
    """Paths of latitude and longitude, or of x and y, nearest to the message itself; None where a schema tells of none.

    Read are definitions of ROS 1 and ROS 2, and JSON schemas.
    """
    found = _known(schema_name, schema_data)
    for first, second in _PAIRS:
        for prefix, names in found:
            if first in names and second in names:
                return f"{prefix}{first}", f"{prefix}{second}"
    return None


def measured_paths(schema_name: str, schema_data: bytes) -> Mapping[str, str]:
    """Paths of a bearing and, beside it, a range and an elevation, by these names; empty where a schema tells of no bearing."""
    found = _known(schema_name, schema_data)
    for bearing in _MEASURED["bearing"]:
        for prefix, names in found:
            if bearing in names:
                beside = {kind: next((name for name in known if name in names), None) for kind, known in _MEASURED.items()}
                return {kind: f"{prefix}{name}" for kind, name in beside.items() if name is not None}
    return {}


def _known(schema_name: str, schema_data: bytes) -> list[tuple[str, set[str]]]:
    """Path and names of the plain fields of every structure of a schema; empty where it cannot be read."""
    try:
        text = schema_data.decode()
        fields = _of_json(json.loads(text)) if text.lstrip().startswith("{") else _of_ros(schema_name, text)
        return list(_structures(fields, "", 0))
    except Exception:  # foreign parsers raise what they like, and a suggestion is not worth an error
        return []


def _structures(fields: Fields, prefix: str, depth: int) -> Iterator[tuple[str, set[str]]]:
    """Path and names of the plain fields of every structure, those of a message before those of its parts."""
    yield prefix, {name for name, inner in fields.items() if inner is None}
    for name, inner in fields.items():
        if inner is not None and depth < _MAX_DEPTH:
            is_array = isinstance(inner, list)
            yield from _structures(inner[0] if is_array else inner, f"{prefix}{name}{'[:]' if is_array else ''}.", depth + 1)


def _of_ros(schema_name: str, text: str) -> Fields:
    types = get_types_from_msg(text, schema_name)
    parts = schema_name.split("/")

    def fields_of(name: str, depth: int) -> Fields:
        _, fields = types.get(name, ((), ()))
        return {field: inner_of(entry, depth) for field, entry in fields}

    def inner_of(entry: Any, depth: int) -> Any:
        kind, detail = entry
        if kind == Nodetype.NAME and depth < _MAX_DEPTH:
            return fields_of(str(detail), depth + 1)
        if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE) and detail[0][0] == Nodetype.NAME and depth < _MAX_DEPTH:
            return [fields_of(str(detail[0][1]), depth + 1)]
        return None

    return fields_of(f"{parts[0]}/msg/{parts[-1]}", 0)


def _of_json(schema: Any, depth: int = 0) -> Fields:
    fields: dict[str, Any] = {}
    for name, inner in (schema.get("properties") or {}).items():
        fields[name] = None
        if depth < _MAX_DEPTH and inner.get("properties"):
            fields[name] = _of_json(inner, depth + 1)
        elif depth < _MAX_DEPTH and isinstance(inner.get("items"), dict) and inner["items"].get("properties"):
            fields[name] = [_of_json(inner["items"], depth + 1)]
    return fields
