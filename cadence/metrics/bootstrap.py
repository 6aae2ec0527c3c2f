"""Confidence intervals by resampling whole groups (agents, episodes, blocks of time), never single windows: windows overlap."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from cadence.arrays import Float64s

_MAX_DRAWS = 4_000_000


@dataclass(frozen=True)
class Interval:
    """An estimate with its bootstrap interval; `num_groups` groups of `num_values` values went in.

    With fewer than two groups there is nothing to resample: low and high are NaN.
    """

    value: float
    low: float
    high: float
    num_values: int
    num_groups: int


def bootstrap_mean(
    values: ArrayLike, groups: ArrayLike, rng: np.random.Generator, num_resamples: int = 2000, level: float = 0.95
) -> Interval:
    """Mean of `values` [N] (NaN left out) with a percentile interval over the groups [N] they belong to."""
    array = np.asarray(values, dtype=np.float64)
    return bootstrap_ratio(array, np.ones_like(array), groups, rng, num_resamples, level)


def bootstrap_ratio(
    numerator: ArrayLike,
    denominator: ArrayLike,
    groups: ArrayLike,
    rng: np.random.Generator,
    num_resamples: int = 2000,
    level: float = 0.95,
) -> Interval:
    """Ratio of the sums of two estimators' scores on the same windows [N], paired: both are resampled together.

    A value that is NaN in either is left out of both. Groups of any size keep the weight of their members.
    """
    top, bottom, names = np.asarray(numerator, np.float64), np.asarray(denominator, np.float64), np.asarray(groups)
    if not top.shape == bottom.shape == names.shape or top.ndim != 1:
        raise ValueError(f"bootstrap over shapes {top.shape}, {bottom.shape}, {names.shape}; expected three equal [N]")
    is_valid = ~(np.isnan(top) | np.isnan(bottom))
    _, group = np.unique(names[is_valid], return_inverse=True)
    num_groups = int(group.max()) + 1 if group.size else 0
    sides = [np.bincount(group, side[is_valid], num_groups).astype(np.float64) for side in (top, bottom)]
    sums = np.stack(sides, axis=1)  # [G, 2]
    value = _quotient(sums.sum(axis=0)).item()
    is_defined = num_groups >= 2 and not np.isnan(value)
    low, high = _percentiles(sums, rng, num_resamples, level) if is_defined else (np.nan, np.nan)
    return Interval(value, low, high, int(is_valid.sum()), num_groups)


def _percentiles(sums: Float64s, rng: np.random.Generator, num_resamples: int, level: float) -> tuple[float, float]:
    num_groups = len(sums)
    block = max(1, _MAX_DRAWS // num_groups)
    totals = [
        sums[rng.integers(num_groups, size=(min(block, num_resamples - start), num_groups))].sum(axis=1)
        for start in range(0, num_resamples, block)
    ]
    tail = 50.0 * (1.0 - level)
    low, high = np.nanpercentile(_quotient(np.concatenate(totals)), [tail, 100.0 - tail])
    return float(low), float(high)


def _quotient(sums: Float64s) -> Float64s:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(sums[..., 0] / sums[..., 1])
