"""The ground of a mission: silence tells places on it from each other, and says nothing of what lies beyond.

Hypotheses stray, and most where no sensor ever comes. Nothing is seen there, so silence alone would count those most that
left the mission's ground: a prior that is wrong where nobody looked would be made more wrong by every look elsewhere.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely

from cadence.arrays import Float64s

WIDTH = 3.0
"""Ground is at least so many times as wide as sensors see: around one that stands there must be places that it does not see."""
_BLOCK = 256


@dataclass(frozen=True, eq=False)
class Ground:
    """Where sensors stood and agents were seen [P, 2] by time_s [P], not decreasing; what lies between is the ground.

    It is the convex hull, and at least as large as a disc of `least_radius_m`.
    """

    time_s: Float64s
    position_m: Float64s
    least_radius_m: float

    def until(self, at_s: float) -> shapely.Geometry | None:
        """The ground of all places until `at_s`; None before the first one.

        What sensors do later would tell of detections that were not made yet.
        """
        num = int(np.searchsorted(self.time_s, at_s, "right"))
        if num == 0:
            return None
        whole = num // _BLOCK
        hull = _hull(np.concatenate([self._corners_m[whole], self.position_m[whole * _BLOCK : num]]))
        ground = hull.buffer(max(0.0, self.least_radius_m - float(np.sqrt(hull.area / np.pi))))
        shapely.prepare(ground)
        return ground

    @cached_property
    def _corners_m(self) -> list[Float64s]:
        """Of the hulls of the first 0, 1, 2, ... whole blocks of places."""
        found = [np.zeros((0, 2))]
        for begin in range(0, len(self.time_s) - _BLOCK + 1, _BLOCK):
            places_m = np.concatenate([found[-1], self.position_m[begin : begin + _BLOCK]])
            found.append(shapely.get_coordinates(_hull(places_m)))
        return found


def without_beyond(log_missed: Float64s, place_m: Float64s, ground: shapely.Geometry) -> Float64s:
    """Log probabilities [K, ...] of hypotheses at places [K, ..., 2], beyond the ground as the mean probability of those on it.

    So the share of the weights that lies on the ground stays what it was. Where nobody is on it nothing is said.
    """
    is_on = shapely.contains_xy(ground, place_m[..., 0], place_m[..., 1])
    num_on = is_on.sum(axis=0)
    mean = np.where(is_on, np.exp(log_missed), 0.0).sum(axis=0) / np.maximum(num_on, 1)
    beyond = np.log(np.where(num_on > 0, mean, 1.0))
    return np.where(is_on | ~np.isfinite(place_m[..., 0]), log_missed, beyond)


def _hull(place_m: Float64s) -> shapely.Geometry:
    return shapely.convex_hull(shapely.multipoints(place_m))
