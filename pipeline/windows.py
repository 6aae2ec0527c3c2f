"""Tables to tensors: the time grid of a mission, its windows of detections, and truth on the same grid.

Inside a window time is seconds relative to its origin and space metres relative to its datum; int64 nanoseconds and
float64 mission coordinates end here.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import pyarrow as pa
import torch
from torch import Tensor

from cadence.arrays import Bools, Float64s, Int64s
from cadence.constraints.obstacles import Obstacles
from cadence.errors import ConfigError, InputError
from cadence.types import Context, Detections, WindowBatch
from pipeline.tracks import DetectionTrack, agent_tracks, interpolated

_NICE = np.array([1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0])
_STEPS_PER_GAP = 16.0


@dataclass(frozen=True)
class GridConfig:
    """The time grid of the windows.

    step_s         seconds between steps; by default a sixteenth of the gap in which a random moment of the mission lies
    history_steps  steps up to and including the origin
    horizon_steps  steps after it
    stride_steps   steps from one origin to the next
    context_steps  detections from this many steps before the origin on are used; by default from the first step on
    """

    step_s: float | None = None
    history_steps: int = 64
    horizon_steps: int = 32
    stride_steps: int = 16
    context_steps: int | None = None

    def __post_init__(self) -> None:
        if self.step_s is not None and not self.step_s > 0:
            raise ValueError(f"step_s must be positive, got {self.step_s}")
        if min(self.history_steps, self.stride_steps) < 1 or self.horizon_steps < 0:
            raise ValueError("history_steps and stride_steps must be at least 1, horizon_steps at least 0")
        if self.context_steps is not None and self.context_steps < self.history_steps:
            raise ValueError(f"context_steps is {self.context_steps}, less than history_steps {self.history_steps}")


@dataclass(frozen=True, eq=False)
class Grid:
    """Resolved grid: `origins_ns` [B] and the steps around each; detections reach back `context_steps` (None: the history)."""

    step_ns: int
    history_steps: int
    horizon_steps: int
    origins_ns: Int64s
    context_steps: int | None = None

    @property
    def context_ns(self) -> int:
        """How far before the origin detections are used."""
        return (self.context_steps or self.history_steps) * self.step_ns

    @property
    def step_s(self) -> float:
        """Seconds between two steps."""
        return self.step_ns * 1e-9

    @property
    def num_steps(self) -> int:
        """Number of steps T of a window."""
        return self.history_steps + self.horizon_steps

    @property
    def origin_index(self) -> int:
        """Index of the step at the origin, the last of the history."""
        return self.history_steps - 1

    @property
    def time_s(self) -> Tensor:
        """Step times relative to the origin [T], float64."""
        return (torch.arange(self.num_steps, dtype=torch.float64) - self.origin_index) * self.step_s


@dataclass(frozen=True, eq=False)
class MissionWindows:
    """All windows of a mission: the batch, and what brings it back to the mission (datum_m [B, 2], origins_ns [B])."""

    batch: WindowBatch
    origins_ns: Int64s
    step_ns: int
    agent_ids: tuple[str, ...]
    datum_m: Float64s

    def located(self, start_ns: int, obstacles: Obstacles) -> "MissionWindows":
        """The same windows with all that is known beside the detections of a mission that began at `start_ns`.

        Neither goals nor trackers are: logs do not say what they are.
        """
        elapsed_s = torch.from_numpy((self.origins_ns - start_ns).astype(np.float64) * 1e-9).clamp_min(0.0)
        context = Context(torch.from_numpy(self.datum_m), elapsed_s, obstacles=obstacles)
        return replace(self, batch=self.batch.with_context(context))


def plan_grid(detections: pa.Table, config: GridConfig) -> Grid:
    """The grid for a DETECTIONS table: the step from the gaps unless configured, origins from first to last detection."""
    if detections.num_rows == 0:
        raise InputError("detections: the table is empty; nothing was detected, so there is nothing to infer from")
    times = _times_by_agent(detections)
    step_s = config.step_s if config.step_s is not None else suggest_step_s(times)
    step_ns = max(1, round(step_s * 1e9))
    first, last = min(int(t[0]) for t in times), max(int(t[-1]) for t in times)
    stride_ns = config.stride_steps * step_ns
    num_windows = max(1, math.ceil((last - first) / stride_ns))
    if num_windows > 1_000_000:
        raise ConfigError(f"infer.grid: {num_windows} windows of step {step_s:g} s; choose a larger step_s or stride_steps")
    origins = first + stride_ns * np.arange(1, num_windows + 1, dtype=np.int64)
    return Grid(step_ns, config.history_steps, config.horizon_steps, origins, config.context_steps)


def suggest_step_s(times_ns: list[Int64s]) -> float:
    """A sixteenth of the gap in which a random moment lies (time-weighted median), rounded to a plain number.

    Long absences (an agent that leaves for hours) are left out: they are not gaps within a track.
    """
    gaps = np.concatenate([np.diff(times) for times in times_ns]).astype(np.float64) * 1e-9
    gaps = np.sort(gaps[gaps > 0])
    if len(gaps) == 0:
        return 1.0
    median = gaps[np.searchsorted(np.cumsum(gaps), 0.5 * gaps.sum())]
    gaps = gaps[gaps <= 20.0 * median]
    median = gaps[np.searchsorted(np.cumsum(gaps), 0.5 * gaps.sum())]
    exponent = math.floor(math.log10(median / _STEPS_PER_GAP))
    mantissa = median / _STEPS_PER_GAP / 10.0**exponent
    return float(_NICE[np.argmin(np.abs(np.log(_NICE / mantissa)))] * 10.0**exponent)


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
    return Detections(*(torch.from_numpy(value) for value in (time_s, position_m, covariance_m2, is_observed)))


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
    step_times = windows.origins_ns[:, None] + np.round(windows.batch.time_s.numpy() * 1e9).astype(np.int64)
    position = np.full((*step_times.shape[:1], len(windows.agent_ids), step_times.shape[1], 2), np.nan)
    tracks = dict(agent_tracks(truth, 0.0))
    for index, agent in enumerate(windows.agent_ids):
        if agent in tracks:
            track = tracks[agent]
            found = interpolated(track.time_ns, track.position_m, step_times, max_gap_s * 1e9)
            position[:, index] = found - windows.datum_m[:, None]
    is_known_everywhere = np.isfinite(position[..., 0])
    return torch.from_numpy(np.nan_to_num(position)), torch.from_numpy(is_known_everywhere)


def _times_by_agent(table: pa.Table) -> list[Int64s]:
    return [track.time_ns for _, track in agent_tracks(table, 0.0)]


def _one_per_cell(track: DetectionTrack, grid: Grid) -> DetectionTrack:
    return track[is_first_or_last(track.time_ns, grid)]


def is_first_or_last(time_ns: Int64s, grid: Grid) -> Bools:
    """Which of one agent's detections [N], by time, are the first or the last of their step's cell."""
    is_next = np.diff((time_ns - grid.origins_ns[0]) // grid.step_ns) > 0
    return np.asarray(np.append(True, is_next) | np.append(is_next, True))
