"""The gate: how many of the hypotheses the network moves, in the past and in the future of this log.

Network and bank are pooled like the settings of the bank (`cadence.bank.pool`): by how well they foresee what was withheld from
both, half and half where that does not tell.
"""

import dataclasses

import torch

from cadence.bank.hindsight import LEAST_TESTS, Test, distances, num_tests
from cadence.bank.pool import NUM_DRAWN, best_weights
from cadence.bank.rows import scatter_hypotheses
from cadence.diffusion.general import GateScores, GeneralModel

_SAFE = torch.tensor([0.5, 0.5], dtype=torch.float64)
"""Half and half: the energy score of a mixture is never worse than the mean of its parts' scores."""


def gated(model: GeneralModel, past: Test, future: Test) -> GeneralModel:
    """The model with the network's shares chosen by hindsight; half where too little could be withheld.

    Args:
        model: with its bank fitted.
        past: windows, and detections up to their origin that they do not hold.
        future: windows, and detections after it.
    """
    if model.network is None:
        return model
    chosen = [_choose(model, test) for test in (past, future)]
    scores = GateScores(chosen[0].network, chosen[1].network)
    return dataclasses.replace(model, share_past=chosen[0].share, share_future=chosen[1].share, gate=scores)


@dataclasses.dataclass(frozen=True)
class _Choice:
    share: float
    network: float | None


def _choose(model: GeneralModel, test: Test) -> _Choice:
    windows, unseen = test
    if not windows.num_windows or num_tests(windows, unseen) < LEAST_TESTS:
        return _Choice(float(_SAFE[1]), None)
    posterior = model.bank.posterior(windows, NUM_DRAWN)
    drawn = (posterior.sample_m, model.with_shares(1.0).denoised(posterior, windows))
    found = distances([scatter_hypotheses(sample_m, windows).position_m for sample_m in drawn], windows, unseen)
    error, distance = found
    bank, network = (error - 0.5 * distance.diagonal(dim1=-2, dim2=-1)).mean(0).tolist()
    return _Choice(float(best_weights(found, _SAFE)[1]), network / max(bank, 1e-12))
