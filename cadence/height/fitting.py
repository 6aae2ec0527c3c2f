"""What a log's own heights say of its modes: the unit of vertical rate, and the share of time in each mode.

Shares of time, not of detections: detections that follow each other closely would rule else.
"""

import math

import torch
from torch import Tensor

from cadence.height.draws import draw, random_numbers
from cadence.height.filtering import Nodes, Switching, filter_forward
from cadence.height.modes import Modes

DIFFUSE_STEPS = 300.0
"""Standard deviation, in step lengths, of the height where a track starts, before its first detection is seen."""
FLOOR_STEPS = 1e-3
"""No height counts as more exact than this share of a step length."""
_LEAST_MPS, _MOST_MPS = 1e-3, 100.0
_NUM_ROUNDS, _NUM_DRAWN = 8, 8


def typical_rate(rows: Nodes, step_s: float) -> float:
    """Root mean square vertical rate between successive detections, noise taken off; never zero.

    Pairs closer than a quarter of a step are left out: there noise divided by time would rule.
    """
    duration = rows.time_s.diff(dim=1)
    is_pair = rows.is_observed[:, 1:] & rows.is_observed[:, :-1] & (duration > 0.25 * step_s)
    if not bool(is_pair.any()):
        return max(1.0 / step_s, _LEAST_MPS)
    square = rows.height_m.diff(dim=1) ** 2 - rows.variance_m2[:, 1:] - rows.variance_m2[:, :-1]
    square = (square / duration.clamp_min(1e-9) ** 2)[is_pair].clamp(0.0, _MOST_MPS**2)
    weight = duration[is_pair].clamp(max=8.0 * step_s)
    return max(math.sqrt(float((weight * square).sum() / weight.sum())), _LEAST_MPS)


def fit_weights(modes: Modes, prior: Tensor, rows: Nodes, diffuse_m: float, pseudo_count: float) -> Tensor:
    """Log weights [C] of modes in seconds and metres: shares of time in samples given the detections, shrunk to the prior.

    Monte Carlo expectation maximisation with fixed random numbers. `pseudo_count` is what the prior counts, in detections.
    """
    log_weight, num = prior.log(), float(rows.is_observed.sum())
    is_between = (torch.arange(rows.time_s.shape[1]) <= rows.last[:, None])[:, 1:]
    lasted_s = torch.where(is_between, rows.time_s.diff(dim=1), 0.0)
    for number in range(_NUM_ROUNDS):
        switching = Switching(modes, log_weight)
        numbers = random_numbers(
            torch.arange(len(rows.time_s)) + 1_000_003 * number, rows.is_observed.sum(1), _NUM_DRAWN, rows.time_s.shape[1]
        )
        _, mode = draw(switching, rows, filter_forward(switching, rows, diffuse_m), numbers)
        total_s = torch.zeros(len(modes), dtype=torch.float64)
        total_s.index_add_(0, mode[:, :, 1:].flatten(), lasted_s[:, None].expand(-1, _NUM_DRAWN, -1).flatten())
        share = total_s / total_s.sum().clamp_min(1e-300)
        log_weight = ((share * num + pseudo_count * prior) / (num + pseudo_count)).log()
    return log_weight
