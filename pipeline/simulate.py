"""Stage simulate: mission logs out of a simulated world, one MCAP file an episode."""

import hashlib
import json
import os
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from cadence.errors import CadenceError, DeviceError
from cadence.worlds.episode import Episode, gaps_s
from cadence.worlds.patrol import PatrolConfig, simulate_patrol
from pipeline.config import config_as_dict
from pipeline.logs.forms import Encoding
from pipeline.logs.mission import MissionForm, write_mission
from pipeline.logs.reader import open_log
from pipeline.manifest import StageResult, hash_file, manifest_path, write_atomic
from pipeline.progress import Progress
from pipeline.provenance import versions
from pipeline.tables import Frame

STAGE = "simulate"
VERSION = 1
"""Raised when the same settings make other logs than before: finished episodes are then written anew."""


@dataclass(frozen=True)
class SimulateConfig:
    """What to simulate, and how to write it.

    world           the only one so far
    seed            of the whole series of episodes
    num_episodes, first_index  episodes first_index ... first_index + num_episodes - 1 of `seed`; an episode depends on
                               nothing but its index, the seed and the settings below
    num_agents      targets
    duration_s, step_s  length of an episode, and time between truth samples
    detection_rate  mean share of steps with a detection of an agent (episodes differ widely); sets the sensors' ranges
    line_of_sight   whether land hides targets from the sensors at sea level
    encoding        protobuf, json or cdr; protobuf logs in metres hold JSON detections (no Foxglove type has a covariance)
    georeferenced   positions as latitude and longitude
    latitude_deg, longitude_deg  of the middle of the map, for georeferenced logs
    frame_id        name of the frame in the messages
    start_time_s    Unix time of the first message
    """

    world: Literal["patrol"] = "patrol"
    num_episodes: int = 1
    seed: int = 0
    first_index: int = 0
    num_agents: int = 1
    duration_s: float = 7200.0
    step_s: float = 10.0
    detection_rate: float = 0.1
    line_of_sight: bool = True
    encoding: Encoding = "protobuf"
    georeferenced: bool = False
    latitude_deg: float = 59.2
    longitude_deg: float = 20.3
    start_time_s: int = 1700000000
    frame_id: str = "map"

    def __post_init__(self) -> None:
        if self.num_episodes < 1:
            raise ValueError(f"num_episodes is {self.num_episodes}; at least one episode is needed")
        if self.seed < 0 or self.first_index < 0 or self.start_time_s < 0:
            raise ValueError("seed, first_index and start_time_s must not be negative")
        if not (abs(self.latitude_deg) <= 85.0 and abs(self.longitude_deg) <= 180.0):
            raise ValueError(f"the datum {self.latitude_deg}, {self.longitude_deg} is not within 85 degrees of the equator")
        self.world_config()  # refuses what the world cannot do

    def world_config(self) -> PatrolConfig:
        """The settings that the world itself has."""
        return PatrolConfig(self.num_agents, self.duration_s, self.step_s, self.detection_rate, self.line_of_sight)

    def form(self) -> MissionForm:
        """How the episodes are written."""
        datum = (self.latitude_deg, self.longitude_deg) if self.georeferenced else (None, None)
        return MissionForm(self.encoding, Frame(self.frame_id, *datum), self.start_time_s * 1_000_000_000)


@dataclass(frozen=True)
class _Score:
    """What the summary says of one episode."""

    file: str
    sha256: str
    detection_rate: float
    num_detections: int
    gaps_s: tuple[float, ...]


def simulate(out: Path, config: SimulateConfig, progress: Progress, force: bool = False) -> StageResult:
    """Write the episodes of `config` to `out` as `<world>-<seed>-<index>.mcap`, and `simulate.manifest.json` beside them.

    Each log appears whole or not at all, and is left alone where an earlier call with the same settings and versions wrote
    it, whatever its `num_episodes` and `first_index`: a call that was killed goes on where it was. The same settings give
    the same bytes. `StageResult.outputs` are the logs in order. Raises `DeviceError` where `out` cannot be written.
    """
    _prepare(out)
    indices = range(config.first_index, config.first_index + config.num_episodes)
    scores: list[_Score] = []
    num_written = 0
    with progress.bar(len(indices), STAGE, unit="episode") as bar:
        for index in indices:
            path = out / f"{config.world}-{config.seed}-{index:04d}.mcap"
            score = None if force else _finished(path, config, index)
            if score is None:
                score = _write_episode(path, config, index)
                num_written += 1
            scores.append(score)
            bar.update(1)
    manifest = {
        "stage": STAGE,
        "config": config_as_dict(config),
        "inputs": {},
        "versions": versions(),
        "outputs": {score.file: score.sha256 for score in scores},
        "summary": _summary(scores),
    }
    write_atomic(manifest_path(STAGE, out), json.dumps(manifest, indent=1, sort_keys=True) + "\n")
    outputs = tuple(out / score.file for score in scores)
    return StageResult(STAGE, "done" if num_written else "skipped", outputs, {**_summary(scores), "num_written": num_written})


def _prepare(out: Path) -> None:
    """Make the folder; parts that a killed call left behind go."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        for part in out.glob(f".{STAGE}.*.part"):
            part.unlink(missing_ok=True)
    except OSError as error:
        raise DeviceError(f"{out}: cannot write there ({error.strerror}); choose another --out") from error


def _key(config: SimulateConfig, index: int) -> str:
    """What an episode's bytes depend on, as a hash."""
    settled = config_as_dict(replace(config, num_episodes=1, first_index=index))
    made_by = {name: versions()[name] for name in ("cadence", "numpy", "mcap")}
    text = json.dumps({"config": settled, "version": VERSION, "made_by": made_by}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _finished(path: Path, config: SimulateConfig, index: int) -> _Score | None:
    """What is known of an episode that an earlier call wrote with the same settings; None where it must be written.

    Each log says itself which settings made it: a call that was killed left no manifest.
    """
    if not path.is_file():
        return None
    try:
        log = open_log(path)
        mission = dict(log.metadata()).get("mission", {})
        is_sound = log.health.is_complete and not log.health.problems
    except CadenceError:
        return None
    if not is_sound or mission.get("key") != json.dumps(_key(config, index)):
        return None
    rate, count, gaps = (json.loads(mission[name]) for name in ("measured_detection_rate", "num_detections", "gaps_s"))
    return _Score(path.name, hash_file(path), rate, count, tuple(gaps))


def _write_episode(path: Path, config: SimulateConfig, index: int) -> _Score:
    """Simulate one episode and write its log under a temporary name, then rename it."""
    episode = simulate_patrol(config.world_config(), np.random.default_rng([config.seed, index]))
    is_detected = episode.is_detected()
    gaps = tuple(float(gap) for agent in is_detected for gap in gaps_s(agent, config.step_s))
    rate, count = round(float(is_detected.mean()), 6), len(episode.detections)
    mission = _mission_record(episode, config, index)
    mission |= {"measured_detection_rate": rate, "num_detections": count, "gaps_s": gaps, "key": _key(config, index)}
    try:
        handle, name = tempfile.mkstemp(prefix=f".{STAGE}.", suffix=".part", dir=path.parent)
        os.close(handle)
        part = Path(name)
        try:
            write_mission(part, episode, config.form(), mission)
            digest = hash_file(part)
            part.chmod(0o644)
            os.replace(part, path)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise DeviceError(f"{path}: cannot write ({error.strerror}); check the folder and the free space") from error
    return _Score(path.name, digest, rate, count, gaps)


def _mission_record(episode: Episode, config: SimulateConfig, index: int) -> dict[str, Any]:
    """The Metadata record `mission`: how the log came about and what its names mean."""
    record: dict[str, Any] = {
        "world": config.world,
        "seed": config.seed,
        "episode": index,
        "step_s": config.step_s,
        "duration_s": float(episode.time_s[-1]),
        "start_time_s": config.start_time_s,
        "frame_id": config.frame_id,
        "map_side_m": episode.terrain.side_m,
        "agents": episode.agent_ids,
        "sensors": episode.sensor_ids,
        "detection_rate": config.detection_rate,
        "goals_m": [np.round(goals, 1).tolist() for goals in episode.goals_m],
    }
    if config.georeferenced:
        record |= {"latitude_deg": config.latitude_deg, "longitude_deg": config.longitude_deg}
    return record


def _summary(scores: list[_Score]) -> dict[str, Any]:
    """Numbers over all episodes, for people and for `--json`."""
    rates = np.array([score.detection_rate for score in scores])
    gaps = np.concatenate([np.zeros(0), *(np.array(score.gaps_s) for score in scores)])
    return {
        "num_episodes": len(scores),
        "num_detections": sum(score.num_detections for score in scores),
        "detection_rate_mean": round(float(rates.mean()), 6),
        "detection_rate_median": round(float(np.median(rates)), 6),
        "gap_mean_s": round(float(gaps.mean()), 3) if len(gaps) else None,
        "gap_median_s": round(float(np.median(gaps)), 3) if len(gaps) else None,
        "gap_max_s": float(gaps.max()) if len(gaps) else None,
    }
