"""One mission log with truth as episodes of one target each: what forecasts are trained on and scored against."""

import json
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cadence.arrays import Float64s, Int64s
from cadence.errors import InputError
from cadence.recordings import Recordings
from pipeline.documents import parse_json
from pipeline.extract.config import ExtractConfig
from pipeline.extract.writing import write_tables
from pipeline.logs.reader import MissionLog, open_log
from pipeline.mapping.guess import suggest_mapping
from pipeline.obstacle_file import OBSTACLES_NAME
from pipeline.progress import Progress
from pipeline.tables import read_table
from pipeline.tracks import UNKNOWN_AGENT, interpolated

GOAL_KEYS = ("known_goal_m", "hideout_known_to_trackers")
"""Keys of a log's Metadata record `mission` that hold [x, y] or a list of them, metres: where the searching side expects it."""

_AIRCRAFT_FACTOR = 3.0
"""A tracker that moves faster than the target by this factor is an aircraft; they come first."""
_OFF_TRUTH_SHARE = 0.01
_JITTER = 0.01
"""Stamps may be off their step by this share of it."""


@dataclass(frozen=True, eq=False)
class LogEpisodes:
    """What was read of one log: a track for each target with truth, all with the same obstacles.

    recordings  one episode of all targets where they have the same steps, otherwise an episode for each
    names      of the tracks: the log's, with the target's where it has several
    scale_m    what the paper divides distances by: the longer side of the map; NaN where the log does not state it
    obstacles  the entries of obstacles.json as JSON text
    """

    recordings: Recordings
    names: tuple[str, ...]
    scale_m: float
    obstacles: str


@dataclass(frozen=True)
class Gridding:
    """How samples become steps.

    step_s         None: as the log's Metadata record `mission` states, or else the median time between truth samples
    max_gap_steps  truth and trackers are interpolated between samples at most so far apart
    tolerance_m    a detection is exact where it is no further than this from the truth
    """

    step_s: float | None = None
    max_gap_steps: float = 2.0
    tolerance_m: float = 1.0


def read_log_episodes(path: Path, extract: ExtractConfig, gridding: Gridding) -> LogEpisodes:
    """The episodes of the log at `path`. Raises `InputError` where it has no truth, or is not what the protocol needs.

    A detection counts for the first step that is not before it, so nothing is known before it was seen.
    """
    log = open_log(path)
    mission = dict(log.metadata()).get("mission", {})
    extract = extract if not _says_unseen(log, mission, extract) else _truth_twice(log, extract)
    is_unseen = extract.detections == extract.truth != ()
    with tempfile.TemporaryDirectory() as folder:
        write_tables(log, Path(folder), extract, Progress(quiet=True))
        tables = {name: _table(Path(folder), name) for name in ("detections", "truth", "poses")}
        entries = parse_json((Path(folder) / OBSTACLES_NAME).read_text(encoding="utf-8"))["obstacles"]
    truth, seen = tables["truth"], tables["detections"]
    if truth is None:
        raise InputError(f"{path}: has no truth to score against; name its topic with [[evaluate.forecast.extract.truth]]")
    assert seen is not None
    agents = pc.unique(truth["agent_id"]).to_pylist()
    step_ns = _step_ns(path, truth.filter(pc.equal(truth["agent_id"], agents[0])), mission, gridding)
    tracks = [_of_agent(truth, agent) for agent in agents]
    parts = [
        _episode(path, track, _seen_of(seen.slice(0, 0) if is_unseen else seen, agent, len(agents), path),
                 tables["poses"], step_ns, mission, gridding)
        for agent, track in zip(agents, tracks, strict=True)
    ]  # fmt: skip
    names = (path.stem,) if len(agents) == 1 else tuple(f"{path.stem}/{agent}" for agent in agents)
    recordings = Recordings.concatenate(parts)
    if len({time_ns[0] for time_ns, _ in tracks}) == len(set(recordings.length)) == 1:
        recordings = replace(recordings, num_agents=len(agents))
    return LogEpisodes(recordings, names, _scale_m(mission), json.dumps(entries, sort_keys=True))


def _says_unseen(log: MissionLog, mission: Mapping[str, str], extract: ExtractConfig) -> bool:
    """Whether nothing was detected in the whole log: no fault, where the target's start is known."""
    if extract.detections or extract.thinning.enabled or not extract.suggest:
        return False
    suggested = suggest_mapping(log.channels)
    counts = [channel.message_count for channel in log.channels if suggested.roles.get(channel.topic) == "detections"]
    return not suggested.detections and (any(count == 0 for count in counts) or _number(mission, "num_detections") == 0)


def _truth_twice(log: MissionLog, extract: ExtractConfig) -> ExtractConfig:
    """The truth in place of detections, which extraction cannot do without."""
    sources = extract.truth or suggest_mapping(log.channels).truth
    return replace(extract, detections=sources, truth=sources)


def _table(folder: Path, name: str) -> pa.Table | None:
    path = folder / f"{name}.parquet"
    return read_table(path, name)[0] if path.is_file() else None


def _number(record: Mapping[str, str], key: str) -> float | None:
    """A number out of a Metadata record; None where there is none."""
    try:
        value = float(parse_json(record[key]))
    except (KeyError, ValueError, TypeError):
        return None
    return value if np.isfinite(value) else None


def _scale_m(mission: Mapping[str, str]) -> float:
    side_m = _number(mission, "map_side_m")
    return np.nan if side_m is None else side_m


def _step_ns(path: Path, truth: pa.Table, mission: Mapping[str, str], gridding: Gridding) -> int:
    gaps = np.diff(np.sort(truth["time_ns"].to_numpy()))
    if not len(gaps):
        raise InputError(f"{path}: truth is a single position; an episode needs two")
    step_s = gridding.step_s or _number(mission, "step_s") or float(np.median(gaps)) * 1e-9
    return max(1, round(step_s * 1e9))


def _of_agent(truth: pa.Table, agent: str) -> tuple[Int64s, Float64s]:
    """Times [N] and positions [N, 2], sorted."""
    rows = truth.filter(pc.equal(truth["agent_id"], agent)).sort_by("time_ns")
    return rows["time_ns"].to_numpy(), _places(rows)


def _places(rows: pa.Table) -> Float64s:
    return np.stack([rows["x_m"].to_numpy(), rows["y_m"].to_numpy()], axis=-1)


def _seen_of(seen: pa.Table, agent: str, num_agents: int, path: Path) -> pa.Table:
    """Detections of one agent; those of unknown origin belong to the only agent that there is."""
    names = pc.fill_null(seen["agent_id"], UNKNOWN_AGENT)
    if num_agents == 1 and set(pc.unique(names).to_pylist()) <= {UNKNOWN_AGENT, agent}:
        return seen
    if seen.num_rows and not pc.any(pc.equal(names, agent)).as_py():
        found = ", ".join(map(str, pc.unique(names).to_pylist()[:5]))
        raise InputError(f"{path}: truth is of {agent}, detections are of {found}; give both the same names")
    return seen.filter(pc.equal(names, agent))


def _episode(
    path: Path, truth: tuple[Int64s, Float64s], seen: pa.Table, poses: pa.Table | None, step_ns: int,
    mission: Mapping[str, str], gridding: Gridding,
) -> Recordings:  # fmt: skip
    """One target's truth, detections and trackers on its grid of steps."""
    time_ns, place = truth
    num_steps = int((time_ns[-1] - time_ns[0] + _JITTER * step_ns) // step_ns) + 1
    steps_ns = np.minimum(time_ns[0] + step_ns * np.arange(num_steps, dtype=np.int64), time_ns[-1])
    max_gap_ns = gridding.max_gap_steps * step_ns
    position = interpolated(time_ns, place, steps_ns, max_gap_ns)
    if np.isnan(position).any():
        widest = float(np.diff(time_ns).max(initial=0)) * 1e-9
        raise InputError(f"{path}: truth has a gap of {widest:g} s, more than {max_gap_ns * 1e-9:g} s; raise max_gap_steps")
    is_detected = np.zeros(num_steps, dtype=np.bool_)
    is_detected[_seen_steps(path, seen, truth, step_ns, num_steps, gridding.tolerance_m)] = True
    goal = _known_goal(mission)
    return Recordings(
        step_ns / 1e9,
        np.array([0, num_steps]),
        position.astype(np.float32),
        is_detected,
        _trackers(poses, steps_ns, position, max_gap_ns).astype(np.float32),
        goal.astype(np.float32)[None],
    )


def _seen_steps(
    path: Path, seen: pa.Table, truth: tuple[Int64s, Float64s], step_ns: int, num_steps: int, tolerance_m: float
) -> Int64s:
    """The steps of the exact detections. `InputError` where more than one in a hundred is not exact."""
    time_ns, place = truth
    at = seen["time_ns"].to_numpy()
    step = np.ceil((at - time_ns[0]) / step_ns - _JITTER).astype(np.int64)
    is_inside = (at >= time_ns[0]) & (step < num_steps)
    off_m = np.hypot(*(_places(seen) - interpolated(time_ns, place, at, np.inf)).T)[is_inside]
    is_far = ~(off_m <= tolerance_m)
    if is_far.sum() > _OFF_TRUTH_SHARE * len(off_m):
        raise InputError(
            f"{path}: {int(is_far.sum())} of {len(off_m)} detections lie more than {tolerance_m:g} m from the truth; "
            "the paper's protocol is for exact detections (cadence run and evaluate on its results take any)"
        )
    steps: Int64s = step[is_inside][~is_far]
    return steps


def _known_goal(mission: Mapping[str, str]) -> Float64s:
    """The goal [2] that the searching side knows, the first where there are several; NaN where none is stated."""
    for key in GOAL_KEYS:
        try:
            value = np.asarray(parse_json(mission[key]), dtype=np.float64).reshape(-1, 2)
        except (KeyError, ValueError, TypeError):
            continue
        if len(value):
            first: Float64s = value[0]
            return first
    return np.full(2, np.nan)


def _trackers(poses: pa.Table | None, steps_ns: Int64s, target: Float64s, max_gap_ns: float) -> Float64s:
    """Positions [T, M, 2] of the sensors that move, aircraft first, each kind in the order of the log; NaN: unknown."""
    tracks: list[tuple[bool, Float64s]] = []
    pace = _typical_step(target)
    sensors: list[Any] = [] if poses is None else pc.unique(poses["sensor_id"]).to_pylist()
    for sensor in sensors:
        assert poses is not None
        rows = poses.filter(pc.equal(poses["sensor_id"], sensor)).sort_by("time_ns")
        track = interpolated(rows["time_ns"].to_numpy(), _places(rows), steps_ns, max_gap_ns)
        own_pace = _typical_step(track)
        if own_pace > 0:
            tracks.append((own_pace <= _AIRCRAFT_FACTOR * pace, track))
    if not tracks:
        return np.zeros((len(steps_ns), 0, 2))
    return np.stack([track for _, track in sorted(tracks, key=lambda pair: pair[0])], axis=1)


def _typical_step(track: Float64s) -> float:
    """Median length of the steps [T, 2] that are not zero; 0 where nothing moves."""
    length: Float64s = np.hypot(*np.diff(track, axis=0).T)
    moving = length[length > 0]  # NaN is not
    return float(np.median(moving)) if len(moving) else 0.0
