"""P(detect) over distance out of looks at agents whose place is known: never rising, and said to be unknown where little tells.

Which looks those are decides whether the curve is right: an agent's place must be known whether or not this look detected it.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import isotonic_regression

from cadence.arrays import Bools, Float64s
from cadence.evidence.footprints import DetectionCurve

LEAST_LOOKS, LEAST_HITS = 30, 8
_PER_BIN = 4
_MOST_BINS = 24
_TAIL_BINS = 3
"""Beyond the last quantile hits are rare and misses many: the curve must not be drawn out there."""
_FAR = 1.5


@dataclass(frozen=True, eq=False)
class FittedCurve:
    """A curve, and how many looks and detections it rests on."""

    curve: DetectionCurve
    num_looks: int
    num_hits: int


def fit_curve(distance: Float64s, is_hit: Bools) -> FittedCurve | None:
    """The never rising curve of greatest likelihood over bins of distance; None where there is too little to tell.

    Isotonic regression (Barlow, Bartholomew, Bremner, Brunk, 1972) of the shares of hits, with half a hit and half a miss added
    to each bin (Jeffreys' prior), so that no short row of hits makes a sensor certain. Beyond the farthest hit the curve falls
    to zero.

    Args:
        distance: [L] of agents from sensors, metres or shares of the looks' ranges.
        is_hit: [L] which looks detected them.
    """
    is_known = np.isfinite(distance)
    distance, is_hit = distance[is_known], is_hit[is_known]
    num_looks, num_hits = len(distance), int(is_hit.sum())
    if num_looks < LEAST_LOOKS or num_hits < LEAST_HITS or num_hits > num_looks - LEAST_HITS:
        return None
    farthest = float(distance[is_hit].max())
    inside = distance <= _FAR * farthest
    shares = np.linspace(0.0, 1.0, min(_MOST_BINS, max(2, num_hits // _PER_BIN)) + 1)
    hit_at = np.quantile(distance[is_hit], shares[1:-1])
    tail = np.linspace(hit_at[-1], farthest, _TAIL_BINS + 1)[1:]
    edges = np.unique(np.concatenate([[0.0], hit_at, tail, [_FAR * farthest]]))
    number = np.clip(np.searchsorted(edges, distance[inside], "right") - 1, 0, len(edges) - 2)
    count = np.bincount(number, minlength=len(edges) - 1).astype(np.float64)
    hits = np.bincount(number, weights=is_hit[inside], minlength=len(edges) - 1)
    share = isotonic_regression((hits + 0.5) / (count + 1.0), weights=count + 1.0, increasing=False).x
    middle = 0.5 * (edges[1:] + edges[:-1])
    # the last bin holds misses only: beyond the farthest hit nothing is known to be seen
    points, values = np.append(middle[:-1], max(farthest, middle[-2] * 1.001)), np.append(share[:-1], 0.0)
    first = points > 0
    return FittedCurve(DetectionCurve(points[first], np.clip(values[first], 0.0, 1.0)), num_looks, num_hits)
