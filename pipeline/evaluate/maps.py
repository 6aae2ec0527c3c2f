"""MapScore of hypotheses and rivals, and of the distance rings of search and rescue, on some cells of each mission."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from cadence import metrics
from cadence.arrays import Bools, Float64s, Int32s
from cadence.types import HypothesisSet, WindowBatch
from pipeline.scoring.scores import PARTS, Draw, ScoreRow, detection_distances, weight_by_agent

RING_NAME = "ring"
"""The rival of `map_score` alone: rings about the last detection that hold 25, 50, 75 and 95 % of the ways that the log's own
detections show over as long a time (Koester, Lost Person Behavior, 2008)."""

_MOST_CELLS = 1200
_MAP_CELLS = 48
_MARGIN = 0.1
_SHARES = (0.25, 0.5, 0.75, 0.95)
_NUM_LAGS = 24
_NUM_BLOCKS = 10


@dataclass(frozen=True, eq=False)
class MapCells:
    """C scored cells: window, agent and step from the origin [C], whether a detection follows [C], MapScore [C]."""

    window: Int32s
    agent: Int32s
    step: Int32s
    is_between: Float64s
    value: Float64s

    def in_part(self, part: str) -> Bools:
        """Which belong to one of `PARTS` [C]."""
        if part == "final":
            return np.asarray(self.step == self.step.max(initial=1))
        if part == "future":
            return np.asarray(self.step > 0)
        return np.asarray((self.step <= 0) & (self.is_between.astype(bool) if part == "between" else True))


@dataclass(frozen=True, eq=False)
class MapScorer:
    """What is scored: at most 1 200 cells, evenly taken from those with known truth.

    scored      windows by the agents of the truth; truth_m [B, J, T, 2] about datum_m [B, 2]; chosen [B, J, T]
    place_m     middles of the map's cells [N, 2] in the mission frame: the box of detections and truth, a tenth wider
    rings       radii of the rings by time since the last detection
    """

    scored: WindowBatch
    truth_m: Tensor
    datum_m: Tensor
    chosen: Tensor
    place_m: Tensor
    cell_m: float
    found: list[tuple[Tensor, Tensor]] = field(default_factory=list)

    @staticmethod
    def of(scored: WindowBatch, truth_m: Tensor, is_known: Tensor, datum_m: Float64s) -> "MapScorer":
        """All that estimators have in common."""
        age = detection_distances(scored)[0]
        candidates = (is_known & age.isfinite()).nonzero()
        some = torch.linspace(0, len(candidates) - 1, min(len(candidates), _MOST_CELLS)).round().long()
        chosen = torch.zeros_like(is_known)
        if len(candidates):
            chosen[tuple(candidates[some].T)] = True
        datum = torch.from_numpy(datum_m)
        place_m, cell_m = _map_cells(scored, truth_m, chosen, datum)
        return MapScorer(scored, truth_m, datum, chosen, place_m, cell_m)

    def fresh(self) -> "MapScorer":
        """The same for another estimator."""
        return MapScorer(self.scored, self.truth_m, self.datum_m, self.chosen, self.place_m, self.cell_m)

    def watch(self, draw: Draw) -> Draw:
        """The same draws, scored in passing."""

        def watched(index: Tensor) -> HypothesisSet:
            drawn = draw(index)
            self._score(drawn, index)
            return drawn

        return watched

    def cells(self) -> MapCells:
        """All cells so far, by window, agent and step."""
        if not self.found:
            return _no_cells()
        cell, value = (torch.cat(part) for part in zip(*self.found, strict=True))
        return self._cells(cell, value)

    def rings(self) -> MapCells:
        """MapScore of the distance rings about each agent's last detection, on the same cells."""
        cell = self.chosen.nonzero()
        if not len(cell):
            return _no_cells()
        b, j, t = cell.T
        seen = self.scored.detections
        time_s = self.scored.time_s.double().expand(*self.chosen.shape)[b, j, t] + 1e-6 * self.scored.step_s
        is_before = seen.is_observed[b, j] & (seen.time_s[b, j].double() <= time_s[:, None])
        last = torch.where(is_before, seen.time_s[b, j].double(), -torch.inf).argmax(dim=1)
        rows = torch.arange(len(cell))
        begin_m = seen.position_m[b, j][rows, last].double()
        age_s = time_s - seen.time_s[b, j][rows, last].double()
        radii_m = _radii_m(self.scored, age_s).clamp_min(0.5 * self.cell_m)
        shares = torch.tensor(_SHARES)
        place_m = self.place_m[None] - self.datum_m[b][:, None] - begin_m[:, None]
        truth_m = self.truth_m[b, j, t].double() - begin_m
        density = metrics.ring_density(place_m.norm(dim=-1), radii_m, shares)
        at_truth = metrics.ring_density(truth_m.norm(dim=-1)[:, None], radii_m, shares)[:, 0]
        return self._cells(cell, metrics.map_score(density, at_truth))

    def _score(self, drawn: HypothesisSet, index: Tensor) -> None:
        weight = weight_by_agent(drawn)  # [b, K, J]
        b, j, t = (self.chosen[index] & (weight.sum(dim=1) > 0)[..., None]).nonzero().T
        if not len(b):
            return
        position_m = drawn.position_m.double()[b, :, j, t]  # [C, K, 2]
        shares = weight[b, :, j]
        first = position_m.isfinite().all(-1).int().argmax(dim=1)
        stand_in = position_m[torch.arange(len(b)), first][:, None]
        position_m = torch.where(position_m.isfinite().all(-1, keepdim=True), position_m, stand_in)
        place_m = self.place_m[None] - self.datum_m[index[b]][:, None]
        truth_m = self.truth_m[index[b], j, t].double()[:, None]
        density = metrics.map_density(position_m, shares, torch.cat([place_m, truth_m], dim=1), self.cell_m)
        self.found.append((torch.stack([index[b], j, t], dim=1), metrics.map_score(density[:, :-1], density[:, -1])))

    def _cells(self, cell: Tensor, value: Tensor) -> MapCells:
        b, j, t = cell.T
        gap = detection_distances(self.scored)[1][b, j, t]
        return MapCells(
            b.numpy().astype(np.int32), j.numpy().astype(np.int32), (t - self.scored.origin_index).numpy().astype(np.int32),
            gap.isfinite().numpy().astype(np.float64), value.double().numpy(),
        )  # fmt: skip


def map_rows(
    missions: Sequence[tuple[Mapping[str, MapCells], int]], by_log: bool, num_resamples: int, seed: int
) -> Iterator[ScoreRow]:
    """A row an estimator and part: the mean MapScore over missions, each with its number of windows.

    Resampled are logs, or agents and blocks of time. Estimators that some mission lacks are left out.
    """
    rng = np.random.default_rng(seed)
    for name in missions[0][0] if missions else ():
        if all(name in found for found, _ in missions):
            for part in PARTS:
                yield from _row(name, part, [(found[name], count) for found, count in missions], by_log, rng, num_resamples)


def _row(
    name: str, part: str, missions: Sequence[tuple[MapCells, int]], by_log: bool, rng: np.random.Generator, num_resamples: int
) -> Iterator[ScoreRow]:
    values, groups = [], []
    for number, (cells, num_windows) in enumerate(missions):
        is_in = cells.in_part(part)
        block = cells.window[is_in].astype(np.int64) * _NUM_BLOCKS // max(num_windows, 1)
        inside = 0 if by_log else 1 + cells.agent[is_in].astype(np.int64) * _NUM_BLOCKS + block
        values.append(cells.value[is_in])
        groups.append(np.broadcast_to(number * 1_000_000 + inside, values[-1].shape))
    if sum(map(len, values)):
        found = metrics.bootstrap_mean(np.concatenate(values), np.concatenate(groups), rng, num_resamples)
        yield ScoreRow(
            name, part, "part", None, None, "map_score", found.value, found.low, found.high, found.num_values, found.num_groups
        )


def _map_cells(scored: WindowBatch, truth_m: Tensor, chosen: Tensor, datum_m: Tensor) -> tuple[Tensor, float]:
    """Middles of equal cells [N, 2] over the box of detections and truth, a tenth wider, and how wide a cell is."""
    seen = scored.detections
    points = [(seen.position_m.double() + datum_m[:, None, None])[seen.is_observed]]
    points.append((truth_m.double() + datum_m[:, None, None])[chosen])
    every = torch.cat(points)
    if not len(every):
        return torch.zeros(1, 2, dtype=torch.float64), 1.0
    low, high = every.min(dim=0).values, every.max(dim=0).values
    wide = (high - low).max().clamp_min(1.0)
    low, high = low - _MARGIN * wide, high + _MARGIN * wide
    cell = (high - low) / _MAP_CELLS
    steps = torch.arange(_MAP_CELLS, dtype=torch.float64) + 0.5
    return torch.cartesian_prod(low[0] + steps * cell[0], low[1] + steps * cell[1]), float(cell.max())


def _radii_m(scored: WindowBatch, age_s: Tensor) -> Tensor:
    """Radii [C, Q] that hold the shares of the ways which detections show over the lag nearest to each age [C]."""
    seen = scored.detections
    time_s = seen.time_s.double().masked_fill(~seen.is_observed, torch.inf).flatten(0, 1)
    place = seen.position_m.double().flatten(0, 1)
    order = time_s.argsort(dim=1)
    time_s, place = time_s.gather(1, order), place.gather(1, order[..., None].expand(-1, -1, 2))
    longest = float((time_s.masked_fill(time_s.isinf(), -torch.inf).amax(dim=1) - time_s[:, 0]).nan_to_num(0.0, 0.0, 0.0).max())
    lags = torch.logspace(0.0, 1.0, _NUM_LAGS, dtype=torch.float64) ** 3 / 1000.0 * max(longest, 1e-6)
    radii = torch.stack([_way_quantiles(time_s, place, float(lag)) for lag in lags])
    known = radii.isfinite().all(dim=1)
    if not known.any():
        return torch.ones(len(age_s), len(_SHARES), dtype=torch.float64)
    nearest = (age_s.clamp_min(1e-6).log()[:, None] - lags[known].log()).abs().argmin(dim=1)
    # below the shortest lag a way is as much shorter as the time is
    scale = (age_s / lags[known][nearest]).clamp(max=1.0)
    return radii[known][nearest] * torch.where(nearest == 0, scale, 1.0)[:, None]


def _way_quantiles(time_s: Tensor, place: Tensor, lag_s: float) -> Tensor:
    """Quantiles [Q] of the distance between detections about `lag_s` apart (up to half as long again); NaN without any."""
    wanted = time_s + lag_s
    later = torch.searchsorted(time_s.contiguous(), wanted.nan_to_num(posinf=1e300)).clamp(max=time_s.shape[1] - 1)
    taken = time_s.gather(1, later) - time_s
    is_near = taken.isfinite() & (taken >= lag_s) & (taken <= 1.5 * lag_s)
    way = (place.gather(1, later[..., None].expand(-1, -1, 2)) - place).norm(dim=-1)[is_near]
    if len(way) < 8:
        return torch.full((len(_SHARES),), torch.nan, dtype=torch.float64)
    return torch.quantile(way[:16_000_000], torch.tensor(_SHARES, dtype=torch.float64))


def _no_cells() -> MapCells:
    none = np.zeros(0, np.int32)
    return MapCells(none, none, none, np.zeros(0), np.zeros(0))
