"""Streams of detections without identity for `association.py`: simulated meetings, real ships; and what is scored on them."""

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cadence.arrays import Float64s, Int64s
from cadence.worlds.rendezvous import RendezvousConfig, simulate_rendezvous_batch

DATA = Path(__file__).resolve().parents[1].parent / "shared" / "data"
SHIPS = DATA / "maritime/solent_ais_unknown.mcap"


@dataclass(frozen=True, eq=False)
class Log:
    """A stream of unknown origin and its truth.

    time_s [N], position_m [N, 2], sigma_m of the detections, origin [N] which agent caused them; truth_m [A, T, 2] at
    grid_s [T], NaN where unknown; num_agents is what every tracker is told, None: nothing; cutoff_m of GOSPA and OSPA;
    speed_mps of a typical target, which the rivals alone are told; moments from scored_from_s on are scored.
    """

    time_s: Float64s
    position_m: Float64s
    sigma_m: float
    origin: Int64s
    grid_s: Float64s
    truth_m: Float64s
    num_agents: int | None
    cutoff_m: float
    speed_mps: float
    scored_from_s: float = 0.0

    def until(self, end_s: float) -> "Log":
        """What was seen, and is known, up to a moment."""
        seen, grid = self.time_s <= end_s, self.grid_s <= end_s
        return replace(
            self, time_s=self.time_s[seen], position_m=self.position_m[seen], origin=self.origin[seen],
            grid_s=self.grid_s[grid], truth_m=self.truth_m[:, grid],
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Estimate:
    """What a tracker says of a log.

    position_m   [A', T, 2] tracks on the grid, NaN where one does not exist
    label        [N] whose each detection is
    probability  [N, A' + 1] P(detection -> agent), the last column clutter
    sample_m     [K, A', T, 2] equally likely tracks, each moment for itself
    """

    position_m: Float64s
    label: Int64s | None = None
    probability: Float64s | None = None
    sample_m: Float64s | None = None


def rendezvous_logs(seed: int, number: int) -> list[Log]:
    """Episodes of three agents, as one stream each; a grid point every sixth step."""
    episodes = simulate_rendezvous_batch(RendezvousConfig(), seed, range(number))
    logs = []
    for index in range(number):
        track = episodes.track_m(index).astype(np.float64)
        first = int(episodes.recordings.offset[index * episodes.num_agents])
        seen = episodes.recordings.is_detected[first : first + track.shape[0] * track.shape[1]].reshape(track.shape[:2])
        step, agent = np.nonzero(seen.T)
        grid, place = np.arange(0, track.shape[1], 6), track[agent, step]
        logs.append(Log(step * 60.0, place, 1.0, agent, grid * 60.0, track[:, grid], len(track), 1000.0, 2.2))
    return logs


def ship_log() -> Log:
    """The real log, read by the pipeline; truth between reports at most two minutes apart; the first quarter is for tuning."""
    from pipeline.extract.config import ExtractConfig
    from pipeline.extract.stage import extract
    from pipeline.ingest.stage import IngestConfig, ingest
    from pipeline.progress import Progress
    from pipeline.tables import read_table
    from pipeline.tracks import interpolated

    quiet = Progress(quiet=True)
    with tempfile.TemporaryDirectory() as folder:
        directory = Path(folder) / "ships"
        ingest(SHIPS, directory, IngestConfig(), quiet)
        extract(directory, ExtractConfig(), quiet)
        detections, _ = read_table(directory / "detections.parquet", "detections")
        truth, _ = read_table(directory / "truth.parquet", "truth")
    start = detections["time_ns"].to_numpy().min()
    when, seen = ((table["time_ns"].to_numpy() - start) * 1e-9 for table in (truth, detections))
    place, position = (np.stack([table["x_m"].to_numpy(), table["y_m"].to_numpy()], 1) for table in (truth, detections))
    agent = np.array(truth["agent_id"].to_pylist())
    grid = np.arange(0.0, seen.max(), 60.0)
    grid_ns = start + np.round(grid * 1e9).astype(np.int64)
    tracks, cause = [], np.full((len(np.unique(agent)), len(seen)), np.inf)
    for row, name in enumerate(np.unique(agent)):
        order = np.flatnonzero(agent == name)[np.argsort(when[agent == name], kind="stable")]
        times, points = when[order], place[order]
        tracks.append(interpolated(truth["time_ns"].to_numpy()[order], points, grid_ns, 120e9))
        nearest = np.clip(np.searchsorted(times, seen - 1e-6), 0, len(times) - 1)
        is_same = np.abs(times[nearest] - seen) < 1e-6
        cause[row, is_same] = np.hypot(*(points[nearest] - position)[is_same].T)
    return Log(seen, position, 15.0, cause.argmin(0), grid, np.stack(tracks), None, 100.0, 3.0, 0.25 * grid[-1])
