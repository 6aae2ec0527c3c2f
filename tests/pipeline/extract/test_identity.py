"""Who was seen, through whole logs as detectors and trackers write them."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures.small_logs import Row, detection, stamp
from test_extract import Extracted, run


def array(topic: str, second: float, places: list[tuple[float, float]], names: list[str] | None = None) -> Row:
    """A message of several positions: `vision_msgs/Detection3DArray` with names, `geometry_msgs/PoseArray` without."""
    header = {"stamp": stamp(second), "frame_id": "map"}
    positions = [{"x": x, "y": y, "z": 0.0} for x, y in places]
    if names is None:
        return Row(topic, "geometry_msgs/PoseArray", second, {"header": header, "poses": [{"position": p} for p in positions]})
    items = [{"id": name, "bbox": {"center": {"position": p}}} for name, p in zip(names, positions, strict=True)]
    return Row(topic, "vision_msgs/Detection3DArray", second, {"header": header, "detections": items})


def objects(topic: str, second: float, places: list[tuple[float, float]], kind: str, names: list[str] | None = None) -> Row:
    """autoware's objects of one kind: detected, tracked or predicted."""
    first = "initial_pose_with_covariance" if kind == "Predicted" else "pose_with_covariance"
    items: list[dict[str, Any]] = [
        {"kinematics": {first: {"pose": {"position": {"x": x, "y": y, "z": 0.0}}}}} for x, y in places
    ]
    for item, name in zip(items, names or (), strict=False):
        item["object_id"] = {"uuid": list(name.encode() * 16)}
    message = {"header": {"stamp": stamp(second), "frame_id": "map"}, "objects": items}
    return Row(topic, f"autoware_perception_msgs/msg/{kind}Objects", second, message)


def agents(found: Extracted) -> dict[str | None, int]:
    names = found.detections["agent_id"].to_pylist()
    return {name: names.count(name) for name in dict.fromkeys(names)}


def kinds(found: Extracted) -> list[str]:
    return [record["kind"] for record in found.summary["suspicions"]]


def test_a_detector_that_never_fills_in_its_ids(tmp_path: Path) -> None:
    lanes = [(0.0, "0" * 32), (100.0, "0" * 32), (200.0, "0" * 32)]
    for num in (1, 3):  # also where only one is seen
        rows = [
            array("/radar/tracks", i, [(5.0 * i, y) for y, _ in lanes[:num]], [n for _, n in lanes[:num]]) for i in range(20)
        ]
        found = run(tmp_path, rows)
        assert agents(found) == {None: 20 * num} and kinds(found) == ["identity"]
        assert sorted(set(found.detections["y_m"].to_pylist())) == [y for y, _ in lanes[:num]]


@pytest.mark.parametrize(
    ("names", "called"),
    [
        (["DLH1", "DLH1    ", " DLH1"], {"DLH1"}),
        (["DLH1", "DLH1\0\0", "DLH1@@@"], {"DLH1"}),
        ([[*b"DLH1", 0, 0, 0], [*b"DLH1", 0, 7, 9]], {"DLH1"}),
        ([[*b"DLH1", *[0] * 12]], {"DLH1"}),
        ([[*b"DLH1", 0, *[200] * 11]], {"444c4831" + "00" + "c8" * 11}),
        ([[200, 1, 2, 3]], {"c8010203"}),
        (["@@@@", "    ", "UNKNOWN "], {None}),
    ],
)
def test_names_in_fields_that_are_longer(tmp_path: Path, names: list[Any], called: set[str | None]) -> None:
    """Padded with spaces, zeros or the @ of AIS; an array of characters is text, of 16 bytes mostly none."""
    rows = [detection(float(i), 3.0 * i, 0.0, agent_id=names[i % len(names)]) for i in range(12)]
    assert set(agents(run(tmp_path, rows))) == called


def test_an_address_in_capitals_is_the_same_address(tmp_path: Path) -> None:
    uuid = "0A1B2C3D-0000-4000-8000-00000000000F"
    spellings = [("4b16a0", "4B16A0"), (uuid, uuid.lower().replace("-", "")), ("fox", "FOX"), ("a1", "A1")]
    rows = [
        detection(i + 0.5 * j, 100.0 * number + 3.0 * i, 5.0, topic=f"/{'ab'[j]}/contacts", agent_id=names[j])
        for i in range(10) for number, names in enumerate(spellings) for j in (0, 1)
    ]  # fmt: skip
    found = run(tmp_path, sorted(rows, key=lambda row: row.time_s))
    assert agents(found) == {"4b16a0": 20, uuid: 20, "fox": 10, "FOX": 10, "a1": 10, "A1": 10} and kinds(found) == []


def test_a_named_topic_of_arrays_is_a_sensors(tmp_path: Path) -> None:
    rows = [array("/detections/lidar_front", i, [(3.0 * i, y) for y in (0.0, 300.0, 600.0)]) for i in range(20)]
    found = run(tmp_path, rows)
    assert agents(found) == {None: 60} and kinds(found) == []
    assert set(found.detections["sensor_id"].to_pylist()) == {"lidar_front"}
    assert found.detections["y_m"].to_pylist() == [0.0, 300.0, 600.0] * 20


def test_the_stages_of_a_pipeline_count_once(tmp_path: Path) -> None:
    rng, rows = np.random.default_rng(0), []
    for i in range(30):
        places = [(8.0 * i, 0.0), (300 - 6.0 * i, 7.0)]
        noisy = [(x + rng.normal(0, 0.3), y + rng.normal(0, 0.3)) for x, y in places]
        rows.append(objects("/perception/object_recognition/detection/objects", i, noisy, "Detected"))
        rows.append(objects("/perception/object_recognition/tracking/objects", i, places, "Tracked", ["a", "b"]))
        rows.append(objects("/perception/object_recognition/objects", i, places, "Predicted", ["a", "b"]))
    found = run(tmp_path, rows)
    assert agents(found) == {"61" * 16: 30, "62" * 16: 30} and kinds(found) == ["stage"]
    assert found.summary["sources"]["detections"] == ["/perception/object_recognition/tracking/objects"]
    wanted = {"topic": "/perception/object_recognition/detection/objects"}
    assert agents(run(tmp_path, rows, detections=[wanted])) == {None: 60}


def test_a_number_that_is_given_out_again_is_another_target(tmp_path: Path) -> None:
    rows = [array("/radar/detections", i, [(10.0 * i, 0.0)], ["7"]) for i in range(30)]
    rows += [array("/radar/detections", i, [(400 - 8.0 * (i - 33), 350.0)], ["7"]) for i in range(33, 63)]
    found = run(tmp_path, rows)
    assert agents(found) == {"7": 30, "7.2": 30} and kinds(found) == ["identity"]
    stated = {"topic": "/radar/detections", "has_identity": True}
    assert agents(run(tmp_path, rows, detections=[stated])) == {"7": 60}
    assert kinds(run(tmp_path, rows, detections=[stated | {"has_identity": False}])) == []


@pytest.mark.parametrize(
    ("name", "far_m", "num"), [("3", 40.0, 2), ("track_3", 40.0, 2), ("ann", 40.0, 1), ("3", 15.0, 1), ("211123456", 40.0, 1)]
)
def test_a_number_that_a_tracker_gives_to_another_walker(tmp_path: Path, name: str, far_m: float, num: int) -> None:
    """Receivers find their fix again as far away, and their names are no small numbers."""
    rows = [array("/people", i, [(1.0 * i, 0.0)], [name]) for i in range(30)]
    rows += [array("/people", i, [(29.0 - 0.8 * (i - 31), far_m)], [name]) for i in range(31, 60)]
    found = run(tmp_path, rows)
    assert len(agents(found)) == num and kinds(found) == ["identity"] * (num - 1)


@pytest.mark.parametrize("name", ["unknown", "-1", "", "None"])
def test_a_name_that_says_that_there_is_none_is_none(name: str, tmp_path: Path) -> None:
    rows = [detection(float(i), 3.0 * i, 0.0, agent_id=name) for i in range(9)]
    found = run(tmp_path, rows)
    assert agents(found) == {None: 9} and kinds(found) == []


def test_copies_of_one_message_are_one_detection(tmp_path: Path) -> None:
    rows = [array("/detections", float(i), [(3.0 * i, 0.0), (5.0, 9.0)]) for i in range(9)]
    found = run(tmp_path, [copy for row in rows for copy in (row, row)])
    assert agents(found) == {None: 18} and found.detections["num_merged"].to_pylist() == [2] * 18


def test_sensors_that_contradict_each_other_are_told(tmp_path: Path) -> None:
    rows = []
    for i in range(20):
        for sensor, y in (("a", 0.0), ("b", 3.0 if i % 2 else 30.0)):
            rows.append(detection(float(i), 9.0 * i, y, agent_id="T", sensor=sensor, position_covariance=[1.0, 0, 0, 1.0]))
    found = run(tmp_path, rows)
    assert agents(found) == {"T": 20} and kinds(found) == ["covariance"] and found.summary["disagreeing"] == 10
    assert found.detections["y_m"].to_pylist() == [0.0, 1.5] * 10
