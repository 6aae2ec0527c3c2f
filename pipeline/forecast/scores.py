"""Scores of forecasts at the paper's horizons, summed over the windows of each episode: what intervals are made of.

Episodes are what is resampled, so their sums are all that has to be kept, and parts of an evaluation simply add up.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cadence import metrics
from cadence.arrays import Float64s, Int64s
from cadence.constraints.checker import segments_in_collision, states_in_collision
from cadence.constraints.obstacles import Obstacles
from cadence.types import HypothesisSet

HORIZONS = (0, 29, 59, 89, 119)
"""Steps of a window at which the paper reads its scores: the columns 0, 30, 60, 90 and 120 min of its table."""

MEASURES = (
    "displacement_error", "paper_error", "ade", "min_ade_at", "min_ade", "mean_error", "energy_score", "coverage_50",
    "coverage_90",
)  # fmt: skip
"""displacement_error at the step: mean over the hypotheses of the distance to the truth; paper_error: the same, for mixtures
sum_k pi_k |mu_k - y| as the authors take it; ade: displacement error averaged over the steps up to it; min_ade_at: at the step,
of the hypothesis with the least summed error over the window; min_ade: that averaged over the steps up to it; mean_error: of
the hypotheses' mean; energy_score: in its plain form; coverage: share of the 50 and 90 % regions that hold the truth. All but
the coverage in metres."""

SHARES = ("step_length", "states_in_obstacles", "segments_in_obstacles")
"""Means over hypotheses and steps: length of a step in metres; states, and straight ways between states, that touch an
obstacle."""


_FINEST_M = 0.01
_BIN = 1.01
NUM_BINS = 1 + round(np.log(1e8) / np.log(_BIN))
"""Bins of step lengths: up to 1 cm, then each 1 % wider, up to 1000 km."""


@dataclass(frozen=True, eq=False)
class EpisodeScores:
    """Scores of E episodes; letters M measures, H horizons, S shares.

    episode  [E] int64 which they are
    count    [E] int64 windows
    sums     [E, M, H] sums over the windows
    shares   [E, S] sums over the windows
    steps    [E, NUM_BINS] mass of each length of a step; a window has the mass 1
    seconds  that sampling took
    """

    episode: Int64s
    count: Int64s
    sums: Float64s
    shares: Float64s
    steps: Float64s
    seconds: float = 0.0

    def __post_init__(self) -> None:
        e = len(self.episode)
        expected = {
            "count": (e,), "sums": (e, len(MEASURES), len(HORIZONS)), "shares": (e, len(SHARES)), "steps": (e, NUM_BINS),
        }  # fmt: skip
        for name, want in expected.items():
            if getattr(self, name).shape != want:
                raise ValueError(f"EpisodeScores.{name} has shape {getattr(self, name).shape}, expected {want}")

    def measure(self, name: str) -> Float64s:
        """Sums [E, H] of one measure."""
        chosen: Float64s = self.sums[:, MEASURES.index(name)]
        return chosen

    def mean(self, name: str) -> Float64s:
        """A measure's mean over all windows [H]."""
        mean: Float64s = self.measure(name).sum(axis=0) / self.count.sum()
        return mean

    def share(self, name: str) -> Float64s:
        """Sums [E] of one share."""
        chosen: Float64s = self.shares[:, SHARES.index(name)]
        return chosen

    @staticmethod
    def add(parts: Sequence["EpisodeScores"]) -> "EpisodeScores":
        """The parts of one evaluation as a whole; an episode may be in several."""
        episode, row = np.unique(np.concatenate([part.episode for part in parts]), return_inverse=True)

        def total(name: str) -> Any:
            values = np.concatenate([getattr(part, name) for part in parts])
            result = np.zeros((len(episode), *values.shape[1:]), values.dtype)
            np.add.at(result, row, values)
            return result

        sums = {name: total(name) for name in ("count", "sums", "shares", "steps")}
        return EpisodeScores(episode, **sums, seconds=sum(part.seconds for part in parts))

    def as_json(self) -> str:
        """One line; numbers are kept exactly."""
        filled = [[index.tolist(), row[index].tolist()] for row in self.steps for index in [np.flatnonzero(row)]]
        record = {
            "measures": MEASURES, "horizons": HORIZONS, "shares": SHARES, "episode": self.episode.tolist(),
            "count": self.count.tolist(), "sums": self.sums.tolist(), "share_sums": self.shares.tolist(), "steps": filled,
            "seconds": self.seconds,
        }  # fmt: skip
        return json.dumps(record) + "\n"

    @staticmethod
    def from_json(text: str) -> "EpisodeScores":
        """What `as_json` wrote; ValueError or LookupError where it is something else, or of other measures."""
        record = json.loads(text)
        if [record["measures"], record["horizons"], record["shares"]] != [list(MEASURES), list(HORIZONS), list(SHARES)]:
            raise ValueError("scores of other measures")
        count = np.array(record["count"], dtype=np.int64)
        steps = np.zeros((len(count), NUM_BINS))
        for row, (index, mass) in zip(steps, record["steps"], strict=True):
            row[index] = mass
        sums = np.array(record["sums"]).reshape(len(count), len(MEASURES), len(HORIZONS))
        shares = np.array(record["share_sums"]).reshape(len(count), len(SHARES))
        return EpisodeScores(np.array(record["episode"], dtype=np.int64), count, sums, shares, steps, record["seconds"])


def score_forecasts(
    found: HypothesisSet,
    truth_m: Tensor,
    episode: Tensor,
    datum_m: Tensor,
    obstacles: Obstacles,
    paper_error_m: Tensor | None = None,
    seconds: float = 0.0,
) -> EpisodeScores:
    """Score hypotheses [B, K, 1, T, 2] of windows from now on.

    Args:
        found: the hypotheses, relative to the datum.
        truth_m: [B, 1, T, 2] relative to the datum.
        episode: [B] of each window.
        datum_m: [B, 2] in the mission frame.
        obstacles: in the mission frame.
        paper_error_m: [B, H] for mixtures; the displacement error without.
        seconds: that sampling took.
    """
    position, weight, truth = found.position_m.double(), found.weight.double(), truth_m.double()
    known = torch.ones(truth.shape[:3], dtype=torch.bool)
    at = list(HORIZONS)
    error = metrics.expected_distance(position, weight, truth)[:, 0]
    best = metrics.min_ade_distance(position, weight, truth, known)[:, 0]
    covered = metrics.coverage(position[..., at, :], weight, truth[..., at, :], (0.5, 0.9))[:, :, 0]
    columns = {
        "displacement_error": error[:, at],
        "paper_error": error[:, at] if paper_error_m is None else paper_error_m.double(),
        "ade": _running_mean(error)[:, at],
        "min_ade_at": best[:, at],
        "min_ade": _running_mean(best)[:, at],
        "mean_error": metrics.mean_error(position[..., at, :], weight, truth[..., at, :])[:, 0],
        "energy_score": metrics.energy_score(position[..., at, :], weight, truth[..., at, :])[:, 0],
        "coverage_50": covered[0],
        "coverage_90": covered[1],
    }
    sums = np.stack([columns[name].numpy() for name in MEASURES], axis=1)
    length = torch.linalg.vector_norm(position[:, :, 0].diff(dim=2), dim=-1)
    shares = {"step_length": torch.einsum("bk,bkt->b", weight, length) / max(length.shape[-1], 1)}
    shares |= _collisions(position, weight, datum_m, obstacles)
    share_rows = np.stack([shares[name].numpy() for name in SHARES], axis=1)
    episodes, row = np.unique(episode.numpy(), return_inverse=True)
    return EpisodeScores(
        episodes,
        np.bincount(row),
        _summed(sums, row, len(episodes)),
        _summed(share_rows, row, len(episodes)),
        _step_masses(length.numpy(), weight.numpy(), row, len(episodes)),
        seconds,
    )


def step_quantiles(steps: Float64s, levels: Sequence[float]) -> Float64s:
    """Lengths [..., len(levels)] in metres, to 1 %, that the given shares of the mass `steps` [..., NUM_BINS] do not exceed."""
    reached = np.cumsum(steps, axis=-1)
    wanted = reached[..., -1:] * np.asarray(levels) * (1.0 - 1e-12)
    index = (reached[..., None, :] < wanted[..., None]).sum(axis=-1)
    length: Float64s = np.where(index == 0, 0.0, _FINEST_M * _BIN ** (np.minimum(index, NUM_BINS - 1) - 0.5))
    return length


def _running_mean(values: Tensor) -> Tensor:
    return values.cumsum(dim=-1) / torch.arange(1, values.shape[-1] + 1)


def _summed(values: Float64s, row: Int64s, num_rows: int) -> Float64s:
    result = np.zeros((num_rows, *values.shape[1:]))
    np.add.at(result, row, values)
    return result


def _step_masses(length_m: Float64s, weight: Float64s, row: Int64s, num_rows: int) -> Float64s:
    """Mass [E, NUM_BINS] of step lengths [B, K, T - 1] of the windows whose episodes are `row` [B]."""
    with np.errstate(divide="ignore"):
        place = np.ceil(np.log(length_m / _FINEST_M) / np.log(_BIN))
    index = np.clip(np.nan_to_num(place, neginf=0.0), 0, NUM_BINS - 1).astype(np.int64) + row[:, None, None] * NUM_BINS
    mass = np.broadcast_to(weight[..., None] / max(length_m.shape[-1], 1), length_m.shape)
    masses: Float64s = np.bincount(index.ravel(), mass.ravel(), num_rows * NUM_BINS).astype(np.float64)
    return masses.reshape(num_rows, NUM_BINS)


def _collisions(position: Tensor, weight: Tensor, datum_m: Tensor, obstacles: Obstacles) -> dict[str, Tensor]:
    """Weighted shares [B] of states and of segments in obstacles."""
    shares = {}
    for name, test in (("states_in_obstacles", states_in_collision), ("segments_in_obstacles", segments_in_collision)):
        hit = test(position[:, :, 0], obstacles, offset_m=datum_m.double()[:, None, None]).double()
        shares[name] = torch.einsum("bk,bkt->b", weight, hit) / max(hit.shape[-1], 1)
    return shares
