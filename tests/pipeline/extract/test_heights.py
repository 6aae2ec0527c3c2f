"""Heights of detections: where there are any, in metres, above one datum, with their noise; and logs without any."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures.small_logs import Row, fix, stamp
from test_extract import line, run

from pipeline.tables import read_table
from schemas.tables import DETECTIONS, DETECTIONS_WITH_HEIGHT

KNOWN = {"position_covariance": [225.0, 0, 0, 0, 100.0, 0, 0, 0, 16.0], "position_covariance_type": 2}


def climb(scale: float = 1.0, num: int = 40, **more: Any) -> list[Row]:
    """Eastwards at 70 m/s; level, up by 5 m/s, level again; altitudes times a scale."""
    up = 500.0 + 5.0 * np.clip(np.arange(num) - num / 4, 0, num / 2)
    return [fix(float(i), 48.0, 11.0 + 0.001 * i, altitude=float(z * scale), **more) for i, z in enumerate(up)]


def of_heights(found: Any) -> list[dict[str, str]]:
    """What is suspected of altitudes."""
    return [suspicion for suspicion in found.summary["suspicions"] if "altitudes" in suspicion["seen"]]


def above_sea(row: Row) -> Row:
    """The same fix as a receiver states it that counts from the sea."""
    message = {
        "timestamp": stamp(row.time_s),
        "latitude_deg": row.message["latitude"],
        "longitude_deg": row.message["longitude"],
    }  # type: ignore[index, call-overload]
    return Row("/contacts/B", "px4_msgs/SensorGps", row.time_s, message | {"altitude_msl_m": 450.0, "fix_type": 3})


def test_altitudes_are_used_with_what_they_count_from(tmp_path: Path) -> None:
    found = run(tmp_path, climb(**KNOWN))
    assert found.detections.schema.equals(DETECTIONS_WITH_HEIGHT)
    assert found.frame.vertical_datum == "ellipsoid"
    assert found.detections["z_m"].to_pylist()[:2] == [500.0, 500.0]
    assert set(found.detections["cov_zz_m2"].to_pylist()) == {16.0}, "as the message states it"
    assert found.summary["height"]["num_detections"] == 40


@pytest.mark.parametrize("height", [{"altitude": 0.0}, {"altitude": float("nan")}])
def test_heights_of_zero_are_none(tmp_path: Path, height: dict[str, float]) -> None:
    found = run(tmp_path, [fix(float(i), 48.0, 11.0 + 0.001 * i, **height) for i in range(5)])
    assert found.detections.schema.equals(DETECTIONS) and found.frame.vertical_datum is None
    assert "height" not in found.summary


def test_a_log_without_heights_is_as_it_was(tmp_path: Path) -> None:
    found = run(tmp_path, line())
    assert found.detections.schema.equals(DETECTIONS) and found.detections["z_m"].to_pylist() == [0.0] * 5
    assert (tmp_path / "detections.parquet").read_bytes() == _as_written(tmp_path, is_height_used=False)


@pytest.mark.parametrize("unknown", [-9999.0, 0.0, -32768.0])
def test_heights_that_stand_for_none(tmp_path: Path, unknown: float) -> None:
    rows = [fix(float(i), 48.0, 11.0 + 0.001 * i, altitude=unknown if i % 7 == 3 else 500.0 + i) for i in range(40)]
    found = run(tmp_path, rows)
    heights = found.detections["z_m"].to_pylist()
    assert heights.count(None) == 6 and min(z for z in heights if z is not None) == 500.0
    (told,) = of_heights(found)
    assert told["seen"].startswith(f"6 of 40 altitudes are {unknown:g}")


@pytest.mark.parametrize(
    "height",
    [
        lambda i: 0.0 if i > 30 else 900.0 - 30.0 * i,  # it lands
        lambda i: 999.0 if i == 20 else 979.0 + i,  # it passes there
        lambda i: 0.0 if i < 20 else 400.0,  # seen once a minute
    ],
)
def test_heights_that_only_look_like_none(tmp_path: Path, height: Any) -> None:
    found = run(tmp_path, [fix(60.0 * i, 48.0, 11.0 + 0.01 * i, altitude=height(i)) for i in range(40)])
    assert of_heights(found) == [] and found.detections["z_m"].to_pylist() == [height(i) for i in range(40)]


def test_zeros_where_a_track_begins_or_ends_are_the_ground(tmp_path: Path) -> None:
    """Transponders state no altitude there, and decoders make zero of it: no heights, and nothing that cannot be meant."""
    heights = [0.0] * 5 + [533.0 + i for i in range(30)] + [0.0] * 5
    found = run(tmp_path, [fix(5.0 * i, 67.8, 20.3 + 0.001 * i, altitude=z) for i, z in enumerate(heights)])
    assert of_heights(found) == [] and found.summary["ground_heights"] == 10
    assert found.detections["z_m"].to_pylist() == [None] * 5 + heights[5:35] + [None] * 5


def test_heights_can_be_left_alone(tmp_path: Path) -> None:
    found = run(tmp_path, climb(), is_height_used=False)
    assert found.detections.schema.equals(DETECTIONS) and found.detections["z_m"].to_pylist()[0] == 500.0


def test_noise_is_found_where_none_is_stated(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    rows = climb(num=160)
    for row in rows:
        row.message["altitude"] += rng.normal(0, 8.0)  # type: ignore[index, call-overload]
    found = run(tmp_path, rows)
    sigma_m = float(np.sqrt(found.detections["cov_zz_m2"].to_numpy().mean()))
    assert sigma_m == pytest.approx(8.0, rel=0.3)
    (noise,) = found.summary["height"]["noise"]
    assert noise["is_taken"] and noise["source"] == "/contacts/{agent}"
    told = run(tmp_path, rows, detections=[{"topic": "/contacts/{agent}", "sigma_z_m": 3.0}])
    assert set(told.detections["cov_zz_m2"].to_pylist()) == {9.0}


def test_feet_are_told_by_their_multiples(tmp_path: Path) -> None:
    rows = climb()
    for row in rows:
        row.message["altitude"] = float(np.round(row.message["altitude"] / 0.3048 / 25) * 25)  # type: ignore[index, call-overload]
    found = run(tmp_path, rows)
    (suspicion,) = of_heights(found)
    assert "multiples of 25" in suspicion["seen"] and suspicion["setting"].startswith('height_unit = "ft" or "m"')
    assert found.detections["z_m"].to_pylist()[0] == pytest.approx(500.0, abs=5.0)
    source = {"topic": "/contacts/{agent}"}
    metres = run(tmp_path, rows, detections=[source | {"height_unit": "m"}])
    assert of_heights(metres) == [] and metres.detections["z_m"].to_pylist()[0] == 1650.0
    levels = run(tmp_path, climb(1.0 / 30.48), detections=[source | {"height_unit": "FL"}])
    assert levels.detections["z_m"].to_pylist()[0] == pytest.approx(500.0)


def test_what_is_too_high_for_metres_is_left_out(tmp_path: Path) -> None:
    found = run(tmp_path, climb(70.1))
    (suspicion,) = of_heights(found)
    assert "higher than aircraft fly" in suspicion["seen"]
    assert found.detections["z_m"].null_count == 40 and found.frame.vertical_datum is None


def test_heights_above_two_data_are_not_mixed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = climb()
    mixed = sorted([*rows, *map(above_sea, rows[:10])], key=lambda row: row.time_s)
    found = run(tmp_path, mixed)
    known = dict.fromkeys("AB", 0)
    for row in found.detections.to_pylist():
        known[row["agent_id"]] += row["z_m"] is not None
    assert known == {"A": 40, "B": 0} and found.frame.vertical_datum == "ellipsoid"
    stated = [{"topic": "/contacts/A"}, {"topic": "/contacts/B", "vertical_datum": "ellipsoid"}]
    assert run(tmp_path, mixed, detections=stated).detections["z_m"].null_count == 0


def test_truth_above_another_datum_is_none(tmp_path: Path) -> None:
    rows = climb()
    mixed = sorted([*rows, *map(above_sea, rows)], key=lambda row: row.time_s)
    tables = {"detections": [{"topic": "/contacts/A", "agent": "A"}], "truth": [{"topic": "/contacts/B", "agent": "A"}]}
    run(tmp_path, mixed, **tables)
    truth, _ = read_table(tmp_path / "truth.parquet", "truth")
    assert truth["z_m"].null_count == len(truth)
    tables["truth"][0]["vertical_datum"] = "ellipsoid"
    run(tmp_path, mixed, **tables)
    assert read_table(tmp_path / "truth.parquet", "truth")[0]["z_m"].null_count == 0


def test_heights_that_point_down_are_told(tmp_path: Path) -> None:
    rows = []
    for i in range(12):
        pose = {"pose": {"position": {"x": 3.0 * i, "y": 0.0, "z": -40.0 - i}}}
        rows.append(
            Row("/contacts/a", "nav_msgs/Odometry", float(i), {"header": {"stamp": stamp(i), "frame_id": "map"}, "pose": pose})
        )
    found = run(tmp_path, rows)
    assert found.frame.vertical_datum == "frame" and found.detections["z_m"].to_pylist()[0] == -40.0
    turned = run(tmp_path, rows, detections=[{"topic": "/contacts/a", "frame_convention": "ned"}])
    assert turned.detections["z_m"].to_pylist()[0] == 40.0


def _as_written(folder: Path, **tables: Any) -> bytes:
    run(folder, line(), **tables)
    return (folder / "detections.parquet").read_bytes()
