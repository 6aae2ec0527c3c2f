"""Occupancy grids in a log → polygons of what is occupied, in the frame of the grid.

nav_msgs/OccupancyGrid (0–100, -1 unknown) and foxglove.Grid; the last message of a topic counts. Unknown cells are free.
"""

import base64
import math
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import shapely
from shapely.affinity import affine_transform

from cadence.arrays import Bools
from pipeline.logs.decode import field

ROS_GRIDS: Final = ("nav_msgs/msg/OccupancyGrid", "nav_msgs/OccupancyGrid")
FOXGLOVE_GRIDS: Final = ("foxglove.Grid", "foxglove_msgs/msg/Grid", "foxglove_msgs/Grid")
OCCUPANCY_FIELDS: Final = ("occupancy", "occupied", "obstacle", "obstacles")
"""Fields of a foxglove.Grid that say what they are; any other grid is taken only where its topic is named."""

_MAX_CELLS = 1_000_000
_TYPES: Final = {1: "u1", 2: "i1", 3: "<u2", 4: "<i2", 5: "<u4", 6: "<i4", 7: "<f4", 8: "<f8"}
_TYPE_NAMES: Final = ("UINT8", "INT8", "UINT16", "INT16", "UINT32", "INT32", "FLOAT32", "FLOAT64")

Ring = list[list[float]]


class Grid(NamedTuple):
    """Which cells are occupied [rows, columns], and where the corner of cell (0, 0) lies; x counts along the columns."""

    frame_id: str
    is_occupied: Bools
    cell_m: tuple[float, float]
    origin_m: tuple[float, float]
    yaw_rad: float


def ros_grid(message: Any, threshold: float) -> Grid:
    """A nav_msgs/OccupancyGrid; cells of at least `threshold` (0–100) are occupied. ValueError where it makes no sense."""
    info = field(message, "info")
    shape = int(field(info, "height")), int(field(info, "width"))
    cells = np.asarray(field(message, "data"))
    if cells.size != shape[0] * shape[1]:
        raise ValueError(f"{cells.size} cells for a grid of {shape[1]} × {shape[0]}")
    # Some decoders give the signed bytes as unsigned ones: -1 must not become 255.
    values = cells.astype(np.uint8).view(np.int8) if cells.dtype.kind in "iu" else cells
    size = float(field(info, "resolution"))
    return _grid(
        str(field(message, "header.frame_id")), values.reshape(shape) >= threshold, (size, size), field(info, "origin")
    )


def foxglove_grid(message: Any, threshold: float) -> Grid:
    """A foxglove.Grid; its occupancy field, or its first; floats count from 0 to 1. ValueError where it makes no sense."""
    fields = list(field(message, "fields"))
    if not fields:
        raise ValueError("no fields")
    chosen = next((item for item in fields if is_occupancy_field(str(field(item, "name")))), fields[0])
    kind = np.dtype(_TYPES[_type_number(field(chosen, "type"))])
    raw = field(message, "data")
    data = base64.b64decode(raw) if isinstance(raw, str) else bytes(raw)
    columns, row_stride = int(field(message, "column_count")), int(field(message, "row_stride"))
    cell_stride, offset = int(field(message, "cell_stride")), int(field(chosen, "offset"))
    if columns < 1 or cell_stride < offset + kind.itemsize or row_stride < columns * cell_stride:
        raise ValueError(f"{columns} columns of {cell_stride} bytes do not fit into rows of {row_stride} bytes")
    rows = len(data) // row_stride
    cells = np.frombuffer(data, np.uint8, rows * row_stride).reshape(rows, row_stride)[:, : columns * cell_stride]
    one = np.ascontiguousarray(cells.reshape(rows, columns, cell_stride)[:, :, offset : offset + kind.itemsize])
    values = one.view(kind)[..., 0]
    limit = threshold / 100 if kind.kind == "f" else threshold
    size = float(field(message, "cell_size.x")), float(field(message, "cell_size.y"))
    return _grid(str(field(message, "frame_id")), values >= limit, size, field(message, "pose"))


def is_occupancy_field(name: str) -> bool:
    """Whether a field of a foxglove.Grid by its name holds occupancy."""
    return name.lower() in OCCUPANCY_FIELDS


def occupied_polygons(grid: Grid) -> list[list[Ring]]:
    """Rings (exterior, then holes) of the polygons that the occupied cells form, in metres of the grid's frame."""
    cells, (width, height) = _coarsened(grid.is_occupied, grid.cell_m)
    # Runs along the rows first: a wall is a few rectangles, not thousands of cells.
    edges = np.diff(np.pad(cells.astype(np.int8), ((0, 0), (1, 1))), axis=1)
    row, start = np.nonzero(edges == 1)
    end = np.nonzero(edges == -1)[1]
    # Union in whole cells: exact, so that neighbours share their edges to the last bit.
    merged = shapely.union_all(shapely.box(start, row, end, row + 1)).simplify(0)
    cos, sin = math.cos(grid.yaw_rad), math.sin(grid.yaw_rad)
    placed = affine_transform(merged, [cos * width, -sin * height, sin * width, cos * height, *grid.origin_m])
    return [
        [shapely.get_coordinates(ring).tolist() for ring in (part.exterior, *part.interiors)]
        for part in shapely.get_parts(placed)
        if part.geom_type == "Polygon" and not part.is_empty
    ]


def _grid(frame_id: str, is_occupied: Bools, cell_m: tuple[float, float], pose: Any) -> Grid:
    x, y = (float(field(pose, f"position.{axis}")) for axis in "xy")
    qx, qy, qz, qw = (float(field(pose, f"orientation.{axis}")) for axis in "xyzw")
    yaw = math.atan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz)) if (qx, qy, qz, qw) != (0, 0, 0, 0) else 0.0
    if not all(map(math.isfinite, (x, y, yaw, *cell_m))) or min(cell_m) <= 0:
        raise ValueError(f"cells of {cell_m[0]} × {cell_m[1]} m at ({x}, {y})")
    return Grid(frame_id, is_occupied, cell_m, (x, y), yaw)


def _coarsened(cells: Bools, cell_m: tuple[float, float]) -> tuple[Bools, tuple[float, float]]:
    """Blocks of cells, occupied where any cell is, so that no grid has more than _MAX_CELLS."""
    block = math.ceil(math.sqrt(cells.size / _MAX_CELLS))
    if block <= 1:
        return cells, cell_m
    rows, columns = (-size % block for size in cells.shape)
    padded = np.pad(cells, ((0, rows), (0, columns)))
    blocks = padded.reshape(padded.shape[0] // block, block, padded.shape[1] // block, block)
    coarse: Bools = np.asarray(blocks.any(axis=(1, 3)))
    return coarse, (cell_m[0] * block, cell_m[1] * block)


def _type_number(value: Any) -> int:
    number = _TYPE_NAMES.index(value) + 1 if isinstance(value, str) and value in _TYPE_NAMES else value
    if number not in _TYPES:
        raise ValueError(f"unknown field type {value!r}")
    return int(number)


def grid_fields(message: Any) -> Sequence[str]:
    """Names of the fields of a foxglove.Grid."""
    return [str(field(item, "name")) for item in field(message, "fields")]
