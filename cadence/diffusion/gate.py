"""The gate: the network takes part, in past and future, only where this log shows that it does not lose to the bank."""

import dataclasses

from cadence.bank.hindsight import hindsight_score, num_tests, withhold
from cadence.diffusion.general import GateScores, GeneralModel
from cadence.types import Detections, WindowBatch

_LEAST_TESTS = 8


def gated(model: GeneralModel, windows: WindowBatch, later: Detections, seed: int = 0) -> GeneralModel:
    """The model with its network switched off where it scores worse than the bank.

    Args:
        model: with its bank fitted.
        windows: some windows of the log.
        later: detections after each window's origin.
        seed: of what is withheld.
    """
    if model.network is None or windows.num_windows == 0:
        return model
    past = _ratio(model, *withhold(windows, seed))
    future = _ratio(model, windows, later)
    strength = tuple(1.0 if ratio is None or ratio <= 1.0 else 0.0 for ratio in (past, future))
    scores = GateScores(past, future)
    return dataclasses.replace(model, strength_past=strength[0], strength_future=strength[1], gate=scores)


def _ratio(model: GeneralModel, windows: WindowBatch, unseen: Detections) -> float | None:
    if num_tests(windows, unseen) < _LEAST_TESTS:
        return None
    return hindsight_score(model, windows, unseen) / hindsight_score(model.bank, windows, unseen)
