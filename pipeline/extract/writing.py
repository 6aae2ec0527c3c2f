"""A log → detections.parquet, truth.parquet, poses.parquet, obstacles.json.

Decoded messages become rows in the mission frame, sorted by time; whatever is left out is counted in the summary.
"""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cadence.errors import ConfigError, ImplausibleInputError, InputError
from pipeline.accuracies import Accuracy, lines
from pipeline.extract.accuracy import with_accuracy
from pipeline.extract.channel_reader import ChannelReader
from pipeline.extract.collapse import Collapsed, collapse
from pipeline.extract.config import ExtractConfig
from pipeline.extract.heights import settle_heights
from pipeline.extract.logged_sensors import logged_sensors
from pipeline.extract.looks import collect_looks
from pipeline.extract.mission_rows import rows_in_frame
from pipeline.extract.obstacle_sources import collect_obstacles
from pipeline.extract.polar import assumed
from pipeline.extract.positions import Positions
from pipeline.extract.reading import read_positions
from pipeline.extract.selection import select_readers, selected_channels, unused_channels
from pipeline.extract.sightings import SIGHTINGS, Sightings, measurement_rows
from pipeline.extract.summary import summarise, tell
from pipeline.extract.tables import detection_table, track_table
from pipeline.extract.transform_messages import LogTransforms
from pipeline.logs.reader import MissionLog
from pipeline.looks import write_looks
from pipeline.measurement_words import measurement_words
from pipeline.measurements import write_measurements
from pipeline.moments import moment_ns
from pipeline.obstacle_file import OBSTACLES_NAME, write_obstacles
from pipeline.progress import Progress
from pipeline.suspicions import Suspicions, few
from pipeline.tables import Frame, write_table
from schemas.tables import POSES, TRUTH

_MAX_DISAGREEING = 0.05


def write_tables(log: MissionLog, folder: Path, config: ExtractConfig, progress: Progress) -> dict[str, Any]:
    """Write the files of the stage for `log` into `folder`; the summary."""
    suspicions = Suspicions(config.trusted)
    stated = {"detections": config.detections, "truth": config.truth, "poses": config.poses}
    transforms = LogTransforms(log, progress)
    with _about(log):
        channels = selected_channels(log.channels, config.topics)
        readers = select_readers(stated, config.suggest, config.thinning, channels)
        counts = read_positions(log, readers, progress, *_cut_ns(log, config), config.max_detections)
        rows, frame = rows_in_frame(log, readers, config, counts, suspicions, transforms)
    rows, heights = settle_heights(rows, readers, config.is_height_used)
    frame = replace(frame, vertical_datum=heights.datum)
    counts["unselected_topics"] = len({c.topic for c in log.channels} - {c.topic for c in channels})
    accurate, accuracies = _with_accuracy(rows["detections"], readers, config, suspicions)
    detections = collapse(accurate, config.simultaneity_s)
    counts["disagreeing"] = detections.num_disagreeing
    _suspect_disagreement(detections, suspicions)
    counts["collapsed"] = len(rows["detections"]) - len(detections.positions) - detections.num_disagreeing
    truth, counts["duplicate_truth"] = _without_repeats(rows["truth"])
    log_id = log.name
    sensors = config.sensors or (logged_sensors(log) if config.suggest else ())
    if sensors:
        looks, footprints = collect_looks(sensors, rows["poses"], accurate, (log.start_ns, log.end_ns), suspicions)
        write_looks(folder, log_id, looks, footprints, frame)
    told = _write_measurements(rows, readers, folder, log_id, frame)
    found = detection_table(log_id, detections, heights.datum is not None)
    write_table(found, folder / "detections.parquet", "detections", frame)
    if len(truth):
        write_table(track_table(log_id, truth, "agent_id", truth.agent, TRUTH), folder / "truth.parquet", "truth", frame)
    poses = rows["poses"]
    if len(poses):
        write_table(track_table(log_id, poses, "sensor_id", poses.sensor, POSES), folder / "poses.parquet", "poses", frame)
    obstacles = collect_obstacles(log, config.obstacles, frame, progress.note)
    write_obstacles(folder / OBSTACLES_NAME, obstacles)
    unused = unused_channels(readers, channels)
    tell(counts, suspicions, detections.positions, log, progress)
    records = [accuracy.record() for accuracy in accuracies]
    taken = [line for reader in readers if (line := assumed(reader)) is not None]
    for line in few([*lines(records), *taken]):
        progress.note(f"extract: {line}")
    for line in heights.remarks:
        progress.note(f"extract: {line}")
    for channel, why in unused.items():
        progress.note(f"extract: {channel} may hold detections and is not used: {why}")
    if words := measurement_words(told.get("measurements", {})):
        progress.note(f"extract: {words}")
    transforms.tell()
    if config.is_strict and suspicions:
        refused = "; ".join(few(suspicions.lines()))
        raise ImplausibleInputError(f"{log.path}: refused by --strict, as something in it is suspected: {refused}")
    summary = summarise(log, readers, detections.positions, truth, poses, frame, counts, suspicions, len(obstacles))
    told |= {name: counts[name] for name in ("static", "ground_heights", "north_by_name") if counts[name]}
    told |= {"accuracy": records, "unused": unused, "transforms": transforms.summary(counts)}
    told |= {"taken": taken} if taken else {}
    return summary | told | ({"height": dict(heights.record)} if heights.record else {})


@contextlib.contextmanager
def _about(log: MissionLog) -> Iterator[None]:
    """Put the log's path before what is wrong with its content."""
    try:
        yield
    except InputError as error:
        raise type(error)(f"{log.path}: {error}") from error


def _write_measurements(
    rows: Mapping[str, Positions], readers: Sequence[ChannelReader], folder: Path, log_id: str, frame: Frame
) -> dict[str, Any]:
    """What sensors measured that is no position, where they did; what the summary says of it."""
    sightings = rows.get(SIGHTINGS)
    if not isinstance(sightings, Sightings):
        return {}
    datum = frame.vertical_datum
    found = measurement_rows(
        sightings, rows["poses"], {r.channel.topic for r in readers if datum is not None and r.vertical_datum == datum}
    )
    if not len(found):
        return {}
    write_measurements(folder, log_id, found, frame)
    return {"measurements": found.counts()}


def _cut_ns(log: MissionLog, config: ExtractConfig) -> tuple[int | None, int | None]:
    """First log time that is used, and the first after it that is not."""
    start = None if config.start is None else moment_ns(config.start, log.start_ns)
    end = None if config.end is None else moment_ns(config.end, log.start_ns)
    if start is not None and end is not None and end < start:
        raise ConfigError(f"extract.start {config.start!r} lies after extract.end {config.end!r}; correct them")
    return start, None if end is None else end + 1


def _suspect_disagreement(detections: Collapsed, suspicions: Suspicions) -> None:
    """Say where sensors contradict each other more than now and then."""
    if detections.num_disagreeing > _MAX_DISAGREEING * len(detections.positions) and suspicions.looks_for("covariance"):
        suspicions.add(
            "covariance", "simultaneous detections",
            seen=f"{detections.num_disagreeing} lie over four standard deviations from the most accurate one of the same agent",
            done="they are left out",
            setting="sigma_m, or has_identity = false, in a [[extract.detections]]",
        )  # fmt: skip


def _with_accuracy(
    rows: Positions, readers: Sequence[ChannelReader], config: ExtractConfig, suspicions: Suspicions
) -> tuple[Positions, list[Accuracy]]:
    """Detections with a covariance where they state none, and the user or their likelihood does; what the latter found."""
    stated = {reader.channel.topic for reader in readers if reader.source.sigma_m is not None}
    stated |= {r.channel.topic for r in readers if r.is_stated and r.source.bearing_sigma_deg is not None}
    kinds = {reader.channel.topic: reader.channel.schema_name for reader in readers}
    rows, found = with_accuracy(rows, stated, config.default_sigma_m is not None, kinds, suspicions)
    if config.default_sigma_m is None:
        return rows, found
    covariance = rows.covariance_m2.copy()
    covariance[np.isnan(covariance[:, 0])] = config.default_sigma_m**2 * np.array([1.0, 0.0, 1.0])
    return rows.changed(covariance_m2=covariance), found


def _without_repeats(rows: Positions) -> tuple[Positions, int]:
    """Truth with one row an agent and time (the first), and the number of rows left out."""
    _, agent = np.unique(rows.agent.astype(np.str_), return_inverse=True)
    _, kept = np.unique(np.column_stack([rows.time_ns, agent]), axis=0, return_index=True)
    return rows[np.sort(kept)], len(rows) - len(kept)
