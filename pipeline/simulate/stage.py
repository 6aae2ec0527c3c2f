"""Stage simulate: mission logs out of a simulated world, one MCAP file an episode."""

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from cadence.errors import CadenceError, DeviceError
from cadence.worlds.episode import Episode, gaps_s
from cadence.worlds.narco import NarcoConfig, simulate_narco
from cadence.worlds.patrol import PatrolConfig, simulate_patrol
from cadence.worlds.prison import PrisonConfig, simulate_prison_episodes
from cadence.worlds.prison_map import CELL_M
from cadence.worlds.rendezvous import RendezvousConfig, simulate_rendezvous
from cadence.worlds.rendezvous_map import GOALS_M, SITES_M
from pipeline.config import config_as_dict
from pipeline.files import hash_file, replacing, write_atomic
from pipeline.locks import clear_abandoned
from pipeline.logs.reader import open_log
from pipeline.manifest import StageResult, manifest_path
from pipeline.progress import Progress
from pipeline.provenance import versions
from pipeline.simulate.forms import Encoding
from pipeline.simulate.mission_log import MissionForm, write_mission
from pipeline.tables import Frame

STAGE = "simulate"
VERSION = 2
"""Raised when the same settings make other logs than before: finished episodes are then written anew."""

TOGETHER = 25
"""Episodes that are simulated at once, where the world is faster so; what is in them does not depend on it."""


@dataclass(frozen=True)
class SimulateConfig:
    """What to simulate, and how to write it.

    world           patrol: smugglers among islands, watched by boats, an aircraft and masts; prison and narco: the paper's
                    worlds (Prison Escape, Smuggler), one target and many trackers; rendezvous: several agents who meet at a
                    site and go on to a goal together, or go straight there
    seed            of the whole series of episodes
    num_episodes, first_index  episodes first_index ... first_index + num_episodes - 1 of `seed`; an episode depends on
                               nothing but its index, the seed and the settings below
    encoding        protobuf, json or cdr; protobuf logs in metres hold JSON detections (no Foxglove type has a covariance)
    georeferenced   positions as latitude and longitude
    latitude_deg, longitude_deg  of the mission frame's origin, for georeferenced logs: the middle of the map in patrol and
                                 rendezvous, its south-west corner in prison and narco
    frame_id        name of the frame in the messages
    start_time_s    Unix time of the first message
    is_polar        of patrol: detections as ranges and bearings from their sensors (mission.Bearing) instead of positions
    """

    world: Literal["patrol", "prison", "narco", "rendezvous"] = "patrol"
    num_episodes: int = 1
    seed: int = 0
    first_index: int = 0
    encoding: Encoding = "protobuf"
    georeferenced: bool = False
    latitude_deg: float = 59.2
    longitude_deg: float = 20.3
    start_time_s: int = 1700000000
    frame_id: str = "map"
    is_polar: bool = False
    patrol: PatrolConfig = field(default_factory=PatrolConfig)
    prison: PrisonConfig = field(default_factory=PrisonConfig)
    narco: NarcoConfig = field(default_factory=NarcoConfig)
    rendezvous: RendezvousConfig = field(default_factory=RendezvousConfig)

    def __post_init__(self) -> None:
        if self.num_episodes < 1:
            raise ValueError(f"num_episodes is {self.num_episodes}; at least one episode is needed")
        if self.seed < 0 or self.first_index < 0 or self.start_time_s < 0:
            raise ValueError("seed, first_index and start_time_s must not be negative")
        if not (abs(self.latitude_deg) <= 85.0 and abs(self.longitude_deg) <= 180.0):
            raise ValueError(f"the datum {self.latitude_deg}, {self.longitude_deg} is not within 85 degrees of the equator")

        if self.is_polar and self.world != "patrol":
            raise ValueError(f"is_polar is of the world patrol; of {self.world} nobody knows which sensor measured")

    @property
    def stem(self) -> str:
        """What the names of the logs begin with."""
        set_name = {"prison": f"-{self.prison.set}", "narco": f"-{self.narco.set}"}.get(self.world, "")
        return f"{self.world}{set_name}-{self.seed}"

    def form(self) -> MissionForm:
        """How the episodes are written."""
        datum = (self.latitude_deg, self.longitude_deg) if self.georeferenced else (None, None)
        start_ns = self.start_time_s * 1_000_000_000
        is_unknown = self.world == "rendezvous" and not self.rendezvous.is_origin_known
        groups_trackers = self.world in ("prison", "narco")
        return MissionForm(
            self.encoding, Frame(self.frame_id, *datum), start_ns, groups_trackers, not is_unknown, self.is_polar
        )


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

    The paper's worlds have their set in the name: `prison-low-0-0000.mcap`.

    Each log appears whole or not at all, and is left alone where an earlier call with the same settings and versions wrote
    it, whatever its `num_episodes` and `first_index`: a call that was killed goes on where it was. The same settings give
    the same bytes. `StageResult.outputs` are the logs in order. Raises `DeviceError` where `out` cannot be written.
    """
    _prepare(out, config.stem)
    indices = range(config.first_index, config.first_index + config.num_episodes)
    scores: list[_Score] = []
    num_written = 0
    with progress.bar(len(indices), STAGE, unit="episode") as bar:
        for begin in range(0, len(indices), TOGETHER):
            some = indices[begin : begin + TOGETHER]
            paths = {index: out / f"{config.stem}-{index:04d}.mcap" for index in some}
            found = {index: None if force else _finished(path, config, index) for index, path in paths.items()}
            missing = [index for index in some if found[index] is None]
            bar.update(len(some) - len(missing))
            for index, episode in zip(missing, _episodes(config, missing), strict=True):
                found[index] = _write_episode(paths[index], episode, config, index)
                bar.update(1)
            num_written += len(missing)
            scores += [score for score in found.values() if score is not None]
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


def _prepare(out: Path, stem: str) -> None:
    """Make the folder; what a killed call left of these episodes goes."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DeviceError(f"{out}: cannot write there ({error.strerror}); choose another --out") from error
    clear_abandoned(out, f".{stem}-")


def _key(config: SimulateConfig, index: int) -> str:
    """What an episode's bytes depend on, as a hash."""
    settled = config_as_dict(replace(config, num_episodes=1, first_index=index))
    settled = {name: value for name, value in settled.items() if name == config.world or not isinstance(value, dict)}
    # what is off makes the bytes that it made before there was such a setting
    off = config_as_dict(SimulateConfig())
    settled = {name: value for name, value in settled.items() if name != "is_polar" or value != off[name]}
    if config.world == "patrol" and settled["patrol"]["listening"] == off["patrol"]["listening"]:
        settled["patrol"] = {name: value for name, value in settled["patrol"].items() if name != "listening"}
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


def _episodes(config: SimulateConfig, indices: Sequence[int]) -> Iterator[Episode]:
    """The episodes `indices`, in order."""
    if config.world == "prison":
        yield from simulate_prison_episodes(config.prison, config.seed, np.array(indices, dtype=np.int64))
    for index in indices if config.world != "prison" else ():
        if config.world == "narco":
            yield simulate_narco(config.narco, config.seed, index)
        elif config.world == "rendezvous":
            yield simulate_rendezvous(config.rendezvous, config.seed, index)
        else:
            yield simulate_patrol(config.patrol, np.random.default_rng([config.seed, index]))


def _write_episode(path: Path, episode: Episode, config: SimulateConfig, index: int) -> _Score:
    """Write one episode's log, whole or not at all."""
    is_detected = episode.is_detected()
    gaps = tuple(float(gap) for agent in is_detected for gap in gaps_s(agent, _step_s(episode)))
    rate, count = round(float(is_detected.mean()), 6), len(episode.detections)
    mission = _mission_record(episode, config, index)
    mission |= {"measured_detection_rate": rate, "num_detections": count, "gaps_s": gaps, "key": _key(config, index)}
    with replacing(path) as draft:
        write_mission(draft, episode, config.form(), mission)
        digest = hash_file(draft)
    return _Score(path.name, digest, rate, count, gaps)


def _step_s(episode: Episode) -> float:
    return float(episode.time_s[1] - episode.time_s[0])


def _mission_record(episode: Episode, config: SimulateConfig, index: int) -> dict[str, Any]:
    """The Metadata record `mission`: how the log came about and what its names mean."""
    record: dict[str, Any] = {
        "world": config.world,
        "seed": config.seed,
        "episode": index,
        "step_s": _step_s(episode),
        "duration_s": float(episode.time_s[-1]),
        "start_time_s": config.start_time_s,
        "frame_id": config.frame_id,
        "map_side_m": episode.terrain.side_m,
        "agents": episode.agent_ids,
        "sensors": episode.sensor_ids,
        "goals_m": [np.round(goals, 1).tolist() for goals in episode.goals_m],
    }
    if config.georeferenced:
        record |= {"latitude_deg": config.latitude_deg, "longitude_deg": config.longitude_deg}
    if config.world == "patrol":
        return record | {"detection_rate": config.patrol.detection_rate}
    if config.world == "rendezvous":
        return record | _rendezvous_record(episode, config.rendezvous)
    return record | _paper_record(episode, config)


def _rendezvous_record(episode: Episode, config: RendezvousConfig) -> dict[str, Any]:
    """What the logs of the world rendezvous say besides: an episode with a meeting has two goals, the first is the site."""
    return {
        "detection_rate": config.detection_rate,
        "is_meeting": len(episode.goals_m[0]) == 2,
        "is_origin_known": config.is_origin_known,
        "all_goals_m": GOALS_M.tolist(),
        "all_sites_m": SITES_M.tolist(),
    }


def _paper_record(episode: Episode, config: SimulateConfig) -> dict[str, Any]:
    """What the logs of the paper's worlds say besides, with the keys of the original simulator's recorded logs."""
    if config.world == "narco":
        factor = config.narco.detection_factor
        return {"scenario": "smuggler", "set": config.narco.set, "detection_factor": factor, "hideout_known_to_trackers": []}
    stays = ["camera" in name for name in episode.sensor_ids]
    mountains = [
        dict(zip(("x_m", "y_m", "keep_out_radius_m"), circle, strict=True)) for circle in episode.terrain.circles_m.tolist()
    ]
    return {
        "scenario": "prison_escape",
        "set": config.prison.set,
        "detection_factor": config.prison.detection_factor,
        "cell_m": CELL_M,
        "mountains": mountains,
        "hideout_known_to_trackers": episode.goals_m[0][-1:].tolist(),
        "cameras": episode.sensors_m[stays, 0].tolist(),
    }


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
