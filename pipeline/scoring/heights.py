"""Scores of heights, alone and as the third coordinate of places in space."""

import torch
from torch import Tensor

from cadence import metrics

HEIGHT_METRICS = ("height_energy_score_m", "height_coverage_90", "energy_score_3d_m", "coverage_90_3d")


def height_values(drawn: tuple[Tensor, Tensor], weight: Tensor, truth: tuple[Tensor, Tensor]) -> Tensor:
    """HEIGHT_METRICS of C cells [C, 4]; NaN where hypotheses or truth have no height.

    Args:
        drawn: hypotheses in the plane [C, K, 1, 1, 2], and their heights [C, K].
        weight: [C, K].
        truth: places in the plane [C, 2], and heights [C].
    """
    (at, high_m), (truth_m, true_high_m) = drawn, truth
    is_known = true_high_m.isfinite() & high_m.isfinite().all(1)
    found = torch.full((len(high_m), len(HEIGHT_METRICS)), torch.nan, dtype=torch.float64)
    if not bool(is_known.any()):
        return found
    place, high = at[is_known], high_m[is_known].double()[:, :, None, None, None]
    true_place, true_high = truth_m[is_known].double()[:, None, None], true_high_m[is_known].double()[:, None, None, None]
    columns = []
    for samples, true in ((high, true_high), (torch.cat([place, high], -1), torch.cat([true_place, true_high], -1))):
        columns.append(metrics.energy_score(samples, weight[is_known], true).flatten())
        columns.append(metrics.coverage(samples, weight[is_known], true, (0.9,)).flatten())
    found[is_known] = torch.stack(columns, -1)
    return found
