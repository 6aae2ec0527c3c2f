"""Tables to tensors: the windows of detections of a mission on its time grid, and truth on the same grid.

Inside a window time is seconds relative to its origin and space metres relative to its datum; int64 nanoseconds and
float64 mission coordinates end here.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import torch
from torch import Tensor

from cadence.arrays import Bools, Float64s, Int64s
from cadence.constraints.obstacles import Obstacles
from cadence.types import Context, Detections, Evidence, WindowBatch
from pipeline.grids import Grid
from pipeline.tracks import DetectionTrack, agent_tracks, interpolated


@dataclass(frozen=True, eq=False)
class MissionWindows:
    """All windows of a mission: the batch, and what brings it back to the mission (datum_m [B, 2], origins_ns [B])."""

    batch: WindowBatch
    origins_ns: Int64s
    step_ns: int
    agent_ids: tuple[str, ...]
    datum_m: Float64s

    def located(self, start_ns: int, obstacles: Obstacles, evidence: tuple[Evidence, ...] = ()) -> "MissionWindows":
        """The same windows with all that is known beside the detections of a mission that began at `start_ns`.

        Neither goals nor trackers are: logs do not say what they are.
        """
        elapsed_s = torch.from_numpy((self.origins_ns - start_ns).astype(np.float64) * 1e-9).clamp_min(0.0)
        datum_m, names = torch.from_numpy(self.datum_m), self.agent_ids
        context = Context(datum_m, elapsed_s, obstacles=obstacles, evidence=evidence, agent_ids=names)
        return replace(self, batch=self.batch.with_context(context))

    def with_unseen(self, agents: Sequence[str], near_m: Float64s) -> "MissionWindows":
        """The same windows with agents that have no detection; windows without any lie about `near_m` [2]."""
        if not agents:
            return self
        datum_m = np.where(self.batch.is_active.any(1).numpy()[:, None], self.datum_m, near_m)
        batch = replace(self.batch, detections=_with_unseen(self.batch.detections, len(agents)))
        return replace(self, batch=batch, agent_ids=(*self.agent_ids, *agents), datum_m=datum_m)


def _with_unseen(found: Detections, num_agents: int) -> Detections:
    """The same with so many agents behind the others that were never detected."""
    columns = {
        name: torch.cat([value, value.new_zeros(value.shape[0], num_agents, *value.shape[2:])], 1)
        for name, value in vars(found).items()
        if value is not None
    }
    columns["covariance_m2"][:, found.time_s.shape[1] :] = torch.eye(2, dtype=found.covariance_m2.dtype)
    return Detections(**columns)


def build_windows(detections: pa.Table, grid: Grid, seed: int, default_sigma_m: float = 0.0) -> MissionWindows:
    """Windows of detections at every origin of the grid.

    Of the detections of one agent within one step only the first and the last are kept: they hold position and velocity.
    `default_sigma_m` is the accuracy of detections without covariance (the estimators add their own small floor).
    """
    tracks = kept_tracks(detections, grid, default_sigma_m)
    pool = DetectionTrack.one_behind_the_other(tracks.values())
    pick = _picked(tracks.values(), grid.origins_ns - grid.context_ns, grid.origins_ns)
    datum_m = middle_m(pool, pick)
    found = padded_detections(pool, pick, grid.origins_ns, datum_m)
    batch = WindowBatch(grid.time_s, found, window_seeds(seed, len(grid.origins_ns)), grid.origin_index)
    return MissionWindows(batch, grid.origins_ns, grid.step_ns, tuple(tracks), datum_m)


def later_detections(detections: pa.Table, grid: Grid, windows: MissionWindows, default_sigma_m: float = 0.0) -> Detections:
    """What was detected after each window's origin and within its horizon, relative to origin and datum like the window."""
    end = grid.origins_ns + grid.horizon_steps * grid.step_ns
    tracks = kept_tracks(detections, grid, default_sigma_m).values()
    pool, pick = DetectionTrack.one_behind_the_other(tracks), _picked(tracks, grid.origins_ns, end)
    return padded_detections(pool, pick, grid.origins_ns, windows.datum_m)


def kept_tracks(detections: pa.Table, grid: Grid, default_sigma_m: float) -> dict[str, DetectionTrack]:
    """What windows are made of, by agent: of the detections within one step the first and the last."""
    return {agent: _one_per_cell(track, grid) for agent, track in agent_tracks(detections, default_sigma_m)}


def _picked(tracks: Iterable[DetectionTrack], start_ns: Int64s, end_ns: Int64s) -> Int64s:
    """Which detections of the tracks, one behind the other, lie in (start, end] of each of B windows [B, A, N]; -1: padding."""
    begin, end, offset = [], [], 0
    for track in tracks:
        begin.append(offset + np.searchsorted(track.time_ns, start_ns, "right"))
        end.append(offset + np.searchsorted(track.time_ns, end_ns, "right"))
        offset += len(track)
    first, stop = np.stack(begin, axis=1)[..., None], np.stack(end, axis=1)[..., None]
    pick = first + np.arange(max(1, int((stop - first).max())))
    return np.where(pick < stop, pick, -1)


def middle_m(pool: DetectionTrack, pick: Int64s) -> Float64s:
    """The mean position [R, 2] of the picked detections [R, C, N]; the origin where there are none."""
    is_observed = pick >= 0
    total = np.where(is_observed[..., None], pool.position_m[pick], 0.0).sum(axis=(1, 2))
    middle: Float64s = total / np.maximum(is_observed.sum(axis=(1, 2)), 1)[:, None]
    return middle


def padded_detections(pool: DetectionTrack, pick: Int64s, origins_ns: Int64s, datum_m: Float64s) -> Detections:
    """The picked detections [R, C, N] of a pool, -1 for padding, about the origin [R] and the datum [R, 2] of each row."""
    is_observed: Bools = pick >= 0
    time_s = np.where(is_observed, (pool.time_ns[pick] - origins_ns[:, None, None]) * 1e-9, 0.0)
    position_m = np.where(is_observed[..., None], pool.position_m[pick] - datum_m[:, None, None], 0.0)
    covariance_m2 = np.where(is_observed[..., None, None], pool.covariance_m2[pick], np.eye(2))
    columns = [time_s, position_m, covariance_m2, is_observed]
    columns += [
        np.where(is_observed, value[pick], np.nan) for value in (pool.height_m, pool.height_variance_m2) if value is not None
    ]
    return Detections(*map(torch.from_numpy, columns))


def window_seeds(seed: int, num_windows: int) -> Tensor:
    """One seed a window [B], so that a window's hypotheses do not depend on how many windows are computed with it."""
    words = np.random.SeedSequence(seed).generate_state(max(num_windows, 1), np.uint64)[:num_windows]
    return torch.from_numpy((words >> np.uint64(2)).astype(np.int64))


def fit_tracks(detections: pa.Table, grid: Grid, default_sigma_m: float = 0.0) -> Detections:
    """Every agent's detections cut into stretches of a window's context, one a row [R, 1, N]: what estimators are fitted to.

    Times are seconds since the first detection of the stretch, positions metres relative to it.
    """
    tracks = kept_tracks(detections, grid, default_sigma_m).values()
    bounds, offset = [0], 0
    for track in tracks:
        cell = (track.time_ns - track.time_ns[0]) // grid.context_ns
        bounds += (offset + np.flatnonzero(np.diff(cell)) + 1).tolist()
        offset += len(track)
        bounds.append(offset)
    first, stop = np.array(bounds[:-1]), np.array(bounds[1:])
    place = first[:, None, None] + np.arange((stop - first).max())
    pool = DetectionTrack.one_behind_the_other(tracks)
    pick = np.where(place < stop[:, None, None], place, -1)
    return padded_detections(pool, pick, pool.time_ns[first], pool.position_m[first])


def truth_on_grid(truth: pa.Table, windows: MissionWindows, max_gap_s: float) -> tuple[Tensor, Tensor]:
    """Truth at every step: positions [B, A, T, 2] relative to the datum, and where they are known [B, A, T].

    See `interpolated`; unknown between samples that lie more than `max_gap_s` apart.
    """
    step_times = _step_times_ns(windows)
    position = np.full((*step_times.shape[:1], len(windows.agent_ids), step_times.shape[1], 2), np.nan)
    tracks = dict(agent_tracks(truth, 0.0))
    for index, agent in enumerate(windows.agent_ids):
        if agent in tracks:
            track = tracks[agent]
            found = interpolated(track.time_ns, track.position_m, step_times, max_gap_s * 1e9)
            position[:, index] = found - windows.datum_m[:, None]
    is_known_everywhere = np.isfinite(position[..., 0])
    return torch.from_numpy(np.nan_to_num(position)), torch.from_numpy(is_known_everywhere)


def heights_on_grid(truth: pa.Table, windows: MissionWindows, max_gap_s: float) -> Tensor:
    """Heights of the truth at every step [B, A, T], as `truth_on_grid`; NaN where they are unknown."""
    step_times = _step_times_ns(windows)
    height = np.full((len(step_times), len(windows.agent_ids), step_times.shape[1]), np.nan)
    known = truth.filter(pc.is_valid(truth["z_m"])).sort_by("time_ns")
    for index, agent in enumerate(windows.agent_ids):
        own = known.filter(pc.equal(known["agent_id"], agent))
        if own.num_rows:
            height_m = np.repeat(own["z_m"].to_numpy()[:, None], 2, axis=1)
            height[:, index] = interpolated(own["time_ns"].to_numpy(), height_m, step_times, max_gap_s * 1e9)[..., 0]
    return torch.from_numpy(height)


def _step_times_ns(windows: MissionWindows) -> Int64s:
    """Times of all steps [B, T]."""
    steps_ns: Int64s = windows.origins_ns[:, None] + np.round(windows.batch.time_s.numpy() * 1e9).astype(np.int64)
    return steps_ns


def _one_per_cell(track: DetectionTrack, grid: Grid) -> DetectionTrack:
    return track[is_first_or_last(track.time_ns, grid)]


def is_first_or_last(time_ns: Int64s, grid: Grid) -> Bools:
    """Which of one agent's detections [N], by time, are the first or the last of their step's cell."""
    is_next = np.diff((time_ns - grid.origins_ns[0]) // grid.step_ns) > 0
    return np.asarray(np.append(True, is_next) | np.append(is_next, True))
