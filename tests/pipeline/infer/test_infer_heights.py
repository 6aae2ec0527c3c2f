"""Heights beside the plane in the tables of infer: drawn where detections have any, by every estimator, and else not there."""

import dataclasses
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from test_infer import CONFIG, DETECTED_S, QUIET, START_NS, detections, mission, run, tracks

from pipeline.infer.stage import infer
from pipeline.results import read_hypothesis_tables
from pipeline.tables import read_table
from schemas.tables import DETECTIONS_WITH_HEIGHT, hypotheses_schema


def with_heights(table: pa.Table, agents: tuple[str, ...] = ("T0",)) -> pa.Table:
    """Heights of some agents: T0 climbs by 2 m/s from 1000 m."""
    time_s = (table["time_ns"].to_numpy() - table["time_ns"].to_numpy().min()) * 1e-9
    is_high = np.isin(np.array(table["agent_id"].to_pylist()), agents)
    height = pa.array(np.where(is_high, 1000.0 + 2.0 * time_s, np.nan), from_pandas=True)
    index = table.schema.get_field_index("z_m")
    table = table.set_column(index, table.schema.field(index), height)
    return table.append_column(DETECTIONS_WITH_HEIGHT.field("cov_zz_m2"), pa.array(np.full(len(table), 4.0)))


@pytest.fixture(scope="module")
def high(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = mission(tmp_path_factory.mktemp("high"), with_heights(detections()))
    run(directory)
    return directory


def test_the_plane_is_as_it_is_without_heights(high: Path, tmp_path: Path) -> None:
    flat = mission(tmp_path)
    run(flat)
    with_height, without = tracks(high)[0], tracks(flat)[0]
    assert with_height.schema.equals(hypotheses_schema(24, True)) and without.schema.equals(hypotheses_schema(24))
    assert with_height.drop_columns(["height_m"]).equals(without)


def test_heights_are_drawn_for_agents_that_have_them(high: Path) -> None:
    found = read_hypothesis_tables(high)
    seen = {agent.agent_id: agent for window in found.windows for agent in window.agents if agent.is_live}
    assert set(seen) == {"T0", "T1"} and seen["T1"].height_m is None
    window = found.windows[2]
    (agent,) = (agent for agent in window.agents if agent.agent_id == "T0")
    assert agent.height_m is not None and agent.height_m.shape == agent.position_m.shape[:2]
    time_s = (window.origin_ns - START_NS) * 1e-9 + np.arange(-15, 9) * 2.0
    seen_s = np.array([time for time in DETECTED_S["T0"] if time_s[0] <= time <= time_s[15]], dtype=np.float64)
    is_near = np.abs(time_s[:, None] - seen_s).min(1) <= 2.0
    assert is_near.sum() > 3
    assert np.abs(agent.height_m.mean(0) - 1000.0 - 2.0 * time_s)[is_near].max() < 8.0
    table, _ = read_table(high / "hypotheses.parquet", "hypotheses")
    assert table["height_m"].null_count == table["agent_id"].to_pylist().count("T1")


def test_heights_are_told_apart_with_the_detections(tmp_path: Path) -> None:
    table = with_heights(detections(), ("T0", "T1"))
    index = table.schema.get_field_index("agent_id")
    nameless = table.set_column(index, table.schema.field(index), pa.array([None] * len(table), pa.string()))
    directory = mission(tmp_path, nameless)
    config = dataclasses.replace(CONFIG, num_hypotheses=4)
    result = infer(directory, config, QUIET)
    assert result.summary["height"]["rate_mps"] > 0
    for row in read_table(directory / "hypotheses.parquet", "hypotheses")[0].to_pylist():
        is_there = np.isfinite(np.array(row["position_m"])).all()
        assert is_there == (row["height_m"] is not None)
        assert not is_there or np.isfinite(row["height_m"]).all()
