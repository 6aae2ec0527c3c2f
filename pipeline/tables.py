"""Parquet files between the stages: written with their schema and frame, read back only where both fit."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from cadence.errors import InputError
from pipeline.documents import parse_json
from schemas.tables import HEIGHT_COLUMNS, HEIGHT_VERSION, VERSION


@dataclass(frozen=True)
class Frame:
    """The mission frame: x east, y north, metres. The datum is set for georeferenced logs.

    vertical_datum  what heights count from, in words; None where none are used
    """

    frame_id: str
    latitude_deg: float | None = None
    longitude_deg: float | None = None
    vertical_datum: str | None = None

    @property
    def is_georeferenced(self) -> bool:
        """Whether positions can be brought back to latitude and longitude."""
        return self.latitude_deg is not None and self.longitude_deg is not None


def write_table(table: pa.Table, path: Path, name: str, frame: Frame) -> None:
    """Write `table` (its schema must be that of `name` in `schemas.tables`) with version and frame in its metadata."""
    version = HEIGHT_VERSION if HEIGHT_COLUMNS.get(name) in table.column_names else VERSION
    pq.write_table(table.replace_schema_metadata(table_metadata(name, frame, version)), path, compression="zstd")


def table_metadata(name: str, frame: Frame, version: int = VERSION) -> dict[str, str]:
    """What the metadata of a table's schema say of it: its name, the version and the frame."""
    frame_json = {"frame_id": frame.frame_id, "latitude_deg": frame.latitude_deg, "longitude_deg": frame.longitude_deg}
    if frame.vertical_datum is not None:
        frame_json["vertical_datum"] = frame.vertical_datum
    return {"cadence.table": name, "cadence.version": str(version), "cadence.frame": json.dumps(frame_json)}


def read_table(path: Path, name: str) -> tuple[pa.Table, Frame]:
    """The table called `name` and its frame; `InputError` where the file is absent, damaged or of another kind or version."""
    if not path.is_file():
        raise InputError(f"{path}: not found; run the stage that writes it first (cadence run does all of them)")
    try:
        table = pq.read_table(path)
        metadata: dict[bytes, Any] = table.schema.metadata or {}
        kind = metadata.get(b"cadence.table", b"").decode()
        version = metadata.get(b"cadence.version", b"").decode()
        frame = Frame(**parse_json(metadata.get(b"cadence.frame", b"{}")))
    except (pa.ArrowException, OSError, ValueError, TypeError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path}: not a readable cadence table ({reason}); run its stage again with --force") from error
    if kind != name or version not in (str(VERSION), str(HEIGHT_VERSION)):
        found = f"{kind or 'an unknown table'} version {version or '?'}"
        raise InputError(f"{path}: holds {found}, expected {name} version {VERSION} or {HEIGHT_VERSION}; run its stage again")
    return table, frame
