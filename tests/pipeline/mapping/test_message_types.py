"""Every known type against messages built with the real definitions of their types, through the log, in every encoding."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures.ros_messages import (
    AUTOWARE,
    COVARIANCE_36,
    MAVROS,
    RADAR,
    VISION_FOXY,
    VISION_HUMBLE,
    VISION_ROS1,
    Builder,
    store_with,
)
from fixtures.small_logs import START_NS, Row, protobuf_row, write_log
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.LocationFixes_pb2 import LocationFixes
from foxglove_schemas_protobuf.Point3InFrame_pb2 import Point3InFrame
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.json_format import MessageToDict
from google.protobuf.message import Message
from rosbags.typesys import Stores

from pipeline.extract.channel_reader import ChannelReader
from pipeline.extract.positions import Positions
from pipeline.extract.reading import read_positions
from pipeline.logs.reader import open_log
from pipeline.mapping.message_types import MESSAGE_TYPES, normalise_schema, type_of_schema
from pipeline.mapping.sources import SourceConfig
from pipeline.progress import Progress

ROS = Builder(store_with())
HUMBLE, FOXY, RADARS = (Builder(store_with(definitions)) for definitions in (VISION_HUMBLE, VISION_FOXY, RADAR))
NOETIC = Builder(store_with(VISION_ROS1, Stores.ROS1_NOETIC))
TRACKED = Builder(store_with(AUTOWARE, package="autoware_perception_msgs"))
TRACKED_AUTO = Builder(store_with(AUTOWARE, package="autoware_auto_perception_msgs"))
AIRCRAFT = Builder(store_with(MAVROS))


def read(path: Path, rows: list[Row], **source: Any) -> tuple[Positions, ChannelReader]:
    log = open_log(write_log(path / "log.mcap", rows))
    reader = ChannelReader(log.channels[0], SourceConfig(rows[0].topic, **source), "detections", True, {})
    counts = read_positions(log, [reader], Progress(quiet=True))
    assert counts["undecodable"] == 0
    return reader.finish(), reader


def nav_sat_fix(status: int = 0, kind: int = 2, build: Builder = ROS) -> Any:
    state = build("sensor_msgs/msg/NavSatStatus", status=status, service=1)
    return build(
        "sensor_msgs/msg/NavSatFix", header=build.header(), status=state,
        latitude=50.5, longitude=-1.25, altitude=7.0, position_covariance=np.array([4.0, 1, 0, 1, 9, 0, 0, 0, 16]),
        position_covariance_type=kind,
    )  # fmt: skip


COMMON: dict[str, Callable[[Builder], Any]] = {
    "PointStamped": lambda build: build("geometry_msgs/msg/PointStamped", header=build.header(), point=build.point()),
    "PoseStamped": lambda build: build("geometry_msgs/msg/PoseStamped", header=build.header(), pose=build.pose()),
    "PoseWithCovarianceStamped": lambda build: build(
        "geometry_msgs/msg/PoseWithCovarianceStamped", header=build.header(), pose=build.uncertain_pose()
    ),
    "PoseArray": lambda build: build("geometry_msgs/msg/PoseArray", header=build.header(), poses=[build.pose(), build.pose()]),
    "Odometry": lambda build: build(
        "nav_msgs/msg/Odometry", header=build.header(), child_frame_id="base", pose=build.uncertain_pose()
    ),
    "NavSatFix": lambda build: nav_sat_fix(build=build),
}


def encoded(build: Builder, message: Any, encoding: str) -> Row:
    return build.ros1_row(message) if encoding == "ros1" else build.cdr_row(message, is_idl=encoding == "ros2idl")


def json_row(message: Message, topic: str = "/thing") -> Row:
    """The message as Foxglove's JSON schemas have it: times as sec and nsec."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: stamp(item) if key in ("timestamp", "lifetime") else plain(item) for key, item in value.items()}
        return [plain(item) for item in value] if isinstance(value, list) else value

    def stamp(text: str) -> dict[str, int]:
        return {"sec": START_NS // 10**9, "nsec": 5} if text.startswith("20") else {"sec": 0, "nsec": 0}

    tree = MessageToDict(
        message, preserving_proto_field_name=True, always_print_fields_with_no_presence=True, use_integers_for_enums=True
    )
    return Row(topic, message.DESCRIPTOR.full_name, 1.0, json.dumps(plain(tree)).encode())


@pytest.mark.parametrize("encoding", ["ros2msg", "ros2idl", "ros1"])
@pytest.mark.parametrize("name", COMMON)
def test_common_ros_messages(tmp_path: Path, name: str, encoding: str) -> None:
    build = NOETIC if encoding == "ros1" else ROS
    message = COMMON[name](build)
    rows, _ = read(tmp_path, [encoded(build, message, encoding)])
    assert type_of_schema(message.__msgtype__) == name
    assert len(rows) == (2 if name == "PoseArray" else 1)
    assert rows.time_ns[0] == START_NS + 250_000_000
    assert rows.log_time_ns[0] == START_NS + 10**9
    assert rows.frame_id[0] == "odom"
    assert bool(rows.is_geodetic[0]) == (name == "NavSatFix")
    expected = (50.5, -1.25, 7.0) if name == "NavSatFix" else (1.5, -2.5, 3.5)
    assert (rows.first[0], rows.second[0], rows.z_m[0]) == expected
    has_covariance = name in ("PoseWithCovarianceStamped", "Odometry", "NavSatFix")
    np.testing.assert_array_equal(rows.covariance_m2[0], [4, 1, 9] if has_covariance else [np.nan] * 3)
    np.testing.assert_array_equal(rows.height_covariance_m2[0], [0, 0, 16] if has_covariance else [np.nan] * 3)


@pytest.mark.parametrize(
    ("build", "encoding"), [(HUMBLE, "ros2msg"), (HUMBLE, "ros2idl"), (FOXY, "ros2msg"), (FOXY, "ros2idl"), (NOETIC, "ros1")]
)
def test_detection_arrays_of_all_versions(tmp_path: Path, build: Builder, encoding: str) -> None:
    found = [build.detection("7", 10.0), build.detection("", 0.0, has_box=False)]
    array = build("vision_msgs/msg/Detection3DArray", header=build.header(), detections=found)
    rows, _ = read(tmp_path, [encoded(build, array, encoding)])
    assert rows.first.tolist() == [10.0, 1.0]  # the second one has no box: the pose of its hypothesis counts
    assert rows.second.tolist() == [-2.5, -2.5] and rows.z_m.tolist() == [3.5, 3.5]
    assert rows.covariance_m2.tolist() == [[4, 1, 9]] * 2 and rows.score.tolist() == [0.5, 0.5]
    assert rows.agent.tolist() == [None if encoding == "ros1" else "7", None]
    assert rows.time_ns.tolist() == [START_NS + 250_000_000] * 2 and rows.frame_id.tolist() == ["odom"] * 2


def test_detection_array_whose_header_only_its_items_fill_in(tmp_path: Path) -> None:
    one, other = HUMBLE.detection("a", 1.0), HUMBLE.detection("b", 2.0)
    one.header, other.header = HUMBLE.header("cam", START_NS + 1), HUMBLE.header("cam", START_NS + 2)
    other.results = []
    rows, _ = read(tmp_path, [HUMBLE.cdr_row(HUMBLE("vision_msgs/msg/Detection3DArray", detections=[one, other]))])
    assert rows.time_ns.tolist() == [START_NS + 1, START_NS + 2] and rows.frame_id.tolist() == ["cam", "cam"]
    np.testing.assert_array_equal(rows.covariance_m2, [[4, 1, 9], [np.nan] * 3])
    np.testing.assert_array_equal(rows.score, [0.5, np.nan])


def test_a_box_that_is_not_a_number_is_not_filled_in(tmp_path: Path) -> None:
    found = HUMBLE.detection("7", 1.0)
    found.bbox.center.position.x = math.nan
    rows, _ = read(
        tmp_path, [HUMBLE.cdr_row(HUMBLE("vision_msgs/msg/Detection3DArray", header=HUMBLE.header(), detections=[found]))]
    )
    assert rows.first.tolist() == [2.0]  # of the hypothesis


def test_detections_from_several_sensors_keep_their_own_stamps_and_frames(tmp_path: Path) -> None:
    one, other = HUMBLE.detection("a", 1.0), HUMBLE.detection("b", 2.0)
    one.header, other.header = HUMBLE.header("cam", START_NS + 1), HUMBLE.header("lidar", START_NS + 2)
    message = HUMBLE("vision_msgs/msg/Detection3DArray", header=HUMBLE.header("map", START_NS + 9), detections=[one, other])
    rows, _ = read(tmp_path, [HUMBLE.cdr_row(message)])
    assert rows.time_ns.tolist() == [START_NS + 1, START_NS + 2] and rows.frame_id.tolist() == ["cam", "lidar"]


@pytest.mark.parametrize("encoding", ["ros2msg", "ros2idl"])
def test_radar_tracks(tmp_path: Path, encoding: str) -> None:
    upper = np.array([4.0, 1.0, 0.5, 9.0, 0.25, 16.0], np.float32)
    uuid = RADARS("unique_identifier_msgs/msg/UUID", uuid=np.arange(16, dtype=np.uint8))
    track = RADARS("radar_msgs/msg/RadarTrack", uuid=uuid, position=RADARS.point(), position_covariance=upper)
    message = RADARS("radar_msgs/msg/RadarTracks", header=RADARS.header("radar"), tracks=[track, track])
    rows, _ = read(tmp_path, [encoded(RADARS, message, encoding)])
    assert rows.first.tolist() == [1.5] * 2 and rows.second.tolist() == [-2.5] * 2 and rows.z_m.tolist() == [3.5] * 2
    assert rows.covariance_m2.tolist() == [[4, 1, 9]] * 2 and rows.height_covariance_m2.tolist() == [[0.5, 0.25, 16]] * 2
    assert rows.agent.tolist() == ["000102030405060708090a0b0c0d0e0f"] * 2 and rows.frame_id.tolist() == ["radar"] * 2


@pytest.mark.parametrize("encoding", ["ros2msg", "ros2idl"])
@pytest.mark.parametrize("build", [TRACKED, TRACKED_AUTO])
def test_autoware_tracked_objects(tmp_path: Path, build: Builder, encoding: str) -> None:
    package = "autoware_perception_msgs" if build is TRACKED else "autoware_auto_perception_msgs"
    tracked = build(
        f"{package}/msg/TrackedObject",
        object_id=build("unique_identifier_msgs/msg/UUID", uuid=np.arange(16, dtype=np.uint8)), existence_probability=0.75,
        classification=[build(f"{package}/msg/ObjectClassification", label=1, probability=0.5)],
        kinematics=build(f"{package}/msg/TrackedObjectKinematics", pose_with_covariance=build.uncertain_pose()),
    )  # fmt: skip
    message = build(f"{package}/msg/TrackedObjects", header=build.header(), objects=[tracked])
    rows, _ = read(tmp_path, [encoded(build, message, encoding)])
    assert (rows.first[0], rows.second[0], rows.z_m[0], rows.score[0]) == (1.5, -2.5, 3.5, 0.75)
    assert rows.covariance_m2.tolist() == [[4, 1, 9]] and rows.agent[0] == "000102030405060708090a0b0c0d0e0f"


@pytest.mark.parametrize("encoding", ["ros2msg", "ros2idl"])
def test_adsb_vehicles(tmp_path: Path, encoding: str) -> None:
    def vehicle(flags: int) -> Any:
        return AIRCRAFT(
            "mavros_msgs/msg/ADSBVehicle", header=AIRCRAFT.header(), icao_address=11_259_375, callsign="N1", latitude=50.5,
            longitude=-1.25, altitude=1000.0, flags=flags,
        )  # fmt: skip

    rows, reader = read(tmp_path, [encoded(AIRCRAFT, vehicle(flags), encoding) for flags in (3, 2)])
    assert (rows.first.tolist(), rows.second.tolist(), rows.z_m.tolist()) == ([50.5], [-1.25], [1000.0])
    assert rows.agent.tolist() == ["11259375"] and rows.is_geodetic.all() and reader.counts["no_fix"] == 1


def scene() -> SceneUpdate:
    message = SceneUpdate()
    message.deletions.add()
    for name, num_cubes, num_spheres in (("a", 2, 0), ("b", 0, 0), ("c", 1, 1), ("d", 0, 0)):
        entity = message.entities.add(id=name, frame_id="lidar")
        entity.timestamp.FromNanoseconds(START_NS + 5)
        for i in range(num_cubes):
            cube = entity.cubes.add().pose.position
            cube.x, cube.y, cube.z = 1.0 + i, 2.0, 3.0
        for _ in range(num_spheres):
            entity.spheres.add().pose.position.x = 50.0
        if name == "d":
            entity.models.add().pose.position.x = 60.0
    return message


@pytest.mark.parametrize("encode", [protobuf_row, json_row])
def test_cubes_spheres_and_models_of_a_scene(tmp_path: Path, encode: Callable[[Message], Row]) -> None:
    rows, reader = read(tmp_path, [encode(scene())])
    assert rows.first.tolist() == [1.0, 2.0, 1.0, 50.0, 60.0] and rows.agent.tolist() == ["a", "a", "c", "c", "d"]
    assert rows.second.tolist() == [2.0, 2.0, 2.0, 0.0, 0.0] and set(rows.frame_id) == {"lidar"}
    assert rows.time_ns.tolist() == [START_NS + 5] * 5 and reader.counts["incomplete"] == 0


def test_fix_without_position_or_covariance(tmp_path: Path) -> None:
    rows, reader = read(tmp_path, [ROS.cdr_row(nav_sat_fix(status=-1)), ROS.cdr_row(nav_sat_fix(kind=0))])
    assert len(rows) == 1 and reader.counts["no_fix"] == 1
    assert np.isnan(rows.covariance_m2).all()


def fix(latitude: float) -> LocationFix:
    message = LocationFix(latitude=latitude, longitude=-1.25, altitude=7.0, frame_id="wgs84")
    message.timestamp.FromNanoseconds(START_NS + 5)
    message.position_covariance.extend([4.0, 1, 0, 1, 9, 0, 0, 0, 7])
    message.position_covariance_type = LocationFix.KNOWN
    return message


@pytest.mark.parametrize("encode", [protobuf_row, json_row])
def test_location_fix(tmp_path: Path, encode: Callable[[Message], Row]) -> None:
    rows, _ = read(tmp_path, [encode(fix(50.5))])
    assert (rows.first[0], rows.second[0], rows.z_m[0], rows.time_ns[0]) == (50.5, -1.25, 7.0, START_NS + 5)
    assert rows.is_geodetic.all() and rows.covariance_m2[0].tolist() == [4, 1, 9]


def test_location_fix_of_unknown_covariance(tmp_path: Path) -> None:
    message = fix(50.5)
    message.position_covariance_type = LocationFix.UNKNOWN
    rows, _ = read(tmp_path, [protobuf_row(message)])
    assert np.isnan(rows.covariance_m2).all()


@pytest.mark.parametrize("encode", [protobuf_row, json_row])
def test_location_fixes(tmp_path: Path, encode: Callable[[Message], Row]) -> None:
    rows, _ = read(tmp_path, [encode(LocationFixes(fixes=[fix(50.5), fix(51.5)]))])
    assert rows.first.tolist() == [50.5, 51.5]
    assert rows.covariance_m2.tolist() == [[4, 1, 9]] * 2
    assert rows.time_ns.tolist() == [START_NS + 5] * 2


@pytest.mark.parametrize("encode", [protobuf_row, json_row])
@pytest.mark.parametrize("kind", [PoseInFrame, PosesInFrame, Point3InFrame])
def test_poses_in_frame(tmp_path: Path, kind: type[Message], encode: Callable[[Message], Row]) -> None:
    message: Any = kind(frame_id="map")
    message.timestamp.FromNanoseconds(START_NS + 5)
    place = message.point if kind is Point3InFrame else (message.poses.add() if kind is PosesInFrame else message.pose).position
    place.x, place.y, place.z = 1.5, -2.5, 3.5
    rows, _ = read(tmp_path, [encode(message)])
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
    assert type_of_schema(name) == expected


def test_types_are_complete() -> None:
    for name, known in MESSAGE_TYPES.items():
        assert all(normalise_schema(schema) == schema for schema in known.schemas), name
        assert known.schemas or name == "AIS"  # JSON without a schema
        assert [bool(known.x), bool(known.latitude), known.is_polar].count(True) == 1, name
