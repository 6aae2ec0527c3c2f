"""Sensors' footprints on the way from settings to rows: who looked where, what is fitted, what contradicts, what is refused."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures.small_logs import START_NS, Row, detection, pose
from test_extract import fails, run

from cadence.errors import ConfigError, InputError
from cadence.evidence.footprints import DetectionCurve
from pipeline.looks import has_looks, read_footprints, read_looks

POSES = [{"topic": "/plane", "sensor": "plane"}]
DISC: dict[str, Any] = {"sensor": "plane", "probability": 0.8, "range_m": 50.0}


def flight() -> list[Row]:
    """A plane flies east at 10 m/s and looks every second; it sees the target at 2 s and 7 s, another sensor does at 5 s."""
    rows = [pose(float(i), 10.0 * i, 0.0, topic="/plane") for i in range(11)]
    return [
        *rows,
        detection(2.0, 20.0, 10.0, sensor="plane", agent_id="T0"),
        detection(5.0, 50.0, 10.0, sensor="mast", agent_id="T0"),
        detection(7.2, 70.0, 10.0, sensor="plane", agent_id="T0"),
    ]


def test_every_pose_is_a_look_that_knows_what_it_saw(tmp_path: Path) -> None:
    found = run(tmp_path, flight(), poses=POSES, sensors=[DISC])
    table = found.table("looks")
    assert table["time_ns"].to_pylist() == [START_NS + i * 10**9 for i in range(11)]
    assert table["x_m"].to_pylist() == [10.0 * i for i in range(11)] and table["heading_rad"].to_pylist() == [0.0] * 11
    assert table["seen"].to_pylist() == [["T0"] if i in (2, 7) else [] for i in range(11)]
    ((footprint, looks),) = read_looks(tmp_path, START_NS + 10**9)
    assert looks.time_s[0] == -1.0 and looks.curve(np.array([20.0, 51.0])).tolist() == [0.8, 0.0]
    assert footprint.trust == 1.0 and not footprint.is_standing and found.summary["suspicions"] == []
    ((_, turned),) = read_looks(tmp_path, START_NS)
    assert not turned.is_silent("T0")[2] and turned.is_silent("T0")[3] and turned.is_silent("T1")[2]


def test_without_sensors_there_are_no_files(tmp_path: Path) -> None:
    run(tmp_path, flight(), poses=POSES)
    assert not has_looks(tmp_path) and read_looks(tmp_path, 0) == ()


def test_a_mast_stands_looks_north_and_is_off_at_times(tmp_path: Path) -> None:
    mast = {
        "sensor": "mast",
        "position": [0.0, 0.0],
        "every_s": 2.0,
        "angle_deg": 90.0,
        "heading_deg": 0.0,
        "on": [[0.0, 3.0], [8.0, 99.0]],
    }
    mast |= {"probability": [[0.0, 0.9], [100.0, 0.0]], "is_hidden": True}
    found = run(tmp_path, flight(), poses=POSES, sensors=[mast])
    assert found.table("looks")["time_ns"].to_pylist() == [START_NS + s * 10**9 for s in (0, 2, 8, 10)]
    ((footprint, looks),) = read_looks(tmp_path, START_NS)
    assert footprint.is_hidden and footprint.is_standing and footprint.shape == "sector"
    at = np.array([[0.0, 50.0], [50.0, 0.0], [10.0, 50.0], [0.0, -50.0]])
    assert looks.probability(at).tolist() == pytest.approx([0.45, 0.0, 0.9 * (1 - np.hypot(10, 50) / 100), 0.0])


def test_polygons_fixed_to_sensor_and_ground(tmp_path: Path) -> None:
    ahead = {"sensor": "plane", "probability": 0.5, "polygon": [[0.0, -5.0], [30.0, -5.0], [30.0, 25.0], [0.0, 25.0]]}
    ground = {
        "sensor": "field",
        "probability": 0.5,
        "polygon": [[0, 0], [90, 0], [90, 90]],
        "fixed_to": "ground",
        "every_s": 5.0,
    }
    run(tmp_path, flight(), poses=POSES, sensors=[ahead, ground])
    (_, plane), (_, field) = read_looks(tmp_path, START_NS)
    assert plane.probability(plane.position_m + np.array([10.0, 20.0])).tolist() == [0.5] * 11
    assert plane.probability(plane.position_m + np.array([-10.0, 0.0])).tolist() == [0.0] * 11
    assert len(field) == 3 and field.probability(np.array([[80.0, 10.0]] * 3)).tolist() == [0.5] * 3


def test_what_contradicts_detections_is_told_and_softened(tmp_path: Path) -> None:
    rows = [*flight(), *(detection(8.0 + 0.1 * i, 80.0, 5.0 + i, sensor="plane", agent_id="T0") for i in range(2))]
    for sub, reach, trust in (("a", 8.0, 0.5), ("b", 4.0, 0.0)):
        folder = tmp_path / sub
        folder.mkdir()
        found = run(folder, rows, poses=POSES, sensors=[DISC | {"range_m": reach}])
        assert read_footprints(folder)[0].trust == trust
        (told,) = [line for line in found.summary["suspicions"] if line["kind"] == "place"]
        assert "plane" in told["subject"] and "of its 4 detections" in told["seen"]
    folder = tmp_path / "c"
    folder.mkdir()
    run(folder, rows, poses=POSES, sensors=[DISC | {"range_m": 4.0}], trusted=["place"])
    assert read_footprints(folder)[0].trust == 1.0


@pytest.mark.parametrize(("num", "is_told"), [(5, True), (11, False)])
def test_one_of_many_detections_beyond_the_table_is_chance(tmp_path: Path, num: int, is_told: bool) -> None:
    seen = [detection(0.9 * i, 9.0 * i, 10.0, sensor="plane", agent_id="T0") for i in range(num)]
    rows = sorted(
        [*flight()[:11], *seen, detection(9.95, 99.0, 60.0, sensor="plane", agent_id="T0")], key=lambda row: row.time_s
    )
    found = run(tmp_path, rows, poses=POSES, sensors=[DISC])
    assert [line["kind"] for line in found.summary["suspicions"]] == ["place"] * is_told
    assert (read_footprints(tmp_path)[0].trust < 1.0) == is_told


def test_a_curve_is_fitted_on_other_times_than_it_is_used_at(tmp_path: Path) -> None:
    """A target goes to and fro before a mast; a second sensor always knows where it is."""
    law = DetectionCurve(np.array([0.0, 300.0, 900.0]), np.array([0.8, 0.8, 0.0]))
    generator = np.random.default_rng(4)
    rows = []
    for i in range(800):
        x = 700.0 + 600.0 * np.sin(0.05 * i)
        rows.append(detection(float(i), x, 0.0, sensor="tracker", agent_id="T0"))
        if generator.random() < law(np.array(x)):
            rows.append(detection(float(i), x, 0.0, sensor="mast", agent_id="T0"))
    found = run(tmp_path, rows, sensors=[{"sensor": "mast", "position": [0.0, 0.0], "every_s": 1.0}])
    (footprint,) = read_footprints(tmp_path)
    assert len(footprint.curves) == 2 and footprint.num_looks is not None and footprint.num_looks > 700
    at = np.array([200.0, 400.0, 600.0, 800.0])
    for part in (0, 1):
        assert np.abs(footprint.curve(part)(at) - law(at)).max() < 0.15
    parts = found.table("looks")["part"].to_pylist()
    assert parts[:100] == [0] * 100 and parts[101:199] == [1] * 98 and len(read_looks(tmp_path, 0)) == 2


def test_a_group_of_sensors_shares_an_entry(tmp_path: Path) -> None:
    rows = [pose(float(i), 0.0, 10.0 * i, topic=f"/{name}") for i in range(5) for name in ("boat_1", "boat_2")]
    rows += [detection(2.0, 1.0, 20.0, sensor="camera of boat_2", agent_id=None)]
    poses = [{"topic": f"/{name}", "sensor": name} for name in ("boat_1", "boat_2")]
    boats = {"sensor": "boat_*", "probability": 0.5, "range_m": 10.0, "every_s": 2.0, "detects_as": "camera of boat_2"}
    found = run(tmp_path, rows, poses=poses, sensors=[boats])
    table = found.table("looks")
    assert table["sensor_id"].to_pylist() == ["boat_1", "boat_2"] * 3
    assert [names for names in table["seen"].to_pylist() if names] == [[None], [None]]


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ({"sensor": "plane", "probability": 0.5, "range_m": 0.0}, "no area"),
        ({"sensor": "plane", "probability": 0.5, "polygon": [[0, 0], [1, 1], [2, 2]]}, "area is zero"),
        ({"sensor": "plane", "probability": 0.5, "range_m": 5.0, "angle_deg": 0.0}, "no area"),
        ({"sensor": "ghost", "probability": 0.5, "range_m": 5.0}, "'ghost' has no pose .*plane.*give its position"),
        ({"sensor": "plane", "probability": 1.5, "range_m": 5.0}, "between 0 and 1, got 1.5"),
        ({"sensor": "plane", "probability": [[0.0, -0.5], [5.0, 0.0]]}, "between 0 and 1, got -0.5"),
        ({"sensor": "plane", "probability": [[5.0, 0.5], [5.0, 0.0]]}, "must increase"),
        ({"sensor": "plane", "probability": 0.0, "range_m": 5.0}, "never detects"),
        ({"sensor": "plane", "probability": 0.5}, "ends somewhere"),
        ({"sensor": "plane"}, "not stated, and the log does not tell it .0 hits in 4 looks"),
        ({"sensor": "m", "position": [0, 0], "probability": 0.5, "range_m": 5.0}, "give every_s"),
        ({"sensor": "m", "position": [0, 0], "every_s": 0.0, "probability": 0.5, "range_m": 5.0}, "above zero"),
        (
            {"sensor": "m", "position": [0, 0], "every_s": 1.0, "probability": 0.5, "range_m": 5.0, "angle_deg": 30.0},
            "heading_deg",
        ),
        ({"sensor": "m", "position": [0, 0], "every_s": 1e-6, "probability": 0.5, "range_m": 5.0}, "larger every_s"),
        ({"sensor": "plane", "probability": 0.5, "angle_deg": 9.0, "polygon": [[0, 0], [1, 0], [0, 1]]}, "not both"),
        ({"sensor": "plane", "probability": 0.5, "range_m": 5.0, "on": [[3.0, 1.0]]}, "end after"),
    ],
)
def test_what_cannot_be_meant_is_one_clear_line(tmp_path: Path, entry: dict[str, Any], words: str) -> None:
    fails(tmp_path, flight(), ConfigError, words, poses=POSES, sensors=[entry])


def test_damaged_files_are_told(tmp_path: Path) -> None:
    run(tmp_path, flight(), poses=POSES, sensors=[DISC])
    path = tmp_path / "sensors.json"
    for content in ("{", json.dumps({"version": 9, "footprints": []}), json.dumps({"version": 1, "footprints": [{"x": 1}]})):
        path.write_text(content)
        with pytest.raises(InputError, match="not a list of footprints"):
            read_footprints(tmp_path)
