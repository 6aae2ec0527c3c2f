"""Metres that count from a place of their own, along axes of their own, or from the zero of another grid."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures.field_messages import PX4
from fixtures.ros_messages import Builder, store_with
from fixtures.small_logs import Row, detection, time_ns
from test_extract import run
from test_origins import local

ROS = Builder(store_with(PX4))


def odometry(time_s: float, x: float, y: float, robot: str, frame: str = "odom") -> Row:
    pose = ROS("geometry_msgs/msg/PoseWithCovariance", pose=ROS.pose(x, y, 0.0))
    message = ROS("nav_msgs/msg/Odometry", header=ROS.header(frame, time_ns(time_s)), child_frame_id="base_link", pose=pose)
    return ROS.cdr_row(message, f"/{robot}/odom", time_s)


def ahead(time_s: float, pose_frame: int) -> Row:
    position = np.array([3.0 * time_s, time_s, -9.0], np.float32)
    message = ROS("px4_msgs/msg/VehicleOdometry", timestamp=time_ns(time_s) // 1000, pose_frame=pose_frame, position=position)
    return ROS.cdr_row(message, "/uav/odom", time_s)


def seen(found: Any) -> list[str]:
    return [told["seen"] for told in found.summary["suspicions"]]


ROBOTS = [{"topic": "/{agent}/odom"}]


@pytest.mark.parametrize(("begins_m", "frame", "is_told"), [(0.0, "odom", True), (40.0, "odom", False), (0.0, "map", False)])
def test_robots_that_each_begin_at_zero(tmp_path: Path, begins_m: float, frame: str, is_told: bool) -> None:
    rows = [odometry(i, begins_m * k + 0.5 * i, 0.1 * i * k, f"r{k}", frame) for i in range(30) for k in (1, 2)]
    found = run(tmp_path, rows, detections=ROBOTS)
    assert found.summary["num_agents"] == 2
    told = '"r1", "r2" counts metres from where it began, as others do, and nothing says where that is'
    assert seen(found) == [told] * is_told


def test_one_robot_on_two_topics_begins_once(tmp_path: Path) -> None:
    rows = [odometry(i + 0.1 * k, 0.5 * i, 0.0, name) for i in range(30) for k, name in enumerate(("wheels", "lidar"))]
    found = run(tmp_path, rows, detections=[{"topic": "/wheels/odom", "agent": "a"}, {"topic": "/lidar/odom", "agent": "a"}])
    assert seen(found) == []


@pytest.mark.parametrize("other", [(float("nan"), float("nan")), (47.0, 8.0)])
def test_vehicles_of_which_one_at_least_does_not_say_where_it_began(tmp_path: Path, other: tuple[float, float]) -> None:
    rows = [local(i, 9.0 + i, (0.0, 0.0) if name == "d1" else other, name) for i in range(9) for name in ("d1", "d2")]
    (told,) = seen(run(tmp_path, rows))
    assert told.startswith('"d1"') and "nothing says where that is" in told
    assert seen(run(tmp_path, rows, trusted=["place"])) == []


@pytest.mark.parametrize(
    ("pose_frame", "stated", "num"), [(1, {}, 0), (2, {}, 1), (0, {}, 1), (2, {"frame_convention": "ned"}, 0)]
)
def test_axes_that_are_not_north_and_east(tmp_path: Path, pose_frame: int, stated: dict[str, str], num: int) -> None:
    found = run(tmp_path, [ahead(i, pose_frame) for i in range(9)], detections=[{"topic": "/uav/odom", "agent": "a"} | stated])
    assert found.detections["y_m"].to_pylist() == [3.0 * i for i in range(9)]
    assert seen(found) == ["9 messages say that x is not north but ahead, or anything"] * num


@pytest.mark.parametrize(("zero", "is_told"), [((690_000.0, 5_330_000.0), True), ((60_000.0, 0.0), False)])
def test_a_source_about_the_zero_of_another_grid(tmp_path: Path, zero: tuple[float, float], is_told: bool) -> None:
    rows = []
    for i in range(30):
        rows += [detection(i, zero[0] + 5.0 * i, zero[1], "/gps/contacts", agent_id="a")]
        rows += [detection(i, 5.0 * i, 40.0, "/lidar/contacts", agent_id="b")]
    found = run(tmp_path, rows)
    assert found.summary["num_detections"] == 60
    assert [told["subject"] for told in found.summary["suspicions"]] == ["/gps/contacts"] * is_told
