"""`cadence import`: a table of positions → a mission log that `cadence run` reads without settings.

Topics: /detections and, where the table says which rows are the truth, /truth. Positions in degrees are foxglove.LocationFix,
those in metres mission.Detection, both as JSON with the fields agent_id and sensor_id. The Metadata record `import` says from
which file they came and what each column was taken for.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer

from cadence.errors import UsageError
from pipeline.files import hash_file, replacing
from pipeline.importing.moments import moment_of
from pipeline.importing.sightings import ImportSettings, Sightings, read_sightings
from pipeline.importing.table_file import TableFile, open_table
from pipeline.importing.times import Clock
from pipeline.progress import Progress

DETECTIONS_TOPIC, TRUTH_TOPIC = "/detections", "/truth"
_STAMP = {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}
_NUMBER, _NUMBERS = {"type": "number"}, {"type": "array", "items": {"type": "number"}}
_KNOWN = 3
"""foxglove.LocationFix: the covariance is known."""


@dataclass(frozen=True)
class TakenColumn:
    """What one column of a table was taken for, in words."""

    field: str
    column: str
    taken: str
    by: str
    example: str


@dataclass(frozen=True)
class Imported:
    """What became of a table; `log` is None where it was only looked at.

    left_out  rows that were not used, by reason
    agents    how many names there are; 0: the table does not say who was seen
    """

    table: Path
    kind: str
    provider: str | None
    columns: tuple[TakenColumn, ...]
    unused: tuple[str, ...]
    num_rows: int
    num_detections: int
    num_truth: int
    num_agents: int
    start_ns: int
    end_ns: int
    is_geodetic: bool
    left_out: Mapping[str, int]
    notes: tuple[str, ...]
    log: Path | None


def import_table(table: Path, out: Path | None, settings: ImportSettings, progress: Progress, force: bool = False) -> Imported:
    """Read the table at `table` and write it as a log to `out`, or into that folder; without `out` only look at it.

    Raises `InputError` where it is no table, or anything about it is in doubt, `UsageError` where a setting is wrong or the
    log is there already and `force` is not given. Nothing is written then.
    """
    log = None if out is None else _log_path(table, out, force)
    file = open_table(table)
    sightings = read_sightings(file, settings)
    if log is not None:
        with replacing(log) as draft:
            _write(draft, file, sightings, progress)
    return _summary(file, sightings, settings, log)


def import_settings(
    columns: Sequence[str], form: str, zone: str, zero: str | None, unit: str, agent: str, sensor: str, sigma_m: float | None
) -> ImportSettings:
    """The settings of a call; `UsageError` where one of them cannot be understood."""
    zero_ns = None if zero is None else moment_of(zero)
    if zero is not None and zero_ns is None:
        raise UsageError(f"--zero {zero}: give a moment with its zone, such as 2026-05-01T12:00:00Z")
    return ImportSettings(tuple(columns), Clock(form, zone, zero_ns), unit, agent, sensor, sigma_m)


def _log_path(table: Path, out: Path, force: bool) -> Path:
    if out.is_dir() or out.suffix == "":
        out = out / f"{table.name.partition('.')[0]}.mcap"
    if out.suffix != ".mcap":
        raise UsageError(f"--out {out}: a log's name ends with .mcap; correct it")
    if out.exists() and not force:
        raise UsageError(f"{out}: is there already; name another file with --out, or replace it with --force")
    return out


def _write(path: Path, file: TableFile, rows: Sightings, progress: Progress) -> None:
    """Write the log; the same table and settings give the same bytes."""
    name = "foxglove.LocationFix" if rows.is_geodetic else "mission.Detection"
    encode = _fix if rows.is_geodetic else _detection
    with path.open("wb") as target, progress.bar(len(rows.time_ns), "import", "row", scale=True) as bar:
        writer = Writer(target, chunk_size=1 << 18, enable_data_crcs=True)
        writer.start(profile="", library="cadence")
        writer.add_metadata(
            "import", {key: json.dumps(value, ensure_ascii=False) for key, value in _origin(file, rows).items()}
        )
        schema = writer.register_schema(name, "jsonschema", json.dumps(_schema(name, rows)).encode())
        topics = {False: DETECTIONS_TOPIC, True: TRUTH_TOPIC}
        channels = {
            is_truth: writer.register_channel(topic, "json", schema)
            for is_truth, topic in topics.items()
            if (rows.is_truth == is_truth).any()
        }
        counts = dict.fromkeys(channels, 0)
        columns = (rows.time_ns, rows.first, rows.second, rows.altitude_m, rows.covariance_m2, rows.agent, rows.sensor)
        for is_truth, *values in zip(rows.is_truth.tolist(), *(column.tolist() for column in columns), strict=True):
            data = json.dumps(encode(*values), separators=(",", ":"), ensure_ascii=False).encode()
            writer.add_message(channels[is_truth], values[0], data, values[0], counts[is_truth])
            counts[is_truth] += 1
            bar.update()
        writer.finish()  # type: ignore[no-untyped-call]


def _origin(file: TableFile, rows: Sightings) -> dict[str, Any]:
    return {
        "file": file.path.name,
        "sha256": hash_file(file.path),
        "columns": {what: choice.column for what, choice in rows.choices.columns.items()},
        "taken": rows.taken,
        "left_out": dict(rows.left_out),
    }


def _schema(name: str, rows: Sightings) -> dict[str, Any]:
    """JSON schema of the messages; only of fields that some row has, so that a reader knows whether rows name anybody."""
    place: dict[str, Any] = {"latitude": _NUMBER, "longitude": _NUMBER, "altitude": _NUMBER}
    if not rows.is_geodetic:
        place = {"position": {"type": "object", "properties": dict.fromkeys("xyz", _NUMBER)}}
    words = {key: {"type": "string"} for key, column in (("agent_id", rows.agent), ("sensor_id", rows.sensor)) if column.any()}
    covariance: dict[str, Any] = {"position_covariance": _NUMBERS}
    if rows.is_geodetic:
        covariance["position_covariance_type"] = {"type": "integer"}
    properties = {"timestamp": _STAMP, "frame_id": {"type": "string"}, **place, **covariance, **words}
    return {"title": name, "type": "object", "properties": properties}


def _head(time_ns: int, frame_id: str) -> dict[str, Any]:
    second, nanosecond = divmod(time_ns, 10**9)
    return {"timestamp": {"sec": second, "nsec": nanosecond}, "frame_id": frame_id}


def _tail(covariance_m2: list[float], agent: str | None, sensor: str | None) -> dict[str, Any]:
    """What may be absent; nothing is known about up."""
    xx, xy, yy = covariance_m2
    found: dict[str, Any] = {} if np.isnan(xx) else {"position_covariance": [xx, xy, 0.0, xy, yy, 0.0, 0.0, 0.0, 0.0]}
    return found | {key: name for key, name in (("agent_id", agent), ("sensor_id", sensor)) if name}


def _fix(
    time_ns: int, latitude: float, longitude: float, altitude: float, covariance_m2: list[float], agent: str | None,
    sensor: str | None,
) -> dict[str, Any]:  # fmt: skip
    place = {"latitude": latitude, "longitude": longitude} | ({} if np.isnan(altitude) else {"altitude": altitude})
    rest = _tail(covariance_m2, agent, sensor)
    kind = {"position_covariance_type": _KNOWN if "position_covariance" in rest else 0}
    return _head(time_ns, "") | place | kind | rest


def _detection(
    time_ns: int, x: float, y: float, z: float, covariance_m2: list[float], agent: str | None, sensor: str | None
) -> dict[str, Any]:
    position = {"x": x, "y": y} | ({} if np.isnan(z) else {"z": z})
    return _head(time_ns, "map") | {"position": position} | _tail(covariance_m2, agent, sensor)


def _summary(file: TableFile, rows: Sightings, settings: ImportSettings, log: Path | None) -> Imported:
    columns = rows.choices.columns
    shown = tuple(_taken(what, rows) for what in columns if what in rows.taken)
    constants = (("agent", settings.agent), ("sensor", settings.sensor))
    shown += tuple(TakenColumn(what, "-", f"{value} in all rows", "you", "") for what, value in constants if value)
    used = {choice.column for choice in columns.values()}
    num_truth = int(rows.is_truth.sum())
    return Imported(
        table=file.path, kind=file.kind, provider=rows.choices.provider.name if rows.choices.provider else None, columns=shown,
        unused=tuple(name for name in file.names if name not in used), num_rows=rows.num_rows,
        num_detections=len(rows.time_ns) - num_truth, num_truth=num_truth, num_agents=len(set(rows.agent.tolist()) - {None}),
        start_ns=int(rows.time_ns[0]), end_ns=int(rows.time_ns[-1]), is_geodetic=rows.is_geodetic,
        left_out=dict(rows.left_out), notes=rows.notes, log=log,
    )  # fmt: skip


def _taken(what: str, rows: Sightings) -> TakenColumn:
    choice = rows.choices.columns[what]
    return TakenColumn(what, choice.column, rows.taken[what], choice.by, rows.examples[choice.column])
