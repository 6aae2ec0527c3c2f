"""Vehicles whose metres count from places of their own: PX4 states where that is in every message."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures.field_messages import PX4
from fixtures.ros_messages import Builder, store_with
from fixtures.small_logs import Row, detection, fix, time_ns
from test_extract import fails, mk, run

from cadence.errors import InputError
from pipeline.frames import to_geodetic

NED = Builder(store_with(PX4))
DEGREE_M = 111_200.0


def local(time_s: float, north_m: float, origin: tuple[float, float], name: str = "d1", **more: Any) -> Row:
    message = NED(
        "px4_msgs/msg/VehicleLocalPosition", timestamp=time_ns(time_s) // 1000, xy_valid=True, x=north_m, y=0.0, xy_global=True,
        ref_lat=origin[0], ref_lon=origin[1], **more,
    )  # fmt: skip
    return NED.cdr_row(message, f"/targets/{name}/vehicle_local_position", time_s)


def way(found: Any, agent: str) -> np.ndarray:
    """How far north an agent is [N], metres."""
    rows = found.detections.to_pylist()
    return np.array([row["y_m"] for row in rows if row["agent_id"] == agent])


def test_vehicles_that_count_from_different_places(tmp_path: Path) -> None:
    rows = [
        local(i, float(i), (47.0 + 0.01 * number, 8.0), name) for i in range(20) for number, name in enumerate(["d1", "d2"])
    ]
    found = run(tmp_path, rows)
    assert found.summary["suspicions"] == [] and way(found, "d1") == pytest.approx(np.arange(20.0))
    assert way(found, "d2") == pytest.approx(0.01 * DEGREE_M + np.arange(20.0), abs=1.0)


def test_an_origin_that_is_set_anew(tmp_path: Path) -> None:
    rows = [local(i, i - 222.4 * (i >= 10), (47.0 + 0.002 * (i >= 10), 8.0)) for i in range(20)]
    assert way(run(tmp_path, rows), "d1") == pytest.approx(np.arange(20.0), abs=0.5)


@pytest.mark.parametrize("origin", [(math.nan, math.nan), (0.0, 0.0)])
def test_metres_without_an_origin_stay_where_they_are(tmp_path: Path, origin: tuple[float, float]) -> None:
    found = run(
        tmp_path, [local(i, float(i), origin if name == "d1" else (47.0, 8.0), name) for i in range(9) for name in ("d1", "d2")]
    )
    assert way(found, "d1") == pytest.approx(np.arange(9.0)) == way(found, "d2")


def test_an_origin_joins_metres_to_latitude_and_longitude(tmp_path: Path) -> None:
    rows = [row for i in range(9) for row in (local(i, 10.0 * i, (47.0, 8.0)), fix(i + 0.5, 47.001, 8.0, "/targets/d2/fix"))]
    found = run(tmp_path, rows)
    assert way(found, "d2") == pytest.approx(np.full(9, 0.001 * DEGREE_M), abs=0.5)
    latitude, longitude = to_geodetic(found.frame, np.zeros(1), way(found, "d1")[-1:])
    assert (latitude[0], longitude[0]) == pytest.approx((47.0 + 80.0 / DEGREE_M, 8.0), abs=1e-5)
    other = [detection(float(i), 3.0 * i, 0.0, frame="") for i in range(9)]  # which may lie anywhere
    fails(mk(tmp_path / "b"), [*rows, *other], InputError, "come in different frames")
