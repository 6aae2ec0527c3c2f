"""Zeros and the like where no position is known, and real ones that only look like them."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from fixtures.small_logs import Row, detection, fix
from test_extract import fails, run
from test_identity import array

from cadence.errors import InputError


def by_time(rows: list[Row]) -> list[Row]:
    return sorted(rows, key=lambda row: row.time_s)


def drive(num: int, first: int = 0, topic: str = "/contacts/A") -> list[Row]:
    return [fix(float(i), 48.1 + 1e-4 * i, 11.6, topic) for i in range(first, first + num)]


@pytest.mark.parametrize("place", [(0.0, 0.0), (-1.0, -1.0), (90.0, 180.0)])
@pytest.mark.parametrize("times", [range(20), range(25, 30), range(50, 90)])
def test_a_receiver_without_a_fix_that_does_not_say_so(tmp_path: Path, place: tuple[float, float], times: range) -> None:
    rows = [fix(float(i), *place) if i in times else drive(1, i)[0] for i in range(90)]
    found = run(tmp_path, rows)
    assert found.summary["num_detections"] == 90 - len(times)
    assert float(np.abs(np.asarray(found.detections["y_m"])).max()) < 1000.0
    (suspicion,) = found.summary["suspicions"]
    assert f"{len(times)} of 90 positions are at {place[0]:g}, {place[1]:g}" in suspicion["seen"]


@pytest.mark.parametrize("place", [(91.0, 11.6), (48.1, 181.0)])
def test_half_of_what_a_ship_sends_instead_of_its_place(tmp_path: Path, place: tuple[float, float]) -> None:
    found = run(tmp_path, [fix(float(i), *place) if i % 6 == 0 else drive(1, i)[0] for i in range(60)])
    assert (found.summary["num_detections"], found.summary["dropped_nonfinite"]) == (50, 10)
    assert float(np.abs(np.asarray(found.detections["x_m"])).max()) < 10.0 and found.summary["suspicions"] == []


@pytest.mark.parametrize("place", [(1.0, 1.0), (48.1, 48.1), (0.0, 11.6), (1e-7, -1e-7)])
def test_degrees_that_look_written(tmp_path: Path, place: tuple[float, float]) -> None:
    found = run(tmp_path, [fix(float(i), *place) if 20 <= i < 30 else drive(1, i)[0] for i in range(60)])
    assert found.summary["num_detections"] == 50 and len(found.summary["suspicions"]) == 1


@pytest.mark.parametrize("place", [(1e7, 1e7), (-999.0, -999.0), (2147483647.0, 2147483647.0), (1e38, 1e38), (0.0, 250.0)])
def test_metres_that_look_written(tmp_path: Path, place: tuple[float, float]) -> None:
    ways = [place if 20 <= i < 30 else (1500.0 + 5.0 * i, 2500.0) for i in range(60)]
    found = run(tmp_path, [detection(float(i), *way, agent_id="a") for i, way in enumerate(ways)])
    assert found.summary["num_detections"] == 50 and len(found.summary["suspicions"]) == 1


@pytest.mark.parametrize(
    ("is_zero", "others", "num"),
    [
        (lambda i: i % 10 == 3, (500.0, 400.0), 0),
        (lambda i: i < 12, (500.0, 400.0), 12),  # one that stood there
        (lambda i: i % 10 == 3, (-90.0, 0.0), 6),  # others pass there
    ],
)
def test_zeros_in_lists_without_names(
    tmp_path: Path, is_zero: Callable[[int], bool], others: tuple[float, float], num: int
) -> None:
    rows = [
        array("/detections", i, [(others[0] + 3.0 * i, others[1]), (900.0 - 2.0 * i, 800.0), *([(0.0, 0.0)] * is_zero(i))])
        for i in range(60)
    ]
    found = run(tmp_path, rows)
    assert found.detections["x_m"].to_pylist().count(0.0) - (others == (-90.0, 0.0)) == num
    assert len(found.summary["suspicions"]) == (num == 0)


@pytest.mark.parametrize(
    ("num", "frame", "names"),
    [
        (lambda i: i % 3 == 0 or i % 5 == 0, "oak_link", None),  # a camera that found no depth in half of its messages
        (lambda i: 3 - i % 2, "map", None),  # a list of five places
        (lambda i: 3 - i % 2, "map", "0"),
    ],
)
def test_zeros_that_a_sensor_writes_for_none(tmp_path: Path, num: Callable[[int], int], frame: str, names: str | None) -> None:
    rows = []
    for i in range(60):
        places = [(8.0 + 0.1 * i, 2.0), (9.0, -3.0 + 0.1 * i), *([(0.0, 0.0)] * num(i))]
        rows += [array("/detections", i, places, None if names is None else ["1", "2", *([names] * num(i))])]
        rows[-1].message["header"]["frame_id"] = frame  # type: ignore[index, call-overload]
    found = run(tmp_path, rows)
    assert found.summary["num_detections"] == 120 and len(found.summary["suspicions"]) == 1
    assert found.summary["num_agents"] == (0 if names is None else 2)


def test_a_target_that_stands_at_the_zero_of_the_world(tmp_path: Path) -> None:
    found = run(tmp_path, [array("/detections", i, [(8.0 + 0.1 * i, 2.0), *([(0.0, 0.0)] * (i % 3 > 0))]) for i in range(60)])
    assert found.summary["num_detections"] == 100 and found.summary["suspicions"] == []


@pytest.mark.parametrize("held", [5, 30])
def test_a_receiver_that_begins_at_the_place_of_its_maker(tmp_path: Path, held: int) -> None:
    found = run(tmp_path, [*(fix(float(i), 31.2304, 121.4737) for i in range(held)), *drive(60, held)])
    (suspicion,) = found.summary["suspicions"]
    assert found.summary["num_detections"] == 60
    assert f"{held} of {held + 60} positions are at 31.2304, 121.474" in suspicion["seen"]


def test_a_ship_that_is_moored_in_another_country(tmp_path: Path) -> None:
    """Ships without names: the first stays, and is seen again."""
    moored = [fix(float(i), 50.5, 3.5, "/ais") for i in (*range(6), 20)]
    rows = [*moored, *(fix(i + 0.5, 51.5 + 1e-4 * i, 1.5, "/ais") for i in range(6, 40))]
    assert run(tmp_path, by_time(rows), detections=[{"topic": "/ais"}]).summary["suspicions"] == []


def test_what_is_off_the_earth_is_counted(tmp_path: Path) -> None:
    rows = [fix(float(i), *((91.0, 181.0) if i % 2 else (1e7, 1e7))) if 20 <= i < 30 else drive(1, i)[0] for i in range(60)]
    found = run(tmp_path, rows)
    assert found.summary["dropped_nonfinite"] == 10 and found.summary["suspicions"] == []


def test_nothing_but_zeros(tmp_path: Path) -> None:
    rows = [fix(float(i), 0.0, 0.0) for i in range(10)]
    fails(tmp_path, rows, InputError, "10 of 10 positions are at 0, 0")


def test_a_tracker_that_waits_at_zero(tmp_path: Path) -> None:
    rows = [detection(float(i), 0.0, 0.0, agent_id="a") for i in range(5)]
    rows += [detection(float(i), 400.0 + 3.0 * i, 300.0, agent_id="a") for i in range(5, 40)]
    rows += [detection(float(i), 7.0 * i, 0.0, agent_id="b") for i in range(40)]
    found = run(tmp_path, by_time(rows))
    assert found.summary["num_detections"] == 75 and len(found.summary["suspicions"]) == 1


@pytest.mark.parametrize(
    "rows",
    [
        [detection(float(i), max(0.0, 3.0 * (i - 5)), 0.0, agent_id="a") for i in range(40)],  # starts at its origin
        [detection(float(i), 0.0, 0.0, agent_id="a") for i in range(40)],  # stands there
        [detection(float(i), 5.0 * (i - 20), 0.0, agent_id="a") for i in range(40)],  # passes
        # seen where it started, and later where it came to
        [detection(float(i), 0.0, 0.0, agent_id="a") for i in range(5)]
        + [detection(60.0 + i, 180.0 + 3.0 * i, 0.0, agent_id="a") for i in range(30)],
        [fix(float(i), 1e-5 * i, 0.0) for i in range(40)],  # a simulator about 0, 0
        # along an axis, on which it waits, and off it
        [detection(float(i), 5.0 * min(i, 20), 3.0 * max(0, i - 25), agent_id="a") for i in range(40)],
        [detection(float(i), 0.0, 0.0, agent_id="beacon") for i in range(40)]
        + [detection(float(i), 300.0 + 3.0 * i, 0.0, agent_id="a") for i in range(40)],
    ],
)
def test_real_zeros(tmp_path: Path, rows: list[Row]) -> None:
    found = run(tmp_path, by_time(rows))
    assert found.summary["num_detections"] == len(rows) and found.summary["suspicions"] == []


def test_the_way_otherwise(tmp_path: Path) -> None:
    rows = [*(fix(float(i), 0.0, 0.0) for i in range(5)), *drive(20, 5)]
    trusted = run(tmp_path, rows, trusted=["place"], max_speed_mps=1e9)
    assert trusted.summary["num_detections"] == 25
    told = run(tmp_path, rows, detections=[{"topic": "/contacts/{agent}", "where": "latitude != 0"}])
    assert (told.summary["num_detections"], told.summary["unmet"], told.summary["suspicions"]) == (20, 5, [])
