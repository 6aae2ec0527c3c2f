"""Bearings and ranges that are no positions, through logs: measurements.parquet says from where, which way, how exactly."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures.small_logs import Row, detection, fix, stamp
from test_extract import Extracted, fails, run
from test_radar import on_board, polar
from test_sensor_frames import MAST, TARGET, ros2_row, seen, ship

from cadence.errors import InputError
from pipeline.measurement_words import measurement_words
from pipeline.measurements import read_measurements
from schemas.tables import MEASUREMENTS

START_NS = 1_700_000_000_000_000_000
FINDER: dict[str, Any] = {
    "topic": "/finder", "bearing": "bearing", "bearing_sigma_deg": 1.5, "time": "stamp", "agent": "fox",
    "bearing_convention": "compass", "observer_x_m": 100.0, "observer_y_m": -50.0,
}  # fmt: skip
DETECTED = {"topic": "/detections"}


def heard(time_s: float, **values: Any) -> Row:
    return Row("/finder", "own.Heard", time_s, {"stamp": stamp(time_s), **values})


def detected(num: int = 5) -> list[Row]:
    return [detection(2.0 * i, 3.0 * i, 400.0, agent_id="fox") for i in range(num)]


def measured(found: Extracted) -> dict[str, np.ndarray]:
    table = found.table("measurements")
    assert table.schema.equals(MEASUREMENTS)
    return {name: np.asarray(table[name].to_pylist(), dtype=object) for name in table.column_names}


def floats(column: np.ndarray) -> np.ndarray:
    return column.astype(np.float64)


def test_compass_bearings_from_a_place(tmp_path: Path) -> None:
    rows = [*detected(), *(heard(float(i), bearing=np.radians(30.0 * i)) for i in range(8))]
    found = run(tmp_path, rows, detections=[DETECTED, FINDER], trusted=["place"])
    seen_as = measured(found)
    assert floats(seen_as["observer_x_m"]).tolist() == [100.0] * 8 and floats(seen_as["observer_y_m"]).tolist() == [-50.0] * 8
    # from east towards north
    turn = np.exp(1j * floats(seen_as["bearing_rad"])) / np.exp(1j * np.radians(90.0 - 30.0 * np.arange(8)))
    np.testing.assert_allclose(np.angle(turn), 0.0, atol=1e-9)
    np.testing.assert_allclose(floats(seen_as["bearing_sigma_rad"]), np.radians(1.5))
    assert set(seen_as["agent_id"]) == {"fox"} and floats(seen_as["observer_vx_mps"]).tolist() == [0.0] * 8
    assert all(set(seen_as[name]) == {None} for name in ("range_m", "range_sigma_m", "elevation_rad", "range_rate_mps"))
    assert found.summary["measurements"] == {
        "num": 8, "bearing_rad": 8, "elevation_rad": 0, "range_m": 0, "range_rate_mps": 0, "topics": {"/finder": 8},
        "agents": {"fox": 8},
    }  # fmt: skip
    assert found.summary["num_detections"] == 5 and found.summary["suspicions"] == []
    told = "8 bearings of /finder, which are no positions, may weigh windows; about fox (8)"
    assert measurement_words(found.summary["measurements"]) == told and measurement_words({}) == ""


def test_logs_without_any_have_no_table(tmp_path: Path) -> None:
    found = run(tmp_path, detected())
    assert not (found.folder / "measurements.parquet").exists() and "measurements" not in found.summary


def test_from_a_boat_that_moves(tmp_path: Path) -> None:
    """The boat goes north at 111.2 m in two seconds; the velocity is its own."""
    boat = [fix(2.0 * i, 50.0 + 1e-3 * i, -1.0, "/boat/fix") for i in range(8)]
    contacts = [fix(3.0 * i, 50.1, -1.0, "/contacts/fox") for i in range(4)]
    source = {key: value for key, value in FINDER.items() if not key.startswith("observer")} | {"observer": "boat"}
    rows = [*boat, *contacts, *(heard(float(i), bearing=0.5) for i in range(12))]
    found = run(
        tmp_path,
        rows,
        detections=[{"topic": "/contacts/{agent}"}, source],
        poses=[{"topic": "/{sensor}/fix"}],
        trusted=["place"],
    )
    seen_as = measured(found)
    np.testing.assert_allclose(np.diff(floats(seen_as["observer_y_m"])), 55.6, atol=0.1)
    np.testing.assert_allclose(floats(seen_as["observer_vy_mps"]), 55.6, atol=0.1)
    np.testing.assert_allclose(floats(seen_as["bearing_rad"]), np.pi / 2 - 0.5, atol=1e-4)


def test_from_a_sensor_on_a_ship_that_rolls(tmp_path: Path) -> None:
    """Bearing and elevation in the frame of a tilted mast come out as those in the world."""
    rows = [ros2_row(0.0, "ship", "radar", MAST), *(ros2_row(0.5 * i, "map", "ship", ship(0.5 * i)) for i in range(24))]
    for i in range(10):
        _, azimuth, elevation = polar(seen(float(i)))
        message = {"header": {"stamp": stamp(float(i)), "frame_id": "radar"}, "bearing": azimuth, "up": elevation}
        rows.append(Row("/finder", "own.Heard", float(i), message))
    rows += [detection(2.0 * i, TARGET[0], TARGET[1], agent_id="fox") for i in range(4)]
    source = {"topic": "/finder", "bearing": "bearing", "elevation": "up", "bearing_sigma_deg": 1.0, "elevation_sigma_deg": 2.0}
    found = run(tmp_path, rows, detections=[DETECTED, source | {"agent": "fox"}])
    seen_as = measured(found)
    turn, place = zip(*(ship(float(i)) for i in range(10)), strict=True)
    masts = np.array([at + rotation.apply(MAST[1]) for rotation, at in zip(turn, place, strict=True)])
    np.testing.assert_allclose(floats(seen_as["observer_x_m"]), masts[:, 0], atol=1e-6)
    np.testing.assert_allclose(floats(seen_as["observer_y_m"]), masts[:, 1], atol=1e-6)
    line = np.array([polar(TARGET - mast) for mast in masts])
    np.testing.assert_allclose(floats(seen_as["bearing_rad"]), line[:, 1], atol=1e-6)
    np.testing.assert_allclose(floats(seen_as["elevation_rad"]), line[:, 2], atol=1e-6)
    np.testing.assert_allclose(floats(seen_as["observer_vx_mps"])[1:-1], np.gradient(masts[:, 0])[1:-1], atol=1e-6)


def test_ranges_alone(tmp_path: Path) -> None:
    source = {"topic": "/finder", "range": "r", "range_sigma_m": 4.0, "agent": "fox", "observer_x_m": 0.0, "observer_y_m": 0.0}
    rows = [*detected(), *(heard(float(i), r=500.0 - i) for i in range(6))]
    seen_as = measured(run(tmp_path, rows, detections=[DETECTED, source]))
    assert floats(seen_as["range_m"]).tolist() == [500.0 - i for i in range(6)] and set(seen_as["bearing_rad"]) == {None}
    assert set(seen_as["bearing_sigma_rad"]) == {None} and set(floats(seen_as["range_sigma_m"])) == {4.0}


def test_doppler_of_a_position_speaks_beside_it(tmp_path: Path) -> None:
    """Of a named target: the range with the bearing is a position, and not counted again."""
    source = FINDER | {"range": "r", "range_sigma_m": 4.0, "range_rate": "v", "range_rate_sigma_mps": 0.2}
    rows = [heard(float(i), bearing=0.5, r=100.0 + i, v=1.5) for i in range(6)]
    found = run(tmp_path, rows, detections=[source])
    seen_as = measured(found)
    assert found.summary["num_detections"] == 6 and set(floats(seen_as["range_rate_mps"])) == {1.5}
    assert set(seen_as["bearing_rad"]) == {None} and set(seen_as["range_m"]) == {None}
    nameless = {key: value for key, value in source.items() if key != "agent"}
    assert "measurements" not in run(tmp_path, rows, detections=[nameless]).summary


def test_a_beam_too_wide_is_no_position_where_others_are(tmp_path: Path) -> None:
    """At 30 km a degree is bent by 9 m, and the range is exact to 10; alone such detections are positions all the same."""
    source = FINDER | {"range": "r", "range_sigma_m": 10.0, "bearing_sigma_deg": 1.0}
    rows = [heard(float(i), bearing=0.5, r=30_000.0 if i % 2 else 3000.0) for i in range(8)]
    found = run(tmp_path, rows, detections=[source])
    seen_as = measured(found)
    assert found.summary["num_detections"] == 4 and set(floats(seen_as["range_m"])) == {30_000.0}
    np.testing.assert_allclose(floats(seen_as["bearing_rad"]), np.pi / 2 - 0.5)
    far = run(tmp_path, [row for row in rows if isinstance(row.message, dict) and row.message["r"] > 1e4], detections=[source])
    assert far.summary["num_detections"] == 4 and "measurements" not in far.summary


def test_read_back_for_the_windows(tmp_path: Path) -> None:
    rows = [*detected(), *(heard(float(i), bearing=0.1 * i) for i in range(8))]
    run(tmp_path, rows, detections=[DETECTED, FINDER], trusted=["place"])
    found = read_measurements(tmp_path, START_NS - 10**9)
    assert found is not None and found.time_s.tolist() == [1.0 + i for i in range(8)] and found.agent_ids == ("fox",) * 8
    assert np.isnan(found.observer_height_m).all() and (found.observer_velocity_mps == 0).all()
    (tmp_path / "other").mkdir()
    assert read_measurements(tmp_path / "other", 0) is None


def test_heights_of_sensors_count_above_what_those_of_detections_do(tmp_path: Path) -> None:
    rows = on_board()
    source = {"topic": "/finder", "bearing": "b", "bearing_sigma_deg": 1.0, "agent": "fox"}
    header = {"stamp": stamp(2.0), "frame_id": "radar"}
    rows += [Row("/finder", "own.Heard", 2.0, {"header": header, "b": 0.3})]
    found = run(tmp_path, rows, detections=[{"topic": "/radar"}, source])
    assert floats(measured(found)["observer_z_m"])[0] == pytest.approx((ship(2.0)[1] + ship(2.0)[0].apply(MAST[1]))[2])
    flat = run(tmp_path, rows, detections=[{"topic": "/radar"}, source], is_height_used=False)
    assert set(measured(flat)["observer_z_m"]) == {None}


def test_bearings_alone_are_told_to_draw_nobody(tmp_path: Path) -> None:
    rows = [heard(float(i), bearing=0.1 * i) for i in range(8)]
    fails(
        tmp_path,
        rows,
        InputError,
        "8 measurements are bearings or ranges alone, and no detection is a position",
        detections=[FINDER],
    )


def test_a_doubted_unit_does_not_hide_that_bearings_draw_nobody(tmp_path: Path) -> None:
    rows = [heard(float(i), bearing=40.0 * i) for i in range(8)]
    words = r"8 measurements are bearings or ranges alone, .*; suspected place of /finder: .* read as degrees"
    fails(tmp_path, rows, InputError, words, detections=[FINDER])


def test_a_sensor_that_nothing_joins_is_refused(tmp_path: Path) -> None:
    message = {"header": {"stamp": stamp(1.0), "frame_id": "mast"}, "bearing": 0.1}
    rows = [*detected(), Row("/finder", "own.Heard", 1.0, message)]
    source = {"topic": "/finder", "bearing": "bearing", "bearing_sigma_deg": 1.0}
    match = "1 position is not in the mission frame 'map', and no transform of the log joins them; take those topics out"
    fails(tmp_path, rows, InputError, match, detections=[DETECTED, source])


def test_without_a_transform_near_in_time_it_is_left_out_and_counted_once(tmp_path: Path) -> None:
    rows = [ros2_row(0.0, "map", "ship", ship(0.0)), ros2_row(1.0, "map", "ship", ship(1.0)), *detected()]
    for i in range(4):
        header = {"stamp": stamp(float(i)), "frame_id": "ship"}
        rows.append(Row("/finder", "own.Heard", float(i), {"header": header, "bearing": 0.1}))
    source = {"topic": "/finder", "bearing": "bearing", "bearing_sigma_deg": 1.0}
    found = run(tmp_path, rows, detections=[DETECTED, source])
    assert found.summary["measurements"]["num"] == 2 and found.summary["transforms"]["no_transform"] == 2


def moving(num: int = 30) -> list[Row]:
    """A target that goes from west to east past the finder at (100, -50), a detection a second."""
    return [detection(float(i), -600.0 + 40.0 * i, 900.0, agent_id="fox") for i in range(num)]


def towards(i: float) -> float:
    """Clockwise from north, the bearing of the target from the finder."""
    return float(np.arctan2(-600.0 + 40.0 * i - 100.0, 950.0))


@pytest.mark.parametrize(
    ("wrong", "hint"),
    [
        (lambda bearing: np.pi / 2 - bearing, "; from north clockwise, or from east and not, they would fit"),
        (
            lambda bearing: bearing + 0.6,
            "; all turned by -34.4 degrees they would fit|; all turned by 34.4 degrees they would fit",
        ),
        (lambda bearing: 3.0 * bearing + 1.0, ""),
    ],
)
def test_bearings_that_point_elsewhere_are_told_and_left_out(tmp_path: Path, wrong: Any, hint: str) -> None:
    rows = [*moving(), *(heard(i + 0.5, bearing=wrong(towards(i + 0.5))) for i in range(28))]
    found = run(tmp_path, rows, detections=[DETECTED, FINDER])
    (suspicion,) = found.summary["suspicions"]
    assert suspicion["subject"] == "/finder" and suspicion["done"] == "its bearings are left out"
    assert any(suspicion["seen"].endswith(f"just before and after{each}") for each in hint.split("|"))
    assert "measurements" not in found.summary
    told = run(tmp_path, rows, detections=[DETECTED, FINDER], trusted=["place"])
    assert told.summary["suspicions"] == [] and told.summary["measurements"]["num"] == 28


def test_right_bearings_are_not_suspected(tmp_path: Path) -> None:
    noise = np.random.default_rng(2).normal(0.0, np.radians(1.5), 28)
    rows = [*moving(), *(heard(i + 0.5, bearing=towards(i + 0.5) + noise[i]) for i in range(28))]
    found = run(tmp_path, rows, detections=[DETECTED, FINDER])
    assert found.summary["suspicions"] == [] and found.summary["measurements"]["num"] == 28


def test_names_that_several_bear_are_nobodys(tmp_path: Path) -> None:
    """The name is given out anew 80 km away: whom a bearing is about nobody knows."""
    far = [detection(60.0 + i, 80_000.0 + 40.0 * i, 900.0, agent_id="fox") for i in range(20)]
    rows = [*moving(20), *far, *(heard(i + 0.5, bearing=towards(i + 0.5)) for i in range(18))]
    found = run(tmp_path, rows, detections=[DETECTED, FINDER])
    assert set(found.detections["agent_id"].to_pylist()) == {"fox", "fox.2"}
    assert found.summary["measurements"]["agents"] == {} and found.summary["measurements"]["num"] == 18
