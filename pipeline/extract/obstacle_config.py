"""Obstacles as a person states them: the table [extract.obstacles], and files of the same form."""

from dataclasses import dataclass
from pathlib import Path

Points = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class CircleSource:
    """A circle in the mission frame or on the earth.

    radius_m  radius in metres
    x_m, y_m  centre in the mission frame; or
    latitude_deg, longitude_deg  centre on the earth
    name      for people
    """

    radius_m: float
    x_m: float | None = None
    y_m: float | None = None
    latitude_deg: float | None = None
    longitude_deg: float | None = None
    name: str = ""

    def __post_init__(self) -> None:
        local = self.x_m is not None and self.y_m is not None
        geodetic = self.latitude_deg is not None and self.longitude_deg is not None
        given = sum(value is not None for value in (self.x_m, self.y_m, self.latitude_deg, self.longitude_deg))
        if given != 2 or not (local or geodetic):
            raise ValueError("a circle needs x_m and y_m, or latitude_deg and longitude_deg")


@dataclass(frozen=True)
class PolygonSource:
    """A polygon in the mission frame or on the earth.

    points_m, holes_m      corners [x, y] in metres of the mission frame, and of its holes; or
    points_deg, holes_deg  corners [latitude, longitude] in degrees, and of its holes
    name                   for people
    """

    points_m: Points = ()
    holes_m: tuple[Points, ...] = ()
    points_deg: Points = ()
    holes_deg: tuple[Points, ...] = ()
    name: str = ""

    def __post_init__(self) -> None:
        if bool(self.points_m) == bool(self.points_deg):
            raise ValueError("a polygon needs points_m, or points_deg")
        if (self.holes_m and not self.points_m) or (self.holes_deg and not self.points_deg):
            raise ValueError("the holes of a polygon need the unit of its points")


@dataclass(frozen=True)
class ObstacleSources:
    """Where obstacles come from; all of them together count.

    files       .toml (tables [[circles]] and [[polygons]]), GeoJSON, or an obstacles.json
    topics      occupancy grids to use, whatever their frame; without any, those in the mission frame that say what they are
    from_log    use what the log says: Metadata records `cadence.obstacles` and `mission`, occupancy grids
    threshold   cells of a grid are occupied from this value on, 0 to 100
    circles, polygons   stated in the configuration itself
    """

    files: tuple[Path, ...] = ()
    topics: tuple[str, ...] = ()
    from_log: bool = True
    threshold: float = 65.0
    circles: tuple[CircleSource, ...] = ()
    polygons: tuple[PolygonSource, ...] = ()
