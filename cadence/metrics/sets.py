"""Distances between finite sets of positions: GOSPA (Rahmathullah et al. 2017, alpha = 2) and OSPA (Schuhmacher 2008)."""

from dataclasses import dataclass

import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from cadence.arrays import Float64s


@dataclass(frozen=True)
class Gospa:
    """GOSPA and its parts: distance^order = localisation + missed + false (the parts are to the power of the order)."""

    distance: float
    localisation: float
    missed: float
    false: float


def gospa(estimated_m: Tensor, truth_m: Tensor, cutoff_m: float, order: float = 2.0) -> Gospa:
    """GOSPA between estimated [N, 2] and true [M, 2] positions; pairs further apart than the cut-off are not assigned."""
    cost = _assigned_costs(estimated_m, truth_m, cutoff_m, order)
    assigned = cost[cost < cutoff_m**order]
    unit = cutoff_m**order / 2.0
    localisation = float(assigned.sum())
    missed = unit * (len(truth_m) - len(assigned))
    false = unit * (len(estimated_m) - len(assigned))
    return Gospa((localisation + missed + false) ** (1.0 / order), localisation, missed, false)


def ospa(estimated_m: Tensor, truth_m: Tensor, cutoff_m: float, order: float = 2.0) -> float:
    """OSPA between estimated [N, 2] and true [M, 2] positions, metres; 0 for two empty sets, the cut-off where one is."""
    larger, smaller = max(len(estimated_m), len(truth_m)), min(len(estimated_m), len(truth_m))
    if larger == 0:
        return 0.0
    cost = float(_assigned_costs(estimated_m, truth_m, cutoff_m, order).sum())
    return float(((cost + cutoff_m**order * (larger - smaller)) / larger) ** (1.0 / order))


def _assigned_costs(estimated_m: Tensor, truth_m: Tensor, cutoff_m: float, order: float) -> Float64s:
    """Costs min(d, c)^p of the best assignment, one per pair of the smaller set."""
    distance = torch.cdist(
        estimated_m.double().reshape(-1, 2), truth_m.double().reshape(-1, 2), compute_mode="donot_use_mm_for_euclid_dist"
    )
    cost: Float64s = distance.clamp(max=cutoff_m).pow(order).cpu().numpy()
    return cost[linear_sum_assignment(cost)]
