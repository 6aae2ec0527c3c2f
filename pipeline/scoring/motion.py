"""Whether hypotheses move as targets do: the laws of speed, acceleration and turn of all tracks, beside those of the truth.

Scores at single steps do not see a jump between two of them; these do.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from cadence.arrays import Float64s
from cadence.types import HypothesisSet, WindowBatch
from pipeline.scoring.scores import Draw, ScoreRow, detection_distances, weight_by_agent

MOTION_METRICS = {"speed_w1_mps": "speed", "acceleration_w1_mps2": "acceleration", "turn_w1_deg": "turn"}
"""Wasserstein distances (order 1) of a law of the hypotheses to that of the truth on the same steps."""

_MAX_VALUES = 100_000
_FASTEST = 0.999
_SLOWEST_SHARE = 0.05
"""Turns of steps shorter than this share of the mean true one are left out: where nobody moves, directions mean nothing."""


@dataclass(frozen=True, eq=False)
class MotionSample:
    """Values of the three laws of one side of the origin, each with its mass; at most `_MAX_VALUES` are kept of each."""

    values: Mapping[str, Float64s]
    mass: Mapping[str, Float64s]

    @staticmethod
    def concatenate(parts: list["MotionSample"]) -> "MotionSample":
        """All values of the parts, thinned evenly where they are many."""
        found: dict[str, Float64s] = {}
        mass: dict[str, Float64s] = {}
        for law in MOTION_METRICS.values():
            values = np.concatenate([part.values[law] for part in parts] or [np.zeros(0)])
            stride = max(1, -(-len(values) // _MAX_VALUES))
            found[law] = values[::stride]
            mass[law] = np.concatenate([part.mass[law] for part in parts] or [np.zeros(0)])[::stride]
        return MotionSample(found, mass)

    def distance(self, other: "MotionSample", law: str) -> float:
        """Wasserstein distance of a law; NaN where one of the two knows nothing of it."""
        if not self.mass[law].sum() or not other.mass[law].sum():
            return float("nan")
        mass, other_mass = self.mass[law] / self.mass[law].sum(), other.mass[law] / other.mass[law].sum()
        values = np.concatenate([self.values[law], other.values[law]])
        order = np.argsort(values)
        # the area between the two distribution functions; scipy.stats says the same and takes a second to import
        ahead = np.cumsum(np.concatenate([mass, -other_mass])[order])[:-1]
        return float(np.abs(ahead) @ np.diff(values[order]))


MotionLaws = Mapping[str, MotionSample]
"""The laws up to the origin ("past") and after it ("future")."""


@dataclass(frozen=True, eq=False)
class MotionRecorder:
    """Collects how one estimator's hypotheses move, as they are drawn; `is_known` [B, A, T] says which steps count.

    least_m    shorter steps have no direction
    fastest_m  one in a thousand of the true steps is longer
    """

    windows: WindowBatch
    is_known: Tensor
    least_m: float
    fastest_m: float
    parts: dict[str, list[MotionSample]] = field(default_factory=lambda: {"past": [], "future": []})

    def watch(self, draw: Draw) -> Draw:
        """The same draws, measured in passing."""

        def watched(index: Tensor) -> HypothesisSet:
            found = draw(index)
            if len(index):
                self.add(found.position_m.double(), weight_by_agent(found), index)
            return found

        return watched

    def add(self, position_m: Tensor, weight: Tensor, index: Tensor) -> None:
        """Tracks [b, K, A, T, 2] with weights [b, K, A] of the windows [b]."""
        is_future = self.windows.time_s > 0.5 * self.windows.step_s
        for part, side in (("past", ~is_future), ("future", is_future)):
            known = self.is_known[index] & side
            self.parts[part].append(_measured(position_m, weight, known, self.windows.step_s, self.least_m))

    def fresh(self) -> "MotionRecorder":
        """For the same steps, with nothing collected."""
        return replace(self, parts={"past": [], "future": []})

    def laws(self) -> MotionLaws:
        """What was collected."""
        return {part: MotionSample.concatenate(samples) for part, samples in self.parts.items()}


def true_motion(windows: WindowBatch, truth_m: Tensor, is_known: Tensor) -> MotionRecorder:
    """The truth [B, A, T, 2] measured as one hypothesis, where hypotheses are scored; others are recorded with its limits."""
    is_known = is_known & detection_distances(windows)[0].isfinite()
    step_m = truth_m.diff(dim=2).norm(dim=-1)[is_known[..., 1:] & is_known[..., :-1]].numpy()
    if not len(step_m):
        return MotionRecorder(windows, is_known, 0.0, float("inf"))
    limits = _SLOWEST_SHARE * float(step_m.mean()), float(np.quantile(step_m, _FASTEST))
    found = MotionRecorder(windows, is_known, *limits)
    even = torch.ones(len(truth_m), 1, truth_m.shape[1], dtype=torch.float64)
    found.add(truth_m[:, None], even, torch.arange(len(truth_m)))
    return found


def motion_rows(name: str, laws: MotionLaws, truth: MotionLaws) -> Iterator[ScoreRow]:
    """A row a side of the origin and law: of hypotheses against truth. Without intervals: a law has no mean over groups."""
    for part, sample in laws.items():
        for metric, law in MOTION_METRICS.items():
            value = sample.distance(truth[part], law)
            if np.isfinite(value):
                nan = float("nan")
                yield ScoreRow(name, part, "motion", None, None, metric, value, nan, nan, len(truth[part].values[law]), 0)


def _measured(position_m: Tensor, weight: Tensor, known: Tensor, step_s: float, least_m: float) -> MotionSample:
    step = position_m.diff(dim=3)
    length = step.norm(dim=-1)
    is_step = known[..., 1:] & known[..., :-1]
    is_bend = is_step[..., 1:] & is_step[..., :-1]
    first, second = step[..., :-1, :], step[..., 1:, :]
    cross = first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]
    turn = torch.atan2(cross.abs(), (first * second).sum(dim=-1)).rad2deg()
    goes = (length[..., 1:] > least_m) & (length[..., :-1] > least_m)
    laws = {
        "speed": (length / step_s, is_step[:, None].expand_as(length)),
        "acceleration": (step.diff(dim=3).norm(dim=-1) / step_s**2, is_bend[:, None].expand_as(turn)),
        "turn": (turn, is_bend[:, None] & goes),
    }
    values, mass = {}, {}
    for law, (value, chosen) in laws.items():
        used = chosen & value.isfinite() & (weight[..., None] > 0)
        values[law] = value[used].numpy()
        mass[law] = weight[..., None].expand_as(value)[used].numpy()
    return MotionSample(values, mass)
