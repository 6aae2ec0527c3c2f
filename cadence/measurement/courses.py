"""Velocities of a target where it was detected, by its neighbours; where a track is cut."""

from typing import Final

import numpy as np

from cadence.arrays import Bools, Float64s

_MAX_GAPS: Final = 4.0
"""Detections further apart than so many typical gaps say nothing of each other's noise."""
_REACH: Final = 2


def begins_burst(time_s: Float64s, gap_s: float) -> Bools:
    """Where a stretch [N] without long gaps begins, by times [N] and the typical gap."""
    return np.asarray(np.diff(time_s, prepend=-np.inf) > _MAX_GAPS * gap_s)


def velocities(time_s: Float64s, position_m: Float64s, gap_s: float) -> tuple[Float64s, Float64s]:
    """Velocities [N, 2] between neighbours in the burst, the detection itself left out, and the time between these [N].

    Both are zero where there are no two neighbours.
    """
    num = np.arange(len(time_s))
    burst = np.cumsum(begins_burst(time_s, gap_s))
    low = np.maximum(num - _REACH, np.searchsorted(burst, burst, "left"))
    high = np.minimum(num + _REACH, np.searchsorted(burst, burst, "right") - 1)
    low, high = np.where((low == num) & (high > num), num + 1, low), np.where((high == num) & (low < num), num - 1, high)
    base_s = time_s[high] - time_s[low]
    is_known = base_s > 0
    way_m = position_m[high] - position_m[low]
    return np.where(is_known[:, None], way_m / np.where(is_known, base_s, 1.0)[:, None], 0.0), base_s
