"""Tables to tensors: the time grid of a mission, its windows of detections, and truth on the same grid.

Inside a window time is seconds relative to its origin and space metres relative to its datum; int64 nanoseconds and
float64 mission coordinates end here.
"""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import torch
from torch import Tensor

from cadence.constraints.obstacles import Obstacles
from cadence.errors import ConfigError, InputError
from cadence.types import Context, Detections, WindowBatch
from pipeline.arrays import Bools, Float64s, Int64s

UNKNOWN_AGENT = "unknown"
"""Name of the one agent that detections of unknown origin are taken to belong to where they are not told apart
(`pipeline.associations` does that)."""

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


@dataclass(frozen=True, eq=False)
class DetectionTrack:
    """N detections of one agent, or of one stream, sorted by time: time_ns [N], position_m [N, 2], covariance_m2 [N, 2, 2]."""

    time_ns: Int64s
    position_m: Float64s
    covariance_m2: Float64s

    def __getitem__(self, rows: slice | Int64s | Bools) -> "DetectionTrack":
        """A selection of the detections."""
        return DetectionTrack(self.time_ns[rows], self.position_m[rows], self.covariance_m2[rows])

    def __len__(self) -> int:
        return len(self.time_ns)


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
    columns = _slice_tracks(tracks, grid.origins_ns, grid.origins_ns - grid.context_ns, grid.origins_ns)
    observed = columns.is_observed.numpy()
    count = observed.sum(axis=(1, 2))
    datum = columns.position_m.numpy().sum(axis=(1, 2)) / np.maximum(count, 1)[:, None]
    batch = WindowBatch(grid.time_s, _about(columns, datum), window_seeds(seed, len(grid.origins_ns)), grid.origin_index)
    return MissionWindows(batch, grid.origins_ns, grid.step_ns, tuple(tracks), datum)


def later_detections(detections: pa.Table, grid: Grid, windows: MissionWindows, default_sigma_m: float = 0.0) -> Detections:
    """What was detected after each window's origin and within its horizon, relative to origin and datum like the window."""
    end = grid.origins_ns + grid.horizon_steps * grid.step_ns
    tracks = kept_tracks(detections, grid, default_sigma_m)
    return _about(_slice_tracks(tracks, grid.origins_ns, grid.origins_ns, end), windows.datum_m)


def kept_tracks(detections: pa.Table, grid: Grid, default_sigma_m: float) -> dict[str, DetectionTrack]:
    """What windows are made of, by agent: of the detections within one step the first and the last."""
    return {agent: _one_per_cell(track, grid) for agent, track in agent_tracks(detections, default_sigma_m)}


def _about(detections: Detections, datum_m: Float64s) -> Detections:
    """Positions relative to each window's datum; padding at the datum."""
    datum = torch.from_numpy(datum_m)[:, None, None]
    position = torch.where(detections.is_observed[..., None], detections.position_m - datum, 0.0)
    return Detections(detections.time_s, position, detections.covariance_m2, detections.is_observed)


def _slice_tracks(tracks: dict[str, DetectionTrack], origins_ns: Int64s, start_ns: Int64s, end_ns: Int64s) -> Detections:
    """Detections of each agent in (start, end] of each window, padded [B, A, N]; positions still in the mission frame."""
    spans = {
        agent: (np.searchsorted(t.time_ns, start_ns, "right"), np.searchsorted(t.time_ns, end_ns, "right"))
        for agent, t in tracks.items()
    }
    b, a = len(origins_ns), len(tracks)
    n = max(1, max(int((end - begin).max()) for begin, end in spans.values()))
    time_s, position = np.zeros((b, a, n)), np.zeros((b, a, n, 2))
    covariance = np.zeros((b, a, n, 2, 2)) + np.eye(2)
    observed = np.zeros((b, a, n), dtype=bool)
    for index, (agent, track) in enumerate(tracks.items()):
        begin, end = spans[agent]
        row, column = np.nonzero(np.arange(n) < (end - begin)[:, None])
        source = begin[row] + column
        observed[row, index, column] = True
        time_s[row, index, column] = (track.time_ns[source] - origins_ns[row]) * 1e-9
        position[row, index, column] = track.position_m[source]
        covariance[row, index, column] = track.covariance_m2[source]
    return Detections(*(torch.from_numpy(value) for value in (time_s, position, covariance, observed)))


def window_seeds(seed: int, num_windows: int) -> Tensor:
    """One seed a window [B], so that a window's hypotheses do not depend on how many windows are computed with it."""
    words = np.random.SeedSequence(seed).generate_state(max(num_windows, 1), np.uint64)[:num_windows]
    return torch.from_numpy((words >> np.uint64(2)).astype(np.int64))


def fit_tracks(detections: pa.Table, grid: Grid, default_sigma_m: float = 0.0) -> Detections:
    """Every agent's detections cut into stretches of a window's context, one a row [R, 1, N]: what estimators are fitted to.

    Times are seconds since the first detection of the stretch, positions metres relative to it.
    """
    length_ns = grid.context_ns
    pieces: list[DetectionTrack] = []
    for _, track in agent_tracks(detections, default_sigma_m):
        kept = _one_per_cell(track, grid)
        cell = (kept.time_ns - kept.time_ns[0]) // length_ns
        cuts = np.flatnonzero(np.diff(cell)) + 1
        bounds = [0, *cuts.tolist(), len(cell)]
        for begin, end in itertools.pairwise(bounds):
            pieces.append(kept[begin:end])
    n = max(len(piece.time_ns) for piece in pieces)
    r = len(pieces)
    time_s, position = np.zeros((r, 1, n)), np.zeros((r, 1, n, 2))
    covariance, observed = np.zeros((r, 1, n, 2, 2)) + np.eye(2), np.zeros((r, 1, n), dtype=bool)
    for row, piece in enumerate(pieces):
        m = len(piece.time_ns)
        time_s[row, 0, :m] = (piece.time_ns - piece.time_ns[0]) * 1e-9
        position[row, 0, :m] = piece.position_m - piece.position_m[0]
        covariance[row, 0, :m] = piece.covariance_m2
        observed[row, 0, :m] = True
    return Detections(*(torch.from_numpy(value) for value in (time_s, position, covariance, observed)))


def truth_on_grid(truth: pa.Table, windows: MissionWindows, max_gap_s: float) -> tuple[Tensor, Tensor]:
    """Truth at every step: positions [B, A, T, 2] relative to the datum, and where they are known [B, A, T].

    Linear between the enclosing truth samples; unknown where these lie more than `max_gap_s` apart.
    """
    step_times = windows.origins_ns[:, None] + np.round(windows.batch.time_s.numpy() * 1e9).astype(np.int64)
    position = np.full((*step_times.shape[:1], len(windows.agent_ids), step_times.shape[1], 2), np.nan)
    tracks = dict(agent_tracks(truth, 0.0))
    for index, agent in enumerate(windows.agent_ids):
        if agent in tracks:
            found, is_known = interpolated(tracks[agent], step_times, max_gap_s)
            position[:, index] = np.where(is_known[..., None], found - windows.datum_m[:, None], np.nan)
    is_known_everywhere = np.isfinite(position[..., 0])
    return torch.from_numpy(np.nan_to_num(position)), torch.from_numpy(is_known_everywhere)


def interpolated(track: DetectionTrack, time_ns: Int64s, max_gap_s: float) -> tuple[Float64s, Bools]:
    """Positions [..., 2] of a track at any times [...], and where they are known: between samples at most so far apart."""
    at = np.clip(np.searchsorted(track.time_ns, time_ns), 1, max(len(track.time_ns) - 1, 1))
    later = np.minimum(at, len(track.time_ns) - 1)
    before, after = track.time_ns[at - 1], track.time_ns[later]
    is_known = (before <= time_ns) & (time_ns <= after) & (after - before <= max_gap_s * 1e9)
    share = (time_ns - before) / np.maximum(after - before, 1)
    first, second = track.position_m[at - 1], track.position_m[later]
    return first + share[..., None] * (second - first), is_known


def _times_by_agent(table: pa.Table) -> list[Int64s]:
    return [track.time_ns for _, track in agent_tracks(table, 0.0)]


def agent_tracks(table: pa.Table, default_sigma_m: float) -> Iterator[tuple[str, DetectionTrack]]:
    """Agents in the order of their names, each sorted by time."""
    agent = pc.fill_null(table["agent_id"], UNKNOWN_AGENT)
    for name in sorted(pc.unique(agent).to_pylist()):
        yield name, track_of(table.filter(pc.equal(agent, name)).sort_by("time_ns"), default_sigma_m)


def track_of(rows: pa.Table, default_sigma_m: float) -> DetectionTrack:
    """All rows of a table that is sorted by time, whoever caused them."""
    position = np.stack([rows["x_m"].to_numpy(), rows["y_m"].to_numpy()], axis=-1)
    covariance = np.zeros((len(position), 2, 2)) + default_sigma_m**2 * np.eye(2)
    if "cov_xx_m2" in rows.column_names:
        xx, xy, yy = (rows[f"cov_{axis}_m2"].to_numpy() for axis in ("xx", "xy", "yy"))
        given = np.isfinite(xx.astype(np.float64)) & np.isfinite(yy.astype(np.float64))
        stacked = np.stack([xx, np.nan_to_num(xy), np.nan_to_num(xy), yy], axis=-1).astype(np.float64).reshape(-1, 2, 2)
        covariance[given] = stacked[given]
    return DetectionTrack(rows["time_ns"].to_numpy(), position, covariance)


def _one_per_cell(track: DetectionTrack, grid: Grid) -> DetectionTrack:
    return track[is_first_or_last(track.time_ns, grid)]


def is_first_or_last(time_ns: Int64s, grid: Grid) -> Bools:
    """Which of one agent's detections [N], by time, are the first or the last of their step's cell."""
    is_next = np.diff((time_ns - grid.origins_ns[0]) // grid.step_ns) > 0
    return np.asarray(np.append(True, is_next) | np.append(is_next, True))
