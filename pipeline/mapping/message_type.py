"""A known message type: where it keeps position, time, covariance and identity, and which of them are to be believed."""

from dataclasses import dataclass, replace
from typing import Final, Literal

Paths = tuple[str, ...]
"""Alternatives (a type's versions and flattened forms): the first that a message has, and has filled in, is used."""

TIME_PATHS: Paths = ("header.stamp", "timestamp", "stamp")
FRAME_PATHS: Paths = ("header.frame_id", "frame_id")

PATHS: Final = (
    "x", "y", "z", "latitude", "longitude", "altitude", "covariance", "covariance_type", "sigma", "time", "frame_id", "agent",
    "sensor", "score", "range", "bearing", "elevation", "range_rate", "range_sigma", "bearing_sigma", "elevation_sigma",
    "range_rate_sigma", "pixel_x", "pixel_y", "box_width", "box_height",
)  # fmt: skip
"""The fields of a message type that are message paths."""

AngleUnit = Literal["rad", "deg"]
OWN_SENSOR: Final = "{sensor}"
"""An observer that is the sensor of each measurement."""
BearingConvention = Literal["math", "compass"]
"""What a bearing counts from, and which way: from x (ahead, or east) towards y; or from north (or ahead) clockwise."""

VerticalDatum = Literal["ellipsoid", "sea level", "ground", "start", "frame", "not stated"]
"""What heights count from: the WGS 84 ellipsoid, mean sea level, the ground below, where it began, the zero of their frame."""


@dataclass(frozen=True)
class MessageType:
    """Message paths of one type: x and y (metres), latitude and longitude (degrees), or range and bearing.

    A message may lack all others.

    covariance       of numbers, row-major, x (east) and y (north) first, m²: 1, 4, 9 or 36 of them, 6 or 21 of an upper
                     triangle, or 3 of a diagonal
    covariance_type  0 or a word with UNKNOWN: the covariance says nothing
    sigma            standard deviation of x and y in metres, where there is no covariance
    range, bearing, elevation, range_rate  what a sensor measured from where it was, and their standard deviations (..._sigma)
    range_sigma_m, bearing_sigma_deg, elevation_sigma_deg, range_rate_sigma_mps  where messages state none
    pixel_x, pixel_y, box_width, box_height  what a camera saw: right and down from the corner of its image, and how large
    axes             zero where x, y and z are along frame_convention, by what the message says
    origin_latitude, origin_longitude  where on the earth x and y count from, where the type says so
    bearing_unit     of bearing, elevation and their standard deviations
    bearing_convention  what a bearing counts from
    observer         from whose poses was measured, by default; "{sensor}": those of the sensor that a message names
    where            conditions (see `conditions`); those hold whose fields a message has
    alternatives     of positions; "first": the first that a message has. "filled": item by item the first that is not zero.
                     "all": every one of them holds positions of its own
    json_text        the field whose text is JSON, in which all paths begin
    frame_convention axes of x, y and z
    vertical_datum   what z or altitude counts from, by the type's definition
    is_north_first   the covariance has y (north) before x (east)
    role             what such messages hold, whatever their topic is called; None: the topic tells
    names_agents     messages always have room for the identity of what was seen
    is_suggested     whether such messages are used without being told
    """

    schemas: tuple[str, ...]
    x: Paths = ()
    y: Paths = ()
    z: Paths = ()
    latitude: Paths = ()
    longitude: Paths = ()
    altitude: Paths = ()
    covariance: Paths = ()
    covariance_type: Paths = ()
    sigma: Paths = ()
    range: Paths = ()
    bearing: Paths = ()
    elevation: Paths = ()
    range_rate: Paths = ()
    range_sigma: Paths = ()
    bearing_sigma: Paths = ()
    elevation_sigma: Paths = ()
    range_rate_sigma: Paths = ()
    pixel_x: Paths = ()
    pixel_y: Paths = ()
    box_width: Paths = ()
    box_height: Paths = ()
    origin_latitude: Paths = ()
    origin_longitude: Paths = ()
    axes: Paths = ()
    range_sigma_m: float | None = None
    bearing_sigma_deg: float | None = None
    elevation_sigma_deg: float | None = None
    range_rate_sigma_mps: float | None = None
    bearing_unit: AngleUnit = "rad"
    bearing_convention: BearingConvention = "math"
    observer: str | None = None
    where: tuple[str, ...] = ()
    time: Paths = TIME_PATHS
    frame_id: Paths = FRAME_PATHS
    agent: Paths = ()
    sensor: Paths = ()
    score: Paths = ()
    alternatives: Literal["first", "filled", "all"] = "first"
    json_text: str = ""
    frame_convention: Literal["enu", "ned"] = "enu"
    vertical_datum: VerticalDatum = "not stated"
    is_north_first: bool = False
    role: Literal["detections", "truth"] | None = None
    names_agents: bool = False
    is_suggested: bool = True

    @property
    def is_array(self) -> bool:
        """Whether a message may hold several positions."""
        return any("[:]" in path for path in (*self.x, *self.latitude, *self.range, *self.bearing, *self.pixel_x))

    @property
    def is_polar(self) -> bool:
        """Whether it states ranges, bearings or pixels and no positions."""
        return bool(self.range or self.bearing or self.pixel_x)


def metric(schema: str, *points: str) -> MessageType:
    """Positions in metres at alternative paths of something with x, y and z ("" for the message itself)."""
    x, y, z = (tuple(f"{point}.{axis}".lstrip(".") for point in points) for axis in "xyz")
    return MessageType((schema,), x, y, z, vertical_datum="frame")


def geodetic(schema: str, point: str = "", vertical_datum: VerticalDatum = "not stated") -> MessageType:
    """Positions in degrees with the fields of a fix, in the field `point` of a message ("position.")."""
    return MessageType(
        (schema,),
        latitude=(f"{point}latitude",),
        longitude=(f"{point}longitude",),
        altitude=(f"{point}altitude",),
        covariance=(f"{point}position_covariance",),
        covariance_type=(f"{point}position_covariance_type",),
        vertical_datum=vertical_datum,
    )


def stamped_items(known: MessageType, item: str) -> MessageType:
    """The type whose items ("detections[:].") have stamps and frames of their own; where they are empty, the message's."""
    return replace(
        known,
        time=(*(f"{item}{path}" for path in TIME_PATHS), *TIME_PATHS),
        frame_id=(*(f"{item}{path}" for path in FRAME_PATHS), *FRAME_PATHS),
    )
