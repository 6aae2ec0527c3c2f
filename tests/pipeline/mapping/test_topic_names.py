"""Names of topics: which part is who was seen, which who saw, and which only says how far the work on it is."""

import pytest

from pipeline.mapping.topic_names import family_of, pattern_of, words_of


def test_words() -> None:
    assert words_of("/frontCamera/raw_2//x") == ["front", "camera", "raw", "2", "x"]


@pytest.mark.parametrize(
    ("topic", "pattern"),
    [
        ("/contacts/A7", "/contacts/{agent}"),
        ("/contacts/2", "/contacts/{agent}"),
        ("/contacts/A7/pose", "/contacts/{agent}/pose"),
        ("/boat/targets/A7/gps/fix", "/{sensor}/targets/{agent}/gps/fix"),
        ("/target/gps1/raw", "/target/{sensor}/raw"),
        ("/tracks/uav1/detections", "/tracks/{sensor}/detections"),
        ("/radar/north/position", "/radar/{sensor}/position"),
        ("/contacts/filtered/A7", "/contacts/filtered/{agent}"),
        ("/camera1/contacts/A7", "/{sensor}/contacts/{agent}"),
        ("/detections/raw", "/detections/raw"),
        ("/target/tracked_objects", "/target/tracked_objects"),
        ("/targets/filtered_2", "/targets/filtered_2"),
        ("/detections/lidar_front", "/detections/{sensor}"),
        ("/tracks/ekf", "/tracks/ekf"),
        ("/detections/yolov8", "/detections/yolov8"),
        ("/contacts/stage1", "/contacts/stage1"),
        ("/detections/v2x", "/detections/{sensor}"),
        ("/detections/cam0/raw", "/detections/{sensor}/raw"),
        ("/perception/object_recognition/detection/objects", "/perception/object_recognition/detection/objects"),
        ("/uav1/detections/frontLeft/A7", "/uav1/detections/{sensor}/{agent}"),
    ],
)
def test_of_detections(topic: str, pattern: str) -> None:
    assert pattern_of(topic, "detections", True, [topic]) == pattern


def test_messages_that_hold_several_take_no_name_of_the_topic() -> None:
    assert pattern_of("/detections/seahorse", "detections", False, []) == "/detections/seahorse"
    assert pattern_of("/truth/A7", "truth", False, []) == "/truth/A7"


@pytest.mark.parametrize(
    ("one", "other", "is_same"),
    [
        ("/perception/object_recognition/detection/objects", "/perception/object_recognition/objects", True),
        ("/radar/detections", "/radar/tracks", True),
        ("/target/raw", "/target/pose/filtered", True),
        ("/contacts/A7", "/tracks/A7", True),
        ("/radar/detections", "/lidar/detections", False),
        ("/cam1/detections", "/cam2/detections", False),
        ("/contacts/A7", "/contacts/B3", False),
    ],
)
def test_stages_of_one_work_have_one_family(one: str, other: str, is_same: bool) -> None:
    assert (family_of(one) == family_of(other)) == is_same
