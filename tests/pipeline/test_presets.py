"""Every preset against a message of its type, through the log, in CDR, protobuf and JSON."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.LocationFixes_pb2 import LocationFixes
from foxglove_schemas_protobuf.Point3InFrame_pb2 import Point3InFrame
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import Message
from rosbags.typesys import Stores, get_typestore
from small_logs import START_NS, Row, write_log

from pipeline.logs.reader import open_log
from pipeline.positions import ChannelReader, Positions, read_positions
from pipeline.presets import PRESETS, normalise_schema, preset_for
from pipeline.progress import Progress
from pipeline.sources import SourceConfig

STORE = get_typestore(Stores.ROS2_HUMBLE)
SECONDS = START_NS // 10**9
COVARIANCE_36 = np.zeros(36)
COVARIANCE_36[[0, 1, 6, 7, 35]] = 4.0, 1.0, 1.0, 9.0, 7.0


def read(path: Path, rows: list[Row], **source: Any) -> tuple[Positions, ChannelReader]:
    log = open_log(write_log(path / "log.mcap", rows))
    reader = ChannelReader(log.channels[0], SourceConfig(rows[0].topic, **source), "detections", True, {})
    read_positions(log, [reader], Progress(quiet=True))
    return reader.finish(), reader


def ros(name: str, **values: Any) -> Any:
    return STORE.types[name](**values)


def header() -> Any:
    stamp = ros("builtin_interfaces/msg/Time", sec=SECONDS, nanosec=250_000_000)
    return ros("std_msgs/msg/Header", stamp=stamp, frame_id="/odom")


def ros_pose() -> Any:
    point = ros("geometry_msgs/msg/Point", x=1.5, y=-2.5, z=3.5)
    return ros(
        "geometry_msgs/msg/Pose", position=point, orientation=ros("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
    )


def ros_pose_with_covariance() -> Any:
    return ros("geometry_msgs/msg/PoseWithCovariance", pose=ros_pose(), covariance=COVARIANCE_36)


def ros_odometry() -> Any:
    zero = ros("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    twist = ros("geometry_msgs/msg/Twist", linear=zero, angular=zero)
    moving = ros("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36))
    return ros("nav_msgs/msg/Odometry", header=header(), child_frame_id="base", pose=ros_pose_with_covariance(), twist=moving)


def nav_sat_fix(status: int = 0, kind: int = 2) -> Any:
    return ros(
        "sensor_msgs/msg/NavSatFix", header=header(), status=ros("sensor_msgs/msg/NavSatStatus", status=status, service=1),
        latitude=50.5, longitude=-1.25, altitude=7.0, position_covariance=np.array([4.0, 1, 0, 1, 9, 0, 0, 0, 7]),
        position_covariance_type=kind,
    )  # fmt: skip


ROS_MESSAGES: dict[str, Callable[[], Any]] = {
    "PointStamped": lambda: ros("geometry_msgs/msg/PointStamped", header=header(), point=ros_pose().position),
    "PoseStamped": lambda: ros("geometry_msgs/msg/PoseStamped", header=header(), pose=ros_pose()),
    "PoseWithCovarianceStamped": lambda: ros(
        "geometry_msgs/msg/PoseWithCovarianceStamped", header=header(), pose=ros_pose_with_covariance()
    ),
    "PoseArray": lambda: ros("geometry_msgs/msg/PoseArray", header=header(), poses=[ros_pose(), ros_pose()]),
    "Odometry": ros_odometry,
    "NavSatFix": nav_sat_fix,
}


def cdr_row(message: Any, topic: str = "/thing") -> Row:
    name = message.__msgtype__
    text, _ = STORE.generate_msgdef(name, ros_version=2)
    return Row(topic, name, 1.0, bytes(STORE.serialize_cdr(message, name)), "cdr", "ros2msg", text.encode())


def protobuf_row(message: Message, topic: str = "/thing") -> Row:
    files = FileDescriptorSet()
    seen: set[str] = set()

    def add(file: Any) -> None:
        if file.name not in seen:
            seen.add(file.name)
            for dependency in file.dependencies:
                add(dependency)
            file.CopyToProto(files.file.add())

    add(message.DESCRIPTOR.file)
    encoded = message.SerializeToString()
    return Row(topic, message.DESCRIPTOR.full_name, 1.0, encoded, "protobuf", "protobuf", files.SerializeToString())


@pytest.mark.parametrize("name", ROS_MESSAGES)
def test_ros_messages(tmp_path: Path, name: str) -> None:
    rows, _ = read(tmp_path, [cdr_row(ROS_MESSAGES[name]())])
    assert preset_for(ROS_MESSAGES[name]().__msgtype__) == name
    assert len(rows) == (2 if name == "PoseArray" else 1)
    assert rows.time_ns[0] == START_NS + 250_000_000
    assert rows.log_time_ns[0] == START_NS + 10**9
    assert rows.frame_id[0] == "odom"
    assert bool(rows.is_geodetic[0]) == (name == "NavSatFix")
    expected = (50.5, -1.25, 7.0) if name == "NavSatFix" else (1.5, -2.5, 3.5)
    assert (rows.first[0], rows.second[0], rows.z_m[0]) == expected
    has_covariance = name in ("PoseWithCovarianceStamped", "Odometry", "NavSatFix")
    np.testing.assert_array_equal(rows.covariance_m2[0], [4, 1, 9] if has_covariance else [np.nan] * 3)


def test_fix_without_position_or_covariance(tmp_path: Path) -> None:
    rows, reader = read(tmp_path, [cdr_row(nav_sat_fix(status=-1)), cdr_row(nav_sat_fix(kind=0))])
    assert len(rows) == 1 and reader.counts["no_fix"] == 1
    assert np.isnan(rows.covariance_m2).all()


def fix(latitude: float) -> LocationFix:
    message = LocationFix(latitude=latitude, longitude=-1.25, altitude=7.0, frame_id="wgs84")
    message.timestamp.FromNanoseconds(START_NS + 5)
    message.position_covariance.extend([4.0, 1, 0, 1, 9, 0, 0, 0, 7])
    message.position_covariance_type = LocationFix.KNOWN
    return message


def test_location_fix(tmp_path: Path) -> None:
    rows, _ = read(tmp_path, [protobuf_row(fix(50.5))])
    assert (rows.first[0], rows.second[0], rows.z_m[0], rows.time_ns[0]) == (50.5, -1.25, 7.0, START_NS + 5)
    assert rows.is_geodetic.all() and rows.covariance_m2[0].tolist() == [4, 1, 9]


def test_location_fix_of_unknown_covariance(tmp_path: Path) -> None:
    message = fix(50.5)
    message.position_covariance_type = LocationFix.UNKNOWN
    rows, _ = read(tmp_path, [protobuf_row(message)])
    assert np.isnan(rows.covariance_m2).all()


def test_location_fixes(tmp_path: Path) -> None:
    rows, _ = read(tmp_path, [protobuf_row(LocationFixes(fixes=[fix(50.5), fix(51.5)]))])
    assert rows.first.tolist() == [50.5, 51.5]
    assert rows.covariance_m2.tolist() == [[4, 1, 9]] * 2
    assert rows.time_ns.tolist() == [START_NS + 5] * 2


@pytest.mark.parametrize("kind", [PoseInFrame, PosesInFrame, Point3InFrame])
def test_poses_in_frame(tmp_path: Path, kind: type[Message]) -> None:
    message: Any = kind(frame_id="map")
    message.timestamp.FromNanoseconds(START_NS + 5)
    place = message.point if kind is Point3InFrame else (message.poses.add() if kind is PosesInFrame else message.pose).position
    place.x, place.y, place.z = 1.5, -2.5, 3.5
    rows, _ = read(tmp_path, [protobuf_row(message)])
    assert (rows.first[0], rows.second[0], rows.z_m[0], rows.time_ns[0]) == (1.5, -2.5, 3.5, START_NS + 5)
    assert rows.frame_id[0] == "map" and not rows.is_geodetic[0]


def test_flat_json_odometry_without_header(tmp_path: Path) -> None:
    message = {"pose": {"position": {"x": 1.5, "y": -2.5}}}
    rows, _ = read(tmp_path, [Row("/odom", "nav_msgs/Odometry", 2.0, message)])
    assert (rows.first[0], rows.second[0], rows.time_ns[0]) == (1.5, -2.5, START_NS + 2 * 10**9)
    assert np.isnan(rows.z_m[0]) and rows.frame_id[0] == ""


def test_detection_array_as_json(tmp_path: Path) -> None:
    def item(name: str, x: float) -> dict[str, Any]:
        result = {"hypothesis": {"score": 0.5}, "pose": {"covariance": COVARIANCE_36.tolist()}}
        return {"id": name, "bbox": {"center": {"position": {"x": x, "y": 2.0, "z": 0.0}}}, "results": [result]}

    message = {"header": {"frame_id": "map"}, "detections": [item("a", 1.0), item("", 3.0)]}
    rows, _ = read(tmp_path, [Row("/seen", "vision_msgs/msg/Detection3DArray", 2.0, message)])
    assert rows.first.tolist() == [1.0, 3.0] and rows.agent.tolist() == ["a", None]
    assert rows.covariance_m2.tolist() == [[4, 1, 9]] * 2 and rows.score.tolist() == [0.5, 0.5]


def test_empty_array_is_no_detection_and_no_fault(tmp_path: Path) -> None:
    rows, reader = read(tmp_path, [Row("/seen", "foxglove.PosesInFrame", 2.0, {"poses": []})])
    assert len(rows) == 0 and reader.counts["incomplete"] == 0


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("geometry_msgs/msg/PoseStamped", "PoseStamped"),
        ("geometry_msgs/PoseStamped", "PoseStamped"),
        ("geometry_msgs.msg.PoseStamped", "PoseStamped"),
        ("geometry_msgs::msg::PoseStamped", "PoseStamped"),
        ("PoseStamped", "PoseStamped"),
        ("foxglove_msgs/msg/LocationFix", "LocationFix"),
        ("other_msgs/PoseStamped", None),
        ("std_msgs/msg/String", None),
        ("", None),
        (None, None),
    ],
)
def test_schema_names(name: str | None, expected: str | None) -> None:
    assert preset_for(name) == expected


def test_presets_are_complete() -> None:
    for name, preset in PRESETS.items():
        assert preset.schemas and all(normalise_schema(schema) == schema for schema in preset.schemas), name
        assert bool(preset.x) != bool(preset.latitude), name
