"""Choices by hindsight: how well each candidate foresees, or fills in, detections that it was not shown.

The likelihood that weighs the models is ruled by short steps within bursts; what counts is the motion across gaps.
Detections after a window's origin, and bursts withheld inside it, tell — without any truth.
"""

import dataclasses

import torch
from torch import Tensor

from cadence.bank.bank import Bank
from cadence.types import Detections, Estimator, WindowBatch

NUM_SAMPLES = 24
_WITHHELD_STEPS = 1.5
LEAST_TESTS = 8
"""Detections without which nothing is chosen."""


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
    """The candidate with the least mean of `hindsight_scores` at the detections `later` [B, A, N] after each window's origin.

    Without enough of them the bank stays as it is.
    """
    if windows.num_windows == 0 or num_tests(windows, later) < LEAST_TESTS or bank.log_weight is None:
        return bank
    scores = [float(hindsight_scores(candidate, windows, later).mean()) for candidate in candidates(bank)]
    return candidates(bank)[scores.index(min(scores))]


def num_tests(windows: WindowBatch, shown_later: Detections) -> int:
    """How many detections can be compared."""
    return int(_is_used(windows, shown_later).sum())


def hindsight_scores(estimator: Estimator, windows: WindowBatch, shown_later: Detections) -> Tensor:
    """`scores_in_hindsight` of NUM_SAMPLES hypotheses of an estimator."""
    return scores_in_hindsight(estimator.sample(windows, NUM_SAMPLES).position_m, windows, shown_later)


def scores_in_hindsight(position_m: Tensor, windows: WindowBatch, shown_later: Detections) -> Tensor:
    """Energy scores at each agent's detections [B, A, N] that `windows` do not hold, anywhere on their grid: their means [R].

    R runs over the agents of windows with any such detection. Errors are divided by the time to the nearest detection in the
    window, so that long gaps do not rule alone.

    Args:
        position_m: [B, NUM_SAMPLES, A, T, 2] hypotheses of equal weight.
        windows: what they were drawn from.
        shown_later: the detections to compare with.
    """
    foreseen, is_used = at_detections(position_m, windows, shown_later)
    error = (foreseen - shown_later.position_m[:, None]).norm(dim=-1).mean(1)
    # half of the samples against the other half: an unbiased estimate of the mean distance between two of them
    half = NUM_SAMPLES // 2
    spread = (foreseen[:, :half] - foreseen[:, half:]).norm(dim=-1).mean(1)
    distance_s = (shown_later.time_s[..., None] - windows.detections.time_s[..., None, :]).abs()
    known = windows.detections.is_observed[..., None, :]
    scale = torch.where(known, distance_s, torch.inf).amin(-1).clamp_min(windows.step_s)
    score = torch.where(is_used, (error - 0.5 * spread) / scale, 0.0).sum(-1) / is_used.sum(-1).clamp_min(1)
    return score[is_used.any(-1)]


def at_detections(position_m: Tensor, windows: WindowBatch, shown_later: Detections) -> tuple[Tensor, Tensor]:
    """Hypotheses [B, K, A, T, 2] at the times of detections [B, A, N]: positions [B, K, A, N, 2], and which can be compared."""
    position = position_m.nan_to_num()
    at = ((shown_later.time_s - windows.time_s[0]) / windows.step_s).clamp(0, windows.num_steps - 1.001)
    before = at.floor().long()
    share = (at - before)[:, None, :, :, None]
    pick = before[:, None, :, :, None].expand(-1, position.shape[1], -1, -1, 2)
    foreseen = (1.0 - share) * position.gather(3, pick) + share * position.gather(3, pick + 1)
    return foreseen, _is_used(windows, shown_later)


def withhold(windows: WindowBatch, seed: int) -> tuple[WindowBatch, Detections]:
    """The windows without one burst each, chosen at random among all but the first and the last detection, and that burst."""
    detections = windows.detections
    generator = torch.Generator().manual_seed(seed)
    draw = torch.rand(detections.time_s.shape, generator=generator)
    index = torch.arange(detections.time_s.shape[2])
    is_inner = detections.is_observed & (index > 0) & (index < detections.count[..., None] - 1)
    chosen = torch.where(is_inner, draw, -1.0).argmax(-1, keepdim=True)
    distance_s = (detections.time_s - detections.time_s.gather(2, chosen)).abs()
    is_withheld = is_inner & is_inner.any(-1, keepdim=True) & (distance_s <= _WITHHELD_STEPS * windows.step_s)
    # padding belongs last: what is kept moves to the front, in order
    order = torch.argsort((~(detections.is_observed & ~is_withheld)).to(torch.int8), dim=-1, stable=True)
    kept = Detections(
        detections.time_s.gather(2, order),
        detections.position_m.gather(2, order[..., None].expand(-1, -1, -1, 2)),
        detections.covariance_m2.gather(2, order[..., None, None].expand(-1, -1, -1, 2, 2)),
        (detections.is_observed & ~is_withheld).gather(2, order),
    )
    withheld = dataclasses.replace(detections, is_observed=is_withheld)
    return dataclasses.replace(windows, detections=kept), withheld


def _is_used(windows: WindowBatch, shown_later: Detections) -> Tensor:
    is_on_grid = (shown_later.time_s <= windows.time_s[-1]) & (shown_later.time_s >= windows.time_s[0])
    return shown_later.is_observed & windows.is_active[..., None] & is_on_grid
