"""Ranges and bearings through logs: they come out where the target was, as exact as they are, and nonsense is named."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures.ros_messages import RADAR, Builder, store_with
from fixtures.small_logs import Row, fix, stamp
from pyproj import Geod
from test_extract import Extracted, fails, run
from test_sensor_frames import MAST, TARGET, ros2_row, seen, ship

from cadence.errors import ConfigError, InputError, NothingDetectedError
from pipeline.frames import to_local

RADARS = Builder(store_with(RADAR))
SCAN = {"topic": "/radar", "range_sigma_m": 0.01, "bearing_sigma_deg": 0.01, "elevation_sigma_deg": 0.01}
FINDER: dict[str, Any] = {
    "topic": "/finder", "range": "range", "bearing": "bearing", "range_sigma_m": 5.0, "bearing_sigma_deg": 0.5, "time": "stamp",
}  # fmt: skip


def polar(place: np.ndarray) -> tuple[float, float, float]:
    """Range, azimuth and elevation of a place in the axes of a sensor."""
    x, y, z = place.tolist()
    return float(np.linalg.norm(place)), float(np.arctan2(y, x)), float(np.arctan2(z, np.hypot(x, y)))


def scan(time_s: float, *returns: tuple[float, float, float], frame: str = "radar", doppler: float = 0.0) -> Row:
    items = [
        RADARS("radar_msgs/msg/RadarReturn", range=r, azimuth=a, elevation=e, doppler_velocity=doppler) for r, a, e in returns
    ]
    header = RADARS.header(frame, 1_700_000_000_000_000_000 + round(time_s * 1e9))
    return RADARS.cdr_row(RADARS("radar_msgs/msg/RadarScan", header=header, returns=items), "/radar", time_s)


def on_board(num: int = 12) -> list[Row]:
    """A ship that moves, turns and rolls, with a tilted radar on its mast that sees a buoy."""
    rows = [ros2_row(0.0, "ship", "radar", MAST), *(ros2_row(0.5 * i, "map", "ship", ship(0.5 * i)) for i in range(2 * num))]
    return [*rows, *(scan(float(i), polar(seen(float(i)))) for i in range(num))]


def finder(time_s: float, range_m: float, bearing: float, **more: Any) -> Row:
    return Row("/finder", "own.Sighting", time_s, {"stamp": stamp(time_s), "range": range_m, "bearing": bearing, **more})


def finders(num: int = 12, **more: Any) -> list[Row]:
    return [finder(float(i), 1000.0 + 10.0 * i, np.radians(30.0), **more) for i in range(num)]


def test_returns_come_out_where_the_target_was_whatever_the_radar_did(tmp_path: Path) -> None:
    found = run(tmp_path, on_board(), detections=[SCAN])
    place = np.column_stack([found.detections[name].to_numpy() for name in ("x_m", "y_m", "z_m")])
    np.testing.assert_allclose(place, np.tile(TARGET, (12, 1)), atol=1e-3)
    assert found.summary["num_unknown_origin"] == 12 and found.summary["suspicions"] == []
    assert found.frame.frame_id == "map" and found.frame.vertical_datum == "frame"


def test_a_scan_is_read_without_settings(tmp_path: Path) -> None:
    found = run(tmp_path, on_board())
    assert found.summary["num_detections"] == 12 and found.summary["unused"] == {}
    (taken,) = found.summary["taken"]
    assert "0.5 m in range and 1° in bearing are taken, as its type states no accuracy" in taken
    # 1 degree at 47 m is .8 m across and .5 m along; the mast is tilted, and up are 2 degrees
    sigma_m = np.sqrt(found.detections["cov_xx_m2"].to_numpy() + found.detections["cov_yy_m2"].to_numpy())
    assert (sigma_m > 0.8).all() and (sigma_m < 1.5).all()


def test_covariance_is_narrow_along_and_wide_across(tmp_path: Path) -> None:
    """A standing radar whose x axis is east; to the north 2 km away a degree is 35 m."""
    rows = [scan(float(i), (2000.0, np.pi / 2, 0.0), frame="map") for i in range(4)]
    found = run(tmp_path, rows, detections=[{"topic": "/radar", "range_sigma_m": 3.0, "bearing_sigma_deg": 1.0}])
    sigma_x, sigma_y = (np.sqrt(found.detections[f"cov_{axis}_m2"].to_numpy()[0]) for axis in ("xx", "yy"))
    assert sigma_x == pytest.approx(2000.0 * np.radians(1.0), rel=0.01) and sigma_y == pytest.approx(3.0, rel=0.04)
    assert found.detections["z_m"].null_count == 4  # a radar of two dimensions leaves elevations zero
    assert found.detections["y_m"].to_numpy()[0] == pytest.approx(2000.0 * np.exp(0.5 * np.radians(1.0) ** 2))


def test_targets_in_degrees_by_their_type(tmp_path: Path) -> None:
    item = RADARS("ainstein_radar_msgs/msg/RadarTarget", range=100.0, azimuth=90.0, elevation=0.0)
    rows = []
    for i in range(3):
        header = RADARS.header("map", 1_700_000_000_000_000_000 + i * 10**9)
        message = RADARS("ainstein_radar_msgs/msg/RadarTargetArray", header=header, targets=[item])
        rows.append(RADARS.cdr_row(message, "/targets/raw", i))
    found = run(tmp_path, rows)
    np.testing.assert_allclose(found.detections["x_m"].to_numpy(), 0.0, atol=1e-9)
    np.testing.assert_allclose(found.detections["y_m"].to_numpy(), 100.0, atol=0.02)
    assert found.summary["suspicions"] == []


def test_a_compass_bearing_from_a_place_that_is_stated(tmp_path: Path) -> None:
    source = FINDER | {"bearing_convention": "compass", "observer_x_m": 100.0, "observer_y_m": -50.0, "agent": "fox"}
    found = run(tmp_path, finders(), detections=[source])
    ranges = 1000.0 + 10.0 * np.arange(12)
    np.testing.assert_allclose(found.detections["x_m"].to_numpy(), 100.0 + 0.5 * ranges, atol=0.1)
    np.testing.assert_allclose(found.detections["y_m"].to_numpy(), -50.0 + ranges * np.cos(np.radians(30.0)), atol=0.1)
    assert found.detections["agent_id"].to_pylist() == ["fox"] * 12


def test_a_bearing_from_ahead_of_an_observer(tmp_path: Path) -> None:
    """30 degrees to the left of a course of 120 is due east of north: 90."""
    source = FINDER | {"observer_x_m": 0.0, "observer_y_m": 0.0, "observer_heading_deg": 120.0, "agent": "fox"}
    found = run(tmp_path, finders(), detections=[source])
    np.testing.assert_allclose(found.detections["x_m"].to_numpy(), 1000.0 + 10.0 * np.arange(12), atol=0.1)
    np.testing.assert_allclose(found.detections["y_m"].to_numpy(), 0.0, atol=1e-6)


def test_from_an_observer_that_moves_in_latitude_and_longitude(tmp_path: Path) -> None:
    """Where the geodesic ends that leaves the boat in that direction, between two of its fixes."""
    boat = [fix(2.0 * i, 50.0 + 1e-3 * i, -1.0, "/boat/fix") for i in range(8)]
    source = FINDER | {"bearing_convention": "compass", "observer": "boat", "agent": "fox"}
    poses = [{"topic": "/{sensor}/fix"}]
    found = run(tmp_path, [*boat, *finders()], detections=[source], poses=poses)
    longitude, latitude, _ = Geod(ellps="WGS84").fwd(
        [-1.0] * 12, 50.0 + 5e-4 * np.arange(12), [30.0] * 12, 1000.0 + 10.0 * np.arange(12)
    )
    x_m, y_m = to_local(found.frame, np.array(latitude), np.array(longitude))
    np.testing.assert_allclose(found.detections["x_m"].to_numpy(), x_m, atol=0.1)
    np.testing.assert_allclose(found.detections["y_m"].to_numpy(), y_m, atol=0.1)


def test_from_an_observer_whose_metres_are_north_east_down(tmp_path: Path) -> None:
    """At 300 m north, 40 m east and 20 m up; the target is due east of it, narrow to the east, wide to the north."""
    rows: list[Row] = []
    for i in range(8):
        place = {"timestamp": stamp(float(i)), "xy_valid": True, "x": 300.0, "y": 40.0, "z": -20.0}
        rows += [
            Row("/drone/pose", "px4_msgs/msg/VehicleLocalPosition", float(i), place),
            finder(i + 0.25, 1000.0, np.pi / 2, up=0.1),
        ]
    source = FINDER | {"bearing_convention": "compass", "observer": "drone", "agent": "fox", "bearing_sigma_deg": 2.0}
    source |= {"elevation": "up", "elevation_sigma_deg": 0.1}
    found = run(tmp_path, rows[:-1], detections=[source], poses=[{"topic": "/{sensor}/pose"}])
    seen_at = [found.detections[name].to_numpy()[0] for name in ("x_m", "y_m", "z_m")]
    assert seen_at == pytest.approx([40.0 + 1000.0 * np.cos(0.1), 300.0, 20.0 + 1000.0 * np.sin(0.1)], abs=1.0)
    sigma_x, sigma_y = (np.sqrt(found.detections[f"cov_{axis}_m2"].to_numpy()[0]) for axis in ("xx", "yy"))
    assert sigma_x == pytest.approx(5.0, abs=0.3) and sigma_y == pytest.approx(995.0 * np.radians(2.0), rel=0.01)


def test_own_poses_need_a_sensor(tmp_path: Path) -> None:
    source = FINDER | {"observer": "{sensor}"}
    fails(tmp_path, finders(), ConfigError, "12 of its messages name no sensor", detections=[source])


def test_without_a_pose_near_in_time_it_is_left_out_and_counted(tmp_path: Path) -> None:
    boat = [fix(2.0 * i, 50.0, -1.0, "/boat/fix") for i in range(3)]
    source = FINDER | {"bearing_convention": "compass", "observer": "boat", "agent": "fox"}
    found = run(tmp_path, [*boat, *finders()], detections=[source], poses=[{"topic": "/{sensor}/fix"}])
    assert found.summary["num_detections"] == 5  # up to 4 s


def said(found: Extracted) -> dict[str, str]:
    """The only suspicion."""
    (suspicion,) = found.summary["suspicions"]
    return dict(suspicion)


def test_degrees_in_fields_of_radians_are_told_and_read_as_degrees(tmp_path: Path) -> None:
    rows = [scan(float(i), (100.0, -60.0 + 10.0 * i, 0.0), frame="map") for i in range(12)]
    found = run(tmp_path, rows, detections=[{"topic": "/radar"}])
    assert said(found)["seen"] == "bearings from -60 to 50, beyond 2 pi: no radians"
    bearing = np.arctan2(found.detections["y_m"].to_numpy(), found.detections["x_m"].to_numpy())
    np.testing.assert_allclose(np.degrees(bearing), -60.0 + 10.0 * np.arange(12), atol=1e-4)
    stated = run(tmp_path, rows, detections=[{"topic": "/radar", "bearing_unit": "deg"}])
    assert stated.summary["suspicions"] == [] and stated.detections.equals(found.detections)
    told = run(tmp_path, rows, detections=[{"topic": "/radar", "bearing_unit": "rad"}])
    assert told.summary["suspicions"] == []


def test_negative_ranges_are_told_and_left_out(tmp_path: Path) -> None:
    rows = [scan(float(i), (100.0, 0.1, 0.0), (-7.0, 0.2, 0.0), (0.0, 0.0, 0.0), frame="map") for i in range(6)]
    found = run(tmp_path, rows)
    assert said(found)["seen"] == "6 of 18 ranges are negative, down to -7 m"
    assert found.summary["num_detections"] == 6 and found.summary["dropped_nonfinite"] == 12


def test_standard_deviations_of_zero_are_none(tmp_path: Path) -> None:
    rows = [finder(float(i), 1000.0 + i, 0.5, sigma=0.02 if i % 2 else 0.0) for i in range(8)]
    source = FINDER | {"bearing_sigma": "sigma", "observer_x_m": 0.0, "observer_y_m": 0.0, "agent": "fox"}
    found = run(tmp_path, rows, detections=[source])
    assert said(found)["seen"] == "4 of 8 standard deviations of its bearing are not above zero"
    assert said(found)["done"] == "0.5 degrees are taken"
    without = {key: value for key, value in source.items() if key != "bearing_sigma_deg"}
    assert run(tmp_path, rows, detections=[without]).summary["num_detections"] == 4


@pytest.mark.parametrize(
    ("more", "match"),
    [
        ({"bearing_sigma_deg": None}, "nothing says how exact its bearing is; give bearing_sigma_deg"),
        ({"range_sigma_m": None}, "nothing says how exact its range is; give range_sigma_m"),
        ({"elevation": "up"}, "nothing says how exact its elevation is; give elevation_sigma_deg"),
        ({"bearing_convention": "compass"}, "compass bearings are of a place, and nothing says which; give observer"),
        ({"observer": "boat"}, r"its observer 'boat' has no pose in this log \(sensors with poses: none\)"),
        ({"sigma_m": 3.0}, "sigma_m is of positions; state range_sigma_m and bearing_sigma_deg"),
        ({"bearing_sigma_deg": 30.0}, "a standard deviation of the bearing of 30 degrees tells no position"),
    ],
)
def test_what_is_refused(tmp_path: Path, more: dict[str, Any], match: str) -> None:
    source = {key: value for key, value in (FINDER | more).items() if value is not None}
    fails(tmp_path, finders(), ConfigError, match, detections=[source])


def test_settings_of_bearings_are_not_for_positions(tmp_path: Path) -> None:
    rows = [fix(float(i), 50.0, 1.0) for i in range(3)]
    fails(
        tmp_path,
        rows,
        ConfigError,
        "bearing_unit is of ranges and bearings",
        detections=[{"topic": "/contacts/A", "bearing_unit": "deg"}],
    )
    both = {"detections": [{"topic": "/contacts/A"}], "truth": [{"topic": "/radar"}]}
    fails(tmp_path, [*rows, *on_board()], ConfigError, "ranges and bearings are detections", **both)


def test_a_radar_that_nothing_joins_is_refused_as_any_sensor(tmp_path: Path) -> None:
    rows = [ros2_row(0.5 * i, "map", "ship", ship(0.5 * i)) for i in range(8)]
    rows += [scan(float(i), (100.0, 0.1, 0.0)) for i in range(4)]
    fails(tmp_path, rows, InputError, "in the frame radar, which no transform of the log joins")


def street(is_filled: bool = True, is_empty: bool = False) -> list[Row]:
    """A radar on the road among twelve walls, at 10 m/s to the east, and a car that goes before it at 15."""
    rng, rows = np.random.default_rng(1), []
    walls = np.column_stack([rng.uniform(10.0, 90.0, 12), rng.uniform(-30.0, 30.0, 12), np.zeros(12)])
    for i in range(6):
        items = [(wall - [1.0 * i, 0.0, 0.0], -10.0) for wall in walls]
        items += [] if is_empty else [(np.array([40.0 + 0.5 * i, 3.0, 0.0]), 5.0)]
        returns = [(*polar(place), along * place[0] / np.linalg.norm(place) if is_filled else 0.0) for place, along in items]
        message = [
            RADARS("radar_msgs/msg/RadarReturn", range=r, azimuth=a, elevation=e, doppler_velocity=v) for r, a, e, v in returns
        ]
        header = RADARS.header("map", 1_700_000_000_000_000_000 + i * 10**8)
        rows.append(RADARS.cdr_row(RADARS("radar_msgs/msg/RadarScan", header=header, returns=message), "/radar", 0.1 * i))
    return rows


def test_walls_are_left_out_by_their_doppler(tmp_path: Path) -> None:
    found = run(tmp_path, street())
    assert found.summary["num_detections"] == 6 and found.summary["static"] == 72
    np.testing.assert_allclose(found.detections["x_m"].to_numpy(), 40.0 + 0.5 * np.arange(6), atol=0.1)
    told = run(tmp_path, street(), detections=[{"topic": "/radar", "is_static_used": True}])
    assert told.summary["num_detections"] == 78 and "static" not in told.summary
    # a radar that fills in no Doppler says nothing of what stands
    assert run(tmp_path, street(is_filled=False)).summary["num_detections"] == 78


def test_where_everything_stands_nothing_was_detected(tmp_path: Path) -> None:
    fails(
        tmp_path,
        street(is_empty=True),
        NothingDetectedError,
        "all 72 returns stand, by the Doppler of their scans; is_static_used",
    )


def test_clutter_is_left_out_by_a_condition(tmp_path: Path) -> None:
    rows = [scan(float(i), (100.0, 0.1, 0.0), frame="map", doppler=0.0 if i % 2 else -4.0) for i in range(8)]
    found = run(tmp_path, rows, detections=[{"topic": "/radar", "where": "returns[:].doppler_velocity != 0"}])
    assert found.summary["num_detections"] == 4 and found.summary["unmet"] == 4
