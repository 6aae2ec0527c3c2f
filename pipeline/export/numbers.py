"""Numbers that describe weighted hypotheses: spread, agreement, modes, envelopes, occupancy."""

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from cadence.arrays import Float64s

_MODE_SHARE = 0.1
"""Smaller groups of hypotheses are stragglers, not modes."""


def spread_m(position_m: Float64s, weight: Float64s) -> float:
    """Root mean square distance of positions [K, 2] to their weighted mean."""
    return float(np.sqrt(weight @ np.sum((position_m - weight @ position_m) ** 2, axis=-1)))


def covariance_m2(position_m: Float64s, weight: Float64s) -> Float64s:
    """Weighted covariance [2, 2] of positions [K, 2]."""
    away = position_m - weight @ position_m
    return np.asarray(np.einsum("k,ki,kj->ij", weight, away, away))


def weight_entropy(weight: Float64s) -> float:
    """Entropy of weights [K] over its largest value: 1 where all count the same, 0 where only one counts."""
    positive = weight[weight > 0]
    if len(weight) < 2:
        return 0.0
    return float(np.clip(-(positive @ np.log(positive)) / np.log(len(weight)), 0.0, 1.0))


def entropy_bits(probability: Float64s) -> float:
    """Entropy of probabilities [N] in bits: 0 where one is certain, 1 for a coin."""
    positive = probability[probability > 0]
    return max(float(-(positive @ np.log2(positive))), 0.0) if len(positive) else 0.0


def count_modes(position_m: Float64s, weight: Float64s) -> int:
    """Separate groups among positions [K, 2]: links up to three typical distances between neighbours, a tenth of the weight."""
    if len(position_m) < 3:
        return len(position_m) if len(position_m) < 2 else 1
    distance = np.linalg.norm(position_m[:, None] - position_m[None], axis=-1)
    # The distance to the third neighbour: pairs that happen to lie close say little about the density.
    neighbour = np.sort(distance, axis=1)[:, min(3, len(distance) - 1)]
    _, group = connected_components(csr_array(distance <= 3.0 * np.median(neighbour)), directed=False)
    return int(np.count_nonzero(np.bincount(group, weights=weight) >= _MODE_SHARE))


def weighted_quantile(value: Float64s, weight: Float64s, share: float) -> Float64s:
    """The smallest of the values [K, ...] below or at which lies at least `share` of the weight [K]."""
    order = np.argsort(value, axis=0, kind="stable")
    below = np.cumsum(weight[order], axis=0)
    index = np.argmax(below >= share - 1e-9, axis=0)
    return np.asarray(np.take_along_axis(np.take_along_axis(value, order, 0), index[None], 0)[0])
