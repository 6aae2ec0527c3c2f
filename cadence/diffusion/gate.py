"""The gate: how many of the hypotheses the network moves, in the past and in the future of this log.

Half and half is the safe choice: the energy score of a mixture is never worse than the mean of its parts' scores. The log
moves it to the network or to the bank alone only where detections withheld from both show clearly that this is better.
"""

import dataclasses
import math

import torch
from torch import Tensor

from cadence.bank.hindsight import LEAST_TESTS, NUM_SAMPLES, num_tests, scores_in_hindsight, withhold
from cadence.diffusion.general import GateScores, GeneralModel
from cadence.types import Detections, WindowBatch

_SHARES = (0.5, 1.0, 0.0)


def gated(model: GeneralModel, windows: WindowBatch, later: Detections, seed: int = 0) -> GeneralModel:
    """The model with the network's shares chosen by hindsight.

    Clearly better means: by more than one standard error of the difference between paired scores.

    Args:
        model: with its bank fitted.
        windows: some windows of the log.
        later: detections after each window's origin.
        seed: of what is withheld.
    """
    if model.network is None:
        return model
    untested = _Choice(_SHARES[0], None, None)
    past = _choose(model, *withhold(windows, seed)) if windows.num_windows else untested
    future = _choose(model, windows, later) if windows.num_windows else untested
    scores = GateScores(past.network, past.half, future.network, future.half)
    return dataclasses.replace(model, share_past=past.share, share_future=future.share, gate=scores)


@dataclasses.dataclass(frozen=True)
class _Choice:
    share: float
    network: float | None
    half: float | None


def _choose(model: GeneralModel, windows: WindowBatch, unseen: Detections) -> _Choice:
    if num_tests(windows, unseen) < LEAST_TESTS:
        return _Choice(_SHARES[0], None, None)
    network_m, bank_m = (model.with_shares(share).sample(windows, NUM_SAMPLES).position_m for share in (1.0, 0.0))
    # Half and half begins with the same noise: it is the network's hypotheses where those are moved, and the bank's elsewhere.
    is_moved = model.with_shares(0.5).moves(NUM_SAMPLES)[:, None, None, None]
    half, network, bank = (
        scores_in_hindsight(position_m, windows, unseen)
        for position_m in (torch.where(is_moved, network_m, bank_m), network_m, bank_m)
    )
    ratios = float(network.mean() / bank.mean()), float(half.mean() / bank.mean())
    # the larger gain over half and half, counted in standard errors
    gains = {1.0: _gain(half, network), 0.0: _gain(half, bank)}
    best = max(gains, key=lambda share: gains[share])
    return _Choice(best if gains[best] > 1.0 else _SHARES[0], *ratios)


def _gain(half: Tensor, other: Tensor) -> float:
    """How much better `other` scores than `half`, in standard errors of the paired difference."""
    difference = half - other
    error = float(difference.std()) / math.sqrt(len(difference)) if len(difference) > 1 else math.inf
    mean = float(difference.mean())
    return mean / error if error > 0.0 else 0.0
