"""Ingest: log → catalogue.json: channels, rates, time range, health, content hash, suggested mapping.

Every later stage finds the log through the catalogue, and `open_catalogued_log` sees to it that it is still the same log.
"""

import dataclasses
import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from cadence.errors import ConfigError, InputError
from pipeline.arrays import Int64s
from pipeline.config import read_config
from pipeline.logs.decode import Decoder, UndecodableChannel, UndecodableMessage, decoder_for
from pipeline.logs.decode import field as field_of
from pipeline.logs.parts import mission_name, recorded_parts
from pipeline.logs.reader import Channel, Health, MissionLog, open_log, open_parts, reopen
from pipeline.manifest import StageResult, hash_file, read_manifest, run_stage
from pipeline.mapping.guess import suggest_mapping
from pipeline.progress import Progress

CATALOGUE_NAME: Final = "catalogue.json"
CATALOGUE_VERSION: Final = 1
_FRAME_PATHS: Final = ("header.frame_id", "frame_id")


@dataclass(frozen=True)
class IngestConfig:
    """Nothing can be configured: the catalogue states facts."""


@dataclass(frozen=True)
class CatalogueChannel:
    """One channel as the catalogue states it.

    mean_rate_hz, median_gap_s  None with fewer than two messages, or all at one time
    reason                      why the channel cannot be decoded, else None
    frame_id                    of its first message, where it states one
    """

    id: int
    topic: str
    encoding: str
    schema_name: str
    schema_encoding: str
    num_messages: int
    mean_rate_hz: float | None
    median_gap_s: float | None
    is_decodable: bool
    reason: str | None
    frame_id: str | None


@dataclass(frozen=True)
class CataloguePart:
    """One file of a recording in several files."""

    path: Path
    sha256: str
    size_bytes: int


@dataclass(frozen=True)
class Catalogue:
    """What `ingest` found. Times are log times; `roles` and `suggested_mapping` (TOML) come from `pipeline.mapping.guess`.

    parts   all files of a recording in several files, else empty
    path    the log; the first part where there are several
    sha256  of the log; where there are several parts, of their hashes in order
    """

    version: int
    path: Path
    sha256: str
    size_bytes: int
    start_ns: int
    end_ns: int
    duration_s: float
    library: str
    channels: tuple[CatalogueChannel, ...]
    health: Health
    metadata_names: tuple[str, ...]
    suggested_mapping: str
    roles: dict[str, str] = field(default_factory=dict)
    parts: tuple[CataloguePart, ...] = ()

    @property
    def files(self) -> tuple[CataloguePart, ...]:
        """Every file of the log, be it one or several."""
        return self.parts or (CataloguePart(self.path, self.sha256, self.size_bytes),)

    @property
    def name(self) -> str:
        """What the log is called: its stem, or what the stems of its parts have in common."""
        return mission_name([part.path for part in self.files])


def ingest(
    log: Path | Sequence[Path], directory: Path, config: IngestConfig, progress: Progress, force: bool = False
) -> StageResult:
    """Write the catalogue of `log`: a file, the folder of a split recording, or the parts of one mission.

    Raises `InputError` where it is no MCAP or no message can be read.
    """
    paths = _files(log)

    def body(work: Path) -> dict[str, Any]:
        catalogue = _survey(paths, progress)
        (work / CATALOGUE_NAME).write_text(json.dumps(_plain(catalogue, directory), indent=1) + "\n", encoding="utf-8")
        for problem in catalogue.health.problems:
            progress.note(f"{paths[0].name if len(paths) == 1 else catalogue.name}: {problem}")
        return _summary(catalogue, directory)

    is_moved = _is_of_other_paths(directory, paths)
    return run_stage("ingest", directory, config=config, inputs=paths, body=body, force=force or is_moved)


def survey_channels(log: MissionLog, on_bytes: Callable[[int], object] | None = None) -> tuple[CatalogueChannel, ...]:
    """Rates of all channels, and for each whether its first message can be decoded. Reads the whole log once."""
    times: dict[int, list[Int64s]] = {channel.id: [] for channel in log.channels}
    first: dict[int, tuple[int, bytes]] = {}
    for batch in log.batches(on_bytes=on_bytes):
        number, time_ns = batch.channel.id, int(batch.log_time_ns[0])
        times[number].append(batch.log_time_ns)
        if number not in first or time_ns < first[number][0]:
            first[number] = time_ns, next(batch.payloads())
    return tuple(
        _describe(channel, times[channel.id], _try(channel, first[channel.id][1] if channel.id in first else None))
        for channel in log.channels
    )


def read_catalogue(directory: Path) -> Catalogue:
    """The catalogue in `directory`; `InputError` where it is absent, damaged or of another version."""
    path = directory / CATALOGUE_NAME
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise InputError(f"{path}: not found; run `cadence ingest` first (`cadence run` does all stages)") from error
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}); run `cadence ingest` again with --force") from error
    version = data.get("version") if isinstance(data, dict) else None
    if version != CATALOGUE_VERSION:
        raise InputError(
            f"{path}: has version {version}, expected {CATALOGUE_VERSION}; run `cadence ingest` again with --force"
        )
    try:
        catalogue = read_config(Catalogue, data, str(path))
    except ConfigError as error:
        raise InputError(f"{error}; run `cadence ingest` again with --force") from error
    here = directory.resolve()
    parts = tuple(dataclasses.replace(part, path=here / part.path) for part in catalogue.parts)
    return dataclasses.replace(catalogue, path=here / catalogue.path, parts=parts)


def open_catalogued_log(catalogue: Catalogue, on_bytes: Callable[[int], object] | None = None) -> MissionLog:
    """The log of the catalogue, opened; `InputError` where it is gone or no longer has the content that was ingested."""
    for part in catalogue.files:
        path = part.path
        if not path.is_file():
            raise InputError(
                f"{path}: the log that was ingested is not there any more; put it back, or ingest it where it is now"
            )
        if path.stat().st_size != part.size_bytes or hash_file(path) != part.sha256:
            raise InputError(f"{path}: was changed after it was ingested; run `cadence ingest` again")
    return reopen([part.path for part in catalogue.files], catalogue.health, on_bytes)


def _files(log: Path | Sequence[Path]) -> tuple[Path, ...]:
    """The files of the log, absolute."""
    given = [log] if isinstance(log, Path) else log
    paths = tuple(part.resolve() for path in given for part in recorded_parts(path) or (path,))
    for path in paths:
        if path.is_dir():
            open_log(path)  # says what is wrong; the stage would try to hash it
    if len({path.name for path in paths}) < len(paths):  # manifests know inputs by their names
        raise InputError(f"{paths[0].parent}: two parts of one mission have the same name; rename one of them")
    return paths


def _is_of_other_paths(directory: Path, paths: Sequence[Path]) -> bool:
    """Whether the catalogue that is there names other files: equal content does not make it usable."""
    if read_manifest("ingest", directory) is None:
        return False
    try:
        return [part.path for part in read_catalogue(directory).files] != list(paths)
    except InputError:
        return True


def _survey(paths: Sequence[Path], progress: Progress) -> Catalogue:
    parts = tuple(CataloguePart(path, hash_file(path), path.stat().st_size) for path in paths)
    name, size_bytes = mission_name(paths), sum(part.size_bytes for part in parts)
    with progress.bar(size_bytes, f"check {name}", unit="B", scale=True) as bar:
        log = open_parts(paths, bar.update)
    if log.health.num_messages == 0:
        why = log.health.problems[0] if log.health.problems else "nothing was recorded"
        raise InputError(f"{paths[0]}: holds no message that can be read ({why}); check the recording")
    with progress.bar(log.size_bytes, f"survey {name}", unit="B", scale=True) as bar:
        channels = survey_channels(log, bar.update)
    suggested = suggest_mapping(log.channels)
    return Catalogue(
        version=CATALOGUE_VERSION,
        path=paths[0],
        sha256=parts[0].sha256 if len(parts) == 1 else _joint_hash(parts),
        size_bytes=size_bytes,
        parts=parts if len(parts) > 1 else (),
        start_ns=log.start_ns,
        end_ns=log.end_ns,
        duration_s=(log.end_ns - log.start_ns) / 1e9,
        library=log.library,
        channels=channels,
        health=log.health,
        metadata_names=tuple(name for name, _ in log.metadata()),
        suggested_mapping=suggested.to_toml(),
        roles=dict(suggested.roles),
    )


def _joint_hash(parts: Sequence[CataloguePart]) -> str:
    return hashlib.sha256("".join(part.sha256 for part in parts).encode()).hexdigest()


def _try(channel: Channel, data: bytes | None) -> tuple[str | None, str | None]:
    """Why the channel cannot be decoded (None where it can), and the frame of its first message."""
    try:
        decode: Decoder = decoder_for(channel)
        message = decode(data) if data is not None else None
    except (UndecodableChannel, UndecodableMessage) as error:
        return str(error), None
    for path in _FRAME_PATHS:
        try:
            frame_id = field_of(message, path)
        except KeyError:
            continue
        if isinstance(frame_id, str):
            return None, frame_id
    return None, None


def _describe(channel: Channel, parts: Sequence[Int64s], trial: tuple[str | None, str | None]) -> CatalogueChannel:
    reason, frame_id = trial
    times = np.sort(np.concatenate([*parts, np.empty(0, np.int64)]))
    span_s = float(times[-1] - times[0]) / 1e9 if len(times) else 0.0
    has_rate = len(times) > 1 and span_s > 0
    return CatalogueChannel(
        id=channel.id,
        topic=channel.topic,
        encoding=channel.message_encoding,
        schema_name=channel.schema_name,
        schema_encoding=channel.schema_encoding,
        num_messages=len(times),
        mean_rate_hz=(len(times) - 1) / span_s if has_rate else None,
        median_gap_s=float(np.median(np.diff(times))) / 1e9 if has_rate else None,
        is_decodable=reason is None,
        reason=reason,
        frame_id=frame_id,
    )


def _plain(catalogue: Catalogue, directory: Path) -> dict[str, Any]:
    parts = [{**dataclasses.asdict(part), "path": _stated_path(part.path, directory)} for part in catalogue.parts]
    return dataclasses.asdict(catalogue) | {"path": _stated_path(catalogue.path, directory), "parts": parts}


def _stated_path(log: Path, directory: Path) -> str:
    """Absolute; relative to the mission directory for a log in it (fetched from elsewhere): the two may move together."""
    inside = directory.resolve()
    return str(log.relative_to(inside) if log.is_relative_to(inside) else log)


def _summary(catalogue: Catalogue, directory: Path) -> dict[str, Any]:
    undecodable = [channel.topic for channel in catalogue.channels if not channel.is_decodable and channel.num_messages]
    return {
        "log": _stated_path(catalogue.path, directory),
        **({"parts": [_stated_path(part.path, directory) for part in catalogue.parts]} if catalogue.parts else {}),
        "num_channels": len(catalogue.channels),
        "num_messages": catalogue.health.num_messages,
        "duration_s": catalogue.duration_s,
        "is_complete": catalogue.health.is_complete,
        "problems": list(catalogue.health.problems),
        "undecodable": undecodable,
    }
