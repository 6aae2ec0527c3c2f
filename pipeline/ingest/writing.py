"""What is in a log: channels, rates, time range, health, content hash, suggested mapping."""

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from cadence.arrays import Int64s
from cadence.errors import InputError, NothingDetectedError
from pipeline.catalogue import (
    CATALOGUE_VERSION,
    Catalogue,
    CatalogueChannel,
    CataloguePart,
    stated_path,
)
from pipeline.files import hash_file
from pipeline.logs.decode import Decoder, UndecodableChannel, UndecodableMessage, decoder_for
from pipeline.logs.decode import field as field_of
from pipeline.logs.parts import mission_name
from pipeline.logs.reader import Channel, MissionLog, open_parts
from pipeline.mapping.guess import suggest_mapping
from pipeline.progress import Progress

_FRAME_PATHS: Final = ("header.frame_id", "frame_id")


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


def survey(paths: Sequence[Path], progress: Progress) -> Catalogue:
    """What is found in the files of a log, each of which is read once; raises as `ingest` does."""
    parts = tuple(CataloguePart(path, hash_file(path), path.stat().st_size) for path in paths)
    name, size_bytes = mission_name(paths), sum(part.size_bytes for part in parts)
    with progress.bar(size_bytes, f"check {name}", unit="B", scale=True) as bar:
        log = open_parts(paths, bar.update)
    if log.health.num_messages == 0 and log.health.is_complete:
        raise NothingDetectedError(f"{paths[0]}: is sound, but no message was recorded in it; there is nothing to infer from")
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


def summary_of(catalogue: Catalogue, directory: Path) -> dict[str, Any]:
    """What the manifest says of a catalogue that lies in `directory`."""
    undecodable = [channel.topic for channel in catalogue.channels if not channel.is_decodable and channel.num_messages]
    return {
        "log": stated_path(catalogue.path, directory),
        **({"parts": [stated_path(part.path, directory) for part in catalogue.parts]} if catalogue.parts else {}),
        "num_channels": len(catalogue.channels),
        "num_messages": catalogue.health.num_messages,
        "duration_s": catalogue.duration_s,
        "is_complete": catalogue.health.is_complete,
        "problems": list(catalogue.health.problems),
        "undecodable": undecodable,
    }
