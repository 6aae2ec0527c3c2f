"""Single positions far off their agent's track: recorder faults, such as a ship that is in another country for a second."""

import numpy as np

from cadence.arrays import Bools
from pipeline.extract.positions import Positions

_MIN_DISTANCE_M = 1000.0
_MIN_RATIO = 10.0


def is_spike(positions: Positions, max_speed_mps: float) -> Bools:
    """Which rows [N], sorted by time and in metres, nothing could have reached and left again.

    Such a row lies over 1 km, and over ten times as far as its agent's neighbouring rows from each other, from both of them,
    and the way there and the way back would both need more than `max_speed_mps`: noise on close stamps is no spike. The
    first and the last row of an agent, and rows of unknown origin, are never one.
    """
    found = np.zeros(len(positions), dtype=np.bool_)
    for rows in positions.agents.rows():
        if len(rows) < 3:
            continue
        place = positions.first[rows] + 1j * positions.second[rows]
        time_s = (positions.time_ns[rows] - positions.time_ns[rows[0]]) * 1e-9
        step_m, step_s = np.abs(np.diff(place)), np.diff(time_s)
        is_fast = step_m > max_speed_mps * step_s
        least_m = np.minimum(step_m[:-1], step_m[1:])
        is_far = least_m > np.maximum(_MIN_DISTANCE_M, _MIN_RATIO * np.abs(place[2:] - place[:-2]))
        found[rows[1:-1]] = is_fast[:-1] & is_fast[1:] & is_far
    return found
