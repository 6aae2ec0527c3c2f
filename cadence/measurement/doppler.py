"""Which returns of a radar stand: of one scan all that fit one motion of the radar itself.

What stands moves past a radar as the radar moves: its range rate is minus the radar's own velocity along the line of sight. So
most returns of a scan among walls and trees lie on one sine over the bearing, and the motion that most of them fit is the
radar's own: Kellner, Barjenbruch, Klappstein, Dickmann and Dietmayer, "Instantaneous ego-motion estimation using Doppler
radar", IEEE Conference on Intelligent Transportation Systems, 2013. Neither a pose of the radar nor the sign of its range rates
is needed. One ship of many returns, or a convoy, fits one motion as well: it lies in one direction, surroundings do not.
"""

import itertools
from typing import Final

import numpy as np

from cadence.arrays import Bools, Float64s

_LEAST: Final = 5
"""Returns of a scan that must agree."""
_SHARE: Final = 0.5
_MOST_PAIRS: Final = 200
_LEAST_SPREAD_RAD: Final = 0.5
"""In bearing, of the returns that tell of a radar that moves: 30 degrees."""
_STEADY: Final = 0.2
"""Two lines of sight that differ by less (a sine) tell no motion across them."""


def are_static(line_of_sight: Float64s, range_rate_mps: Float64s, tolerance_mps: float) -> Bools:
    """Which returns [N] of one scan stand; none where fewer than five, or than half of them, agree.

    Args:
        line_of_sight: [N, 2] where each return is, x and y of a unit vector in the radar's axes (shorter above or below).
        range_rate_mps: [N], of either sign.
        tolerance_mps: by which range rates may differ from what one motion makes.
    """
    nothing = np.zeros(len(range_rate_mps), np.bool_)
    known = np.flatnonzero(np.isfinite(range_rate_mps) & np.isfinite(line_of_sight).all(axis=1))
    if len(known) < _LEAST:
        return nothing
    ways, rates = line_of_sight[known], range_rate_mps[known]
    misses = np.abs(_motions(ways, rates) @ ways.T - rates)
    best = int((misses < tolerance_mps).sum(axis=1).argmax())
    fits = misses[best] < tolerance_mps
    if fits.sum() < max(_LEAST, _SHARE * len(known)):
        return nothing
    motion, *_ = np.linalg.lstsq(ways[fits], rates[fits], rcond=1e-3)
    if np.hypot(*motion) > tolerance_mps and _spread_rad(ways[fits]) < _LEAST_SPREAD_RAD:
        return nothing
    nothing[known[np.abs(ways @ motion - rates) < tolerance_mps]] = True
    return nothing


def _spread_rad(ways: Float64s) -> float:
    """How far apart in bearing lines of sight [N, 2] are, but for a few of them."""
    angle = np.arctan2(ways[:, 1], ways[:, 0])
    apart = np.angle(np.exp(1j * (angle - np.angle(np.exp(1j * angle).mean()))))
    return float(np.diff(np.quantile(apart, [0.05, 0.95]))[0])


def _motions(ways: Float64s, rates: Float64s) -> Float64s:
    """Motions [M, 2] to try: none, and those that pairs of returns [N] tell, evenly some of all pairs."""
    pairs = np.array(list(itertools.combinations(range(len(rates)), 2)))
    pairs = pairs[np.linspace(0, len(pairs) - 1, min(_MOST_PAIRS, len(pairs))).round().astype(np.int64)]
    one, other = ways[pairs[:, 0]], ways[pairs[:, 1]]
    across = one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]
    is_told = np.abs(across) > _STEADY
    one, other, across = one[is_told], other[is_told], across[is_told]
    rate, of_other = rates[pairs[is_told, 0]], rates[pairs[is_told, 1]]
    x = (rate * other[:, 1] - of_other * one[:, 1]) / across
    y = (of_other * one[:, 0] - rate * other[:, 0]) / across
    return np.vstack([np.zeros((1, 2)), np.column_stack([x, y])])
