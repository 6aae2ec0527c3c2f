"""Measurements from the table of extract to weighed windows: whom they are about, and that nothing else changes."""

import dataclasses
from pathlib import Path

import numpy as np
from test_infer import CONFIG, FRAME, START_NS, mission, run

from cadence.bearings.estimator import MEASURED
from cadence.evidence.settings import WeighingConfig
from pipeline.infer.measuring import hear_measurements
from pipeline.manifest import read_manifest
from pipeline.measurements import MeasurementRows, read_measurements, write_measurements
from pipeline.results import read_hypothesis_tables
from pipeline.tables import read_table

NUM = 60
MAST = np.array([-500.0, 0.0])
MIDDLE = np.array([3.0 * 106.0, 40.0 * np.sin(0.02 * 106.0) + 15.0])
"""Where T0 is said to have been at 106 s, on the way from 94 to 120 s on which nobody saw it."""


def with_bearings(
    directory: Path, agents: tuple[str | None, ...] = ("T0",), sigma_rad: float = 0.002, at_s: float | np.ndarray = 106.0,
    turned_rad: float = 0.0,
) -> Path:  # fmt: skip
    """A mast in the west that hears somebody at 106 s, each of `agents` once."""
    num = len(agents)
    nothing = np.full(num, np.nan)
    east, north = MIDDLE - MAST
    rows = MeasurementRows(
        time_ns=START_NS + np.full(num, np.multiply(at_s, 1e9)).astype(np.int64),
        sensor=np.array(["mast"] * num, dtype=object),
        agent=np.array(agents, dtype=object),
        observer_m=np.tile([*MAST, np.nan], (num, 1)),
        observer_velocity_mps=np.zeros((num, 2)),
        range_m=nothing,
        bearing_rad=np.full(num, np.arctan2(north, east) + turned_rad),
        elevation_rad=nothing,
        range_rate_mps=nothing,
        range_sigma_m=nothing,
        bearing_sigma_rad=np.full(num, sigma_rad),
        elevation_sigma_rad=nothing,
        range_rate_sigma_mps=nothing,
        topic=np.array(["/mast"] * num, dtype=object),
        log_time_ns=np.zeros(num, np.int64),
        sequence=np.zeros(num, np.int64),
    )
    write_measurements(directory, "walk", rows, FRAME)
    return directory


def inferred(directory: Path, **changes: object) -> dict:
    run(directory, dataclasses.replace(CONFIG, num_hypotheses=NUM), **changes)
    manifest = read_manifest("infer", directory)
    assert manifest is not None
    return manifest["summary"]


def miss_m(directory: Path) -> float:
    """How far T0 is, in the mean over hypotheses of the first window that knows, from the line on which it was heard."""
    heard_ns = START_NS + 106 * 10**9
    window = next(one for one in read_hypothesis_tables(directory).windows if one.origin_ns >= heard_ns)
    agent = next(agent for agent in window.agents if agent.agent_id == "T0")
    step = 15 + round((heard_ns - window.origin_ns) / 2e9)
    place = agent.position_m[:, step] + np.array(agent.datum_m) - MAST
    line = (MIDDLE - MAST) / np.linalg.norm(MIDDLE - MAST)
    return float(window.weight @ np.abs(place[:, 0] * line[1] - place[:, 1] * line[0]))


def test_a_bearing_pulls_the_way_that_nobody_saw(tmp_path: Path) -> None:
    plain = mission(tmp_path / "plain")
    inferred(plain)
    heard = with_bearings(mission(tmp_path / "heard"))
    summary = inferred(heard)
    assert summary["measurements"] == {"num_used": 1, "num_not_used": 0, "agents": {"T0": 1}}
    assert miss_m(heard) < 0.6 * miss_m(plain)


def test_bearings_that_are_set_aside_in_most_windows_are_told(tmp_path: Path) -> None:
    misread = with_bearings(mission(tmp_path), ("T0", "T1") * 100, at_s=np.arange(200.0), turned_rad=-np.pi)
    summary = inferred(misread)
    assert 2 * summary["status"]["contradicted"] > sum(summary["status"].values())
    assert "how their bearings count" in summary["remarks"][-1]


def test_who_was_never_seen_is_drawn_from_bearings(tmp_path: Path) -> None:
    """An owl is heard in four moments from the mast, which cannot tell how far away it is; one more bearing is nobody's."""
    heard = with_bearings(mission(tmp_path), ("T0", *["owl"] * 4, None), at_s=np.array([106.0, 90, 100, 110, 120, 120]))
    summary = inferred(heard)
    assert summary["measurements"] == {"num_used": 5, "num_not_used": 1, "agents": {"T0": 1, "owl": 4}}
    assert summary["remarks"][-1].startswith("1 measurement says not which of 3 agents they are about and are not used")
    tables = read_hypothesis_tables(heard)
    first = next(window for window in tables.windows if window.origin_ns >= START_NS + 120 * 10**9)
    owl = next(agent for agent in first.agents if agent.agent_id == "owl")
    assert owl.status == MEASURED
    away = owl.position_m[:, 15] + np.array(owl.datum_m) - MAST
    range_m, bearing = np.hypot(*away.T), np.arctan2(away[:, 1], away[:, 0])
    assert np.abs(bearing - np.arctan2(*(MIDDLE - MAST)[::-1])).max() < 0.5
    assert np.quantile(range_m, 0.95) > 4.0 * np.quantile(range_m, 0.05)
    rows, _ = read_table(heard / "windows.parquet", "windows")
    mine = [row for row in rows.to_pylist() if row["agent_id"] == "owl"]
    assert {row["status"] for row in mine} == {"no_detections", MEASURED}
    assert all(row["num_detections"] == 0 and row["age_s"] is None for row in mine)


def test_switched_off_no_byte_differs(tmp_path: Path) -> None:
    plain, off = mission(tmp_path / "plain"), with_bearings(mission(tmp_path / "off"))
    inferred(plain)
    inferred(off, evidence=WeighingConfig(is_used=False))
    for name in ("windows.parquet", "hypotheses.parquet"):
        assert (off / name).read_bytes() == (plain / name).read_bytes()


def test_a_nameless_bearing_is_of_the_only_agent(tmp_path: Path) -> None:
    found = read_measurements(with_bearings(mission(tmp_path), (None,)), START_NS)
    assert len(hear_measurements(found, WeighingConfig(), ("T0",)).evidence) == 1
    assert hear_measurements(found, WeighingConfig(), ("T0", "T1")).evidence == ()
