"""Numbers out of weighted stories, each with its Monte Carlo error: probabilities, and laws of times and places.

K stories of unequal weight tell as much as 1 / sum w² of equal weight (their effective number, Kish 1965). Errors are those of
having drawn finitely many stories, nothing else: whether the stories are right is for the pages of evidence to say.
"""

import math
from dataclasses import dataclass

import numpy as np

from cadence.arrays import Bools, Float64s
from cadence.resampling import effective_number

LEVEL = 0.95
"""Of Monte Carlo intervals."""
_Z = 1.959963984540054
_ONE_SIDED = 1.0 - LEVEL


@dataclass(frozen=True)
class Probability:
    """Share of the weight of the stories in which something is so, and the 95 % interval of what more stories would say.

    num_effective  stories of equal weight that would tell as much
    """

    value: float
    low: float
    high: float
    num_effective: float


@dataclass(frozen=True)
class Law:
    """How a number is distributed over the stories in which there is one.

    low, median, high        5, 50 and 95 % quantile
    median_low, median_high  95 % Monte Carlo interval of the median
    num_effective            stories of equal weight that would tell as much
    """

    low: float
    median: float
    high: float
    median_low: float
    median_high: float
    num_effective: float


def probability(weight: Float64s, is_so: Bools) -> Probability:
    """Probability of what `is_so` [K] in stories of weights [K].

    The interval is Wilson's; where all or no stories agree it is one-sided and exact (Clopper and Pearson), the rule of three:
    of 300 stories without it, less than 1 %.
    """
    total = float(weight.sum())
    if not total > 0:
        return Probability(math.nan, 0.0, 1.0, 0.0)
    share, num = float(weight[is_so].sum()) / total, effective_number(weight)
    # sums of weights that miss one by a rounding error still mean all
    if not is_so[weight > 0].any():
        return Probability(0.0, 0.0, 1.0 - _ONE_SIDED ** (1.0 / num), num)
    if is_so[weight > 0].all():
        return Probability(1.0, _ONE_SIDED ** (1.0 / num), 1.0, num)
    return Probability(share, *wilson(share, num), num)


def wilson(share: float, num: float) -> tuple[float, float]:
    """The 95 % interval of a probability of which `share` was seen in `num` draws (Wilson 1927)."""
    scale = 1.0 + _Z**2 / num
    middle = (share + _Z**2 / (2.0 * num)) / scale
    half = _Z * math.sqrt(share * (1.0 - share) / num + _Z**2 / (4.0 * num**2)) / scale
    return max(middle - half, 0.0), min(middle + half, 1.0)


def law(weight: Float64s, value: Float64s, give_or_take: Float64s | None = None) -> Law | None:
    """Law of `value` [K] over stories of weights [K], those left out in which it is NaN; None where it is in all.

    Where each value is known to within `give_or_take` [K] only, half of the weight lies at either end of that.
    """
    is_there = np.isfinite(value) & (weight > 0)
    if not is_there.any():
        return None
    weight, value = weight[is_there], value[is_there]
    num = effective_number(weight)
    if give_or_take is not None:
        value = np.concatenate([value - give_or_take[is_there], value + give_or_take[is_there]])
        weight = np.concatenate([weight, weight])
    levels = np.array([0.05, 0.5, 0.95, *wilson(0.5, num)])
    low, median, high, median_low, median_high = quantiles(weight, value, levels).tolist()
    return Law(low, median, high, median_low, median_high, num)


def quantiles(weight: Float64s, value: Float64s, levels: Float64s) -> Float64s:
    """Quantiles [Q] of `value` [K] under weights [K], linear between the middles of the weights' steps (Hazen's rule)."""
    order = np.argsort(value, kind="stable")
    share = weight[order] / weight.sum()
    middle = np.cumsum(share) - 0.5 * share
    found: Float64s = np.interp(levels, middle, value[order])
    return found
