"""Mission hypotheses of a log with heights: they are drawn beside the plane, for agents that have any."""

import json
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from test_retrospect import DETECTED_S, INFER, QUIET, detections, run

from pipeline.files import hash_file
from pipeline.infer.stage import infer
from pipeline.stories import MISSION_NAME, read_stories
from pipeline.tables import Frame, read_table, write_table
from schemas.tables import DETECTIONS_WITH_HEIGHT


def with_heights() -> pa.Table:
    """T0 climbs by 2 m/s from 1000 m; the heights of the others are unknown."""
    table = detections()
    time_s = (table["time_ns"].to_numpy() - table["time_ns"].to_numpy().min()) * 1e-9
    is_high = np.array(table["agent_id"].to_pylist()) == "T0"
    height = pa.array(np.where(is_high, 1000.0 + 2.0 * time_s, np.nan), from_pandas=True)
    index = table.schema.get_field_index("z_m")
    table = table.set_column(index, table.schema.field(index), height)
    return table.append_column(DETECTIONS_WITH_HEIGHT.field("cov_zz_m2"), pa.array(np.full(len(table), 4.0)))


def directory_of(parent: Path, table: pa.Table) -> Path:
    directory = parent / "walk"
    directory.mkdir(parents=True)
    write_table(table, directory / "detections.parquet", "detections", Frame("map"))
    (directory / "obstacles.json").write_text('{"version": 1, "obstacles": []}')
    infer(directory, INFER, QUIET)
    run(directory)
    return directory


@pytest.fixture(scope="module")
def high(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return directory_of(tmp_path_factory.mktemp("high"), with_heights())


def test_heights_are_where_the_agent_is_and_as_they_were_seen(high: Path) -> None:
    stories = read_stories(high).stories
    assert stories.height_m is not None
    assert np.isnan(stories.height_m[:, 1:]).all()
    assert (np.isfinite(stories.height_m[:, 0]) == stories.is_present[:, 0]).all()
    seen_s = np.array(DETECTED_S["T0"], dtype=np.float64)
    at = np.searchsorted(stories.time_s, seen_s - 0.5)
    off_m = stories.height_m[:, 0, at] - (1000.0 + 2.0 * seen_s)
    assert np.abs(off_m.mean(axis=0)).max() < 4.0


def test_what_infer_fitted_is_what_would_be_fitted_again(high: Path, tmp_path: Path) -> None:
    """Models are handed on by infer's manifest; where it says nothing of them they are fitted to the same."""
    alone = tmp_path / "walk"
    shutil.copytree(high, alone)
    told = json.loads((alone / "infer.manifest.json").read_text())
    assert {"bank", "height"} <= set(told["summary"])
    del told["summary"]["bank"], told["summary"]["height"]
    (alone / "infer.manifest.json").write_text(json.dumps(told))
    (alone / "retrospect.manifest.json").unlink()
    assert run(alone).status == "done"
    assert hash_file(alone / MISSION_NAME) == hash_file(high / MISSION_NAME)


def test_the_plane_keeps_its_numbers_and_a_log_without_heights_its_bytes(high: Path, tmp_path: Path) -> None:
    flat = directory_of(tmp_path, detections())
    np.testing.assert_array_equal(read_stories(high).stories.position_m, read_stories(flat).stories.position_m)
    assert read_stories(flat).stories.height_m is None
    table, _ = read_table(flat / MISSION_NAME, "mission")
    assert table["height_m"].null_count == table.num_rows
