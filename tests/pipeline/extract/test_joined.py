"""Frames that nothing joins to the world: refused where the log knows better, told where only a name speaks."""

from pathlib import Path

import numpy as np
import pytest
from fixtures.ros_messages import Builder, store_with
from fixtures.small_logs import Row, detection, fix, pose, time_ns, write_log
from scipy.spatial.transform import Rotation
from test_extract import QUIET, fails, mk, run

from cadence.errors import InputError
from pipeline.extract.config import ExtractConfig
from pipeline.extract.writing import write_tables
from pipeline.logs.reader import open_log

ROS = Builder(store_with())


def transform(time_s: float, parent: str, child: str, x: float = 0.0, topic: str = "/tf", is_unset: bool = False) -> Row:
    rotation = ROS.turn(w=0.0) if is_unset else ROS.turn()
    motion = ROS("geometry_msgs/msg/Transform", translation=ROS("geometry_msgs/msg/Vector3", x=x), rotation=rotation)
    header = ROS.header(parent, time_ns(time_s))
    link = ROS("geometry_msgs/msg/TransformStamped", header=header, child_frame_id=child, transform=motion)
    return ROS.cdr_row(ROS("tf2_msgs/msg/TFMessage", transforms=[link]), topic, time_s)


def seen(frame: str, num: int = 20) -> list[Row]:
    """A target at (100, 30) of the world from a vehicle that drives east at 1 m/s."""
    return [detection(float(i), 100.0 - i, 30.0, topic="/radar/contacts", frame=frame) for i in range(num)]


DRIVE = [transform(float(i), "odom", "base_link", float(i)) for i in range(20)]
MOUNT = transform(0.0, "base_link", "radar", topic="/tf_static")


def test_joined_frames_come_to_the_world(tmp_path: Path) -> None:
    found = run(tmp_path, [MOUNT, *DRIVE, *seen("radar")])
    np.testing.assert_allclose(found.detections["x_m"], 100.0)
    assert found.summary["suspicions"] == []


def test_a_frame_that_no_transform_joins(tmp_path: Path) -> None:
    match = r"detections are in the frame radar, which no transform .* \(odom → base_link\); record its transforms"
    fails(mk(tmp_path / "a"), [*DRIVE, *seen("radar")], InputError, match)
    stated = run(mk(tmp_path / "b"), [*DRIVE, *seen("radar")], frame="radar")
    assert stated.frame.frame_id == "radar" and stated.detections["x_m"][0].as_py() == 100.0
    assert run(mk(tmp_path / "c"), [*DRIVE, *seen("radar")], trusted=["place"]).frame.frame_id == "radar"


def test_a_part_without_metadata_beside_the_first_one(tmp_path: Path) -> None:
    for part in range(2):
        write_log(tmp_path / f"run_{part}.mcap", [*DRIVE, *seen("radar")])
    for part, words in ((0, "record its transforms"), (1, r"run_0.mcap beside it may be its first part.* `ros2 bag reindex")):
        with pytest.raises(InputError, match=words):
            write_tables(open_log(tmp_path / f"run_{part}.mcap"), mk(tmp_path / f"{part}"), ExtractConfig(), QUIET)


def test_a_tree_of_its_own(tmp_path: Path) -> None:
    """The radar's antenna has a mount, but nothing says where the mount is."""
    mount = transform(0.0, "radar", "antenna", topic="/tf_static")
    fails(tmp_path, [mount, *DRIVE, *seen("antenna")], InputError, "frame antenna, which no transform")


def test_a_rotation_of_zeros(tmp_path: Path) -> None:
    unset = [transform(float(i), "map", "base_link", float(i), is_unset=True) for i in range(20)]
    fails(tmp_path, [*unset, *seen("base_link")], InputError, "20 transforms have a rotation of zeros, which is none")


@pytest.mark.parametrize("extra", [[], DRIVE])
def test_an_image_is_no_map(tmp_path: Path, extra: list[Row]) -> None:
    fails(tmp_path, [*extra, *seen("camera_color_optical_frame")], InputError, "optical_frame")


def test_a_vehicle_without_transforms_moves_by_its_name(tmp_path: Path) -> None:
    found = run(mk(tmp_path / "a"), seen("robot1/base_link"))
    (suspicion,) = found.summary["suspicions"]
    assert (suspicion["kind"], suspicion["subject"]) == ("place", "frame robot1/base_link")
    assert suspicion["setting"] == 'extract.frame = "robot1/base_link"'
    assert run(mk(tmp_path / "b"), seen("robot1/base_link"), frame="robot1/base_link").summary["suspicions"] == []
    mounted = run(mk(tmp_path / "c"), [MOUNT, *seen("radar")])  # its root is the vehicle, which nothing moves
    assert mounted.summary["suspicions"][0]["subject"] == "frame base_link"


def test_a_sensor_beside_a_vehicle_that_moves(tmp_path: Path) -> None:
    """Nothing says where the radar is, and its vehicle is told to move in another frame."""

    def beside(speed_mps: float, frame: str) -> list[Row]:
        drive = [pose(float(i), speed_mps * i, 0.0, "/ownship/pose", frame) for i in range(20)]
        return sorted([*seen("radar"), *drive], key=lambda row: row.time_s)

    (suspicion,) = run(mk(tmp_path / "a"), beside(5.0, "map")).summary["suspicions"]
    assert suspicion["subject"] == "frame radar" and "/ownship/pose moves by 95 m" in suspicion["seen"]
    for speed_mps, frame in ((0.0, "map"), (5.0, "radar")):
        assert run(mk(tmp_path / f"{frame}"), beside(speed_mps, frame)).summary["suspicions"] == []


def test_a_frame_without_a_name_beside_what_moves(tmp_path: Path) -> None:
    drive = [transform(float(i), "odom", "base_link", 3.0 * i) for i in range(20)]
    both = sorted([*drive, *seen("")], key=lambda row: row.time_s)
    (suspicion,) = run(mk(tmp_path / "a"), both).summary["suspicions"]
    assert suspicion["subject"] == "/radar/contacts"
    assert suspicion["seen"] == "the messages name no frame, and base_link moves by 57 m in odom"
    assert run(mk(tmp_path / "b"), both, frame="map").summary["suspicions"] == []
    assert run(mk(tmp_path / "c"), seen("")).summary["suspicions"] == []
    slow = sorted([*DRIVE, *seen("")], key=lambda row: row.time_s)  # 19 m: it may as well stand
    assert run(mk(tmp_path / "d"), slow).summary["suspicions"] == []


def test_what_is_in_a_frame_of_the_earth_joins_the_map(tmp_path: Path) -> None:
    mount = transform(0.0, "utm", "map", 690_000.0, topic="/tf_static")
    rows = [mount, *seen("map"), *(detection(float(i), 690_000.0 + i, 30.0, "/other/contacts", frame="utm") for i in range(20))]
    found = run(tmp_path, sorted(rows, key=lambda row: row.time_s))
    assert found.frame.frame_id == "map" and max(found.detections["x_m"].to_pylist()) == 100.0


@pytest.mark.parametrize("turn", [0.0, 0.3])
def test_degrees_and_metres_of_a_map_whose_place_the_transforms_tell(tmp_path: Path, turn: float) -> None:
    """At 0 N 90 E the earth's y is up, its z north, and east is against its x; a map that is turned there is no such."""
    to_earth = Rotation.from_matrix([[-1, 0, 0], [0, 0, 1], [0, 1, 0]]) * Rotation.from_rotvec([0, 0, turn])
    rotation = ROS.turn(*to_earth.as_quat())
    shift = ROS("geometry_msgs/msg/Transform", translation=ROS("geometry_msgs/msg/Vector3", y=6_378_137.0), rotation=rotation)
    header = ROS.header("earth", time_ns(0))
    link = ROS("geometry_msgs/msg/TransformStamped", header=header, child_frame_id="map", transform=shift)
    mount = ROS.cdr_row(ROS("tf2_msgs/msg/TFMessage", transforms=[link]), "/tf_static", 0.0)
    rows = [mount, *seen("map"), *(fix(float(i), 1e-4 * i, 90.0) for i in range(20))]
    if turn:
        fails(tmp_path, rows, InputError, "different frames")
        return
    found = run(tmp_path, rows)
    assert (found.frame.frame_id, found.frame.latitude_deg, found.frame.longitude_deg) == ("map", 0.0, 90.0)
    assert max(found.detections["y_m"].to_pylist()) == pytest.approx(19 * 11.0574, abs=0.1)


def test_two_frames_of_one_topic_and_the_way_out(tmp_path: Path) -> None:
    rows = [detection(float(i), 3.0 * i, 0.0, frame="odom" if i < 8 else "map") for i in range(20)]
    fails(mk(tmp_path / "a"), rows, InputError, r"""one frame of a topic by where = 'header.frame_id == "map"'""")
    found = run(mk(tmp_path / "b"), rows, detections=[{"topic": "/detections", "where": 'frame_id == "odom"'}])
    assert found.summary["num_detections"] == 8 and found.frame.frame_id == "odom"


@pytest.mark.parametrize("frame", ["map", "robot1/odom", "world_ned", "local_origin", "radar", "qualisys", ""])
@pytest.mark.parametrize("extra", [[], DRIVE])
def test_frames_that_stand(tmp_path: Path, frame: str, extra: list[Row]) -> None:
    if frame == "radar" and extra:
        pytest.skip("refused above")
    assert run(tmp_path, [*extra, *seen(frame)]).summary["suspicions"] == []


def test_a_part_of_a_split_recording_has_no_static_transforms(tmp_path: Path) -> None:
    later = [row for i, row in enumerate(DRIVE)] + seen("radar")
    first, second = write_log(tmp_path / "run_0.mcap", [MOUNT, *DRIVE]), write_log(tmp_path / "run_1.mcap", later)
    (tmp_path / "metadata.yaml").write_text(f"  relative_file_paths:\n    - {first.name}\n    - {second.name}\n")
    with pytest.raises(InputError, match=rf"part of a split recording, .* run the folder {tmp_path}; or"):
        write_tables(open_log(second), tmp_path, ExtractConfig(), QUIET)
    first.unlink()
    with pytest.raises(InputError, match=r"find .*run_0\.mcap; or"):
        write_tables(open_log(second), tmp_path, ExtractConfig(), QUIET)
