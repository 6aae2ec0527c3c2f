"""GeoParquet 1.1: a row a step of each track with its place as a point, and a row a region; also of logs in metres."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import shapely

from cadence.arrays import Float64s
from pipeline.takeaway.answer import Answer, Track
from pipeline.takeaway.degrees import coordinates, region_in_degrees

_TIME = pa.timestamp("ns", "UTC")
_STEPS = pa.schema(
    [
        pa.field("log_id", pa.string(), nullable=False),
        pa.field("agent_id", pa.string(), nullable=False),
        pa.field("kind", pa.string(), nullable=False),  # hypothesis, or mean of them
        pa.field("window", pa.int32()),  # null: a mission hypothesis
        pa.field("hypothesis", pa.int32()),  # null: the mean
        pa.field("weight", pa.float64(), nullable=False),
        pa.field("time", _TIME, nullable=False),
        pa.field("height_m", pa.float64()),
        pa.field("spread_m", pa.float64()),  # of the mean
        pa.field("geometry", pa.binary(), nullable=False),
    ]
)
_REGIONS = pa.schema(
    [
        pa.field("log_id", pa.string(), nullable=False),
        pa.field("agent_id", pa.string(), nullable=False),
        pa.field("window", pa.int32()),
        pa.field("level", pa.float64(), nullable=False),
        pa.field("time", _TIME, nullable=False),
        pa.field("area_m2", pa.float64(), nullable=False),
        pa.field("geometry", pa.binary(), nullable=False),
    ]
)
_ROWS = 250_000


def write_steps(answer: Answer, path: Path, num_hypotheses: int | None) -> None:
    """Every step of every hypothesis and of the means, none left out."""
    tracks = [*answer.means(), *answer.tracks(num_hypotheses)]
    has_height = any(track.height_m is not None for track in tracks)
    metadata = _metadata(answer, ["Point Z", "Point"] if has_height else ["Point"])
    with pq.ParquetWriter(path, _STEPS.with_metadata(metadata), compression="zstd") as writer:
        for group in _groups(tracks):
            writer.write_table(
                pa.concat_tables([_steps(answer, track) for track in group]).cast(_STEPS.with_metadata(metadata))
            )


def write_regions(answer: Answer, path: Path) -> None:
    """A row a region: agent, level, moment and shape."""
    rows: list[dict[str, Any]] = []
    for region in answer.regions:
        shape = region_in_degrees(answer.frame, region.shape) if answer.frame.is_georeferenced else region.shape
        rows.append(
            {
                "log_id": answer.log_id,
                "agent_id": region.agent_id,
                "window": region.window,
                "level": region.level,
                "time": region.time_ns,
                "area_m2": float(region.shape.area),
                "geometry": shapely.to_wkb(shape),
            }
        )
    columns = {name: [row[name] for row in rows] for name in _REGIONS.names}
    arrays = [
        pa.array(columns[field.name], pa.int64()).cast(_TIME)
        if field.name == "time"
        else pa.array(columns[field.name], field.type)
        for field in _REGIONS
    ]
    schema = _REGIONS.with_metadata(_metadata(answer, ["Polygon", "MultiPolygon"]))
    pq.write_table(pa.Table.from_arrays(arrays, schema=schema), path, compression="zstd")


def _groups(tracks: Iterable[Track]) -> Iterable[list[Track]]:
    """Tracks together, as many as are a row group."""
    group: list[Track] = []
    for track in tracks:
        group.append(track)
        if sum(map(len, group)) >= _ROWS:
            yield group
            group = []
    if group:
        yield group


def _steps(answer: Answer, track: Track) -> pa.Table:
    num = len(track)
    place = coordinates(answer.frame, track.position_m) if answer.frame.is_georeferenced else track.position_m
    hypothesis = pa.nulls(num, pa.int32()) if track.hypothesis is None else pa.array(np.full(num, track.hypothesis, np.int32))
    window = pa.nulls(num, pa.int32()) if track.window is None else pa.array(np.full(num, track.window, np.int32))
    kind = "mean" if track.hypothesis is None else "hypothesis"
    columns = [
        pa.array([answer.log_id] * num), pa.array([track.agent_id] * num), pa.array([kind] * num), window, hypothesis,
        pa.array(np.full(num, track.weight)), pa.array(track.time_ns).cast(_TIME), _optional(track.height_m, num),
        _optional(track.spread_m, num), pa.array(_points(place, track.height_m), pa.binary()),
    ]  # fmt: skip
    return pa.Table.from_arrays(columns, schema=_STEPS)


def _points(place: Float64s, height_m: Float64s | None) -> list[bytes]:
    """Well-known binary; with a height only where it is known."""
    points = shapely.points(place)
    if height_m is not None:
        known = np.isfinite(height_m)
        points[known] = shapely.points(np.column_stack([place[known], height_m[known]]))
    found: list[bytes] = shapely.to_wkb(points, flavor="iso").tolist()
    return found


def _optional(column: Float64s | None, num: int) -> pa.Array:
    return pa.nulls(num, pa.float64()) if column is None else pa.array(column, from_pandas=True)


def _metadata(answer: Answer, kinds: list[str]) -> dict[str, str]:
    """The specification's own: without `crs` it is longitude and latitude (OGC:CRS84); null: a plane of its own."""
    column: dict[str, Any] = {"encoding": "WKB", "geometry_types": kinds}
    if not answer.frame.is_georeferenced:
        column["crs"] = None
    geo = {"version": "1.1.0", "primary_column": "geometry", "columns": {"geometry": column}}
    return {"geo": json.dumps(geo), "cadence.source": answer.source}
