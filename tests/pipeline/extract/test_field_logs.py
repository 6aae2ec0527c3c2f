"""Logs with the types that people record: what is taken for detections, and what is named because it is not."""

import json
from pathlib import Path

import numpy as np
from fixtures.field_messages import OBJECTS
from fixtures.ros_messages import Builder, store_with
from fixtures.small_logs import Row, fix, pose, stamp, time_ns
from test_extract import fails, run

from cadence.errors import InputError

ROS, SEEN = Builder(store_with()), Builder(store_with(OBJECTS))


def pose_row(time_s: float, x: float, topic: str, frame: str = "map") -> Row:
    message = ROS("geometry_msgs/msg/PoseStamped", header=ROS.header(frame, time_ns(time_s)), pose=ROS.pose(x))
    return ROS.cdr_row(message, topic, time_s)


def test_topics_of_several_types_in_one_pattern(tmp_path: Path) -> None:
    """Each is read by its own type, although the patterns of both fit both."""
    rows = []
    for i in range(4):
        header = SEEN.header("map", time_ns(i))
        item = SEEN("derived_object_msgs/msg/Object", id=7, pose=SEEN.pose(float(i)))
        box = SEEN("jsk_recognition_msgs/msg/BoundingBox", pose=SEEN.pose(100.0))
        array = SEEN("derived_object_msgs/msg/ObjectArray", header=header, objects=[item])
        boxes = SEEN("jsk_recognition_msgs/msg/BoundingBoxArray", header=header, boxes=[box])
        rows += [SEEN.cdr_row(array, "/front/radar/detections", i), SEEN.cdr_row(boxes, "/left/radar/detections", i)]
    found = run(tmp_path, rows)
    assert found.summary["num_detections"] == 8 and found.summary["incomplete"] == 0
    assert set(zip(found.detections["agent_id"].to_pylist(), found.detections["topic"].to_pylist(), strict=True)) == {
        ("7", "/front/radar/detections"), (None, "/left/radar/detections"),
    }  # fmt: skip


def test_one_topic_with_two_types_is_never_mixed(tmp_path: Path) -> None:
    (tmp_path / "both").mkdir()
    rows = [fix(float(i), 50.0, 1.0 + i * 1e-4, "/target/position") for i in range(6)]
    rows += [pose(6.0 + i, 10.0 * i, 0.0, "/target/position") for i in range(6)]
    found = run(tmp_path, rows, detections=[{"topic": "/target/position", "message_type": "NavSatFix"}])
    assert found.summary["num_detections"] == 6 and found.frame.is_georeferenced
    assert found.summary["unused"] == {"/target/position (foxglove.PoseInFrame)": "[[extract.detections]] names others"}
    fails(tmp_path / "both", rows, InputError, r"frames: /target/position \(latitude and longitude\), /target/position")


def test_patterns_that_overlap_read_a_topic_once(tmp_path: Path) -> None:
    """`/radar/contacts/{agent}`, and `/{sensor}/contacts/{agent}` for the camera's, which means the radar's as well."""
    topics = ("/radar/contacts/v1", "/camera/contacts/v1")
    rows = [pose_row(i + 0.2 * k, 5.0 * i, topic) for i in range(8) for k, topic in enumerate(topics)]
    found = run(tmp_path, rows)
    assert sorted(found.detections["topic"].to_pylist()) == sorted(8 * topics)
    pasted = [{"topic": "/radar/contacts/{agent}"}, {"topic": "/{sensor}/contacts/{agent}"}]
    assert run(tmp_path, rows, detections=pasted).detections.equals(found.detections)


def test_a_set_point_is_no_detection(tmp_path: Path) -> None:
    """What an autopilot is told to reach has a name like that of what it looks for."""
    rows = [
        row for i in range(8) for row in (pose_row(i, 50.0, "/uav1/target_pose"), pose_row(i, 3.0 * i, "/radar/contacts/v1"))
    ]
    rows += [pose_row(i, 9.0, "/uav1/goal/target") for i in range(8)]
    found = run(tmp_path, rows)
    assert found.detections["agent_id"].to_pylist() == ["v1"] * 8
    told = "it may be where a vehicle is told to go"
    assert found.summary["unused"] == {
        f"{topic} (geometry_msgs/msg/PoseStamped)": told for topic in ("/uav1/target_pose", "/uav1/goal/target")
    }


def test_a_target_pose_alone_is_the_target(tmp_path: Path) -> None:
    found = run(tmp_path, [pose_row(i, 3.0 * i, "/target_pose") for i in range(8)])
    assert found.summary["num_detections"] == 8 and found.summary["unused"] == {}


def test_ships_in_json_without_a_schema(tmp_path: Path) -> None:
    rows = []
    for i in range(10):
        rows.append(Row("/ais", "", i, {"type": 1, "mmsi": 1, "lat": 55.0 + i * 1e-4, "lon": 4.0}))
        rows.append(Row("/ais", "", i, {"type": 18, "mmsi": "2", "lat": "55.0", "lon": str(4.0 + i * 1e-4)}))
        rows.append(Row("/ais", "", i, {"type": 5, "mmsi": 1, "shipname": "X"}))
        rows.append(Row("/ais", "", i, {"type": 1, "mmsi": 1, "lat": 91.0, "lon": 181.0}))
    found = run(tmp_path, rows)
    assert sorted(found.detections["agent_id"].to_pylist()) == ["1"] * 10 + ["2"] * 10
    assert (found.summary["incomplete"], found.summary["dropped_nonfinite"]) == (10, 10)


def test_aircraft_in_geojson_are_detections_and_no_obstacles(tmp_path: Path) -> None:
    def row(i: int, topic: str) -> Row:
        point = {
            "type": "Feature",
            "id": "abc",
            "properties": {},
            "geometry": {"type": "Point", "coordinates": [8.0 + i * 1e-3, 47.0]},
        }
        ring = [[8.0, 47.0], [8.1, 47.0], [8.1, 47.1], [8.0, 47.0]]
        area = {"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": [ring]}}
        text = json.dumps({"type": "FeatureCollection", "features": [point, area]})
        return Row(topic, "foxglove.GeoJSON", i, {"geojson": text})

    found = run(tmp_path, [row(i, "/adsb/aircraft") for i in range(8)] + [row(i, "/fences") for i in range(8)])
    assert found.detections["agent_id"].to_pylist() == ["abc"] * 8 and found.summary["num_obstacles"] == 0
    assert found.summary["incomplete"] == found.summary["dropped_nonfinite"] == 0


def test_transforms_of_motion_capture_are_truth(tmp_path: Path) -> None:
    def vicon(i: int, name: str) -> Row:
        shift = ROS("geometry_msgs/msg/Transform", translation=ROS("geometry_msgs/msg/Vector3", x=0.5 * i), rotation=ROS.turn())
        header = ROS.header("vicon", time_ns(i))
        message = ROS("geometry_msgs/msg/TransformStamped", header=header, child_frame_id=name, transform=shift)
        return ROS.cdr_row(message, f"/vicon/{name}/{name}", i)

    rows = [vicon(i, "fox") for i in range(12)] + [
        pose_row(i, 0.5 * i, "/radar/contacts/fox", "vicon") for i in range(0, 12, 4)
    ]
    found = run(tmp_path, rows)
    truth = found.table("truth")
    assert truth["agent_id"].to_pylist() == ["fox"] * 12 and truth["x_m"].to_pylist() == [0.5 * i for i in range(12)]
    assert found.detections["agent_id"].to_pylist() == ["fox"] * 3


def test_bodies_of_motion_capture_are_truth_by_name(tmp_path: Path) -> None:
    rows = []
    for i in range(5):
        bodies = [
            SEEN("mocap4r2_msgs/msg/RigidBody", rigid_body_name=name, pose=SEEN.pose(x + i))
            for name, x in (("a", 0.0), ("b", 50.0))
        ]
        message = SEEN("mocap4r2_msgs/msg/RigidBodies", header=SEEN.header("map", time_ns(i)), rigidbodies=bodies)
        rows += [SEEN.cdr_row(message, "/rigid_bodies", i), pose_row(i, float(i), "/contacts")]
    found = run(tmp_path, rows)
    assert sorted(found.table("truth")["agent_id"].to_pylist()) == ["a"] * 5 + ["b"] * 5
    assert found.detections["agent_id"].to_pylist() == [None] * 5  # of one of two


def test_channels_that_may_hold_detections_are_named(tmp_path: Path) -> None:
    rows = [pose_row(i, 3.0 * i, "/contacts/a") for i in range(8)]
    rows += [Row("/lidar/objects", "own.ObstacleDetections", 1.0, {}), Row("/fused", "own_msgs/msg/TrackedObjectList", 1.0, {})]
    rows += [Row("/radar/detections", "radar_msgs/msg/RadarScan", 1.0, {"returns": []})]
    rows += [ROS.cdr_row(ROS("visualization_msgs/msg/MarkerArray"), "/viz/targets"), Row("/wheel", "own.Speed", 1.0, {})]
    found = run(tmp_path, rows)
    assert found.summary["unused"] == {
        "/lidar/objects (own.ObstacleDetections)": "its type is not known",
        "/fused (own_msgs/msg/TrackedObjectList)": "its type is not known",
        "/radar/detections (radar_msgs/msg/RadarScan)": (
            "returns of a radar are used by themselves only where there are no other detections, which may be made of them"
        ),
        "/viz/targets (visualization_msgs/msg/MarkerArray)": "what is drawn may be anything",
    }
    stated = run(tmp_path, [*rows, pose_row(9.0, 1.0, "/more/contacts/b")], detections=[{"topic": "/contacts/{agent}"}])
    others = "[[extract.detections]] names others"
    assert stated.summary["unused"]["/more/contacts/b (geometry_msgs/msg/PoseStamped)"] == others


def test_conditions_on_items(tmp_path: Path) -> None:
    targets = [{"id": k, "x": 10.0 * k, "y": 0.0, "p": 0.2 * k} for k in range(4)]
    rows = [Row("/own", "own.Targets", i, {"t": stamp(i), "targets": targets}) for i in range(3)]
    source = {
        "topic": "/own",
        "x": "targets[:].x",
        "y": "targets[:].y",
        "agent_path": "targets[:].id",
        "where": "targets[:].p > 0.3",
    }
    found = run(tmp_path, rows, detections=[source])
    assert found.detections["agent_id"].to_pylist() == ["2", "3"] * 3 and found.summary["unmet"] == 6
    np.testing.assert_array_equal(found.detections["x_m"], [20.0, 30.0] * 3)
