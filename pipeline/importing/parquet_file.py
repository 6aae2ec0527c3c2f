"""Parquet, also with a geometry of points (GeoParquet 1.0 and 1.1), whose coordinates become columns."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pyproj
import shapely

from cadence.errors import InputError

_AXES = ("geometry longitude", "geometry latitude")
_PLANE = ("geometry x", "geometry y")


def open_parquet(path: Path) -> tuple[tuple[str, ...], Callable[[Sequence[str]], dict[str, pa.ChunkedArray]]]:
    """The names of the columns that hold one value a row, and what reads some of them; `InputError` where it is damaged."""
    try:
        schema = pq.read_schema(path)
    except (pa.ArrowException, OSError) as error:
        raise InputError(f"{path}: cannot be read as Parquet ({str(error).splitlines()[0]}); copy it again") from error
    plain = tuple(field.name for field in schema if not pa.types.is_nested(field.type) and not pa.types.is_binary(field.type))
    geometry, axes = _geometry(path, schema)

    def read(names: Sequence[str]) -> dict[str, pa.ChunkedArray]:
        wanted = [name for name in names if name in plain]
        needs_geometry = any(name in axes for name in names)
        try:
            table = pq.read_table(path, columns=[*wanted, *[geometry] * needs_geometry])
        except (pa.ArrowException, OSError) as error:
            raise InputError(f"{path}: cannot be read as Parquet ({str(error).splitlines()[0]}); copy it again") from error
        if not len(table):
            raise InputError(f"{path}: has no rows; export it again")
        found = {name: _plain(table[name]) for name in wanted}
        if needs_geometry:
            found |= dict(zip(axes, _coordinates(path, table[geometry]), strict=True))
        return {name: found[name] for name in names}

    return (*plain, *axes), read


def _plain(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """The column without a dictionary."""
    return column.cast(column.type.value_type) if pa.types.is_dictionary(column.type) else column


def _geometry(path: Path, schema: pa.Schema) -> tuple[str, tuple[str, ...]]:
    """The column that holds the geometry, and what its two axes are called; empty without one."""
    text = (schema.metadata or {}).get(b"geo")
    if text is None:
        return "", ()
    try:
        record = json.loads(text)
        name = str(record["primary_column"])
        column = record["columns"][name]
        crs: Any = column.get("crs", "OGC:CRS84")  # by the specification: where it is not stated
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: its GeoParquet metadata cannot be understood; write it again") from error
    if column.get("encoding") != "WKB" or name not in schema.names:
        raise InputError(f"{path}: its geometry is no WKB; write it as WKB, or give columns of latitude and longitude")
    if crs is None:
        return name, _PLANE
    try:
        known = pyproj.CRS.from_user_input(json.dumps(crs) if isinstance(crs, dict) else crs)
    except pyproj.exceptions.CRSError as error:
        raise InputError(f"{path}: its coordinate system cannot be understood; write it in OGC:CRS84") from error
    if not known.is_geographic:
        raise InputError(f"{path}: its geometry is in {known.name}; write it in latitude and longitude (OGC:CRS84)")
    return name, _AXES  # the specification has longitude first, whatever the system says


def _coordinates(path: Path, column: pa.ChunkedArray) -> tuple[pa.ChunkedArray, pa.ChunkedArray]:
    try:
        shapes = shapely.from_wkb(column.to_numpy(zero_copy_only=False))
    except (shapely.errors.GEOSException, TypeError) as error:
        raise InputError(f"{path}: its geometry cannot be read; write it again") from error
    kinds = set(np.unique(shapely.get_type_id(shapes)).tolist()) - {-1}
    if kinds - {0}:
        raise InputError(f"{path}: its geometry holds other shapes than points; give a point and a time a row")
    return pa.chunked_array([pa.array(shapely.get_x(shapes))]), pa.chunked_array([pa.array(shapely.get_y(shapes))])
