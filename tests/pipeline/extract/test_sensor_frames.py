"""Detections in the frames of sensors, through logs: they come out where the target was, whatever the sensor did."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import flatbuffers
import foxglove_schemas_flatbuffer
import numpy as np
import pytest
from fixtures.ros_messages import Builder, store_with
from fixtures.small_logs import Row, detection, fix, protobuf_row, stamp, time_ns, write_log
from foxglove_schemas_flatbuffer import FrameTransform as FlatTransform
from foxglove_schemas_flatbuffer import Quaternion, Time, Vector3
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from rosbags.typesys import Stores
from scipy.spatial.transform import Rotation
from test_extract import Extracted, fails, mk, run

from cadence.errors import ConfigError, InputError
from pipeline.extract.config import ExtractConfig
from pipeline.extract.writing import write_tables
from pipeline.logs.reader import open_log
from pipeline.progress import Progress

ROS, ROS1 = Builder(store_with()), Builder(store_with(base=Stores.ROS1_NOETIC))
TARGET = np.array([40.0, 25.0, 3.0])
MAST = Rotation.from_euler("zyx", [30, -10, 5], degrees=True), np.array([2.0, -1.0, 6.0])

Pose = tuple[Rotation, np.ndarray]
Encode = Callable[[float, str, str, Pose], Row]


def ship(time_s: float) -> Pose:
    """A ship that goes on at a steady speed while it turns, rolls and pitches."""
    rotation = Rotation.from_euler("z", 0.3 * time_s) * Rotation.from_rotvec([0.1, 0.05, 0.0])
    return rotation, np.array([3.0 * time_s, -2.0 * time_s, 0.5])


def seen(time_s: float, frame: str = "radar") -> np.ndarray:
    """Where the radar (or the ship) sees the target."""
    rotation, place = ship(time_s)
    on_board = rotation.inv().apply(TARGET - place)
    return MAST[0].inv().apply(on_board - MAST[1]) if frame == "radar" else on_board


def transform(build: Builder, time_s: float, parent: str, child: str, pose: Pose) -> Any:
    x, y, z, w = pose[0].as_quat()
    moved = build(
        "geometry_msgs/msg/Transform", rotation=build.turn(x, y, z, w),
        translation=build("geometry_msgs/msg/Vector3", **dict(zip("xyz", pose[1].tolist(), strict=True))),
    )  # fmt: skip
    name = "geometry_msgs/msg/TransformStamped"
    return build(name, header=build.header(parent, time_ns(time_s)), child_frame_id=child, transform=moved)


def ros2_row(time_s: float, parent: str, child: str, pose: Pose) -> Row:
    message = ROS("tf2_msgs/msg/TFMessage", transforms=[transform(ROS, time_s, parent, child, pose)])
    return ROS.cdr_row(message, "/tf_static" if child == "radar" else "/tf", time_s)


def ros1_row(time_s: float, parent: str, child: str, pose: Pose) -> Row:
    ROS1.store.register(TF_ROS1)
    message = ROS1("tf/msg/tfMessage", transforms=[transform(ROS1, time_s, f"/{parent}", f"/{child}", pose)])
    return ROS1.ros1_row(message, "/tf_static" if child == "radar" else "/tf", time_s)


TF_ROS1 = {"tf/msg/tfMessage": store_with().fielddefs["tf2_msgs/msg/TFMessage"]}


def _foxglove(time_s: float, parent: str, child: str, pose: Pose) -> FrameTransform:
    message = FrameTransform(parent_frame_id=parent, child_frame_id=child)
    message.timestamp.FromNanoseconds(time_ns(time_s))
    message.translation.x, message.translation.y, message.translation.z = pose[1]
    message.rotation.x, message.rotation.y, message.rotation.z, message.rotation.w = pose[0].as_quat()
    return message


def foxglove_row(time_s: float, parent: str, child: str, pose: Pose) -> Row:
    return protobuf_row(_foxglove(time_s, parent, child, pose), "/transform", time_s)


def foxglove_rows(time_s: float, parent: str, child: str, pose: Pose) -> Row:
    return protobuf_row(FrameTransforms(transforms=[_foxglove(time_s, parent, child, pose)]), "/transforms", time_s)


def json_transform_row(time_s: float, parent: str, child: str, pose: Pose) -> Row:
    message = {
        "timestamp": stamp(time_s), "parent_frame_id": parent, "child_frame_id": child,
        "translation": dict(zip("xyz", pose[1].tolist(), strict=True)),
        "rotation": dict(zip("xyzw", pose[0].as_quat().tolist(), strict=True)),
    }  # fmt: skip
    return Row("/transform", "foxglove.FrameTransform", time_s, message)


def flatbuffer_row(time_s: float, parent: str, child: str, pose: Pose) -> Row:
    builder = flatbuffers.Builder()
    names = [builder.CreateString(name) for name in (parent, child)]
    parts = []
    for kind, values in ((Vector3, pose[1]), (Quaternion, pose[0].as_quat())):
        kind.Start(builder)
        for axis, value in zip("XYZW", values, strict=False):
            getattr(kind, f"Add{axis}")(builder, value)
        parts.append(kind.End(builder))
    FlatTransform.Start(builder)
    FlatTransform.AddTimestamp(builder, Time.CreateTime(builder, *divmod(time_ns(time_s), 10**9)))
    FlatTransform.AddParentFrameId(builder, names[0])
    FlatTransform.AddChildFrameId(builder, names[1])
    FlatTransform.AddTranslation(builder, parts[0])
    FlatTransform.AddRotation(builder, parts[1])
    builder.Finish(FlatTransform.End(builder))
    schema = Path(foxglove_schemas_flatbuffer.__file__).parent / "FrameTransform.bfbs"
    data = bytes(builder.Output())
    return Row("/transform", "foxglove.FrameTransform", time_s, data, "flatbuffer", "flatbuffer", schema.read_bytes())


def seen_row(time_s: float, frame: str = "radar", late_s: float = 0.2, **more: Any) -> Row:
    """A detection that is logged some time after its stamp, when the ship has gone on already."""
    x, y, z = seen(time_s, frame).tolist()
    message = {"timestamp": stamp(time_s), "frame_id": frame, "position": {"x": x, "y": y, "z": z}, **more}
    return Row("/radar/contacts", "mission.Detection", time_s + late_s, message)


def cruise(encode: Encode, last_s: float = 10.0) -> list[Row]:
    """Samples of the ship ten times a second; where the mast stands is told only at the very end."""
    poses = [encode(i / 10, "map", "ship", ship(i / 10)) for i in range(round(last_s * 10) + 1)]
    return [*poses, encode(last_s, "ship", "radar", MAST)]


def places(found: Extracted) -> np.ndarray:
    return np.column_stack([found.detections[name].to_numpy() for name in ("x_m", "y_m", "z_m")])


@pytest.mark.parametrize("encode", [ros2_row, ros1_row, foxglove_row, foxglove_rows, json_transform_row, flatbuffer_row])
def test_a_target_that_stays_comes_out_on_one_point(tmp_path: Path, encode: Encode) -> None:
    """Each time is between two samples of the ship; between them it turns at a steady rate, so slerp is exact."""
    times = np.arange(0.25, 9.5, 0.37)
    found = run(tmp_path, [*(seen_row(float(time_s)) for time_s in times), *cruise(encode)])
    np.testing.assert_allclose(places(found), np.broadcast_to(TARGET, (len(times), 3)), atol=1e-6)
    assert found.frame.frame_id == "map"
    transforms = found.summary["transforms"]
    assert (transforms["num_frames"], transforms["transformed"], transforms["no_transform"]) == (2, len(times), 0)


def test_covariances_turn_too(tmp_path: Path) -> None:
    """A radar on a mast that is turned by a quarter: what it knows badly is along its y, which is x on the map."""
    quarter = Rotation.from_euler("z", 90, degrees=True), np.zeros(3)
    still = Rotation.identity(), np.array([100.0, 0.0, 0.0])
    row = detection(1.0, 1.0, 2.0, frame="radar", covariance=[1.0, 0.5, 0.5, 9.0])
    found = run(
        tmp_path,
        [row, ros2_row(0.5, "map", "ship", still), ros2_row(1.5, "map", "ship", still), ros2_row(2, "ship", "radar", quarter)],
    )
    assert places(found)[0] == pytest.approx([98.0, 1.0, 0.0])
    columns = [found.detections[name][0].as_py() for name in ("cov_xx_m2", "cov_xy_m2", "cov_yy_m2")]
    assert columns == pytest.approx([9.0, -0.5, 1.0])


def test_what_no_transform_is_near_is_refused_and_counted(tmp_path: Path) -> None:
    rows = [*(seen_row(float(time_s)) for time_s in (-2.0, -0.4, 5.0, 10.4, 12.0)), *cruise(ros2_row)]
    found = run(tmp_path, rows)
    assert found.detections["time_ns"].to_pylist() == [time_ns(time_s) for time_s in (-0.4, 5.0, 10.4)]
    assert found.summary["transforms"]["no_transform"] == 2
    assert run(tmp_path, rows, max_extrapolation_s=3.0).summary["num_detections"] == 5
    strict = run(tmp_path, rows, max_extrapolation_s=0.0, max_transform_gap_s=0.05)
    assert strict.summary["num_detections"] == 1  # the one at a sample
    message = "none of the detections the log has a transform near enough"
    fails(mk(tmp_path / "none"), [seen_row(50.0), *cruise(ros2_row)], InputError, message)


@pytest.mark.parametrize("child", ["body_frame_id", "child_frame_id"])
def test_foxglove_odometry_tells_where_its_body_is(tmp_path: Path, child: str) -> None:
    def odometry(time_s: float) -> Row:
        rotation, place = ship(time_s)
        pose = {
            "position": dict(zip("xyz", place.tolist(), strict=True)),
            "orientation": dict(zip("xyzw", rotation.as_quat().tolist(), strict=True)),
        }
        message = {"timestamp": stamp(time_s), "frame_id": "odom", child: "ship", "pose": pose}
        return Row("/own/odom", "foxglove.Odometry", time_s, message)

    found = run(tmp_path, [*(seen_row(i + 0.55, "ship") for i in range(8)), *(odometry(i / 10) for i in range(100))])
    assert found.frame.frame_id == "odom"
    np.testing.assert_allclose(found.detections["x_m"], TARGET[0], atol=0.02)


def test_odometry_tells_where_its_child_frame_is(tmp_path: Path) -> None:
    def odometry(time_s: float) -> Row:
        rotation, place = ship(time_s)
        x, y, z, w = rotation.as_quat()
        pose = ROS.pose(*place.tolist())
        pose.orientation = ROS.turn(x, y, z, w)
        stated = ROS("geometry_msgs/msg/PoseWithCovariance", pose=pose)
        message = ROS("nav_msgs/msg/Odometry", header=ROS.header("map", time_ns(time_s)), child_frame_id="ship", pose=stated)
        return ROS.cdr_row(message, "/odom", time_s)

    found = run(tmp_path, [*(seen_row(i + 0.55, "ship") for i in range(8)), *(odometry(i / 10) for i in range(100))])
    np.testing.assert_allclose(places(found), np.broadcast_to(TARGET, (8, 3)), atol=1e-6)
    assert found.table("poses")["sensor_id"].to_pylist() == ["odom"] * 100


def test_sensors_of_several_frames_come_together(tmp_path: Path) -> None:
    camera = detection(3.0, *seen(3.0, "ship")[:2].tolist(), topic="/camera/detections", frame="ship")
    camera.message["position"]["z"] = float(seen(3.0, "ship")[2])  # type: ignore[index, call-overload]
    found = run(tmp_path, [seen_row(2.0), camera, *cruise(ros2_row)])
    np.testing.assert_allclose(places(found), np.broadcast_to(TARGET, (2, 3)), atol=1e-6)


def test_detections_in_a_fixed_frame_stay_as_they_are(tmp_path: Path) -> None:
    drift = ros2_row(0.0, "map", "odom", (Rotation.identity(), np.array([5.0, 0.0, 0.0])))
    rows = [detection(float(i), 3.0 * i, 1.0, frame="odom") for i in range(5)]
    found = run(tmp_path, [*rows, drift])
    assert found.frame.frame_id == "odom" and found.detections["x_m"].to_pylist() == [0.0, 3.0, 6.0, 9.0, 12.0]
    moved = run(tmp_path, [*rows, drift], frame="map", max_extrapolation_s=10.0)
    assert moved.frame.frame_id == "map" and moved.detections["x_m"].to_pylist() == [5.0, 8.0, 11.0, 14.0, 17.0]


def test_truth_in_another_frame_is_brought_to_the_detections(tmp_path: Path) -> None:
    truth = Row("/truth/T0", "mission.Detection", 2.0, seen_row(2.0, "ship").message)
    found = run(tmp_path, [detection(2.0, 40.0, 25.0, frame="map"), truth, *cruise(ros2_row)])
    truth_table = found.table("truth")
    assert [truth_table[name][0].as_py() for name in ("x_m", "y_m", "z_m")] == pytest.approx(TARGET.tolist(), abs=1e-6)


def test_frames_that_nothing_joins_are_an_error(tmp_path: Path) -> None:
    other = detection(3.0, 1.0, 2.0, topic="/camera/detections", frame="cart")
    match = r"detections are in the frame cart, which no transform of the log joins to another \(ship → radar; map → ship\)"
    fails(mk(tmp_path / "a"), [seen_row(2.0), other, *cruise(ros2_row)], InputError, match)
    match = "extract.frame: no position and no transform of the log is in 'world'; known: map, radar, ship"
    fails(mk(tmp_path / "b"), [seen_row(2.0), *cruise(ros2_row)], ConfigError, match, frame="world")


def test_cycles_and_bad_transforms_are_named(tmp_path: Path) -> None:
    still = Rotation.identity(), np.zeros(3)
    odd = ros2_row(1.0, "a", "b", still), ros2_row(1.0, "b", "a", still)
    broken = json_transform_row(1.0, "map", "x", still)
    broken.message["rotation"] = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 0.0}  # type: ignore[index, call-overload]
    found = run(tmp_path, [seen_row(2.0), *odd, broken, *cruise(ros2_row)])
    assert found.summary["transforms"]["problems"] == ["frames a → b → a form a cycle and are not used"]
    assert found.summary["transforms"]["zero_rotations"] == 1
    assert places(found)[0] == pytest.approx(TARGET, abs=1e-6)


def test_transforms_that_cannot_be_decoded_are_counted(tmp_path: Path) -> None:
    broken = Row("/more/tf", "tf2_msgs/msg/TFMessage", 1.0, b"\x00\x01\x00\x00", "cdr", "ros2msg", b"not a schema")
    found = run(tmp_path, [seen_row(2.0), broken, *cruise(ros2_row)])
    assert found.summary["transforms"]["undecodable_transforms"] == 1 and found.summary["num_detections"] == 1


def test_north_east_down(tmp_path: Path) -> None:
    """12 m north, 5 m east, 30 m below; known badly to the north."""
    rows = [detection(float(i), 12.0 + i, 5.0, frame="local_ned", covariance=[9.0, 1.0, 1.0, 4.0]) for i in range(3)]
    for row in rows:
        row.message["position"]["z"] = 30.0  # type: ignore[index, call-overload]
    found = run(tmp_path, rows, detections=[{"topic": "/detections", "frame_convention": "ned"}])
    np.testing.assert_allclose(places(found), [[5, 12, -30], [5, 13, -30], [5, 14, -30]])
    columns = [found.detections[name][0].as_py() for name in ("cov_xx_m2", "cov_xy_m2", "cov_yy_m2")]
    assert columns == pytest.approx([4.0, 1.0, 9.0]) and found.frame.frame_id == "local_ned_enu"
    by_name = run(tmp_path, rows)
    assert by_name.detections.equals(found.detections) and by_name.summary["north_by_name"] == 3
    stated = run(tmp_path, rows, detections=[{"topic": "/detections", "frame_convention": "enu"}])
    assert stated.detections["x_m"].to_pylist() == [12.0, 13.0, 14.0] and "north_by_name" not in stated.summary


def test_what_was_left_out_is_told_in_one_line_each(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = Row("/truth/T0", "mission.Detection", 2.0, detection(2.0, 1.0, 1.0, frame="cart").message)
    broken = Row("/more/tf", "tf2_msgs/msg/TFMessage", 1.0, b"\x00\x01\x00\x00", "cdr", "ros2msg", b"not a schema")
    log = write_log(tmp_path / "log.mcap", [seen_row(2.0), seen_row(50.0), other, broken, *cruise(ros2_row)])
    summary = write_tables(open_log(log), tmp_path, ExtractConfig(), Progress())
    told = capsys.readouterr().err
    assert summary["transforms"]["unconnected_frames"] == ["cart"]
    assert "no transform joins the detections' frame to cart" in told
    assert "1 message with transforms cannot be decoded" in told
    assert "1 position has no transform near enough in time" in told
    ned = write_log(tmp_path / "ned.mcap", [detection(float(i), i, i, frame="local_ned") for i in range(3)])
    write_tables(open_log(ned), tmp_path, ExtractConfig(), Progress())
    assert "3 positions are north, east, down by their frame's name and were turned" in capsys.readouterr().err


def test_a_sensor_in_a_world_that_is_north_east_down(tmp_path: Path) -> None:
    """The same cruise, its world read as NED: east is what was y."""
    found = run(
        tmp_path, [seen_row(2.0), *cruise(ros2_row)], detections=[{"topic": "/radar/contacts", "frame_convention": "ned"}]
    )
    assert places(found)[0] == pytest.approx([TARGET[1], TARGET[0], -TARGET[2]], abs=1e-6)


def test_metres_and_degrees_come_together_about_a_stated_datum(tmp_path: Path) -> None:
    rows = [detection(0.0, 10.0, 20.0), fix(1.0, 50.001, -1.0, "/contacts/A")]
    found = run(tmp_path, rows, datum=[50.0, -1.0])
    assert (found.frame.frame_id, found.frame.latitude_deg) == ("map", 50.0)
    np.testing.assert_allclose(found.detections["y_m"].to_numpy(), [20.0, 111.229], atol=0.01)
    fails(mk(tmp_path / "without"), rows, InputError, "state extract.datum")
