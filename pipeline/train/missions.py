"""Missions with truth to train on: a folder of MCAP logs, extracted once and kept, or episodes of the simulator."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa

from cadence.errors import CadenceError, InputError
from cadence.worlds.episode import Episode
from pipeline.extract.config import ExtractConfig
from pipeline.extract.stage import extract
from pipeline.ingest.stage import IngestConfig, ingest
from pipeline.missions import mission_directories
from pipeline.progress import Progress
from pipeline.tables import read_table


@dataclass(frozen=True, eq=False)
class TrainingMission:
    """Detections and truth of one mission, in its frame."""

    name: str
    detections: pa.Table
    truth: pa.Table


def missions_of_logs(data: Path, cache: Path, config: ExtractConfig, progress: Progress) -> list[TrainingMission]:
    """Every log in the folder `data` that has truth and detections, by name; their tables are kept in `cache`.

    Logs that cannot be used are named and left out. Raises `InputError` where fewer than two are left: one trains, the other
    validates.
    """
    if not data.is_dir():
        raise InputError(f"{data}: not a folder; train.data is a folder of MCAP logs with truth")
    logs = sorted(data.rglob("*.mcap"))
    if not logs:
        raise InputError(f"{data}: no .mcap file in it; train.data is a folder of MCAP logs with truth")
    missions = []
    quiet = Progress(quiet=True)
    with progress.bar(len(logs), "extract", unit="log") as bar:
        for log, directory in mission_directories(logs, cache).items():
            try:
                ingest(log, directory, IngestConfig(), quiet)
                extract(directory, config, quiet)
                missions.append(_read_mission(log, directory))
            except CadenceError as error:
                progress.note(f"train: left out: {error}")
            bar.update(1)
    if not missions:
        raise InputError(f"{data}: no log in it has detections and truth; map them in [train.extract]")
    if len(missions) < 2:
        raise InputError(f"{data}: one usable log; at least two are needed, as whole logs are kept for validation")
    return missions


def _read_mission(log: Path, directory: Path) -> TrainingMission:
    detections, _ = read_table(directory / "detections.parquet", "detections")
    if not (directory / "truth.parquet").is_file():
        raise InputError(f"{log}: has no truth; name its topic with [[train.extract.truth]]")
    truth, _ = read_table(directory / "truth.parquet", "truth")
    return TrainingMission(log.stem, detections, truth)


def mission_of_episode(episode: Episode, name: str) -> TrainingMission:
    """A simulated episode as tables, with the columns that windows are made from; its time starts at zero."""
    time_ns = np.round(episode.time_s * 1e9).astype(np.int64)
    agents = np.array(episode.agent_ids, dtype=object)
    seen = episode.detections
    # several sensors may see an agent in one step: the first stands for them, as windows want one position a time
    _, first = np.unique(seen.agent * len(time_ns) + seen.step, return_index=True)
    detections = pa.table(
        {
            "time_ns": time_ns[seen.step[first]],
            "agent_id": pa.array(agents[seen.agent[first]], pa.string()),
            "x_m": seen.position_m[first, 0],
            "y_m": seen.position_m[first, 1],
            "cov_xx_m2": seen.covariance_m2[first, 0, 0],
            "cov_xy_m2": seen.covariance_m2[first, 0, 1],
            "cov_yy_m2": seen.covariance_m2[first, 1, 1],
        }
    )
    num_agents, num_steps = episode.truth_m.shape[:2]
    truth = pa.table(
        {
            "time_ns": np.tile(time_ns, num_agents),
            "agent_id": pa.array(np.repeat(agents, num_steps), pa.string()),
            "x_m": episode.truth_m[..., 0].reshape(-1),
            "y_m": episode.truth_m[..., 1].reshape(-1),
        }
    )
    return TrainingMission(name, detections, truth)
