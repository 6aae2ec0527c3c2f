"""Where a sensor looks and how likely it detects there: curves over distance, areas fixed to the sensor or to the ground."""

from dataclasses import dataclass

import numpy as np

from cadence.arrays import Bools, Float64s


@dataclass(frozen=True, eq=False)
class DetectionCurve:
    """Probability of detection over distance: straight between its points, nothing beyond the last one.

    distance     [M] not negative, increasing; metres, or shares of the range that a look states
    probability  [M] from 0 to 1
    """

    distance: Float64s
    probability: Float64s

    def __post_init__(self) -> None:
        if self.distance.ndim != 1 or self.distance.shape != self.probability.shape or len(self.distance) < 1:
            raise ValueError("a curve of P(detect) is pairs of a distance and a probability")
        if not (np.diff(self.distance) > 0).all() or not self.distance[0] >= 0:
            raise ValueError("distances of a curve of P(detect) must increase from 0 or more")
        if not ((self.probability >= 0) & (self.probability <= 1)).all():
            least, most = self.probability.min(), self.probability.max()
            raise ValueError(f"P(detect) must lie between 0 and 1, got {least:g} to {most:g}")

    def __call__(self, distance: Float64s) -> Float64s:
        """P at distances of any shape."""
        found: Float64s = np.interp(distance, self.distance, self.probability, right=0.0)
        return found

    @property
    def reach(self) -> float:
        """The distance beyond which nothing is detected."""
        seen = np.flatnonzero(self.probability > 0)
        if not len(seen):
            return 0.0
        return float(self.distance[min(seen[-1] + 1, len(self.distance) - 1)])

    @property
    def half(self) -> float:
        """The farthest of its points at which it detects half as surely as at best."""
        return float(self.distance[np.flatnonzero(self.probability >= 0.5 * self.probability.max())[-1]])


@dataclass(frozen=True, eq=False)
class Sector:
    """What lies within `half_angle_rad` of the way that a sensor faces; a camera's view seen from above."""

    half_angle_rad: float

    def __post_init__(self) -> None:
        if not 0 < self.half_angle_rad <= np.pi:
            angle_deg = np.degrees(2.0 * self.half_angle_rad)
            raise ValueError(f"a sector must open by more than 0 and at most 360 degrees, got {angle_deg:g}: it has no area")

    def holds(self, offset_m: Float64s, heading_rad: Float64s) -> Bools:
        """Which offsets [..., L, 2] from sensors that face `heading_rad` [L] (from east to north) it holds [..., L]."""
        bearing = np.arctan2(offset_m[..., 1], offset_m[..., 0])
        away = np.abs((bearing - heading_rad + np.pi) % (2 * np.pi) - np.pi)
        inside: Bools = away <= self.half_angle_rad
        return inside


@dataclass(frozen=True, eq=False)
class Polygon:
    """An area [N, 2] in metres: x ahead of the sensor and y to its left, or, fixed to the ground, of the mission frame."""

    corners_m: Float64s
    is_on_ground: bool = False

    def __post_init__(self) -> None:
        if self.corners_m.ndim != 2 or self.corners_m.shape[1] != 2 or len(self.corners_m) < 3:
            raise ValueError("a polygon needs three corners [x, y] at least")
        import shapely  # settings hold footprints, and are read where nothing heavy may be loaded

        area = shapely.Polygon(self.corners_m)
        if not (area.is_valid and area.area > 0):
            raise ValueError("a polygon whose area is zero, or whose edges cross")

    def holds(self, offset_m: Float64s, heading_rad: Float64s) -> Bools:
        """As `Sector.holds`; of a polygon on the ground offsets are positions in the mission frame."""
        import shapely

        x, y = offset_m[..., 0], offset_m[..., 1]
        if not self.is_on_ground:
            cos, sin = np.cos(heading_rad), np.sin(heading_rad)
            x, y = cos * x + sin * y, cos * y - sin * x
        inside: Bools = shapely.intersects_xy(shapely.Polygon(self.corners_m), x, y)
        return inside


Area = Sector | Polygon
"""What limits a footprint beside the curve; a disc has none."""


def detection_probability(
    curve: DetectionCurve, area: Area | None, position_m: Float64s, sensor_m: Float64s, heading_rad: Float64s, range_m: Float64s
) -> Float64s:
    """P(detect) [..., L] of agents at positions [..., L, 2], one a look.

    Args:
        curve: over distance, in units of `range_m`.
        area: what limits it.
        position_m: of the agents.
        sensor_m: [L, 2] of the sensors.
        heading_rad: [L] which way they face.
        range_m: [L] unit of the curve's distances; nothing is detected where it is zero.
    """
    offset_m = position_m - sensor_m
    distance = np.hypot(offset_m[..., 0], offset_m[..., 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        found = curve(np.where(range_m > 0, distance / range_m, np.inf))
    if area is None:
        return found
    is_ground = isinstance(area, Polygon) and area.is_on_ground
    return np.where(area.holds(position_m if is_ground else offset_m, heading_rad), found, 0.0)
