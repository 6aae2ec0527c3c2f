"""The trajectory library: recorded episodes whose course so far resembles the window's, and what they did next.

A state is a step of a recorded episode. A window is laid over it so that its last detection falls on that step; the state's
weight is a product of kernels over how well the episode agrees with everything the window knows, and the hypotheses are
continuations drawn with these weights (a particle filter whose particles are recordings; as density estimation: Nadaraya
1964, Watson 1964). No model of motion is involved, so that a learned model that does not beat it has learned paths only.
"""

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch

from cadence.arrays import Float64s, Int64s
from cadence.bank.rows import active_rows, scatter_hypotheses
from cadence.recordings import Recordings
from cadence.resampling import candidates_at, systematic
from cadence.types import Context, Detections, HypothesisSet, WindowBatch

_REACH = 3.5
"""Standard deviations of the last detection's kernel beyond which a state is not looked at."""
_CELL = 8.0
"""Side of a cell of the grid that finds them, in step lengths."""
_MIN_STATES = 50
_NUM_NEAREST = 2000
"""States that stand in where the reach holds fewer than `_MIN_STATES`."""
_MAX_SCORED = 8000
"""States of a window that are compared in full: the best ones by what costs little to compare."""
_MAX_STATES = 1_500_000
_HOTTEST = 64.0
_SAME_GOAL_M = 1.0
_MIN_LAG = 2.0
"""Steps between the chosen detections, at least: paths on a grid waver from step to step."""


@dataclass(frozen=True)
class LibraryConfig:
    """The kernels. Lengths are in step lengths (median of the recordings' moves), times in steps; infinity turns one off.

    sigma               of the last detection's distance from the recorded track
    sigma_per_lag       growth of that for older detections, a step of their lag behind the last one
    sigma_per_age       growth of it for all detections, a step since the last one
    num_detections      detections that are compared
    lag_growth          ratio of their lags: 1.6 compares few at growing lags; 1 the last ones in a row
    age_sigma           of the logarithm of the steps since the last detection, the recording's own against the window's
    count_sigma         of the root of the number of detections in the `count_steps` up to the last one, likewise
    count_steps         see count_sigma
    elapsed_sigma       of the steps since the beginning, where the window knows them
    elapsed_growth      growth of that, a step since the beginning
    goal_penalty        taken from the log weight where another goal was known, if the window knows one
    fade                steps since the last detection over which the shift of the recorded track onto it fades; 0: no shift
    min_episodes        effective number of episodes: the log weights are flattened until so many share the weight
    stride              every so many steps of an episode are states
    is_systematic       draw evenly along the cumulated weights (less variance) instead of independently
    """

    sigma: float = 5.5
    sigma_per_lag: float = 0.28
    sigma_per_age: float = 0.0
    num_detections: int = 8
    lag_growth: float = 1.6
    age_sigma: float = 0.8
    count_sigma: float = 2.0
    count_steps: int = 50
    elapsed_sigma: float = 80.0
    elapsed_growth: float = 0.1
    goal_penalty: float = 1.0
    fade: float = 150.0
    min_episodes: float = 3.0
    stride: int = 3
    is_systematic: bool = True

    def __post_init__(self) -> None:
        positive = (self.sigma, self.age_sigma, self.count_sigma, self.elapsed_sigma, self.num_detections, self.stride)
        if min(positive) <= 0 or self.lag_growth < 1.0:
            raise ValueError("LibraryConfig: sigmas, num_detections and stride must be positive, lag_growth 1 at least")


@dataclass(frozen=True, eq=False)
class _States:
    """N states of the recordings, and what is compared of them; lengths in metres.

    Sorted by the cell of a square grid that they lie in, so that a row of cells is one slice: cell [N] is the number of the
    cell, cell_m its side, corner_m [2] where the grid begins, num_rows of cells in y.

    row [N] in the flat arrays; episode [N]; step [N] since its beginning; left [N] steps to its end; num_recent [N]
    detections in the last steps; age [S] steps since the last detection, for every row of the flat arrays; length_m the
    median way of a step in which a target moved, the unit of the kernels' lengths.
    """

    cell: Int64s
    cell_m: float
    corner_m: Float64s
    num_rows: int
    row: Int64s
    episode: Int64s
    step: Int64s
    left: Int64s
    num_recent: Float64s
    age: Int64s
    length_m: float

    def around(self, place_m: Float64s, reach_m: float) -> Int64s:
        """States in all cells that the square of `reach_m` around a place [2] touches."""
        low = np.floor((place_m - reach_m - self.corner_m) / self.cell_m).astype(np.int64)
        high = np.floor((place_m + reach_m - self.corner_m) / self.cell_m).astype(np.int64)
        column = np.arange(max(low[0], 0), min(high[0], int(self.cell[-1]) // self.num_rows) + 1) * self.num_rows
        first, last = max(low[1], 0), min(high[1], self.num_rows - 1)
        if first > last:
            return np.zeros(0, dtype=np.int64)
        begin, end = np.searchsorted(self.cell, column + first), np.searchsorted(self.cell, column + last, side="right")
        parts = [np.arange(i, j) for i, j in zip(begin, end, strict=True)]
        return np.concatenate([np.zeros(0, dtype=np.int64), *parts])


def _states(recordings: Recordings, config: LibraryConfig) -> _States:
    length, total = recordings.length, len(recordings.position_m)
    stride = max(config.stride, math.ceil(total / _MAX_STATES))
    episode = np.repeat(np.arange(len(length)), length)
    begin = recordings.offset[episode]
    rows = np.arange(total)
    # neighbouring episodes are thinned at different phases
    row = np.flatnonzero((rows - begin) % stride == episode % stride)
    if not len(row):
        row = rows
    seen = np.concatenate([[0], np.cumsum(recordings.is_detected)])
    length_m = _length(recordings)
    place_m, cell_m = recordings.position_m[row].astype(np.float64), _CELL * length_m
    corner_m = place_m.min(axis=0)
    index = np.floor((place_m - corner_m) / cell_m).astype(np.int64)
    num_rows = int(index[:, 1].max()) + 1
    cell = index[:, 0] * num_rows + index[:, 1]
    order = np.argsort(cell, kind="stable")
    row, cell = row[order], cell[order]
    recent = seen[row + 1] - seen[np.maximum(row + 1 - config.count_steps, begin[row])]
    last = np.maximum.accumulate(np.where(recordings.is_detected | (rows == begin), rows, 0))
    return _States(
        cell=cell,
        cell_m=cell_m,
        corner_m=corner_m,
        num_rows=num_rows,
        row=row,
        episode=episode[row],
        step=row - begin[row],
        left=recordings.offset[episode[row] + 1] - 1 - row,
        num_recent=recent.astype(np.float64),
        age=rows - last,
        length_m=length_m,
    )


def _length(recordings: Recordings) -> float:
    way = np.linalg.norm(np.diff(recordings.position_m, axis=0), axis=1)
    is_within = np.ones(len(way), dtype=bool)
    is_within[recordings.offset[1:-1] - 1] = False
    moved = way[is_within & (way > 0.0)]
    return float(np.median(moved)) if len(moved) else 1.0


@dataclass(frozen=True, eq=False)
class _Query:
    """One agent of one window: mission frame, metres and steps; detections newest first.

    lag [n] steps behind the last detection; position_m [n, 2]; age of the last detection; num_recent detections in the last
    `count_steps` up to it; elapsed and goal_m [2] are None and NaN where unknown.
    """

    lag: Int64s
    position_m: Float64s
    age: int
    num_recent: int
    elapsed: float | None
    goal_m: Float64s


@dataclass(frozen=True, eq=False)
class TrajectoryLibrary:
    """The library as an `Estimator`; it needs to know where the windows lie.

    Windows of any grid with the recordings' step are taken. Hypotheses have equal weights.
    """

    recordings: Recordings
    states: _States
    config: LibraryConfig
    name: str = "library"

    @staticmethod
    def from_recordings(
        recordings: Recordings, config: LibraryConfig | None = None, name: str = "library"
    ) -> "TrajectoryLibrary":
        """The library of all episodes of `recordings`; raises ValueError where there are none."""
        if not len(recordings):
            raise ValueError("TrajectoryLibrary: no episodes")
        config = config or LibraryConfig()
        return TrajectoryLibrary(recordings, _states(recordings, config), config, name=name)

    def fit(self, tracks: Detections) -> Self:
        """The library itself: it knows its recordings and adapts to nothing."""
        return self

    def sample(self, windows: WindowBatch, num_hypotheses: int) -> HypothesisSet:
        """Continuations of recorded episodes [B, K, A, T, 2]; deterministic in the windows' seeds, agent by agent."""
        context = windows.required_context("TrajectoryLibrary")
        steps = np.rint(windows.time_s.double().numpy() / self.recordings.step_s).astype(np.int64)
        window, agent = (index.numpy() for index in windows.is_active.nonzero(as_tuple=True))
        nodes, seeds = active_rows(windows)
        sample_m = np.empty((len(window), num_hypotheses, len(steps), 2))
        for row in range(len(window)):
            count = int(nodes.is_observed[row].sum())
            datum_m = context.datum_m[window[row]].double().numpy()
            query = self._query(
                np.rint(-nodes.time_s[row, :count].numpy()[::-1] / self.recordings.step_s).astype(np.int64),
                nodes.position_m[row, :count].numpy()[::-1] + datum_m,
                context,
                int(window[row]),
                int(agent[row]),
            )
            state, weight = self._weighted(query)
            drawn = _draw(weight, num_hypotheses, np.random.default_rng(int(seeds[row])), self.config.is_systematic)
            sample_m[row] = self._continued(query, state[drawn], steps) - datum_m
        return scatter_hypotheses(torch.from_numpy(sample_m), windows)

    def _query(self, age: Int64s, position_m: Float64s, context: Context, window: int, agent: int) -> _Query:
        """What is compared of the detections [N], newest first, and of the context."""
        lag = age - age[0]
        chosen = spaced_lags(lag, self.config.num_detections, self.config.lag_growth)
        elapsed = None if context.elapsed_s is None else float(context.elapsed_s[window]) / self.recordings.step_s
        goal_m = np.full(2, np.nan)
        if context.known_goal_m is not None:
            goal_m = context.known_goal_m[window, agent].double().numpy()
        recent = int((lag < self.config.count_steps).sum())
        return _Query(lag[chosen], position_m[chosen], int(age[0]), recent, elapsed, goal_m)

    def _weighted(self, query: _Query) -> tuple[Int64s, Float64s]:
        """States that may continue the window [M] and their weights [M], which sum to one."""
        sigma_m = self.states.length_m * (self.config.sigma + self.config.sigma_per_age * query.age)
        state = self._nearby(query, sigma_m)
        log_weight = self._log_circumstances(query, state)
        offset_m = self.recordings.position_m[self.states.row[state]] - query.position_m[0]
        quick = log_weight - 0.5 * np.square(offset_m / sigma_m).sum(axis=1)
        if len(state) > _MAX_SCORED:
            best = np.argpartition(quick, -_MAX_SCORED)[-_MAX_SCORED:]
            state, log_weight = state[best], log_weight[best]
        log_weight = log_weight + self._log_course(query, state, sigma_m)
        return state, _flattened(log_weight, self.states.episode[state], self.config.min_episodes)

    def _nearby(self, query: _Query, sigma_m: float) -> Int64s:
        """States near the last detection whose episodes go on until now: the target has not arrived yet."""
        states = self.states
        state = states.around(query.position_m[0], _REACH * sigma_m)
        state = state[states.left[state] >= query.age]
        if len(state) >= _MIN_STATES:
            return state
        going_on = np.flatnonzero(states.left >= query.age)
        if not len(going_on):
            going_on = np.arange(len(states.row))
        if len(going_on) <= _NUM_NEAREST:
            return going_on
        distance_m = np.square(self.recordings.position_m[states.row[going_on]] - query.position_m[0]).sum(axis=1)
        return going_on[np.argpartition(distance_m, _NUM_NEAREST)[:_NUM_NEAREST]]

    def _log_circumstances(self, query: _Query, state: Int64s) -> Float64s:
        """Kernels over everything but the places of the detections [M]."""
        config, states = self.config, self.states
        log_weight = np.zeros(len(state))
        if math.isfinite(config.age_sigma):
            now = states.row[state] + np.minimum(query.age, states.left[state])
            log_weight -= 0.5 * np.square((np.log1p(states.age[now]) - math.log1p(query.age)) / config.age_sigma)
        if math.isfinite(config.count_sigma):
            differ = np.sqrt(states.num_recent[state]) - math.sqrt(query.num_recent)
            log_weight -= 0.5 * np.square(differ / config.count_sigma)
        if query.elapsed is not None and math.isfinite(config.elapsed_sigma):
            sigma = config.elapsed_sigma + config.elapsed_growth * query.elapsed
            log_weight -= 0.5 * np.square((states.step[state] + query.age - query.elapsed) / sigma)
        if config.goal_penalty and np.isfinite(query.goal_m).all():
            goal_m = self.recordings.known_goal_m
            is_other = np.logical_not((np.abs(goal_m - query.goal_m) < _SAME_GOAL_M).all(axis=1))
            log_weight -= np.where(is_other[states.episode[state]], config.goal_penalty, 0.0)
        return log_weight

    def _log_course(self, query: _Query, state: Int64s, sigma_m: float) -> Float64s:
        """Kernels over the places of the detections [M]; before its beginning a recorded target waits where it begins."""
        back = np.minimum(query.lag, self.states.step[state][:, None])
        offset_m = self.recordings.position_m[self.states.row[state][:, None] - back] - query.position_m
        sigmas_m = sigma_m + self.config.sigma_per_lag * self.states.length_m * query.lag
        log_weight: Float64s = -0.5 * (np.square(offset_m).sum(axis=2) / np.square(sigmas_m)).sum(axis=1)
        return log_weight

    def _continued(self, query: _Query, state: Int64s, steps: Int64s) -> Float64s:
        """Places [K, T, 2] of the states' episodes at `steps` [T] from now, shifted; parked after their end."""
        row = self.states.row[state]
        since = np.clip(query.age + steps, -self.states.step[state][:, None], self.states.left[state][:, None])
        place_m: Float64s = self.recordings.position_m[row[:, None] + since].astype(np.float64)
        if self.config.fade > 0.0:
            part = np.maximum(0.0, 1.0 - np.abs(query.age + steps) / self.config.fade)
            shift_m = query.position_m[0] - self.recordings.position_m[row]
            place_m += shift_m[:, None] * part[:, None]
        return place_m


def spaced_lags(lag: Int64s, count: int, growth: float) -> Int64s:
    """Places of at most `count` of the lags [N] (rising from 0), each at least `growth` times the one before it.

    With a growth of 1 the first `count` in a row.
    """
    if growth <= 1.0:
        return np.arange(min(count, len(lag)))
    chosen = [0]
    while len(chosen) < count:
        behind = float(lag[chosen[-1]])
        found = int(np.searchsorted(lag, max(behind + _MIN_LAG, growth * behind)))
        if found == len(lag):
            break
        chosen.append(found)
    return np.array(chosen)


def _flattened(log_weight: Float64s, episode: Int64s, min_episodes: float) -> Float64s:
    """Weights [M] proportional to exp(log_weight / T), T >= 1 the least that gives so many effective episodes.

    Neighbouring states of one episode tell the same: their weights are added before 1 / sum w^2 is taken.
    """
    log_weight = log_weight - log_weight.max()
    _, member = np.unique(episode, return_inverse=True)

    def weights(temperature: float) -> Float64s:
        weight = np.exp(log_weight / temperature)
        shares: Float64s = weight / weight.sum()
        return shares

    def is_enough(temperature: float) -> bool:
        return bool(1.0 / np.square(np.bincount(member, weights(temperature))).sum() >= min_episodes)

    if min_episodes <= 1.0 or is_enough(1.0):
        return weights(1.0)
    low, high = 1.0, _HOTTEST
    for _ in range(8):
        middle = math.sqrt(low * high)
        low, high = (low, middle) if is_enough(middle) else (middle, high)
    return weights(high)


def _draw(weight: Float64s, number: int, rng: np.random.Generator, is_systematic: bool) -> Int64s:
    """Indices [K] drawn with the weights [M], in random order."""
    drawn = systematic(weight, number, rng.random()) if is_systematic else candidates_at(weight, rng.random(number))
    shuffled: Int64s = rng.permutation(drawn)
    return shuffled
