"""Draws by weight: evenly spread ones, and few weighted candidates out of many, without bias."""

import numpy as np

from cadence.arrays import Float64s, Int64s


def candidates_at(weight: Float64s, share: Float64s) -> Int64s:
    """The candidate [K] into which each share in [0, 1) of the cumulated weights [M] falls; never one without weight."""
    edges = np.cumsum(weight)
    last_used = int(np.flatnonzero(weight > 0)[-1])
    found = np.searchsorted(edges, share * edges[-1], side="right")
    return np.asarray(np.minimum(found, last_used), dtype=np.int64)


def effective_number(weight: Float64s) -> float:
    """How many of equal weight tell as much as those of weights [K], which need not sum to one (Kish 1965); 0 without any."""
    squared = float(np.square(weight).sum())
    return float(weight.sum()) ** 2 / squared if squared > 0 else 0.0


def systematic(weight: Float64s, num: int, uniform: float) -> Int64s:
    """Indices [num], ascending, evenly spaced along the cumulated weights [M].

    A candidate is drawn within one of its share of `num` times (systematic resampling: Kitagawa, "Monte Carlo filter and
    smoother for non-Gaussian nonlinear state space models", 1996). Weights need not sum to one.

    Args:
        weight: [M] non-negative, not all zero.
        num: how many to draw.
        uniform: a random number in [0, 1), which decides all draws.
    """
    return candidates_at(weight, (np.arange(num) + uniform) / num)


def resample(weight: Float64s, num: int, uniform: float) -> tuple[Int64s, Float64s]:
    """At most `num` of the candidates, no one twice, each weight right in expectation.

    Optimal resampling for discrete states (Fearnhead and Clifford, "On-line inference for hidden Markov models via particle
    filters", 2003): what weighs enough is kept as it is, the rest is drawn systematically and shares one weight.

    Args:
        weight: [W] weights that sum to one.
        num: how many to keep.
        uniform: a random number in [0, 1), which decides all draws.

    Returns:
        Indices in ascending order, and the new weights, which sum to one.
    """
    used = np.flatnonzero(weight > 0)
    if len(used) <= num:
        return used, weight[used] / weight[used].sum()
    level = threshold(weight[used], num)
    is_kept = weight[used] >= level
    light = used[~is_kept]
    # none of the light ones outweighs one share: two points can meet in one only by rounding
    drawn = light[np.unique(systematic(weight[light], num - int(is_kept.sum()), uniform))]
    index = np.concatenate([used[is_kept], drawn])
    new = np.concatenate([weight[used[is_kept]], np.full(len(drawn), level)])
    order = np.argsort(index, kind="stable")
    return index[order], new[order] / new.sum()


def threshold(weight: Float64s, num: int) -> float:
    """The weight c with sum(min(weight / c, 1)) = num: heavier candidates are kept, lighter ones drawn with chance w / c."""
    ordered = np.sort(weight)
    num_light = np.arange(len(weight) - num + 1, len(weight) + 1)
    level = np.cumsum(ordered)[num_light - 1] / (num - (len(weight) - num_light))
    is_heavy = np.append(ordered[num_light[:-1]] >= level[:-1], True)
    return float(level[int(is_heavy.argmax())])
