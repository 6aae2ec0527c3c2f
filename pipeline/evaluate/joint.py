"""Scores of all agents of a window together: of the joint hypothesis as one vector, and of the set of estimated positions.

A cell is a window and a part of it. They are there for logs of several agents only: with one agent they tell nothing new.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from cadence import metrics
from cadence.arrays import Float64s, Int32s, Int64s
from cadence.types import HypothesisSet, WindowBatch
from pipeline.scoring.matching import matched
from pipeline.scoring.scores import PARTS, Draw, ScoreRow, detection_distances, weight_by_agent

JOINT_METRICS = (
    "joint_energy_score_m", "joint_min_ade_m", "gospa_m", "localisation_error_m", "num_missed", "num_false",
)  # fmt: skip
"""Columns of `JointCells.value`.

joint_energy_score_m is that of all agents' tracks as one vector (root mean square over its known cells), joint_min_ade_m the
error of the one joint hypothesis that is best for all; both over agents that are part of every hypothesis. gospa_m is the mean
over the steps of GOSPA (order 2) between weighted mean positions and truth, and the others are what it is made of: the error of
the assigned, how many agents were missed and how many are none (where the truth is silent about an agent, its estimate
counts as neither).
"""
_ORDER = 2.0
_NUM_BLOCKS = 10


@dataclass(frozen=True, eq=False)
class JointCells:
    """C scored cells: window [C], part [C] index of `PARTS`, value [C, len(JOINT_METRICS)]."""

    window: Int32s
    part: Int32s
    value: Float64s

    def __len__(self) -> int:
        return len(self.window)

    @staticmethod
    def concatenate(parts: Sequence["JointCells"]) -> "JointCells":
        """All cells of the parts, in order."""
        if not parts:
            return JointCells(np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros((0, len(JOINT_METRICS))))
        return JointCells(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("window", "part", "value")))


@dataclass(frozen=True, eq=False)
class JointScorer:
    """What one estimator's hypotheses are compared with; collects cells as they are drawn.

    drawn [B, A]    windows as the estimator sees them; is_counted [B, A] agents that are said to be there
    scored [B, J]   the same detections by the agents of the truth; match [B, J] which of the A each one is (-1: none)
    truth_m [B, J, T, 2], is_known [B, J, T]
    cutoff_m        of GOSPA
    """

    drawn: WindowBatch
    is_counted: Tensor
    scored: WindowBatch
    match: Tensor
    truth_m: Tensor
    is_known: Tensor
    cutoff_m: float
    found: list[JointCells] = field(default_factory=list)

    def watch(self, draw: Draw) -> Draw:
        """The same draws by the agents of the truth, scored in passing."""

        def watched(index: Tensor) -> HypothesisSet:
            raw = draw(index)
            hypotheses = matched(raw, self.match[index])
            if len(index):
                self.found.append(self._cells(raw, hypotheses, index))
            return hypotheses

        return watched

    def cells(self) -> JointCells:
        """All cells so far."""
        return JointCells.concatenate(self.found)

    def _cells(self, raw: HypothesisSet, hypotheses: HypothesisSet, index: Tensor) -> JointCells:
        value = torch.full((len(index), len(PARTS), len(JOINT_METRICS)), torch.nan, dtype=torch.float64)
        value[..., :2] = _vector_scores(hypotheses, self.scored[index], self.truth_m[index], self.is_known[index])
        value[..., 2:] = self._set_scores(raw, index)
        window = index[:, None].expand(-1, len(PARTS)).flatten().numpy().astype(np.int32)
        part = np.tile(np.arange(len(PARTS), dtype=np.int32), len(index))
        is_used = value.isfinite().any(-1).flatten().numpy()
        return JointCells(window[is_used], part[is_used], value.flatten(0, 1).numpy()[is_used])

    def _set_scores(self, raw: HypothesisSet, index: Tensor) -> Tensor:
        """GOSPA and its parts [b, PARTS, 4], means over the steps with truth; NaN for "between", which no set has."""
        windows, share = self.drawn[index], weight_by_agent(raw)
        mean_m = torch.einsum("bka,bkats->bats", share, raw.position_m.double().nan_to_num())
        begins = detection_distances(windows)[0].isfinite() & self.is_counted[index][..., None]
        is_there = begins & (share.sum(1) > 0)[..., None]
        out = torch.full((len(index), len(PARTS), 4), torch.nan, dtype=torch.float64)
        is_future = windows.time_s > 0.5 * windows.step_s
        steps_of = {"past": ~is_future, "future": is_future, "final": torch.arange(windows.num_steps) == windows.num_steps - 1}
        for b, window in enumerate(index.tolist()):
            known, match = self.is_known[window], self.match[window]
            # Where the truth is silent about an agent, nobody can say that its estimate is a false one.
            is_there[b, match[match >= 0]] &= known[match >= 0]
            scores = torch.full((windows.num_steps, 4), torch.nan, dtype=torch.float64)
            for step in known.any(0).nonzero()[:, 0].tolist():
                estimated = mean_m[b, is_there[b, :, step], step]
                scores[step] = _gospa(estimated, self.truth_m[window, known[:, step], step], self.cutoff_m)
            for part, steps in steps_of.items():
                out[b, PARTS.index(part)] = scores[steps].nanmean(0)
        return out


def _gospa(estimated_m: Tensor, truth_m: Tensor, cutoff_m: float) -> Tensor:
    """Distance, error of the assigned (NaN without any), missed and false agents [4]."""
    found = metrics.gospa(estimated_m, truth_m, cutoff_m, _ORDER)
    unit = cutoff_m**_ORDER / 2.0
    num_missed, num_false = found.missed / unit, found.false / unit
    num_assigned = len(truth_m) - num_missed
    error_m = (found.localisation / num_assigned) ** (1.0 / _ORDER) if num_assigned else float("nan")
    return torch.tensor([found.distance, error_m, num_missed, num_false], dtype=torch.float64)


def _vector_scores(found: HypothesisSet, windows: WindowBatch, truth_m: Tensor, is_known: Tensor) -> Tensor:
    """Joint energy score and joint minADE [b, PARTS, 2] over the cells that are scored agent by agent as well."""
    age, gap, _ = detection_distances(windows)
    is_drawn = found.position_m[..., 0, 0].isfinite().all(dim=1)  # [b, J]: part of every hypothesis
    chosen = is_known & age.isfinite() & is_drawn[..., None]
    is_future = (windows.time_s > 0.5 * windows.step_s).expand_as(chosen)
    is_final = (torch.arange(windows.num_steps) == windows.num_steps - 1).expand_as(chosen)
    masks = {"past": ~is_future, "between": ~is_future & gap.isfinite(), "future": is_future, "final": is_final}
    out = []
    for part in PARTS:
        known = chosen & masks[part]
        energy = metrics.trajectory_energy_score(found.position_m, found.weight, truth_m, known)
        distance = metrics.min_ade_distance(found.position_m, found.weight, truth_m, known, is_joint=True)
        best = torch.where(known, distance, 0.0).flatten(1).sum(1) / known.flatten(1).sum(1)
        out.append(torch.stack([energy, best], dim=-1))
    return torch.stack(out, dim=1)


def block_of(cells: JointCells, num_windows: int) -> Int64s:
    """One of ten blocks of origins of every cell [C]: what is resampled within a log, as its windows overlap."""
    return np.asarray(cells.window.astype(np.int64) * _NUM_BLOCKS // max(num_windows, 1))


def summarise_joint(name: str, cells: JointCells, groups: Int64s, seed: int = 0, num_resamples: int = 1000) -> list[ScoreRow]:
    """A row a part and metric, with bootstrap intervals over the groups [C]; counts are of windows."""
    rng = np.random.default_rng(seed)
    rows = []
    for number, part in enumerate(PARTS):
        is_in = cells.part == number
        for column, metric in enumerate(JOINT_METRICS):
            found = metrics.bootstrap_mean(cells.value[is_in, column], groups[is_in], rng, num_resamples)
            if found.num_values:
                interval = (found.value, found.low, found.high, found.num_values, found.num_groups)
                rows.append(ScoreRow(name, part, "joint", None, None, metric, *interval))
    return rows
