"""Obstacles of a mission: from files, from the configuration and from the log, to obstacles.json and back.

obstacles.json holds {"version": 1, "obstacles": [...]}; an obstacle is {"kind": "circle", "x_m", "y_m", "radius_m"} or
{"kind": "polygon", "rings_m": [exterior, holes...]}, each with an optional "name", in the mission frame.
"""

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cadence.errors import ConfigError
from pipeline.config import load_toml, read_config
from pipeline.documents import parse_json
from pipeline.extract.grids import (
    FOXGLOVE_GRIDS,
    ROS_GRIDS,
    foxglove_grid,
    grid_fields,
    is_occupancy_field,
    occupied_polygons,
    ros_grid,
)
from pipeline.extract.obstacle_config import CircleSource, ObstacleSources, PolygonSource
from pipeline.frames import to_geodetic, to_local
from pipeline.logs.decode import UndecodableChannel, UndecodableMessage, decoder_for
from pipeline.logs.reader import MissionLog
from pipeline.obstacle_file import Json, checked_entry, listed_entries
from pipeline.tables import Frame

Note = Callable[[str], object]


@dataclass(frozen=True)
class _ObstacleFile:
    circles: tuple[CircleSource, ...] = ()
    polygons: tuple[PolygonSource, ...] = ()


def collect_obstacles(log: MissionLog, sources: ObstacleSources, frame: Frame, note: Note | None = None) -> list[Json]:
    """All obstacles in the mission frame, as entries of obstacles.json.

    What the user states must be right: `ConfigError` names file and feature. What a log says and cannot be used is left
    out, and `note` is called with one line about it.
    """
    found = list(_from_tables(sources.circles, sources.polygons, frame, "config"))
    for path in sources.files:
        found += _from_file(path, frame)
    say = note or (lambda text: None)
    if sources.from_log:
        found += _from_metadata(log, frame, say)
    if sources.from_log or sources.topics:
        found += _from_grids(log, sources, frame, say)
    return found


def _from_tables(
    circles: Sequence[CircleSource], polygons: Sequence[PolygonSource], frame: Frame, where: str
) -> Iterator[Json]:
    for index, circle in enumerate(circles):
        feature = f"{where}: circles[{index}]{_named(circle.name)}"
        if circle.latitude_deg is None:
            centre: list[Any] = [[circle.x_m, circle.y_m]]
        else:
            centre = _local([[circle.longitude_deg, circle.latitude_deg]], frame, feature)
        entry = {"kind": "circle", "x_m": centre[0][0], "y_m": centre[0][1], "radius_m": circle.radius_m, "name": circle.name}
        yield _valid(entry, feature)
    for index, polygon in enumerate(polygons):
        feature = f"{where}: polygons[{index}]{_named(polygon.name)}"
        rings: list[Any] = [polygon.points_m, *polygon.holes_m]
        if polygon.points_deg:
            degrees = [polygon.points_deg, *polygon.holes_deg]
            rings = [_local([[longitude, latitude] for latitude, longitude in ring], frame, feature) for ring in degrees]
        yield _valid({"kind": "polygon", "rings_m": rings, "name": polygon.name}, feature)


def _from_file(path: Path, frame: Frame) -> list[Json]:
    if path.suffix.lower() == ".toml":
        tables = read_config(_ObstacleFile, load_toml(path), str(path))
        return list(_from_tables(tables.circles, tables.polygons, frame, str(path)))
    try:
        content = parse_json(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot read the obstacles ({error.strerror}); check the path") from error
    except ValueError as error:
        raise ConfigError(f"{path}: neither TOML (.toml) nor JSON ({error}); correct the file") from error
    if isinstance(content, dict) and "type" in content:
        return list(_from_geojson(content, frame, str(path)))
    try:
        entries = listed_entries(content)
    except ValueError as error:
        raise ConfigError(f"{path}: neither GeoJSON nor obstacles.json ({error}); correct the file") from error
    return [_valid(entry, f"{path}: obstacles[{index}]") for index, entry in enumerate(entries)]


def _from_geojson(content: Mapping[str, Any], frame: Frame, where: str) -> Iterator[Json]:
    kind = content.get("type")
    features = content.get("features") if kind == "FeatureCollection" else [content]
    for index, feature in enumerate(features if isinstance(features, list) else []):
        is_feature = isinstance(feature, dict) and feature.get("type") == "Feature"
        properties = (feature.get("properties") or {}) if is_feature else {}
        geometry = feature.get("geometry") if is_feature else feature
        name = str(properties.get("name", ""))
        yield from _geometry(geometry, properties, name, frame, f"{where}: feature {index}{_named(name)}")


def _geometry(geometry: Any, properties: Mapping[str, Any], name: str, frame: Frame, where: str) -> Iterator[Json]:
    kind = geometry.get("type") if isinstance(geometry, dict) else None
    coordinates = geometry.get("coordinates") if isinstance(geometry, dict) else None
    if kind == "GeometryCollection":
        for part in geometry.get("geometries", []):
            yield from _geometry(part, properties, name, frame, where)
    elif kind == "Point":
        radius = properties.get("radius_m")
        if radius is None:
            raise ConfigError(f"{where}: a Point needs the property radius_m; add it, or use a Polygon")
        centre = _local([coordinates], frame, where)[0]
        yield _valid({"kind": "circle", "x_m": centre[0], "y_m": centre[1], "radius_m": radius, "name": name}, where)
    elif kind in ("Polygon", "MultiPolygon"):
        polygons = [coordinates] if kind == "Polygon" else coordinates
        for polygon in polygons if isinstance(polygons, list) else [None]:
            rings = [_local(ring, frame, where) for ring in polygon] if isinstance(polygon, list) else None
            yield _valid({"kind": "polygon", "rings_m": rings, "name": name}, where)
    else:
        raise ConfigError(f"{where}: geometry {kind!r} is no obstacle; use Polygon, MultiPolygon or Point with radius_m")


def _from_metadata(log: MissionLog, frame: Frame, note: Note) -> list[Json]:
    found: list[Json] = []
    for name, record in log.metadata():
        where = f"{log.path}: Metadata record {name!r}"
        try:
            if name == "cadence.obstacles":
                found += _from_record(record, frame, where)
            elif name == "mission" and "mountains" in record:
                _check_local(frame, where)
                mountains = parse_json(record["mountains"])
                found += [
                    checked_entry({"kind": "circle", **item, "radius_m": item["keep_out_radius_m"]}) for item in mountains
                ]
        except (ConfigError, ValueError, TypeError, LookupError, AttributeError) as error:
            note(f"{where}: obstacles left out ({error})")
    return _once(found)


def _once(entries: list[Json]) -> list[Json]:
    """The entries without circles that stand there already: simulated logs name mountains in both records."""
    circles = [entry["kind"] == "circle" and (entry["x_m"], entry["y_m"], entry["radius_m"]) for entry in entries]
    return [entry for index, entry in enumerate(entries) if not circles[index] or circles[index] not in circles[:index]]


def _from_record(record: Mapping[str, str], frame: Frame, where: str) -> list[Json]:
    """A record `cadence.obstacles`: `geojson`, or `obstacles` (entries of obstacles.json) in metres about its datum."""
    found: list[Json] = []
    if "geojson" in record:
        found += _from_geojson(parse_json(record["geojson"]), frame, where)
    content = parse_json(record.get("obstacles", "[]"))
    entries = [checked_entry(entry) for entry in (content if isinstance(content, list) else listed_entries(content))]
    if "latitude_deg" in record and "longitude_deg" in record:
        if frame.is_georeferenced:
            datum = Frame("record", float(parse_json(record["latitude_deg"])), float(parse_json(record["longitude_deg"])))
            entries = [_moved(entry, datum, frame) for entry in entries]
    elif entries:
        _check_local(frame, where)
    return found + entries


def _moved(entry: Json, old: Frame, new: Frame) -> Json:
    """An entry about one datum, about another."""
    if (old.latitude_deg, old.longitude_deg) == (new.latitude_deg, new.longitude_deg):
        return entry

    def move(points: list[list[float]]) -> list[list[float]]:
        array = np.asarray(points, dtype=np.float64)
        moved: list[list[float]] = np.stack(to_local(new, *to_geodetic(old, array[:, 0], array[:, 1])), axis=1).tolist()
        return moved

    if entry["kind"] == "polygon":
        return {**entry, "rings_m": [move(ring) for ring in entry["rings_m"]]}
    ((x_m, y_m),) = move([[entry["x_m"], entry["y_m"]]])
    return {**entry, "x_m": x_m, "y_m": y_m}


def _from_grids(log: MissionLog, sources: ObstacleSources, frame: Frame, note: Note) -> list[Json]:
    grids = {channel.topic: channel for channel in log.channels if channel.schema_name in ROS_GRIDS + FOXGLOVE_GRIDS}
    for topic in sources.topics:
        if topic not in grids:
            kind = next((channel.schema_name for channel in log.channels if channel.topic == topic), None)
            what = "is not in the log" if kind is None else f"is a {kind or 'channel without schema'}, no occupancy grid"
            raise ConfigError(f"obstacles.topics: {topic!r} {what}; `cadence info {log.path}` lists its channels")
    # Our own output is a grid too (where targets may be), and may be part of a log that is run again.
    topics = sources.topics or [topic for topic in grids if not topic.startswith("/cadence")]
    return [entry for topic in topics for entry in _from_grid(log, topic, sources, frame, note)]


def _from_grid(log: MissionLog, topic: str, sources: ObstacleSources, frame: Frame, note: Note) -> list[Json]:
    """The occupied cells of the last grid on a topic."""
    messages = deque(log.messages([topic]), maxlen=1)
    if not messages:
        return []
    last, is_stated = messages[0], topic in sources.topics
    channel = last.channel
    try:
        message = decoder_for(channel)(last.data)
        if channel.schema_name in ROS_GRIDS:
            grid = ros_grid(message, sources.threshold)
        elif is_stated or any(map(is_occupancy_field, grid_fields(message))):
            grid = foxglove_grid(message, sources.threshold)
        else:
            return []
    except (UndecodableChannel, UndecodableMessage, ValueError, TypeError, LookupError) as error:
        note(f"{log.path}: the grid on {topic} is left out ({error})")
        return []
    if not is_stated and (frame.is_georeferenced or grid.frame_id not in ("", frame.frame_id)):
        note(
            f"{log.path}: the grid on {topic} is in frame {grid.frame_id!r}, not in the mission frame "
            f"{frame.frame_id!r}, and is left out; name it in obstacles.topics to use it as it is"
        )
        return []
    name = {"name": topic}
    return [checked_entry({"kind": "polygon", "rings_m": rings, **name}) for rings in occupied_polygons(grid)]


def _check_local(frame: Frame, where: str) -> None:
    if frame.is_georeferenced:
        raise ConfigError(f"{where}: metres without a datum have no place in a mission in latitude and longitude")


def _local(points: Any, frame: Frame, where: str) -> list[list[float]]:
    """[longitude, latitude] pairs in degrees as [x, y] in metres of the mission frame; `ConfigError` names `where`."""
    if not frame.is_georeferenced:
        raise ConfigError(
            f"{where}: in latitude and longitude, but the mission frame {frame.frame_id!r} has no datum; "
            "set extract.datum, or give metres"
        )
    try:
        degrees = np.array([[float(point[0]), float(point[1])] for point in points], dtype=np.float64).reshape(-1, 2)
    except (ValueError, TypeError, LookupError) as error:
        raise ConfigError(f"{where}: not a list of positions ({error}); correct the coordinates") from error
    if not bool((np.isfinite(degrees).all(axis=1) & (np.abs(degrees) <= [360, 90]).all(axis=1)).all()):
        raise ConfigError(f"{where}: a position is not on the earth; GeoJSON wants longitude first, TOML latitude first")
    local: list[list[float]] = np.stack(to_local(frame, degrees[:, 1], degrees[:, 0]), axis=1).tolist()
    return local


def _valid(entry: Any, where: str) -> Json:
    try:
        return checked_entry(entry)
    except (ValueError, TypeError, LookupError, AttributeError) as error:
        raise ConfigError(f"{where}: {_reason(error)}; correct the geometry") from error


def _reason(error: Exception) -> str:
    if isinstance(error, KeyError):
        return f"{error} is missing"
    # The entry is checked alone: its place in a list of one says nothing.
    return str(error).replace("Obstacles.polygons[0]", "the polygon").replace("Obstacles.circles", "circles")


def _named(name: str) -> str:
    return f" ({name})" if name else ""
