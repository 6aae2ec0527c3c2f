"""Message forms: how one position is written, as protobuf, JSON or CDR, in metres or in latitude and longitude."""

import functools
import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from google.protobuf.message import Message
from mcap.writer import Writer
from mcap_protobuf.schema import build_file_descriptor_set
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

Encoding = Literal["protobuf", "json", "cdr"]


@dataclass(frozen=True)
class Report:
    """A position at a time. x and y are metres, or, for geodetic forms, longitude and latitude in degrees.

    covariance_m2 is xx, xy, yy (east, north); None for truth and poses. The identities are written where a form has room.
    Forms of several positions write `group`, x and y each, and not x and y. Forms of bearings write `measured`.
    """

    time_ns: int
    frame_id: str
    x: float
    y: float
    covariance_m2: tuple[float, float, float] | None = None
    agent_id: str = ""
    sensor_id: str = ""
    group: tuple[tuple[float, float], ...] = ()
    measured: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True)
class Form:
    """One message type: its schema as MCAP wants it, and how to make a message's bytes."""

    message_encoding: str
    schema_name: str
    schema_encoding: str
    schema_data: bytes
    encode: Callable[[Report], bytes]
    has_agent_id: bool = False

    def register(self, writer: Writer, topic: str) -> int:
        """The id of a new channel; the schema is registered once a writer."""
        schema = writer.register_schema(self.schema_name, self.schema_encoding, self.schema_data)
        return int(writer.register_channel(topic, self.message_encoding, schema))


def pose_form(encoding: Encoding, is_geodetic: bool) -> Form:
    """The form of truth and of sensors' poses."""
    if encoding == "cdr":
        return _cdr_form("sensor_msgs/msg/NavSatFix" if is_geodetic else "geometry_msgs/msg/PoseStamped")
    if encoding == "json":
        return _json_fix_form() if is_geodetic else _json_pose_form()
    return _protobuf_form(LocationFix, _protobuf_fix) if is_geodetic else _protobuf_form(PoseInFrame, _protobuf_pose)


def group_form(encoding: Encoding) -> Form:
    """The form of several positions at once, in metres."""
    if encoding == "cdr":
        return _cdr_form("geometry_msgs/msg/PoseArray")
    return _json_group_form() if encoding == "json" else _protobuf_form(PosesInFrame, _protobuf_group)


def detection_form(encoding: Encoding, is_geodetic: bool) -> Form:
    """The form of detections. No Foxglove schema has metres with a covariance: there, protobuf logs hold JSON detections."""
    if encoding == "cdr":
        return _cdr_form("sensor_msgs/msg/NavSatFix" if is_geodetic else "geometry_msgs/msg/PoseWithCovarianceStamped")
    if is_geodetic:
        return _json_fix_form() if encoding == "json" else _protobuf_form(LocationFix, _protobuf_fix)
    return _json_detection_form()


def protobuf_schema(message: type[Message]) -> bytes:
    """The file descriptor set that MCAP keeps for a protobuf message type."""
    return bytes(build_file_descriptor_set(message).SerializeToString())


def _covariance9(report: Report) -> list[float]:
    """Row-major 3 x 3, east, north, up; nothing is known about up."""
    xx, xy, yy = report.covariance_m2 or (0.0, 0.0, 0.0)
    return [xx, xy, 0.0, xy, yy, 0.0, 0.0, 0.0, 0.0]


def _protobuf_form(message: type[Message], encode: Callable[[Report], bytes]) -> Form:
    return Form("protobuf", message.DESCRIPTOR.full_name, "protobuf", protobuf_schema(message), encode)


def _protobuf_pose(report: Report) -> bytes:
    message = PoseInFrame(frame_id=report.frame_id)
    message.timestamp.FromNanoseconds(report.time_ns)
    message.pose.position.x, message.pose.position.y = report.x, report.y
    message.pose.orientation.w = 1.0
    return bytes(message.SerializeToString(deterministic=True))


def _protobuf_group(report: Report) -> bytes:
    message = PosesInFrame(frame_id=report.frame_id)
    message.timestamp.FromNanoseconds(report.time_ns)
    for x, y in report.group:
        pose = message.poses.add()
        pose.position.x, pose.position.y, pose.orientation.w = x, y, 1.0
    return bytes(message.SerializeToString(deterministic=True))


def _protobuf_fix(report: Report) -> bytes:
    message = LocationFix(frame_id=report.frame_id, longitude=report.x, latitude=report.y)
    message.timestamp.FromNanoseconds(report.time_ns)
    if report.covariance_m2 is not None:
        message.position_covariance.extend(_covariance9(report))
        message.position_covariance_type = LocationFix.KNOWN
    for key, value in (("agent_id", report.agent_id), ("sensor_id", report.sensor_id)):
        if value:
            message.metadata.add(key=key, value=value)
    return bytes(message.SerializeToString(deterministic=True))


_STAMP = {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}
_NUMBERS = {"type": "array", "items": {"type": "number"}}


def _object(names: str, kind: str = "number") -> dict[str, Any]:
    return {"type": "object", "properties": {name: {"type": kind} for name in names}}


def _json_form(
    name: str, properties: dict[str, Any], fill: Callable[[Report], dict[str, Any]], has_agent_id: bool = False
) -> Form:
    schema = {"title": name, "type": "object"}
    schema["properties"] = {"timestamp": _STAMP, "frame_id": {"type": "string"}, **properties}  # type: ignore[assignment]

    def encode(report: Report) -> bytes:
        second, nanosecond = divmod(report.time_ns, 1_000_000_000)
        stamped = {"timestamp": {"sec": second, "nsec": nanosecond}, "frame_id": report.frame_id, **fill(report)}
        return json.dumps(stamped, separators=(",", ":")).encode()

    return Form("json", name, "jsonschema", json.dumps(schema).encode(), encode, has_agent_id)


_POSE = {"type": "object", "properties": {"position": _object("xyz"), "orientation": _object("xyzw")}}


def _json_pose(x: float, y: float) -> dict[str, Any]:
    return {"position": {"x": x, "y": y, "z": 0.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}


def _json_pose_form() -> Form:
    return _json_form("foxglove.PoseInFrame", {"pose": _POSE}, lambda report: {"pose": _json_pose(report.x, report.y)})


def _json_group_form() -> Form:
    poses = {"poses": {"type": "array", "items": _POSE}}
    return _json_form("foxglove.PosesInFrame", poses, lambda report: {"poses": [_json_pose(x, y) for x, y in report.group]})


def _json_fix_form() -> Form:
    numbers = {name: {"type": "number"} for name in ("latitude", "longitude", "altitude")}
    return _json_form(
        "foxglove.LocationFix",
        {**numbers, "position_covariance": _NUMBERS, "position_covariance_type": {"type": "integer"}},
        lambda report: {
            "latitude": report.y,
            "longitude": report.x,
            "altitude": 0.0,
            "position_covariance": _covariance9(report),
            "position_covariance_type": 0 if report.covariance_m2 is None else 3,
        },
    )


def _json_detection_form() -> Form:
    words = {name: {"type": "string"} for name in ("agent_id", "sensor_id")}
    return _json_form(
        "mission.Detection",
        {**words, "position": _object("xyz"), "position_covariance": _NUMBERS},
        lambda report: {
            **{key: name for key, name in (("agent_id", report.agent_id), ("sensor_id", report.sensor_id)) if name},
            "position": {"x": report.x, "y": report.y, "z": 0.0},
            "position_covariance": _covariance9(report),
        },
        has_agent_id=True,
    )


def bearing_form() -> Form:
    """The form of bearings, in whatever encoding: no standard type of messages has bearings from true north."""
    words = {name: {"type": "string"} for name in ("agent_id", "sensor_id")}
    numbers = {name: {"type": "number"} for name in ("bearing", "bearing_sigma", "range", "range_sigma")}
    return _json_form(
        "mission.Bearing",
        words | numbers,
        lambda report: {"agent_id": report.agent_id, "sensor_id": report.sensor_id, **dict(report.measured)},
        has_agent_id=True,
    )


@functools.cache
def _typestore() -> Typestore:
    return get_typestore(Stores.ROS2_HUMBLE)


def _cdr_form(name: str) -> Form:
    store = _typestore()
    fill = {
        "NavSatFix": _ros_fix,
        "PoseStamped": _ros_pose,
        "PoseWithCovarianceStamped": _ros_pose_with_covariance,
        "PoseArray": _ros_poses,
    }
    make = fill[name.rpartition("/")[2]]
    definition = store.generate_msgdef(name, ros_version=2)[0]
    return Form("cdr", name, "ros2msg", definition.encode(), lambda report: bytes(store.serialize_cdr(make(report), name)))


def _ros_header(report: Report) -> Any:
    types = _typestore().types
    stamp = types["builtin_interfaces/msg/Time"](*divmod(report.time_ns, 1_000_000_000))
    return types["std_msgs/msg/Header"](stamp, report.frame_id)


def _ros_pose_at(x: float, y: float) -> Any:
    types = _typestore().types
    position = types["geometry_msgs/msg/Point"](x, y, 0.0)
    return types["geometry_msgs/msg/Pose"](position, types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0))


def _ros_pose(report: Report) -> Any:
    return _typestore().types["geometry_msgs/msg/PoseStamped"](_ros_header(report), _ros_pose_at(report.x, report.y))


def _ros_poses(report: Report) -> Any:
    return _typestore().types["geometry_msgs/msg/PoseArray"](_ros_header(report), [_ros_pose_at(x, y) for x, y in report.group])


def _ros_pose_with_covariance(report: Report) -> Any:
    types = _typestore().types
    covariance = np.zeros((6, 6))
    xx, xy, yy = report.covariance_m2 or (0.0, 0.0, 0.0)
    covariance[:2, :2] = [[xx, xy], [xy, yy]]
    pose = types["geometry_msgs/msg/PoseWithCovariance"](_ros_pose_at(report.x, report.y), covariance.ravel())
    return types["geometry_msgs/msg/PoseWithCovarianceStamped"](_ros_header(report), pose)


def _ros_fix(report: Report) -> Any:
    types = _typestore().types
    status = types["sensor_msgs/msg/NavSatStatus"](status=0, service=1)
    kind = 0 if report.covariance_m2 is None else 3
    return types["sensor_msgs/msg/NavSatFix"](
        _ros_header(report), status, report.y, report.x, 0.0, np.array(_covariance9(report)), kind
    )
