"""Choice among settings of the bank by hindsight: how well each foresees detections that came later.

The likelihood that weighs the models is ruled by short steps within bursts; what counts for a forecast is the motion
across gaps. Detections after a window's origin tell, without any truth.
"""

import dataclasses

import torch
from torch import Tensor

from cadence.bank.bank import Bank
from cadence.types import Detections, WindowBatch

_NUM_SAMPLES = 24


def candidates(bank: Bank) -> tuple[Bank, ...]:
    """The settings to choose from: models that change rarely or often, and the one fitted Ornstein-Uhlenbeck model alone."""
    only_last = torch.zeros(len(bank.models), dtype=torch.float64)
    only_last[-1] = 1.0
    return (
        dataclasses.replace(bank, switch_rate=1.0 / 32.0),
        dataclasses.replace(bank, switch_rate=1.0 / 128.0),
        dataclasses.replace(bank, log_weight=only_last.log(), later_weight=only_last, switch_rate=0.0),
    )


def choose_by_hindsight(bank: Bank, windows: WindowBatch, later: Detections) -> Bank:
    """The candidate with the least mean energy score at the detections `later` [B, A, N] after each window's origin.

    Errors are divided by the distance at typical speed since the last detection, so that long gaps do not rule alone.
    Without any later detection the bank stays as it is.
    """
    is_used = later.is_observed & windows.is_active[..., None] & (later.time_s <= windows.time_s[-1])
    if int(is_used.sum()) < 8 or bank.log_weight is None:
        return bank
    scores = [_score(candidate, windows, later, is_used) for candidate in candidates(bank)]
    return candidates(bank)[int(torch.stack(scores).argmin())]


def _score(bank: Bank, windows: WindowBatch, later: Detections, is_used: Tensor) -> Tensor:
    position = bank.sample(windows, _NUM_SAMPLES).position_m.nan_to_num()
    at = ((later.time_s - windows.time_s[0]) / windows.step_s).clamp(0, windows.num_steps - 1.001)
    before = at.floor().long()
    share = (at - before)[:, None, :, :, None]
    pick = before[:, None, :, :, None].expand(-1, _NUM_SAMPLES, -1, -1, 2)
    foreseen = (1.0 - share) * position.gather(3, pick) + share * position.gather(3, pick + 1)
    error = (foreseen - later.position_m[:, None]).norm(dim=-1).mean(1)
    # half of the samples against the other half: an unbiased estimate of the mean distance between two of them
    half = _NUM_SAMPLES // 2
    spread = (foreseen[:, :half] - foreseen[:, half:]).norm(dim=-1).mean(1)
    last = torch.where(windows.detections.is_observed, windows.detections.time_s, -torch.inf).amax(-1, keepdim=True)
    scale = (later.time_s - last).clamp_min(windows.step_s)
    score: Tensor = ((error - 0.5 * spread) / scale)[is_used].mean()
    return score
