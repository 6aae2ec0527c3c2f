"""How much of the silence is believed: the exponent of its likelihood, chosen where withheld detections tell.

Looks are not independent, and hypotheses are not where targets may be: with all that looks say, single windows become certain
of a wrong place. Detections that were withheld show whether weighing by silence helps, and how much of it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from cadence.bank.hindsight import LEAST_TESTS, at_detections
from cadence.evidence.silence import Silence
from cadence.evidence.weights import known_tracks
from cadence.types import Detections, Estimator, WindowBatch

CANDIDATES = (0.3, 0.6, 1.0)
SAFE = 0.3
"""Where nothing tells: it halved the damage that full weight does to single windows, and kept nearly all that it ratios."""
_NUM_DRAWN = 48


@dataclass(frozen=True)
class ChosenExponent:
    """The exponent, of how many tests, and each candidate's energy score over that without silence."""

    exponent: float
    num_tests: int
    ratios: dict[float, float]


def choose_exponent(
    estimator: Estimator, windows: WindowBatch, withheld: Detections, silences: Sequence[Silence]
) -> ChosenExponent:
    """The exponent by which hypotheses of `windows` foresee withheld detections best.

    Zero where silence harms for certain; above `SAFE` only where that is certainly better (a standard error).

    Args:
        estimator: what draws, fitted to the log.
        windows: with their context, without the detections that are withheld.
        withheld: these.
        silences: whose exponent is asked for.
    """
    drawn = estimator.sample(windows, _NUM_DRAWN).position_m
    tracks = known_tracks(windows, drawn)
    said = [
        sum(each, torch.zeros(())) for each in zip(*(one.log_likelihoods(tracks, CANDIDATES) for one in silences), strict=True)
    ]
    foreseen, is_used = at_detections(drawn, windows, withheld)
    plain = _scores(foreseen, torch.zeros_like(said[0]), withheld)
    is_tested = is_used.any(-1) & (said[0].amax(1) > said[0].amin(1) + 1e-9)
    num = int(is_tested.sum())
    if num < LEAST_TESTS:
        return ChosenExponent(SAFE, num, {})

    def ratio(log_weight: Tensor) -> Tensor:
        score = _scores(foreseen, log_weight, withheld)
        total, before = (torch.where(is_used, value, 0.0).sum(-1)[is_tested] for value in (score, plain))
        return total / before.clamp_min(1e-9)

    ratios = {exponent: ratio(log_weight) for exponent, log_weight in zip(CANDIDATES, said, strict=True)}
    chosen = SAFE
    if _certainly(ratios[SAFE] - 1.0, 1.0):
        chosen = 0.0
    else:
        for exponent in CANDIDATES[1:]:
            if _certainly(ratios[chosen] - ratios[exponent], 1.0):
                chosen = exponent
    return ChosenExponent(chosen, num, {exponent: float(value.mean()) for exponent, value in ratios.items()})


def _certainly(worse: Tensor, num_errors: float) -> bool:
    """Whether the mean is above zero by so many of its standard errors."""
    return float(worse.mean()) > num_errors * float(worse.std()) / math.sqrt(len(worse))


def _scores(foreseen: Tensor, log_weight: Tensor, withheld: Detections) -> Tensor:
    """Energy scores [B, A, N] of positions [B, K, A, N, 2] with log weights [B, K, A]."""
    weight = torch.softmax(log_weight, 1)[..., None]
    error = (weight * (foreseen - withheld.position_m[:, None]).norm(dim=-1)).sum(1)
    others = [(weight * (foreseen - foreseen[:, k, None]).norm(dim=-1)).sum(1) for k in range(foreseen.shape[1])]
    score: Tensor = error - 0.5 * (weight * torch.stack(others, 1)).sum(1)
    return score
