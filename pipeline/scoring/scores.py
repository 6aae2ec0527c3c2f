"""Scores of many windows cell by cell, one cell per window, agent and step with known truth, and their summary.

A cell keeps where it lies (steps to the detections around it, steps beyond the origin) beside its scores, so that every table
is a mean over a selection of cells, with an interval from a bootstrap over groups: windows overlap, cells of one agent
belong together, and only whole agents (or episodes, or blocks of time of a single agent) can be resampled.
"""

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from cadence import metrics
from cadence.arrays import Bools, Float64s, Int32s, Int64s
from cadence.types import Estimator, HypothesisSet, WindowBatch
from pipeline.scoring.heights import HEIGHT_METRICS, height_values

METRICS = (
    "ade_m", "min_ade_m", "mean_error_m", "energy_score_m", "energy_score_fair_m", "trajectory_energy_score_m",
    "coverage_50", "coverage_90", "spread_m", "step_length_m", "true_step_length_m", "collision_share",
    "fast_step_share", "fast_track_share", *HEIGHT_METRICS,
)  # fmt: skip
"""Columns of `Cells.value`.

ade_m is the expected distance of a hypothesis; min_ade_m that of the hypothesis best over the agent's past (or future) in the
window; trajectory_energy_score_m stands once per window, agent and side of the origin, at its first cell; step lengths
from the step before; collision_share is NaN where no obstacles are known; fast_step_share is that of the hypotheses whose step
to the cell is longer than hardly any true one, fast_track_share that of those with any such step, at the side's first cell.
What is of heights, alone and as the third coordinate, is NaN where hypotheses or truth have none.
"""

PARTS = ("past", "between", "future", "final")
"""past: up to the origin and after the agent's first detection in the window; between: the part of it with a later detection
in the window as well; future: beyond the origin; final: the last step."""

Draw = Callable[[Tensor], HypothesisSet]
"""Hypotheses of the windows with the given indices [b]."""

IsInside = Callable[[Tensor, Tensor], Tensor]
"""Whether positions [b, K, A, T, 2], relative to the datum of the windows with the indices [b], lie in an obstacle."""

_MAX_STATES = 4_000_000
_MIN_GROUPS = 6
_NUM_BLOCKS = 10


@dataclass(frozen=True, eq=False)
class Cells:
    """C scored cells; distances in time are in steps.

    window, agent, step [C]  index of the window and the agent; step relative to the origin (0), positive in the future
    age [C]      since the last detection at or before the cell; gap [C] between the detections around it, infinite
                 where a later one is missing; nearest [C] to the nearest detection of the window
    value [C, len(METRICS)]
    """

    window: Int32s
    agent: Int32s
    step: Int32s
    age: Float64s
    gap: Float64s
    nearest: Float64s
    value: Float64s

    def __len__(self) -> int:
        return len(self.window)

    def column(self, metric: str) -> Float64s:
        """One metric of all cells [C]."""
        return np.asarray(self.value[:, METRICS.index(metric)])

    def is_in(self, part: str) -> Bools:
        """Which cells belong to one of `PARTS` [C]."""
        if part == "final":
            return np.asarray(self.step == self.step.max(initial=1))
        if part == "future":
            return np.asarray(self.step > 0)
        return np.asarray((self.step <= 0) & (np.isfinite(self.gap) if part == "between" else True))

    @staticmethod
    def concatenate(parts: Sequence["Cells"]) -> "Cells":
        """All cells of the parts, in order."""
        names = ("window", "agent", "step", "age", "gap", "nearest", "value")
        return Cells(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


@dataclass(frozen=True)
class ScoreRow:
    """One number of a table: the mean of a metric over the cells of one slice, with its bootstrap interval.

    by  "part" (of `PARTS`), "joint" (the same, all agents together), "mission" (steps of which mission hypotheses tell, each
        once), or "horizon", "gap", "nearest", "age" with steps in (above_steps, up_to_steps]
    """

    estimator: str
    part: str
    by: str
    above_steps: float | None
    up_to_steps: float | None
    metric: str
    value: float
    low: float
    high: float
    num_cells: int
    num_groups: int


def score_cells(
    found: HypothesisSet,
    windows: WindowBatch,
    truth_m: Tensor,
    is_known: Tensor,
    inside: Tensor | None = None,
    fastest_m: float = float("inf"),
    is_brief: bool = False,
    truth_height_m: Tensor | None = None,
) -> Cells:
    """Score one batch: truth_m [B, A, T, 2] relative to the datum, is_known [B, A, T], inside [B, K, A, T] in obstacles.

    truth_height_m is [B, A, T], NaN where it is unknown.

    `fastest_m` is the length of a step that hardly any true one exceeds. Brief scores lack (NaN) what takes most of the time:
    energy scores, the best hypothesis, step lengths.

    Cells before an agent's first detection, of agents without detections, and of agents without hypotheses are left out.
    """
    age, gap, nearest = detection_distances(windows)
    found, weight = _filled_up(found)
    is_drawn = weight.sum(dim=1) > 0  # [B, A]
    chosen = is_known & age.isfinite() & is_drawn[..., None]
    is_future = (windows.time_s > 0.5 * windows.step_s).expand_as(chosen)
    value = torch.full((*chosen.shape, len(METRICS)), torch.nan, dtype=torch.float64)
    rows, agents, steps = chosen.nonzero(as_tuple=True)
    at = found.position_m.double()[rows, :, agents, steps][:, :, None, None]  # [C, K, 1, 1, 2]
    value[chosen] = _cell_values(at, weight[rows, :, agents], truth_m[chosen][:, None, None], is_brief)
    if not is_brief:
        for side in (~is_future, is_future):
            _put_track_values(value, found.position_m, weight, truth_m, chosen & side)
        _put_step_lengths(value, found.position_m, weight, truth_m, chosen)
    if math.isfinite(fastest_m):
        for side in (~is_future, is_future):
            _put_fast_steps(value, found.position_m, weight, chosen & side, fastest_m)
    if found.height_m is not None and truth_height_m is not None and not is_brief:
        high, true_high = found.height_m[rows, :, agents, steps], truth_height_m[chosen]
        of_heights = height_values((at, high), weight[rows, :, agents], (truth_m[chosen], true_high))
        value[..., -len(HEIGHT_METRICS) :][chosen] = of_heights
    if inside is not None:
        share = torch.einsum("bka,bkat->bat", weight, inside.double())
        value[..., METRICS.index("collision_share")] = share
    window, agent, step = (index.numpy().astype(np.int32) for index in (rows, agents, steps - windows.origin_index))
    age_steps, gap_steps, nearest_steps = (side[chosen].numpy() for side in (age, gap, nearest))
    return Cells(window, agent, step, age_steps, gap_steps, nearest_steps, value[chosen].numpy())


def score_in_chunks(
    draw: Draw,
    windows: WindowBatch,
    truth_m: Tensor,
    is_known: Tensor,
    num_hypotheses: int,
    is_inside: IsInside | None = None,
    after_chunk: Callable[[int], object] | None = None,
    fastest_m: float = float("inf"),
    is_brief: bool = False,
    truth_height_m: Tensor | None = None,
) -> Cells:
    """`score_cells` for any number of windows in bounded memory; windows without any cell to score are not drawn."""
    states = windows.num_agents * num_hypotheses * windows.num_steps
    asked = (is_known.any(dim=-1) & windows.is_active).any(dim=-1).nonzero().squeeze(1)
    parts = []
    for index in torch.split(asked, max(1, _MAX_STATES // states)):
        found = draw(index)
        inside = None if is_inside is None else is_inside(found.position_m, index)
        high = None if truth_height_m is None else truth_height_m[index]
        part = score_cells(found, windows[index], truth_m[index], is_known[index], inside, fastest_m, is_brief, high)
        parts.append(replace(part, window=index.numpy().astype(np.int32)[part.window]))
        if after_chunk is not None:
            after_chunk(len(index))
    return Cells.concatenate(parts) if parts else _no_cells()


def compare(
    estimators: Mapping[str, Estimator],
    windows: WindowBatch,
    truth_m: Tensor,
    is_known: Tensor,
    num_hypotheses: int,
    is_inside: IsInside | None = None,
    after_chunk: Callable[[int], object] | None = None,
) -> dict[str, Cells]:
    """Cells of every (fitted) estimator on the same windows, in the same order: what paired ratios need.

    Raises ValueError where an estimator leaves out an agent that has detections: it would be spared its worst cells.
    """
    found = {}
    for name, estimator in estimators.items():

        def draw(index: Tensor, estimator: Estimator = estimator) -> HypothesisSet:
            return estimator.sample(windows[index], num_hypotheses)

        found[name] = score_in_chunks(draw, windows, truth_m, is_known, num_hypotheses, is_inside, after_chunk)
        first = next(iter(found.values()))
        if len(first) != len(found[name]):
            raise ValueError(f"{name} scored {len(found[name])} cells where {next(iter(found))} scored {len(first)}")
    return found


def groups_of(cells: Cells, num_windows: int) -> Int64s:
    """Bootstrap group of every cell [C]: its agent; with fewer than six agents, its agent and one of ten blocks of origins."""
    agent = cells.agent.astype(np.int64)
    if len(np.unique(agent)) >= _MIN_GROUPS:
        return agent
    return np.asarray(agent * _NUM_BLOCKS + cells.window.astype(np.int64) * _NUM_BLOCKS // max(num_windows, 1))


def summarise(name: str, cells: Cells, groups: Int64s, seed: int = 0, num_resamples: int = 1000) -> list[ScoreRow]:
    """All rows of one estimator: every metric by part, the main ones by horizon, gap, time to the nearest detection and age."""
    rng = np.random.default_rng(seed)
    rows = []
    for part in PARTS:
        for metric in METRICS:
            if metric in ("trajectory_energy_score_m", "fast_track_share") and part not in ("past", "future"):
                continue  # it is that of the whole past, or the whole future
            rows.append(_row(name, part, "part", (None, None), metric, cells, groups, cells.is_in(part), rng, num_resamples))
    for part, by, distance in _distances(cells):
        for low, high in _octaves(distance[cells.is_in(part)]):
            is_in = cells.is_in(part) & (distance > low) & (distance <= high)
            for metric in ("ade_m", "min_ade_m", "mean_error_m", "energy_score_m", "coverage_50", "coverage_90", "spread_m"):
                rows.append(_row(name, part, by, (low, high), metric, cells, groups, is_in, rng, num_resamples))
    return [row for row in rows if row.num_cells]


def part_mean(cells: Cells, part: str, metric: str) -> float:
    """The value that `summarise` gives for a part, without its interval; NaN without any cell."""
    values = cells.column(metric)[cells.is_in(part)]
    return metrics.bootstrap_mean(values, np.zeros(len(values)), np.random.default_rng(0), 1).value


def energy_ratio(
    cells: Cells, rival: Cells, part: str, groups: Int64s, seed: int = 0, num_resamples: int = 2000
) -> metrics.Interval:
    """Energy score over the rival's on the same cells, paired (below 1: ahead of the rival)."""
    is_in = cells.is_in(part)
    return metrics.bootstrap_ratio(
        cells.column("energy_score_m")[is_in], rival.column("energy_score_m")[is_in], groups[is_in],
        np.random.default_rng(seed), num_resamples,
    )  # fmt: skip


def weight_by_agent(found: HypothesisSet) -> Tensor:
    """Weights of the hypotheses for each agent [B, K, A]: over those that it is part of (finite); zero without any."""
    is_there = found.position_m[..., 0, 0].isfinite()
    weight = found.weight.double()[..., None] * is_there
    total = weight.sum(dim=1, keepdim=True)
    shared = torch.where(total > 0, weight / torch.where(total > 0, total, 1.0), 0.0)
    # An agent of every hypothesis keeps the weights as they are.
    return torch.where(is_there.all(dim=1, keepdim=True), weight, shared)


def _filled_up(found: HypothesisSet) -> tuple[HypothesisSet, Tensor]:
    """Hypotheses without NaN where an agent has any at all, and weights by agent: zero for what was filled in."""
    is_there = found.position_m[..., 0, 0].isfinite()
    weight = weight_by_agent(found)
    if bool((is_there.all(1) | ~is_there.any(1)).all()):
        return found, weight
    first = is_there.to(torch.int8).argmax(dim=1)[:, None, :, None, None]
    one = found.position_m.gather(1, first.expand(-1, -1, -1, *found.position_m.shape[3:]))
    filled = replace(found, position_m=torch.where(is_there[..., None, None], found.position_m, one))
    if found.height_m is not None:
        high = found.height_m.gather(1, first[..., 0].expand(-1, -1, -1, found.height_m.shape[3]))
        filled = replace(filled, height_m=torch.where(is_there[..., None], found.height_m, high))
    return filled, weight


def _cell_values(at: Tensor, weight: Tensor, truth_m: Tensor, is_brief: bool) -> Tensor:
    """What one cell tells by itself: at [C, K, 1, 1, 2], weight [C, K], truth_m [C, 1, 1, 2] -> [C, len(METRICS)]."""
    value = torch.full((len(at), len(METRICS)), torch.nan, dtype=torch.float64)
    if not len(at):
        return value
    distance = metrics.expected_distance(at, weight, truth_m).flatten()
    plain = torch.full_like(distance, torch.nan) if is_brief else metrics.energy_score(at, weight, truth_m).flatten()
    covered = metrics.coverage(at, weight, truth_m, (0.5, 0.9)).reshape(2, -1)
    columns = {
        "ade_m": distance,
        "mean_error_m": metrics.mean_error(at, weight, truth_m).flatten(),
        "energy_score_m": plain,
        # Both forms share their distances: only the spread term is divided differently.
        "energy_score_fair_m": distance - (distance - plain) / (1.0 - weight.square().sum(dim=1)),
        "coverage_50": covered[0],
        "coverage_90": covered[1],
        "spread_m": metrics.spread(at, weight).flatten(),
    }
    for name, column in columns.items():
        value[:, METRICS.index(name)] = column
    return value


def _put_track_values(value: Tensor, position_m: Tensor, weight: Tensor, truth_m: Tensor, chosen: Tensor) -> None:
    """What needs whole tracks: the best hypothesis over the chosen steps, and the score of the trajectory."""
    rows, agents = chosen.any(dim=-1).nonzero(as_tuple=True)
    if not len(rows):
        return
    track = position_m.double()[rows, :, agents][:, :, None]  # [R, K, 1, T, 2]
    weight, truth, known = weight[rows, :, agents], truth_m[rows, agents][:, None], chosen[rows, agents][:, None]
    best = torch.full_like(value[..., 0], torch.nan)
    best[rows, agents] = metrics.min_ade_distance(track, weight, truth, known)[:, 0]
    column = value[..., METRICS.index("min_ade_m")]
    column[chosen] = best[chosen]
    first = known[:, 0].int().argmax(dim=-1)
    value[rows, agents, first, METRICS.index("trajectory_energy_score_m")] = metrics.trajectory_energy_score(
        track, weight, truth, known
    )


def _put_step_lengths(value: Tensor, position_m: Tensor, weight: Tensor, truth_m: Tensor, chosen: Tensor) -> None:
    """Mean length of the step that leads to a cell, where the cell before it counts too."""
    both = torch.zeros_like(chosen)
    both[..., 1:] = chosen[..., 1:] & chosen[..., :-1]
    length = torch.linalg.vector_norm(position_m.double().diff(dim=3), dim=-1)
    mean = torch.einsum("bka,bkat->bat", weight, length)
    true = torch.linalg.vector_norm(truth_m.diff(dim=2), dim=-1)
    for name, steps in (("step_length_m", mean), ("true_step_length_m", true)):
        column = value[..., METRICS.index(name)]
        column[both] = steps[both[..., 1:]]


def _put_fast_steps(value: Tensor, position_m: Tensor, weight: Tensor, chosen: Tensor, fastest_m: float) -> None:
    """Which hypotheses come to a cell, or to any of a window's side, by a step that is too long."""
    both = chosen[..., 1:] & chosen[..., :-1]
    is_fast = (position_m.double().diff(dim=3).norm(dim=-1) > fastest_m) & both[:, None]  # [B, K, A, T - 1]
    share = torch.einsum("bka,bkat->bat", weight, is_fast.double())
    step_column = value[..., 1:, METRICS.index("fast_step_share")]
    step_column[both] = share[both]
    rows, agents = both.any(dim=-1).nonzero(as_tuple=True)
    first = chosen[rows, agents].int().argmax(dim=-1)
    any_fast = torch.einsum("bka,bka->ba", weight, is_fast.any(dim=-1).double())
    value[rows, agents, first, METRICS.index("fast_track_share")] = any_fast[rows, agents]


def detection_distances(windows: WindowBatch) -> tuple[Tensor, Tensor, Tensor]:
    """Steps since the last detection, length of the enclosing gap, steps to the nearest detection, [B, A, T] each."""
    detections = windows.detections
    # A detection at a step's time belongs to it whatever the rounding of both to float seconds.
    time_s = windows.time_s.double() + 1e-6 * windows.step_s
    sorted_s = detections.time_s.double().masked_fill(~detections.is_observed, torch.inf)
    num_before = torch.searchsorted(sorted_s.contiguous(), time_s.expand(*sorted_s.shape[:2], -1).contiguous(), right=True)
    edge = torch.full_like(sorted_s[..., :1], torch.inf)
    padded = torch.cat([-edge, sorted_s, edge], dim=-1)
    before, after = padded.gather(-1, num_before), padded.gather(-1, num_before + 1)
    age, ahead = (time_s - before).clamp_min(0.0), after - time_s
    return age / windows.step_s, (after - before) / windows.step_s, torch.minimum(age, ahead) / windows.step_s


def _distances(cells: Cells) -> Iterable[tuple[str, str, Float64s]]:
    """The slices (part, by, distance in steps) that tables are cut along."""
    return (
        ("between", "gap", cells.gap),
        ("past", "nearest", cells.nearest),
        ("past", "age", cells.age),
        ("future", "horizon", cells.step.astype(np.float64)),
        ("future", "age", cells.age),
    )


def _octaves(distance: Float64s) -> list[tuple[float, float]]:
    """Bins (0, 1], (1, 2], (2, 4], ... steps up to the largest distance; the first one takes in zero."""
    finite = distance[np.isfinite(distance)]
    if not len(finite):
        return []
    top = int(np.ceil(np.log2(max(float(finite.max()), 1.0))))
    return list(itertools.pairwise([-1.0, *(2.0**i for i in range(top + 1))]))


def _row(
    name: str, part: str, by: str, bounds: tuple[float | None, float | None], metric: str, cells: Cells,
    groups: Int64s, is_in: Bools, rng: np.random.Generator, num_resamples: int,
) -> ScoreRow:  # fmt: skip
    found = metrics.bootstrap_mean(cells.column(metric)[is_in], groups[is_in], rng, num_resamples)
    return ScoreRow(name, part, by, *bounds, metric, found.value, found.low, found.high, found.num_values, found.num_groups)


def _no_cells() -> Cells:
    none, never = np.zeros(0, np.int32), np.zeros(0)
    return Cells(none, none, none, never, never, never, np.zeros((0, len(METRICS))))
