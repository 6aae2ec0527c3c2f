"""ROS messages for tests, built with their real definitions: common types by rosbags, others as their packages say."""

from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore
from small_logs import START_NS, Row

SECONDS = START_NS // 10**9
COVARIANCE_36 = np.zeros(36)
COVARIANCE_36[[0, 1, 6, 7, 14, 35]] = 4.0, 1.0, 1.0, 9.0, 16.0, 7.0

_BOX = {
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections\n",
}
_FLAT = "{kind} id\nfloat64 score\ngeometry_msgs/PoseWithCovariance pose\n"
_DETECTION = "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\nvision_msgs/BoundingBox3D bbox\n"

VISION_HUMBLE = _BOX | {
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score\n",
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n"
    ),
    "vision_msgs/msg/Detection3D": f"{_DETECTION}string id\n",
}
VISION_FOXY = _BOX | {
    "vision_msgs/msg/ObjectHypothesisWithPose": _FLAT.format(kind="string"),
    "vision_msgs/msg/Detection3D": (
        f"{_DETECTION}sensor_msgs/PointCloud2 source_cloud\nbool is_tracking\nstring tracking_id\n"
    ),
}
VISION_ROS1 = _BOX | {
    "vision_msgs/msg/ObjectHypothesisWithPose": _FLAT.format(kind="int64"),
    "vision_msgs/msg/Detection3D": f"{_DETECTION}sensor_msgs/PointCloud2 source_cloud\n",
}
RADAR = {
    "radar_msgs/msg/RadarTrack": (
        "unique_identifier_msgs/UUID uuid\ngeometry_msgs/Point position\ngeometry_msgs/Vector3 velocity\n"
        "geometry_msgs/Vector3 acceleration\ngeometry_msgs/Vector3 size\nuint16 classification\n"
        "float32[6] position_covariance\nfloat32[6] velocity_covariance\nfloat32[6] acceleration_covariance\n"
        "float32[6] size_covariance\n"
    ),
    "radar_msgs/msg/RadarTracks": "std_msgs/Header header\nradar_msgs/RadarTrack[] tracks\n",
}
AUTOWARE = {
    "{package}/msg/ObjectClassification": "uint8 UNKNOWN=0\nuint8 CAR=1\nuint8 label\nfloat32 probability\n",
    "{package}/msg/Shape": (
        "uint8 BOUNDING_BOX=0\nuint8 type\ngeometry_msgs/Polygon footprint\ngeometry_msgs/Vector3 dimensions\n"
    ),
    "{package}/msg/TrackedObjectKinematics": (
        "uint8 UNAVAILABLE=0\ngeometry_msgs/PoseWithCovariance pose_with_covariance\n"
        "geometry_msgs/TwistWithCovariance twist_with_covariance\n"
        "geometry_msgs/AccelWithCovariance acceleration_with_covariance\nuint8 orientation_availability\nbool is_stationary\n"
    ),
    "{package}/msg/TrackedObject": (
        "unique_identifier_msgs/UUID object_id\nfloat32 existence_probability\n"
        "{package}/ObjectClassification[] classification\n{package}/TrackedObjectKinematics kinematics\n{package}/Shape shape\n"
    ),
    "{package}/msg/TrackedObjects": "std_msgs/Header header\n{package}/TrackedObject[] objects\n",
}
MAVROS = {
    "mavros_msgs/msg/ADSBVehicle": (
        "uint8 ALT_GEOMETRIC=1\nuint16 FLAG_VALID_COORDS=1\nuint16 FLAG_VALID_ALTITUDE=2\nstd_msgs/Header header\n"
        "uint32 icao_address\nstring callsign\nfloat64 latitude\nfloat64 longitude\nfloat32 altitude\nfloat32 heading\n"
        "float32 hor_velocity\nfloat32 ver_velocity\nuint8 altitude_type\nuint8 emitter_type\n"
        "builtin_interfaces/Duration tslc\nuint16 flags\nuint16 squawk\n"
    )
}


def store_with(definitions: dict[str, str] | None = None, base: Stores = Stores.ROS2_HUMBLE, package: str = "") -> Typestore:
    """The types of a distribution and those of `definitions`; `{package}` in them becomes `package`."""
    store = get_typestore(base)
    for name, text in (definitions or {}).items():
        store.register(get_types_from_msg(text.replace("{package}", package), name.replace("{package}", package)))
    return store


class Builder:
    """Builds messages of one store."""

    def __init__(self, store: Typestore) -> None:
        self.store = store

    def __call__(self, name: str, **values: Any) -> Any:
        """A message; fields that are not given are zero or empty."""
        kind = self.store.types[name]
        return kind(**{field: values.get(field, self._zero(desc)) for field, desc in self.store.fielddefs[name][1]})

    def _zero(self, desc: Any) -> Any:
        node, inner = desc
        if node == Nodetype.BASE:
            return "" if inner[0] == "string" else False if inner[0] == "bool" else 0.0 if "float" in inner[0] else 0
        if node == Nodetype.NAME:
            return self(inner)
        (item, of), num = inner
        if item == Nodetype.BASE and of[0] != "string":
            return np.zeros(num if node == Nodetype.ARRAY else 0, of[0].replace("octet", "uint8"))
        return [self._zero((item, of)) for _ in range(num)] if node == Nodetype.ARRAY else []

    def header(self, frame_id: str = "/odom", time_ns: int = START_NS + 250_000_000) -> Any:
        """A header, stamped a quarter of a second after the start."""
        stamp = self("builtin_interfaces/msg/Time", sec=time_ns // 10**9, nanosec=time_ns % 10**9)
        return self("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)

    def point(self, x: float = 1.5, y: float = -2.5, z: float = 3.5) -> Any:
        """A point."""
        return self("geometry_msgs/msg/Point", x=x, y=y, z=z)

    def pose(self, x: float = 1.5, y: float = -2.5, z: float = 3.5) -> Any:
        """A pose without rotation."""
        return self("geometry_msgs/msg/Pose", position=self.point(x, y, z), orientation=self.turn())

    def turn(self, x: float = 0.0, y: float = 0.0, z: float = 0.0, w: float = 1.0) -> Any:
        """A quaternion."""
        return self("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def uncertain_pose(self, x: float = 1.5, y: float = -2.5, z: float = 3.5) -> Any:
        """A pose with a covariance."""
        return self("geometry_msgs/msg/PoseWithCovariance", pose=self.pose(x, y, z), covariance=COVARIANCE_36)

    def detection(self, name: str, x: float, has_box: bool = True) -> Any:
        """A Detection3D of any version: its box at x, its best hypothesis one metre beside it."""
        box = self("vision_msgs/msg/BoundingBox3D", center=self.pose(x)) if has_box else self("vision_msgs/msg/BoundingBox3D")
        kind = "vision_msgs/msg/ObjectHypothesisWithPose"
        fields = {field for field, _ in self.store.fielddefs[kind][1]}
        score = {"score": 0.5} if "score" in fields else {"hypothesis": self("vision_msgs/msg/ObjectHypothesis", score=0.5)}
        best = self(kind, pose=self.uncertain_pose(x + 1.0), **score)
        names = {"id": name, "tracking_id": name}
        return self("vision_msgs/msg/Detection3D", bbox=box, results=[best], **names)

    def cdr_row(self, message: Any, topic: str = "/thing", time_s: float = 1.0, is_idl: bool = False) -> Row:
        """A row in CDR, with the schema as msg or as IDL."""
        name = message.__msgtype__
        text = idl_of(self.store, name) if is_idl else self.store.generate_msgdef(name, ros_version=2)[0]
        data = bytes(self.store.serialize_cdr(message, name))
        return Row(topic, name, time_s, data, "cdr", "ros2idl" if is_idl else "ros2msg", text.encode())

    def ros1_row(self, message: Any, topic: str = "/thing", time_s: float = 1.0) -> Row:
        """A row in the encoding of ROS 1."""
        name = message.__msgtype__
        text, _ = self.store.generate_msgdef(name, ros_version=1)
        data = bytes(self.store.serialize_ros1(message, name))
        return Row(topic, name.replace("/msg/", "/"), time_s, data, "ros1", "ros1msg", text.encode())


_IDL = {"float64": "double", "float32": "float", "bool": "boolean", "byte": "octet"}


def idl_of(store: Typestore, name: str) -> str:
    """All types of a message as rosidl writes them: a file each, with includes, constants, annotations and array types."""
    files: dict[str, str] = {}

    def add(name: str) -> None:
        if name not in files:
            files[name] = ""
            constants, fields = store.fielddefs[name]
            for _, desc in fields:
                inner = desc[1] if desc[0] == Nodetype.NAME else desc[1][0][1] if desc[0] > Nodetype.NAME else None
                if isinstance(inner, str):
                    add(inner)
            files[name] = _idl_file(name, constants, fields)

    add(name)
    return "\n".join(f"{'=' * 80}\nIDL: {name}\n{text}" for name, text in files.items())


def _idl_file(name: str, constants: Any, fields: Any) -> str:
    package, _, kind = name.split("/")
    includes, types, members = [], [], []
    for field, desc in fields:
        text = _idl_type(desc, includes, types)
        comment = f'@verbatim (language="comment", text=\n        "About {{{field}}};" "\\n" " // more")'
        members.append(f"      {comment}\n      {text} {field};\n")
    known = "".join(f"      /** a constant; */\n      const {_IDL.get(t, t)} {n} = {v};\n" for n, t, v in constants)
    module = f"    module {kind}_Constants {{\n{known}    }};\n" if known else ""
    head = f"// generated from rosidl_adapter/resource/msg.idl.em\n\n{''.join(includes)}\n"
    body = f"{module}{''.join(types)}    struct {kind} {{\n{''.join(members)}    }};\n"
    return f"{head}module {package} {{\n  module msg {{\n{body}  }};\n}};\n"


def _idl_type(desc: Any, includes: list[str], types: list[str]) -> str:
    node, inner = desc
    if node == Nodetype.BASE:
        return _IDL.get(inner[0], inner[0])
    if node == Nodetype.NAME:
        includes.append(f'#include "{inner}.idl"\n')
        return inner.replace("/", "::")
    item, num = inner
    text = _idl_type(item, includes, types)
    if node == Nodetype.SEQUENCE:
        return f"sequence<{text}, {num}>" if num else f"sequence<{text}>"
    alias = f"{text.replace('::', '__')}__{num}"
    if not any(alias in line for line in types):
        types.append(f"    typedef {text} {alias}[{num}];\n")
    return alias
