"""Extract: catalogue and log → detections.parquet, truth.parquet, poses.parquet, obstacles.json.

Decoded messages become rows in the mission frame, sorted by time; whatever is left out is counted in the summary.
"""

import contextlib
import itertools
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from cadence.errors import ConfigError, ImplausibleInputError, InputError, NothingDetectedError
from pipeline.arrays import Objects
from pipeline.catalogue import open_catalogued_log, read_catalogue
from pipeline.extract.collapse import Collapsed, collapse
from pipeline.extract.fill_ins import without_fill_ins
from pipeline.extract.joined import check_joined
from pipeline.extract.mission_clock import on_one_clock
from pipeline.extract.names import Naming, without_false_names
from pipeline.extract.obstacle_sources import ObstacleSources, collect_obstacles
from pipeline.extract.placement import Placing, bring_together, in_enu, mission_frame, place
from pipeline.extract.plausibility import Kind, Suspicions, few
from pipeline.extract.positions import ChannelReader, Positions, Rows
from pipeline.extract.reading import read_positions
from pipeline.extract.reuse import without_reused_names
from pipeline.extract.scatter import with_scatter
from pipeline.extract.selection import ROLES, select_readers, selected_channels, unused_channels
from pipeline.extract.spikes import is_spike
from pipeline.extract.stages import without_other_stages
from pipeline.extract.stamps import moment_ns
from pipeline.extract.stretches import without_set_back, without_unjoined
from pipeline.extract.summary import summarise, tell
from pipeline.extract.thinning import ThinningConfig, is_seen, noise
from pipeline.extract.transform_messages import LogTransforms
from pipeline.extract.transforms import Limits
from pipeline.extract.units import in_true_units
from pipeline.logs.reader import MissionLog
from pipeline.manifest import StageResult, run_stage
from pipeline.mapping.sources import SourceConfig
from pipeline.missions import CATALOGUE_NAME
from pipeline.obstacle_file import OBSTACLES_NAME, write_obstacles
from pipeline.progress import Progress
from pipeline.tables import Frame, write_table
from schemas.tables import DETECTIONS, POSES, TRUTH

_MAX_DISAGREEING = 0.05


@dataclass(frozen=True)
class ExtractConfig:
    """What to take from a log.

    detections, truth, poses   the sources of each role
    suggest          fill roles that are left empty by what the names of topics suggest
    thinning         make sparse detections out of a dense channel
    simultaneity_s   detections of one agent within this time are collapsed into one
    topics           patterns ("/radar/*"); take positions only from topics that fit one of them; empty: from all
    start, end       use only messages logged in this part: seconds after the log's first message, or a moment (ISO 8601)
    frame            name of the fixed frame to bring detections into, by the log's transforms; by default their own where it
                     does not move, else the one that it moves in
    max_extrapolation_s   how long before its first and after its last sample a transform holds; later positions are refused
    max_transform_gap_s   longest time between two samples over which a transform is interpolated
    default_sigma_m  standard deviation of detections that state none; without it that of their scatter about smooth ways, where
                     there is one, else they count as exact
    max_speed_mps    single positions that could only be reached and left again faster are recorder faults (see `spikes`)
    trusted          kinds of suspicion that are not looked for: what the log says of them counts as it stands (docs/formats.md)
    is_strict        refuse a log of which something is suspected (`--strict`)
    datum            [latitude, longitude] in degrees of x = y = 0; by default the median of all positions, and unknown for
                     logs in metres
    obstacles        where obstacles come from; by default what the log says
    """

    detections: tuple[SourceConfig, ...] = ()
    truth: tuple[SourceConfig, ...] = ()
    poses: tuple[SourceConfig, ...] = ()
    suggest: bool = True
    thinning: ThinningConfig = field(default_factory=ThinningConfig)
    simultaneity_s: float = 0.001
    topics: tuple[str, ...] = ()
    start: float | str | None = None
    end: float | str | None = None
    frame: str | None = None
    max_extrapolation_s: float = 0.5
    max_transform_gap_s: float = 10.0
    default_sigma_m: float | None = None
    max_speed_mps: float | None = 1000.0
    datum: tuple[float, float] | None = None
    obstacles: ObstacleSources = field(default_factory=ObstacleSources)
    trusted: tuple[Kind, ...] = ()
    is_strict: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.simultaneity_s < np.inf:
            raise ValueError("simultaneity_s must not be negative")
        if self.default_sigma_m is not None and not 0 < self.default_sigma_m < np.inf:
            raise ValueError("default_sigma_m must be positive")
        if self.max_speed_mps is not None and not self.max_speed_mps > 0:
            raise ValueError("max_speed_mps must be positive")
        if not (0 <= self.max_extrapolation_s < np.inf and 0 < self.max_transform_gap_s < np.inf):
            raise ValueError("max_extrapolation_s must not be negative, and max_transform_gap_s must be positive")
        for name in ("start", "end"):
            value = getattr(self, name)
            if value is not None and moment_ns(value, 0) is None:
                raise ValueError(f'{name} = {value!r}: expected seconds after the start of the log, or "2024-05-01T12:30:00Z"')
        if self.datum is not None and not (abs(self.datum[0]) <= 90 and abs(self.datum[1]) <= 180):
            raise ValueError(f"datum {list(self.datum)}: expected [latitude, longitude] in degrees")


def extract(directory: Path, config: ExtractConfig, progress: Progress, force: bool = False) -> StageResult:
    """Write the tables of the log that `directory` was ingested from.

    Raises `InputError` where no detection is left, of which `NothingDetectedError` where none was recorded, and
    `ImplausibleInputError` where something is suspected and `config.is_strict`.
    """
    catalogue = read_catalogue(directory)

    def body(work: Path) -> dict[str, Any]:
        return write_tables(open_catalogued_log(catalogue), work, config, progress)

    for path in config.obstacles.files:
        if not path.is_file():
            raise ConfigError(f"{path}: not a file; correct extract.obstacles.files")
    inputs = [directory / CATALOGUE_NAME, *config.obstacles.files]
    return run_stage("extract", directory, config=config, inputs=inputs, body=body, force=force)


def write_tables(log: MissionLog, folder: Path, config: ExtractConfig, progress: Progress) -> dict[str, Any]:
    """Write the files of the stage for `log` into `folder`; the summary."""
    suspicions = Suspicions(config.trusted)
    stated = {"detections": config.detections, "truth": config.truth, "poses": config.poses}
    transforms = LogTransforms(log, progress)
    with _about(log):
        channels = selected_channels(log.channels, config.topics)
        readers = select_readers(stated, config.suggest, config.thinning, channels)
        counts = read_positions(log, readers, progress, *_cut_ns(log, config))
        rows, frame = _rows_in_frame(log, readers, config, counts, suspicions, transforms)
    counts["unselected_topics"] = len({c.topic for c in log.channels} - {c.topic for c in channels})
    scattered, sigmas_m = _with_accuracy(rows["detections"], readers, config, suspicions)
    detections = collapse(scattered, config.simultaneity_s)
    counts["disagreeing"] = detections.num_disagreeing
    _suspect_disagreement(detections, suspicions)
    counts["collapsed"] = len(rows["detections"]) - len(detections.positions) - detections.num_disagreeing
    truth, counts["duplicate_truth"] = _without_repeats(rows["truth"])
    log_id = log.name
    write_table(_detection_table(log_id, detections), folder / "detections.parquet", "detections", frame)
    if len(truth):
        write_table(_track_table(log_id, truth, "agent_id", truth.agent, TRUTH), folder / "truth.parquet", "truth", frame)
    poses = rows["poses"]
    if len(poses):
        write_table(_track_table(log_id, poses, "sensor_id", poses.sensor, POSES), folder / "poses.parquet", "poses", frame)
    obstacles = collect_obstacles(log, config.obstacles, frame, progress.note)
    write_obstacles(folder / OBSTACLES_NAME, obstacles)
    unused = unused_channels(readers, channels)
    tell(counts, suspicions, detections.positions, log, progress)
    for topic, sigma_m in sigmas_m.items():
        progress.note(
            f"extract: {topic} states no accuracy, but its detections scatter by {sigma_m:.3g} m, which is taken as their "
            "standard deviation; sigma_m in its [[extract.detections]] states another"
        )
    for channel, why in unused.items():
        progress.note(f"extract: {channel} may hold detections and is not used: {why}")
    transforms.tell()
    if frame.frame_id.lower().endswith("ned"):
        progress.note(
            f'extract: frame {frame.frame_id} may be north-east-down; if so give its sources frame_convention = "ned"'
        )
    if config.is_strict and suspicions:
        refused = "; ".join(few(suspicions.lines()))
        raise ImplausibleInputError(f"{log.path}: refused by --strict, as something in it is suspected: {refused}")
    summary = summarise(log, readers, detections.positions, truth, poses, frame, counts, suspicions, len(obstacles))
    return summary | {"scatter_sigma_m": sigmas_m, "unused": unused, "transforms": transforms.summary(counts)}


@contextlib.contextmanager
def _about(log: MissionLog) -> Iterator[None]:
    """Put the log's path before what is wrong with its content."""
    try:
        yield
    except InputError as error:
        raise type(error)(f"{log.path}: {error}") from error


def _cut_ns(log: MissionLog, config: ExtractConfig) -> tuple[int | None, int | None]:
    """First log time that is used, and the first after it that is not."""
    start = None if config.start is None else moment_ns(config.start, log.start_ns)
    end = None if config.end is None else moment_ns(config.end, log.start_ns)
    if start is not None and end is not None and end < start:
        raise ConfigError(f"extract.start {config.start!r} lies after extract.end {config.end!r}; correct them")
    return start, None if end is None else end + 1


def _rows_in_frame(
    log: MissionLog, readers: Sequence[ChannelReader], config: ExtractConfig, counts: Counter[str], suspicions: Suspicions,
    transforms: LogTransforms,
) -> tuple[dict[str, Positions], Frame]:  # fmt: skip
    """The rows of every role, placed in the mission frame and thinned, and that frame."""
    parts = {role: _numbered([(reader, reader.finish()) for reader in readers if reader.role == role]) for role in ROLES}
    parts = without_set_back(parts, suspicions)
    timed, clock = on_one_clock(parts, suspicions)
    rows = {role: _columns(_in_place(role, parts[role], timed[role], suspicions), counts) for role in ROLES}
    primary = "truth" if config.thinning.enabled and config.thinning.thin_from == "truth" else "detections"
    _check_any(primary, rows[primary], counts, suspicions)
    rows = without_unjoined(rows, primary, suspicions)
    placing = Placing(config.frame, Limits(config.max_extrapolation_s, config.max_transform_gap_s))
    read_tree = partial(transforms.read, clock)
    if config.frame is None:
        check_joined(rows[primary], primary, transforms, read_tree, log, suspicions)
    rows = bring_together(rows, primary, placing, read_tree, counts)
    _check_any(primary, rows[primary], counts, suspicions)
    rows = {role: in_enu(positions) for role, positions in rows.items()}
    frame = mission_frame(rows[primary], [rows[role] for role in ROLES if role != primary], config.datum)
    rows = {role: _placed(role, rows[role], frame, counts, transforms.apart) for role in ROLES}
    rows["detections"] = _identified(rows["detections"], readers, config.simultaneity_s, suspicions)
    rows = {role: _without_spikes(rows[role], config.max_speed_mps, counts) for role in ROLES}
    if config.thinning.enabled:
        rows["detections"] = _thinned(rows[primary], config.thinning)
        if len(rows["detections"]) == 0:
            raise InputError("thinning left no detection; choose a smaller extract.thinning.mean_gap_s or another seed")
    return rows, frame


def _identified(rows: Positions, readers: Sequence[ChannelReader], tolerance_s: float, suspicions: Suspicions) -> Positions:
    """Detections, each counted once, with names that can be meant."""
    of_detections = [reader for reader in readers if reader.role == "detections"]
    naming = Naming(
        believed={reader.channel.topic for reader in of_detections if reader.source.has_identity},
        topical={reader.channel.topic for reader in of_detections if reader.names["agent"] is not None},
    )
    suggested = {reader.channel.topic: reader.channel.schema_name for reader in of_detections if not reader.is_stated}
    rows = without_false_names(rows, tolerance_s, naming, suspicions)
    rows = without_other_stages(rows, suggested, suspicions)
    return without_reused_names(rows, tolerance_s, naming, suspicions)


def _suspect_disagreement(detections: Collapsed, suspicions: Suspicions) -> None:
    """Say where sensors contradict each other more than now and then."""
    if detections.num_disagreeing > _MAX_DISAGREEING * len(detections.positions) and suspicions.looks_for("covariance"):
        suspicions.add(
            "covariance", "simultaneous detections",
            seen=f"{detections.num_disagreeing} lie over four standard deviations from the most accurate one of the same agent",
            done="they are left out",
            setting="sigma_m, or has_identity = false, in a [[extract.detections]]",
        )  # fmt: skip


def _columns(parts: Sequence[Positions], counts: Counter[str]) -> Positions:
    """All finite rows of a role, sorted by time."""
    counts["out_of_order"] += sum(int((part.time_ns < np.maximum.accumulate(part.time_ns)).sum()) for part in parts)
    rows = Positions.concatenate(list(parts) or [Rows().finish()])
    is_finite = np.isfinite(rows.first) & np.isfinite(rows.second)
    # A latitude off the earth is as little a position as NaN.
    is_finite &= ~rows.is_geodetic | ((np.abs(rows.first) <= 90) & (np.abs(rows.second) <= 360))
    counts["dropped_nonfinite"] += int((~is_finite).sum())
    rows = rows[is_finite]
    return rows[np.argsort(rows.time_ns, kind="stable")]


def _numbered(parts: Sequence[tuple[ChannelReader, Positions]]) -> list[tuple[ChannelReader, Positions]]:
    """The rows of each reader, with numbers of messages that no other reader has."""
    sizes = [int(part.message.max(initial=0)) for _, part in parts]
    return [
        (reader, replace(part, message=part.message + before))
        for (reader, part), before in zip(parts, itertools.accumulate(sizes, initial=0), strict=False)
    ]


def _in_place(
    role: str, parts: Sequence[tuple[ChannelReader, Positions]], timed: Sequence[Positions], suspicions: Suspicions
) -> list[Positions]:
    """The rows of each reader, whose times are mended, in true units and without fill-ins."""
    found = [in_true_units(reader.source, role, rows, suspicions) for (reader, _), rows in zip(parts, timed, strict=True)]
    return [without_fill_ins(rows, role, suspicions) for rows in found]


def _check_any(role: str, rows: Positions, counts: Counter[str], suspicions: Suspicions) -> None:
    if len(rows):
        return
    if suspicions:
        reason = f"nothing that can be meant is left of the {role}: {'; '.join(few(suspicions.lines()))}"
    elif counts["no_transform"]:
        reason = (
            f"for none of the {role} the log has a transform near enough in time; "
            "raise extract.max_extrapolation_s and extract.max_transform_gap_s, or check the stamps"
        )
    elif counts["dropped_nonfinite"]:
        reason = "every position is NaN, infinite or off the earth; check the recorder, or map another topic"
    elif counts["undecodable"]:
        reason = "no message of the mapped topics can be decoded; map another topic (cadence info lists them)"
    elif counts["unmet"]:
        reason = "no position meets the conditions of `where`; correct the [extract] entries"
    elif counts["no_fix"]:
        reason = "every position is marked as having no fix; map another topic (cadence info lists them)"
    elif counts["incomplete"]:
        reason = "no message of the mapped topics has a position where the mapping looks for it; correct the [extract] entries"
    elif counts["outside_time_cut"]:
        raise NothingDetectedError("no message of the mapped topics lies inside extract.start and extract.end; widen them")
    else:
        raise NothingDetectedError(f"the topics mapped as {role} hold no position; map another topic (cadence info lists them)")
    raise InputError(reason)


def _placed(role: str, rows: Positions, frame: Frame, counts: Counter[str], apart: set[str]) -> Positions:
    """Rows in the mission frame. What the user asked for must fit; what was only suggested is left out and counted.

    The frames of what is left out are added to `apart`.
    """
    placed, num_elsewhere = place(rows, frame)
    if num_elsewhere:
        geodetic = {"latitude and longitude"} if (rows.is_geodetic & (not frame.is_georeferenced)).any() else set()
        apart |= geodetic | {str(name) for name in rows.frame_id[~rows.is_geodetic]} - {frame.frame_id, ""}
    if num_elsewhere and rows.is_stated.any():
        raise InputError(
            f"{role}: {num_elsewhere} positions are not in the mission frame {frame.frame_id!r}, and no transform of the log "
            f"joins them; take those topics out of [[extract.{role}]]"
        )
    counts["other_frame"] += num_elsewhere
    return placed


def _without_spikes(rows: Positions, max_speed_mps: float | None, counts: Counter[str]) -> Positions:
    if max_speed_mps is None:
        return rows
    spikes = is_spike(rows, max_speed_mps)
    counts["spikes"] += int(spikes.sum())
    return rows[~spikes]


def _thinned(rows: Positions, config: ThinningConfig) -> Positions:
    """The rows that fall into bursts, with noise."""
    if any(agent is None for agent in rows.agent):
        raise InputError(
            "thinning: some detections have no agent; give agent or agent_path, or set extract.thinning.enabled=false"
        )
    is_kept = np.zeros(len(rows), dtype=np.bool_)
    first, second = rows.first.copy(), rows.second.copy()
    for agent in sorted(set(rows.agent)):
        of_agent = np.flatnonzero(rows.agent == agent)
        is_kept[of_agent] = is_seen(rows.time_ns[of_agent], agent, config)
        if config.noise_m > 0:
            added = noise(len(of_agent), agent, config)
            first[of_agent] += added[:, 0]
            second[of_agent] += added[:, 1]
    covariance = rows.covariance_m2
    if config.variance_m2 > 0:
        covariance = np.nan_to_num(covariance, nan=0.0) + np.array([config.variance_m2, 0.0, config.variance_m2])
    return replace(rows, first=first, second=second, covariance_m2=covariance)[is_kept]


def _with_accuracy(
    rows: Positions, readers: Sequence[ChannelReader], config: ExtractConfig, suspicions: Suspicions
) -> tuple[Positions, dict[str, float]]:
    """Detections with a covariance where they state none and the user or their scatter does; the latter's sigma by topic."""
    found: dict[str, float] = {}
    if not config.thinning.enabled:  # what is thinned is as exact as the truth, and its noise is stated
        told = {reader.channel.topic for reader in readers if reader.source.sigma_m is not None}
        rows, found = with_scatter(rows, told, config.default_sigma_m is not None, suspicions)
    if config.default_sigma_m is None:
        return rows, found
    covariance = rows.covariance_m2.copy()
    covariance[np.isnan(covariance[:, 0])] = config.default_sigma_m**2 * np.array([1.0, 0.0, 1.0])
    return replace(rows, covariance_m2=covariance), found


def _without_repeats(rows: Positions) -> tuple[Positions, int]:
    """Truth with one row an agent and time (the first), and the number of rows left out."""
    _, agent = np.unique(rows.agent.astype(np.str_), return_inverse=True)
    _, kept = np.unique(np.column_stack([rows.time_ns, agent]), axis=0, return_index=True)
    return rows[np.sort(kept)], len(rows) - len(kept)


def _detection_table(log_id: str, collapsed: Collapsed) -> pa.Table:
    rows = collapsed.positions
    columns = {
        "log_id": pa.array([log_id] * len(rows)), "time_ns": rows.time_ns, "sensor_id": rows.sensor, "agent_id": rows.agent,
        "x_m": rows.first, "y_m": rows.second, "z_m": rows.z_m, "cov_xx_m2": rows.covariance_m2[:, 0],
        "cov_xy_m2": rows.covariance_m2[:, 1], "cov_yy_m2": rows.covariance_m2[:, 2], "score": rows.score,
        "num_merged": collapsed.num_merged, "topic": rows.topic, "log_time_ns": rows.log_time_ns, "sequence": rows.sequence,
    }  # fmt: skip
    return _table(columns, DETECTIONS)


def _track_table(log_id: str, rows: Positions, key: str, names: Objects, schema: pa.Schema) -> pa.Table:
    columns = {
        "log_id": pa.array([log_id] * len(rows)), "time_ns": rows.time_ns, key: names,
        "x_m": rows.first, "y_m": rows.second, "z_m": rows.z_m,
    }  # fmt: skip
    return _table(columns, schema)


def _table(columns: Mapping[str, Any], schema: pa.Schema) -> pa.Table:
    """NaN becomes null."""
    return pa.table([pa.array(columns[item.name], type=item.type, from_pandas=True) for item in schema], schema=schema)
