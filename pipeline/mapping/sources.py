"""Sources: which topic and which of its fields hold detections, truth or poses, as the user configures them."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal, Protocol

from cadence.errors import ConfigError
from pipeline.mapping.conditions import parse_conditions
from pipeline.mapping.message_path import parse_path
from pipeline.mapping.message_type import PATHS, AngleUnit, BearingConvention, MessageType, VerticalDatum
from pipeline.mapping.message_types import MESSAGE_TYPES, type_of_schema

PLACEHOLDERS = ("agent", "sensor")
LOG_TIME = "log_time"
PUBLISH_TIME = "publish_time"

PATH_KEYS = {"agent": "agent_path", "sensor": "sensor_path"}
"""The keys of a source that state a message path under another name than the type's field; all others are named alike."""

_CHECKED = (
    "agent_path", "sensor_path", "x", "y", "z", "latitude", "longitude", "altitude", "covariance", "sigma", "score", "time",
    "frame_id", "range", "bearing", "elevation", "range_rate", "range_sigma", "bearing_sigma", "elevation_sigma",
    "range_rate_sigma", "pixel_x", "pixel_y", "box_width", "box_height",
)  # fmt: skip
_POSITIVE = (
    "sigma_m", "sigma_z_m", "range_sigma_m", "bearing_sigma_deg", "elevation_sigma_deg", "range_rate_sigma_mps", "pixel_sigma",
)  # fmt: skip
_MEASURED = {
    "range": "range_sigma_m", "bearing": "bearing_sigma_deg", "elevation": "elevation_sigma_deg",
    "range_rate": "range_rate_sigma_mps",
}  # fmt: skip
"""What a sensor may have measured, and the setting that says how exactly where messages do not."""
_OF_BEARINGS = ("is_static_used", "bearing_unit", "bearing_convention", "observer", "observer_x_m", "observer_latitude")
_OF_PIXELS = ("box_width", "box_height", "pixel_sigma", "camera_info")


HeightUnit = Literal["m", "ft", "FL"]
"""What z or altitude is in: metres, feet, or flight levels (hundreds of feet)."""

Unit = Literal["deg", "rad", "1e-7 deg", "ddmm.mm", "m", "ecef"]
"""What latitude and longitude (the first four), or x, y and z, are in."""


class ChannelLike(Protocol):
    """What a mapping needs to know of a channel (`pipeline.logs.reader.Channel` has more)."""

    @property
    def topic(self) -> str: ...  # noqa: D102
    @property
    def schema_name(self) -> str: ...  # noqa: D102
    @property
    def schema_data(self) -> bytes: ...  # noqa: D102
    @property
    def message_count(self) -> int | None: ...  # noqa: D102


@dataclass(frozen=True)
class SourceConfig:
    """One `[[extract.detections]]`, `[[extract.truth]]` or `[[extract.poses]]` entry.

    topic       exact, or with `{agent}` and/or `{sensor}` in place of a part of a name (`/truth/{agent}`)
    message_type  a name of `pipeline.mapping.message_types`; without one and without paths the schema's; its older
                name, preset, is still read
    agent, agent_path    who was seen: a constant, or a message path; neither (nor `{agent}`) means origin unknown
    has_identity   whether messages and topics say who was seen; true: believed as it stands, false: never; default: judged by
                   whether it can be meant
    sensor, sensor_path  who saw it
    x, y, z     message paths of a position in metres
    latitude, longitude, altitude   message paths of a position in degrees (and metres), instead of x, y and z
    range, bearing, elevation, range_rate   message paths of what a sensor measured from where it was, instead of x and y; range
                and bearing together become positions, one alone and range_rate (positive: away from it) speak about tracks
    range_sigma, bearing_sigma, elevation_sigma, range_rate_sigma   message paths of their standard deviations, in the same
                units
    range_sigma_m, bearing_sigma_deg, elevation_sigma_deg, range_rate_sigma_mps   standard deviations where messages state none
    bearing_unit of bearing, elevation and their standard deviations: "rad" (default) or "deg"
    bearing_convention   "math" (default): from the x axis of the sensor's frame (ahead, or east) towards y, as ROS has it;
                "compass": clockwise from north
    pixel_x, pixel_y   message paths of what a camera saw, right and down from the corner of its image, instead of x and y
    box_width, box_height   message paths of its size in pixels, of which a tenth is the standard deviation (one at least)
    pixel_sigma   standard deviation in pixels instead
    camera_info topic of the camera's sensor_msgs/CameraInfo; default: the one whose name is nearest
    is_static_used   true: also returns without a name that stand, by their range rates; default: where most of a scan fits one
                motion of the radar, these are left out
    observer    the sensor of [[extract.poses]] from whose places it was measured; "{sensor}": the one that the message or the
                topic names; default: the origin of the frame that frame_id names, at the stamp, by the log's transforms
    observer_x_m, observer_y_m   where it was measured from, in the mission frame, where that stands
    observer_latitude, observer_longitude   the same in degrees
    observer_heading_deg   clockwise from north, where bearings of an observer count from ahead of it
    unit        of latitude and longitude: "deg", "rad", "1e-7 deg" or "ddmm.mm" (degrees and minutes, as NMEA 0183 has them);
                of x, y and z: "m" (of a plane) or "ecef" (from the earth's centre); default: degrees or metres, but for what
                can hardly be meant as such
    where       conditions on fields of the message, all of which must hold: "fix_type >= 3 && lat_lon_valid"; the type's are
                used where nothing is stated, and "" means none
    covariance  message path of 1, 4, 9 or 36 numbers (a variance, or rows of a matrix), 6 or 21 (an upper triangle) or 3 (a
                diagonal), x first, m²; where it is stated, what is read of a known type does not count
    sigma       message path of a standard deviation of x and y, in metres, where the message states no covariance
    sigma_m     standard deviation of x and y where the message states neither
    height_unit of z or altitude: "m", "ft" or "FL" (hundreds of feet); default: metres, but for what
                can hardly be meant as such
    vertical_datum   what z or altitude counts from: "ellipsoid", "sea level", "ground", "start" or "frame" (the zero of its
                frame); default: what the type's definition says, else "not stated"
    sigma_z_m   standard deviation of z or altitude; default: the message's, else that of its own likelihood
    score       message path of a confidence
    time        message path of a stamp, or "log_time" or "publish_time"; default: the header's stamp, else the log time
    frame_id    message path of the frame's name; default: the header's
    frame_convention   axes of x, y and z, after transforms: "enu" (east, north, up) or "ned" (north, east, down); default: the
                       type's, which is "enu" but for PX4's types
    """

    topic: str
    message_type: str | None = field(default=None, metadata={"older_name": "preset"})
    agent: str | None = None
    agent_path: str | None = None
    has_identity: bool | None = None
    sensor: str | None = None
    sensor_path: str | None = None
    x: str | None = None
    y: str | None = None
    z: str | None = None
    latitude: str | None = None
    longitude: str | None = None
    altitude: str | None = None
    unit: Unit | None = None
    where: str | None = None
    covariance: str | None = None
    sigma: str | None = None
    sigma_m: float | None = None
    height_unit: HeightUnit | None = None
    vertical_datum: VerticalDatum | None = None
    sigma_z_m: float | None = None
    range: str | None = None
    bearing: str | None = None
    elevation: str | None = None
    range_rate: str | None = None
    range_sigma: str | None = None
    bearing_sigma: str | None = None
    elevation_sigma: str | None = None
    range_rate_sigma: str | None = None
    range_sigma_m: float | None = None
    bearing_sigma_deg: float | None = None
    elevation_sigma_deg: float | None = None
    range_rate_sigma_mps: float | None = None
    bearing_unit: AngleUnit | None = None
    bearing_convention: BearingConvention | None = None
    pixel_x: str | None = None
    pixel_y: str | None = None
    box_width: str | None = None
    box_height: str | None = None
    pixel_sigma: float | None = None
    camera_info: str | None = None
    is_static_used: bool | None = None
    observer: str | None = None
    observer_x_m: float | None = None
    observer_y_m: float | None = None
    observer_latitude: float | None = None
    observer_longitude: float | None = None
    observer_heading_deg: float | None = None
    score: str | None = None
    time: str | None = None
    frame_id: str | None = None
    frame_convention: Literal["enu", "ned"] | None = None

    def __post_init__(self) -> None:
        if self.message_type is not None and self.message_type not in MESSAGE_TYPES:
            raise ValueError(f"message_type {self.message_type!r} is not known; known: {', '.join(MESSAGE_TYPES)}")
        for name in _CHECKED:
            text = getattr(self, name)
            if text is not None and text not in (LOG_TIME, PUBLISH_TIME):
                _check(name, self.without_topic(text), parse_path)
        if self.where:
            _check("where", self.where, parse_conditions)
        for name in _POSITIVE:
            value = getattr(self, name)
            if value is not None and not 0 < value < float("inf"):
                raise ValueError(f"topic {self.topic!r}: {name} must be positive")
        self._check_position()
        self._check_identity()

    def _check_position(self) -> None:
        if (self.x is None) != (self.y is None) or (self.latitude is None) != (self.longitude is None):
            raise ValueError(f"topic {self.topic!r}: x and y (or latitude and longitude) go together")
        if (self.pixel_x is None) != (self.pixel_y is None):
            raise ValueError(f"topic {self.topic!r}: pixel_x and pixel_y go together")
        kinds = [self.x is not None, self.latitude is not None, self.range is not None or self.bearing is not None]
        if sum((*kinds, self.pixel_x is not None)) > 1:
            raise ValueError(
                f"topic {self.topic!r}: give only one of x and y, latitude and longitude, range and bearing, or pixels"
            )
        for first, second in (("observer_x_m", "observer_y_m"), ("observer_latitude", "observer_longitude")):
            if (getattr(self, first) is None) != (getattr(self, second) is None):
                raise ValueError(f"topic {self.topic!r}: {first} and {second} go together")
        places = [self.observer is not None, self.observer_x_m is not None, self.observer_latitude is not None]
        if sum(places) > 1:
            raise ValueError(f"topic {self.topic!r}: give only one of observer, observer_x_m and observer_latitude")
        if self.observer_heading_deg is not None and not any(places):
            raise ValueError(
                f"topic {self.topic!r}: observer_heading_deg is of an observer; a frame's heading is in transforms"
            )

    @property
    def observer_place(self) -> tuple[float, float] | None:
        """Where it was measured from, if that stands: metres, or latitude and longitude."""
        if self.observer_x_m is not None and self.observer_y_m is not None:
            return self.observer_x_m, self.observer_y_m
        if self.observer_latitude is not None and self.observer_longitude is not None:
            return self.observer_latitude, self.observer_longitude
        return None

    def _check_identity(self) -> None:
        found = re.findall(r"\{(.*?)\}", self.topic)
        if any(name not in PLACEHOLDERS for name in found) or len(set(found)) < len(found):
            raise ValueError(f"topic {self.topic!r}: the placeholders are {{agent}} and {{sensor}}, each once")
        for name in PLACEHOLDERS:
            given = [key for key in (name, f"{name}_path") if getattr(self, key) is not None]
            given += [f"{{{name}}} in the topic"] if name in found else []
            if len(given) > 1:
                raise ValueError(f"topic {self.topic!r}: give only one of {', '.join(given)}")

    def without_topic(self, path: str) -> str:
        """A message path as it is written in Foxglove, less the topic; one without topic as it is."""
        return path[len(self.topic) :] if path.startswith((f"{self.topic}.", f"{self.topic}{{")) else path

    def match(self, topic: str) -> Mapping[str, str] | None:
        """The placeholders' values where `topic` is meant (empty without placeholders); None where it is not."""
        parts = re.split(r"\{(agent|sensor)\}", self.topic)
        pattern = "".join(f"(?P<{part}>[^/]+)" if i % 2 else re.escape(part) for i, part in enumerate(parts))
        found = re.fullmatch(pattern, topic)
        return None if found is None else found.groupdict()


def resolve_paths(source: SourceConfig, schema_name: str) -> MessageType:
    """The message paths for a schema: what the source states over its type; `ConfigError` where there is no position."""
    is_custom = any(path is not None for path in (source.x, source.latitude, source.range, source.bearing, source.pixel_x))
    name = source.message_type if source.message_type is not None or is_custom else type_of_schema(schema_name)
    if name is None and not is_custom:
        raise ConfigError(
            f"topic {source.topic}: its type, {schema_name or 'without a schema'}, is not known; "
            "give message paths in its [extract] entry: x and y, latitude and longitude, or range and bearing"
        )
    base = MESSAGE_TYPES[name] if name is not None else MessageType(())
    if is_custom:  # another position must not take height or covariance from the type's
        base = MessageType(
            (), time=base.time, frame_id=base.frame_id, agent=base.agent, sensor=base.sensor, score=base.score,
            where=base.where, json_text=base.json_text,
        )  # fmt: skip
    stated: dict[str, Any] = {}
    for item in fields(MessageType):
        value = getattr(source, PATH_KEYS.get(item.name, item.name), None)
        if value is not None:
            stated[item.name] = (source.without_topic(value),) if item.name in PATHS else value
    if source.covariance is not None:
        stated["covariance_type"] = ()
    if source.where is not None:
        stated["where"] = (source.where,) if source.where else ()
    found = replace(base, **stated)
    _check_measured(source, found)
    return found


def _check_measured(source: SourceConfig, found: MessageType) -> None:
    """`ConfigError` where ranges and bearings lack what they need, or settings are of those and the source has none."""
    where = f"topic {source.topic}"
    if not found.is_polar:
        names = [*_MEASURED, *_MEASURED.values(), *_OF_BEARINGS, *_OF_PIXELS]
        unread = [name for name in names if getattr(source, name) is not None]
        if unread:
            raise ConfigError(f"{where}: {unread[0]} is of ranges and bearings, and it has positions; leave it out")
        return
    unread = [name for name in ("sigma", "sigma_m", "covariance", "unit") if getattr(source, name) is not None]
    if unread:
        raise ConfigError(f"{where}: {unread[0]} is of positions; state range_sigma_m and bearing_sigma_deg instead")
    unread = [name for name in (_OF_BEARINGS if found.pixel_x else _OF_PIXELS) if getattr(source, name) is not None]
    if unread:
        raise ConfigError(
            f"{where}: {unread[0]} is of {'bearings' if found.pixel_x else 'pixels'}, and it has others; leave it out"
        )
    if found.pixel_x and not found.box_width and source.pixel_sigma is None:
        raise ConfigError(
            f"{where}: nothing says how exact its pixels are; give pixel_sigma, or the paths box_width and box_height"
        )
    for name, setting in _MEASURED.items():
        has_sigma = getattr(found, f"{name}_sigma") or getattr(found, setting) is not None
        if getattr(source, name) is not None and not has_sigma:
            raise ConfigError(f"{where}: nothing says how exact its {name} is; give {setting}, or the path {name}_sigma")
    if found.bearing_convention == "compass" and found.observer is None and source.observer_place is None:
        raise ConfigError(
            f"{where}: compass bearings are of a place, and nothing says which; give observer (a sensor of [[extract.poses]]), "
            "observer_x_m and observer_y_m, or observer_latitude and observer_longitude"
        )


def _check(name: str, text: str, parse: Callable[[str], object]) -> None:
    try:
        parse(text)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error
