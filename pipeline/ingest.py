"""Ingest: log → catalogue.json: channels, rates, time range, health, content hash, suggested mapping.

Every later stage finds the log through the catalogue, and `open_catalogued_log` sees to it that it is still the same log.
"""

import dataclasses
import json
from array import array
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from cadence.errors import ConfigError, InputError
from pipeline.config import read_config
from pipeline.logs.decode import Decoder, UndecodableChannel, UndecodableMessage, decoder_for
from pipeline.logs.decode import field as field_of
from pipeline.logs.reader import Channel, Health, MissionLog, open_log
from pipeline.manifest import StageResult, hash_file, read_manifest, run_stage
from pipeline.mapping import suggest_mapping
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
class Catalogue:
    """What `ingest` found. Times are log times; `roles` and `suggested_mapping` (TOML) come from `pipeline.mapping`."""

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


def ingest(log: Path, directory: Path, config: IngestConfig, progress: Progress, force: bool = False) -> StageResult:
    """Write the catalogue of `log`. Raises `InputError` where it is no MCAP or no message can be read."""
    log = log.resolve()

    def body(work: Path) -> dict[str, Any]:
        catalogue = _survey(log, progress)
        (work / CATALOGUE_NAME).write_text(json.dumps(_plain(catalogue, directory), indent=1) + "\n", encoding="utf-8")
        for problem in catalogue.health.problems:
            progress.note(f"{log.name}: {problem}")
        return _summary(catalogue, directory)

    if log.is_dir():
        open_log(log)  # says what is wrong; the stage would try to hash it
    return run_stage(
        "ingest", directory, config=config, inputs=[log], body=body, force=force or _is_of_other_path(directory, log)
    )


def survey_channels(log: MissionLog, on_bytes: Callable[[int], object] | None = None) -> tuple[CatalogueChannel, ...]:
    """Rates of all channels, and for each whether its first message can be decoded. Reads the whole log once."""
    times = {channel.id: array("q") for channel in log.channels}
    trials: dict[int, tuple[str | None, str | None]] = {}
    for message in log.messages(on_bytes=on_bytes):
        times[message.channel.id].append(message.log_time_ns)
        if message.channel.id not in trials:
            trials[message.channel.id] = _try(message.channel, message.data)
    return tuple(
        _describe(channel, times[channel.id], trials.get(channel.id) or _try(channel, None)) for channel in log.channels
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
    return dataclasses.replace(catalogue, path=directory.resolve() / catalogue.path)


def open_catalogued_log(catalogue: Catalogue, on_bytes: Callable[[int], object] | None = None) -> MissionLog:
    """The log of the catalogue, opened; `InputError` where it is gone or no longer has the content that was ingested."""
    path = catalogue.path
    if not path.is_file():
        raise InputError(f"{path}: the log that was ingested is not there any more; put it back, or ingest it where it is now")
    if path.stat().st_size != catalogue.size_bytes or hash_file(path) != catalogue.sha256:
        raise InputError(f"{path}: was changed after it was ingested; run `cadence ingest` again")
    return open_log(path, on_bytes)


def _is_of_other_path(directory: Path, log: Path) -> bool:
    """Whether the catalogue that is there names another path: equal content does not make it usable."""
    if read_manifest("ingest", directory) is None:
        return False
    try:
        return read_catalogue(directory).path != log
    except InputError:
        return True


def _survey(path: Path, progress: Progress) -> Catalogue:
    with progress.bar(path.stat().st_size, f"check {path.name}", unit="B", scale=True) as bar:
        log = open_log(path, bar.update)
    if log.health.num_messages == 0:
        why = log.health.problems[0] if log.health.problems else "nothing was recorded"
        raise InputError(f"{path}: holds no message that can be read ({why}); check the recording")
    with progress.bar(log.size_bytes, f"survey {path.name}", unit="B", scale=True) as bar:
        channels = survey_channels(log, bar.update)
    suggested = suggest_mapping(log.channels)
    return Catalogue(
        version=CATALOGUE_VERSION,
        path=path,
        sha256=hash_file(path),
        size_bytes=log.size_bytes,
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


def _describe(channel: Channel, times: "array[int]", trial: tuple[str | None, str | None]) -> CatalogueChannel:
    reason, frame_id = trial
    span_s = (times[-1] - times[0]) / 1e9 if times else 0.0
    has_rate = len(times) > 1 and span_s > 0
    return CatalogueChannel(
        id=channel.id,
        topic=channel.topic,
        encoding=channel.message_encoding,
        schema_name=channel.schema_name,
        schema_encoding=channel.schema_encoding,
        num_messages=len(times),
        mean_rate_hz=(len(times) - 1) / span_s if has_rate else None,
        median_gap_s=float(np.median(np.diff(np.asarray(times)))) / 1e9 if has_rate else None,
        is_decodable=reason is None,
        reason=reason,
        frame_id=frame_id,
    )


def _plain(catalogue: Catalogue, directory: Path) -> dict[str, Any]:
    return dataclasses.asdict(catalogue) | {"path": _stated_path(catalogue.path, directory)}


def _stated_path(log: Path, directory: Path) -> str:
    """Absolute; relative to the mission directory for a log in it (fetched from elsewhere): the two may move together."""
    inside = directory.resolve()
    return str(log.relative_to(inside) if log.is_relative_to(inside) else log)


def _summary(catalogue: Catalogue, directory: Path) -> dict[str, Any]:
    undecodable = [channel.topic for channel in catalogue.channels if not channel.is_decodable and channel.num_messages]
    return {
        "log": _stated_path(catalogue.path, directory),
        "num_channels": len(catalogue.channels),
        "num_messages": catalogue.health.num_messages,
        "duration_s": catalogue.duration_s,
        "is_complete": catalogue.health.is_complete,
        "problems": list(catalogue.health.problems),
        "undecodable": undecodable,
    }
