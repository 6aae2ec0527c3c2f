"""The gate: the network takes part, in past and future, only where this log shows that it does not lose to the bank."""

import dataclasses
import math

from cadence.bank.hindsight import hindsight_scores, num_tests, withhold
from cadence.diffusion.general import GateScores, GeneralModel
from cadence.types import Detections, WindowBatch

_LEAST_TESTS = 8
_ROUNDING = 1e-5
"""A share of the bank's score: differences below it are single precision at work, not a worse network."""


def gated(model: GeneralModel, windows: WindowBatch, later: Detections, seed: int = 0) -> GeneralModel:
    """The model with its network switched off where it clearly scores worse than the bank.

    Clearly: by more than one standard error of the difference between paired scores. The network comes from training with
    the presumption that it helps; a handful of windows must not overturn that.

    Args:
        model: with its bank fitted.
        windows: some windows of the log.
        later: detections after each window's origin.
        seed: of what is withheld.
    """
    if model.network is None or windows.num_windows == 0:
        return model
    past = _compare(model, *withhold(windows, seed))
    future = _compare(model, windows, later)
    scores = GateScores(past.ratio, future.ratio)
    return dataclasses.replace(model, strength_past=past.strength, strength_future=future.strength, gate=scores)


@dataclasses.dataclass(frozen=True)
class _Comparison:
    ratio: float | None
    strength: float


def _compare(model: GeneralModel, windows: WindowBatch, unseen: Detections) -> _Comparison:
    if num_tests(windows, unseen) < _LEAST_TESTS:
        return _Comparison(None, 1.0)
    network, bank = (hindsight_scores(estimator, windows, unseen) for estimator in (model, model.bank))
    difference = network - bank
    error = float(difference.std()) / math.sqrt(len(difference)) if len(difference) > 1 else math.inf
    is_worse = float(difference.mean()) > error + _ROUNDING * float(bank.mean().abs())
    return _Comparison(float(network.mean() / bank.mean()), 0.0 if is_worse else 1.0)
