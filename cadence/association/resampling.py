"""Fewer ways out of many, without bias.

Optimal resampling for discrete states (Fearnhead and Clifford, "On-line inference for hidden Markov models via particle
filters", 2003): what weighs enough is kept as it is, the rest is drawn by stratified sampling and shares one weight. No way is
kept twice, and each weight is right in expectation.
"""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def resample(weight: Floats, num: int, uniform: float) -> tuple[NDArray[np.int64], Floats]:
    """At most `num` of the candidates.

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
    drawn = light[_stratified(weight[light], num - int(is_kept.sum()), uniform)]
    index = np.concatenate([used[is_kept], drawn])
    new = np.concatenate([weight[used[is_kept]], np.full(len(drawn), level)])
    order = np.argsort(index, kind="stable")
    return index[order], new[order] / new.sum()


def threshold(weight: Floats, num: int) -> float:
    """The weight c with sum(min(weight / c, 1)) = num: heavier candidates are kept, lighter ones drawn with chance w / c."""
    ordered = np.sort(weight)
    num_light = np.arange(len(weight) - num + 1, len(weight) + 1)
    level = np.cumsum(ordered)[num_light - 1] / (num - (len(weight) - num_light))
    is_heavy = np.append(ordered[num_light[:-1]] >= level[:-1], True)
    return float(level[int(is_heavy.argmax())])


def _stratified(weight: Floats, num: int, uniform: float) -> NDArray[np.int64]:
    """Indices of `num` systematic draws: no candidate twice, as none outweighs one share."""
    edges = np.cumsum(weight)
    points = (np.arange(num) + uniform) / num * edges[-1]
    index = np.unique(np.searchsorted(edges, points, side="right"))
    return np.asarray(np.minimum(index, len(weight) - 1), dtype=np.int64)
