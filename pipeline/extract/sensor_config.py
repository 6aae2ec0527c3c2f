"""The settings of one `[[extract.sensors]]` entry: what a sensor looks at, when, and how surely it detects there."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from cadence.evidence.footprints import Area, DetectionCurve, Polygon, Sector


@dataclass(frozen=True)
class SensorConfig:
    """One sensor, or several alike, whose silence counts: where it looked and saw nothing.

    sensor       its name in poses and detections; `*` stands for any part of a name
    detects_as   its name in detections, where it is another one
    position     [x, y] in metres of the mission frame of a sensor that stands; by default it is where its poses are
    probability  of a detection in one look: a number, or pairs [distance in metres, probability]; by default fitted from the
                 log's own detections, where they tell
    range_m      where a probability that is a number ends
    angle_deg    of a sector or a camera's view, seen from above; by default all around
    heading_deg  which way a sector or polygon faces, clockwise from north; by default the way that the sensor moves
    polygon      corners [x, y] in metres, instead of range and angle: x ahead and y to the left of the sensor, or on the ground
    fixed_to     what the polygon is fixed to
    on           pairs [from, to] of seconds from the beginning of the log; by default it always looks
    every_s      time from one look to the next that tells something new; by default that between poses
    is_hidden    obstacles hide what is behind them
    """

    sensor: str
    detects_as: str | None = None
    position: tuple[float, float] | None = None
    probability: float | tuple[tuple[float, float], ...] | None = None
    range_m: float | None = None
    angle_deg: float | None = None
    heading_deg: float | None = None
    polygon: tuple[tuple[float, float], ...] = ()
    fixed_to: Literal["sensor", "ground"] = "sensor"
    on: tuple[tuple[float, float], ...] = ()
    every_s: float | None = None
    is_hidden: bool = False

    def __post_init__(self) -> None:
        try:
            self._check()
        except ValueError as error:
            raise ValueError(f"sensor {self.sensor!r}: {error}") from error

    def _check(self) -> None:
        if self.range_m is not None and not self.range_m > 0:
            raise ValueError(f"a footprint with range_m = {self.range_m:g} has no area; give a range above zero")
        if self.every_s is not None and not self.every_s > 0:
            raise ValueError(f"every_s must be above zero, got {self.every_s:g}")
        if isinstance(self.probability, float) and self.range_m is None and not self.polygon:
            raise ValueError(
                "a probability that is a number ends somewhere: give range_m or a polygon, or pairs with a distance"
            )
        if self.polygon and self.angle_deg is not None:
            raise ValueError("give a polygon or angle_deg, not both")
        if self.position is not None and self.every_s is None:
            raise ValueError("it stands, and nothing says how often it looks: give every_s")
        if any(not last > first for first, last in self.on):
            raise ValueError("on: each pair needs an end after its beginning")
        curve, _ = self.stated_curve(), self.area()
        if curve is not None and not curve.reach > 0:
            raise ValueError("it never detects anything (probability is zero everywhere); leave it out")

    def stated_curve(self) -> DetectionCurve | None:
        """The stated P(detect) over metres; None where it is to be fitted."""
        if self.probability is None:
            return None
        if isinstance(self.probability, float):
            return DetectionCurve(np.array([0.0, self._reach_m()]), np.full(2, self.probability))
        pairs = np.array(self.probability, dtype=np.float64).reshape(-1, 2)
        return DetectionCurve(pairs[:, 0], pairs[:, 1])

    def _reach_m(self) -> float:
        if self.range_m is not None:
            return self.range_m
        about = np.zeros(2) if self.fixed_to == "sensor" else np.array(self.about_m())
        return 1.001 * float(np.hypot(*(np.array(self.polygon) - about).T).max())

    def about_m(self) -> tuple[float, float]:
        """Where a sensor that stands is; nobody knows of one that watches an area on the ground: in its middle."""
        if self.position is not None or not self.polygon:
            return self.position or (0.0, 0.0)
        x, y = np.array(self.polygon).mean(axis=0).tolist()
        return x, y

    def area(self) -> Area | None:
        """What limits the footprint beside the curve."""
        if self.polygon:
            return Polygon(np.array(self.polygon, dtype=np.float64), self.fixed_to == "ground")
        return None if self.angle_deg is None else Sector(np.radians(0.5 * self.angle_deg))
