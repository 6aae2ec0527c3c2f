"""Choices by hindsight: how well each candidate foresees, or fills in, detections that it was not shown.

The likelihood that weighs the models is ruled by short steps within bursts; what counts is the motion across gaps.
Detections after a window's origin, and bursts withheld inside it, tell — without any truth.
"""

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor

from cadence.types import Detections, Estimator, WindowBatch

Test = tuple[WindowBatch, Detections]
"""Windows, and detections that they do not hold."""

NUM_SAMPLES = 24
_APART_STEPS = 1.5
_GAP_STEPS = 16.0
"""The gap in which a random moment lies, as grids are planned."""
LEAST_TESTS = 8
"""Detections without which nothing is chosen."""


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
        position_m: [B, K, A, T, 2] hypotheses of equal weight, independent of each other.
        windows: what they were drawn from.
        shown_later: the detections to compare with.
    """
    error, distance = distances([position_m], windows, shown_later)
    return error[:, 0] - 0.5 * distance[:, 0, 0]


def distances(positions_m: Sequence[Tensor], windows: WindowBatch, shown_later: Detections) -> tuple[Tensor, Tensor]:
    """What energy scores of M sets of hypotheses, and of all mixtures of them, consist of; arguments and R as above.

    Returns:
        Mean distance of each set to the detections [R, M], and between two sets [R, M, M], of a set to itself without bias.
    """
    foreseen = [at_detections(position_m, windows, shown_later)[0] for position_m in positions_m]
    is_used = _is_used(windows, shown_later)
    scale = _scale(windows, shown_later)

    def mean(value: Tensor) -> Tensor:
        return (torch.where(is_used, value / scale, 0.0).sum(-1) / is_used.sum(-1).clamp_min(1))[is_used.any(-1)]

    error = [mean((one - shown_later.position_m[:, None]).norm(dim=-1).mean(1)) for one in foreseen]
    # half of the samples against the other half: an unbiased estimate of the mean distance between two of a set
    half = foreseen[0].shape[1] // 2
    between = [[mean((one[:, :half] - other[:, half:]).norm(dim=-1).mean(1)) for other in foreseen] for one in foreseen]
    distance = torch.stack([torch.stack(row, -1) for row in between], -2)
    return torch.stack(error, -1), 0.5 * (distance + distance.mT)


def _scale(windows: WindowBatch, shown_later: Detections) -> Tensor:
    """Seconds from each detection [B, A, N] to the nearest one in its window, at least a step."""
    distance_s = (shown_later.time_s[..., None] - windows.detections.time_s[..., None, :]).abs()
    known = windows.detections.is_observed[..., None, :]
    return torch.where(known, distance_s, torch.inf).amin(-1).clamp_min(windows.step_s)


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
    """The windows without one whole burst of detections an agent, neither the first nor the last, and what was withheld.

    A longer gap remains without it. Of the bursts the one is chosen after which the gap is most like those that are asked for;
    `seed` decides between equals. Agents with fewer than three bursts keep all.
    """
    detections = windows.detections
    burst = _bursts(detections, _APART_STEPS * windows.step_s)
    gap_s = _gaps_without(detections, burst)
    unlike = (gap_s / (_GAP_STEPS * windows.step_s)).log().abs()
    unlike = unlike + 1e-6 * torch.rand(unlike.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    chosen = torch.where(gap_s.isfinite(), unlike, torch.inf).argmin(-1, keepdim=True)
    is_withheld = detections.is_observed & (burst == chosen) & gap_s.isfinite().any(-1, keepdim=True)
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


def _bursts(detections: Detections, apart_s: float) -> Tensor:
    """Which burst of its agent each detection belongs to [B, A, N], counted from zero: they lie more than `apart_s` apart."""
    is_new = (detections.time_s.diff(dim=-1) > apart_s) & detections.is_observed[..., 1:]
    return torch.nn.functional.pad(is_new.cumsum(-1), (1, 0))


def _gaps_without(detections: Detections, burst: Tensor) -> Tensor:
    """Length in seconds of the gap that remains without each burst [B, A, bursts]; infinite for the first and the last."""
    time_s, observed = detections.time_s.double(), detections.is_observed
    never = torch.full((*burst.shape[:2], burst.shape[2] + 1), torch.inf, dtype=torch.float64)
    begin_s = never.scatter_reduce(2, burst, torch.where(observed, time_s, torch.inf), "amin")
    end_s = (-never).scatter_reduce(2, burst, torch.where(observed, time_s, -torch.inf), "amax")
    return torch.cat([never[..., :1], begin_s[..., 2:] - end_s[..., :-2]], dim=-1)


def _is_used(windows: WindowBatch, shown_later: Detections) -> Tensor:
    is_on_grid = (shown_later.time_s <= windows.time_s[-1]) & (shown_later.time_s >= windows.time_s[0])
    return shown_later.is_observed & windows.is_active[..., None] & is_on_grid
