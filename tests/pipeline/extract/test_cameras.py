"""Boxes of a camera as directions: pinhole, distortion, transforms of an optical frame, and what is refused."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures.small_logs import Row, detection, stamp
from scipy.spatial.transform import Rotation
from test_extract import fails, run
from test_radar import polar
from test_sensor_frames import ROS, ros2_row
from test_sightings import floats, measured

from cadence.errors import ConfigError
from pipeline.extract.cameras import Camera

FOCAL, CENTRE = (600.0, 620.0), (320.0, 240.0)
BENT = (-0.3, 0.1, 0.001, -0.002, 0.0)
OPTICAL = Rotation.from_matrix([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Right, down and ahead in ahead, left and up."""
MAST = Rotation.from_euler("zyx", [40, 8, -3], degrees=True), np.array([10.0, -20.0, 15.0])
TARGET = np.array([80.0, 45.0, 2.0])
SOURCE = {"topic": "/cam/boxes", "message_type": "Detection2DArray", "agent": "fox"}
DETECTED = {"topic": "/detections"}


def info(topic: str = "/cam/camera_info", **more: Any) -> Row:
    matrix = [FOCAL[0], 0.0, CENTRE[0], 0.0, FOCAL[1], CENTRE[1], 0.0, 0.0, 1.0]
    message = {"header": {"stamp": stamp(0.0), "frame_id": "cam_optical"}, "K": matrix, "D": [], "distortion_model": ""}
    return Row(topic, "sensor_msgs/CameraInfo", 0.0, message | more)


def boxes(*pixels: tuple[float, float], time_s: float = 1.0, size: tuple[float, float] = (60.0, 31.0)) -> Row:
    items = [{"bbox": {"center": {"position": {"x": x, "y": y}}, "size_x": size[0], "size_y": size[1]}} for x, y in pixels]
    message = {"header": {"stamp": stamp(time_s), "frame_id": "cam_optical"}, "detections": items}
    return Row("/cam/boxes", "vision_msgs/Detection2DArray", time_s, message)


def pixel(place: np.ndarray) -> tuple[float, float]:
    """Where the camera on its mast sees a place, without distortion."""
    right, down, ahead = OPTICAL.inv().apply(MAST[0].inv().apply(place - MAST[1]))
    return CENTRE[0] + FOCAL[0] * right / ahead, CENTRE[1] + FOCAL[1] * down / ahead


def scene() -> list[Row]:
    rows = [ros2_row(0.0, "map", "radar", MAST), ros2_row(0.0, "radar", "cam_optical", (OPTICAL, np.zeros(3)))]
    rows += [ros2_row(2.0, "radar", "cam_optical", (OPTICAL, np.zeros(3)))]
    return [*rows, *(detection(1.0 * i, 80.0, 45.0, agent_id="fox") for i in range(3))]


def test_a_box_is_a_bearing_and_an_elevation(tmp_path: Path) -> None:
    found = run(tmp_path, [*scene(), info(), boxes(pixel(TARGET))], detections=[DETECTED, SOURCE])
    seen_as = measured(found)
    _, bearing, elevation = polar(TARGET - MAST[1])
    assert floats(seen_as["bearing_rad"])[0] == pytest.approx(bearing, abs=1e-6)
    assert floats(seen_as["elevation_rad"])[0] == pytest.approx(elevation, abs=1e-6)
    assert (floats(seen_as["observer_x_m"])[0], floats(seen_as["observer_y_m"])[0]) == pytest.approx((10.0, -20.0))
    # a tenth of the box: 6 pixels of 600, and 3.1 of 620
    assert floats(seen_as["bearing_sigma_rad"])[0] == pytest.approx(0.01, rel=0.03)
    assert floats(seen_as["elevation_sigma_rad"])[0] == pytest.approx(0.005)
    told = run(tmp_path, [*scene(), info(), boxes(pixel(TARGET))], detections=[DETECTED, SOURCE | {"pixel_sigma": 3.0}])
    assert floats(measured(told)["bearing_sigma_rad"])[0] == pytest.approx(0.005, rel=0.03)


def test_a_camera_of_ros_2(tmp_path: Path) -> None:
    matrix = np.array([FOCAL[0], 0.0, CENTRE[0], 0.0, FOCAL[1], CENTRE[1], 0.0, 0.0, 1.0])
    message = ROS(
        "sensor_msgs/msg/CameraInfo", header=ROS.header("cam_optical"), k=matrix, distortion_model="plumb_bob", d=np.zeros(5)
    )
    rows = [*scene(), ROS.cdr_row(message, "/cam/camera_info", 0.0), boxes(pixel(TARGET))]
    seen_as = measured(run(tmp_path, rows, detections=[DETECTED, SOURCE]))
    assert floats(seen_as["bearing_rad"])[0] == pytest.approx(polar(TARGET - MAST[1])[1], abs=1e-6)


def test_distortion_is_taken_out(tmp_path: Path) -> None:
    camera = Camera("/info", FOCAL, CENTRE, BENT, "cam")
    slopes = np.stack(np.meshgrid(np.linspace(-0.45, 0.45, 7), np.linspace(-0.35, 0.35, 7)), axis=-1).reshape(-1, 2)
    bent = camera._distorted(slopes) * FOCAL + CENTRE
    assert np.abs(bent - (slopes * FOCAL + CENTRE)).max() > 15.0
    np.testing.assert_allclose(camera.slopes(bent), slopes, atol=2e-6)
    away = np.array(pixel(TARGET)) - CENTRE
    place = tuple((camera._distorted((away / FOCAL)[None]) * FOCAL + CENTRE)[0].tolist())
    rows = [*scene(), info(D=list(BENT), distortion_model="plumb_bob"), boxes(place)]
    seen_as = measured(run(tmp_path, rows, detections=[DETECTED, SOURCE]))
    assert floats(seen_as["bearing_rad"])[0] == pytest.approx(polar(TARGET - MAST[1])[1], abs=1e-5)


def test_beyond_what_the_distortion_describes_no_direction_is_seen() -> None:
    camera = Camera("/info", FOCAL, CENTRE, (-0.3, 0.0, 0.0, 0.0, 0.0), "cam")
    assert np.isnan(camera.slopes(np.array([[3000.0, 240.0]]))).all()


def test_straight_down_it_has_no_bearing(tmp_path: Path) -> None:
    down = MAST[0].inv() * Rotation.from_euler("y", 90, degrees=True) * OPTICAL
    rows = [
        ros2_row(0.0, "map", "radar", MAST),
        *(ros2_row(t, "radar", "cam_optical", (down, np.zeros(3))) for t in (0.0, 2.0)),
    ]
    rows += [info(), boxes(CENTRE), *(detection(1.0 * i, 80.0, 45.0, agent_id="fox") for i in range(3))]
    assert floats(measured(run(tmp_path, rows, detections=[DETECTED, SOURCE]))["bearing_sigma_rad"])[0] == pytest.approx(np.pi)


@pytest.mark.parametrize(
    ("rows", "more", "match"),
    [
        ([], {}, "pixels are directions only by a camera's CameraInfo, and nothing says the log has none; give camera_info"),
        ([info("/one/info"), info("/two/info")], {}, "nothing says which of /one/info, /two/info; give camera_info"),
        ([info()], {"camera_info": "/cam/camera_inf"}, "camera_info '/cam/camera_inf' is no CameraInfo"),
        ([info(K=[0.0] * 9)], {}, "its camera /cam/camera_info is not calibrated"),
        ([info(K="none")], {}, "its camera /cam/camera_info is not calibrated"),
        ([dataclasses.replace(info(), message=b"{")], {}, "its camera /cam/camera_info cannot be decoded"),
        ([info(D=[0.1] * 4, distortion_model="equidistant")], {}, "has the distortion .equidistant. of 4 numbers"),
        ([info(), info(K=[700.0, 0, 320, 0, 700, 240, 0, 0, 1])], {}, "changes its focal length or centre, as where it zooms"),
        ([info()], {"observer_x_m": 0.0, "observer_y_m": 0.0}, "observer_x_m is of bearings"),
    ],
)  # fmt: skip
def test_what_is_refused(tmp_path: Path, rows: list[Row], more: dict[str, Any], match: str) -> None:
    rows = [*scene(), *rows, boxes(pixel(TARGET))]
    fails(tmp_path, rows, ConfigError, match, detections=[DETECTED, SOURCE | more])


def test_boxes_are_used_only_when_told(tmp_path: Path) -> None:
    found = run(tmp_path, [*scene(), info(), boxes(pixel(TARGET))])
    assert "measurements" not in found.summary
    reason = "boxes of a camera are directions; a source that says whom they show uses them"
    assert found.summary["unused"] == {"/cam/boxes (vision_msgs/Detection2DArray)": reason}


def test_own_types_state_pixels(tmp_path: Path) -> None:
    x, y = pixel(TARGET)
    message = {"header": {"stamp": stamp(1.0), "frame_id": "cam_optical"}, "u": x, "v": y}
    source = {"topic": "/cam/own", "pixel_x": "u", "pixel_y": "v", "agent": "fox"}
    rows = [*scene(), info(), Row("/cam/own", "own.Pixel", 1.0, message)]
    found = run(tmp_path, rows, detections=[DETECTED, source | {"pixel_sigma": 2.0}])
    assert floats(measured(found)["bearing_rad"])[0] == pytest.approx(polar(TARGET - MAST[1])[1], abs=1e-6)
    (tmp_path / "vague").mkdir()
    fails(
        tmp_path / "vague",
        rows,
        ConfigError,
        "nothing says how exact its pixels are; give pixel_sigma",
        detections=[DETECTED, source],
    )
