"""The retrospect stage on small mission directories: whole tracks, seeds, limits, unknown origin, what it refuses."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
import torch
from fixtures import unknown_origin
from fixtures.unknown_origin import CLUTTERED, SWAPPED, TRUE, WEIGHT

from cadence.association.types import AssociationHypotheses
from cadence.constraints.checker import segments_in_collision, states_in_collision
from cadence.diffusion.settings import GuidanceConfig
from cadence.errors import InputError
from pipeline import associations
from pipeline.files import hash_file
from pipeline.grids import GridConfig
from pipeline.infer.config import InferConfig
from pipeline.infer.stage import infer
from pipeline.manifest import StageResult, check_chain
from pipeline.obstacle_file import read_obstacles
from pipeline.pasts import PASTS_NAME, read_pasts
from pipeline.progress import Progress, RelayedProgress
from pipeline.retrospect.config import RetrospectConfig
from pipeline.retrospect.stage import retrospect
from pipeline.stories import MISSION_NAME, read_stories
from pipeline.tables import Frame, read_table, write_table
from schemas.tables import DETECTIONS

QUIET = Progress(quiet=True)
START_NS = 1_700_000_000_000_000_000
GRID = GridConfig(step_s=2.0, history_steps=16, horizon_steps=8, stride_steps=16)
INFER = InferConfig(num_hypotheses=3, checkpoint="none", device="cpu", grid=GRID)
CONFIG = RetrospectConfig(num_hypotheses=20)
DETECTED_S = {"T0": [0, 2, 4, 30, 32, 60, 62, 90, 92, 94, 120, 122, 150, 152], "T1": [6, 8, 10, 28, 30], "T2": [70]}


def detections() -> pa.Table:
    """T0 goes in a wide curve all the time, T1 is seen in the first half minute only, T2 once."""
    rows = [
        {
            "log_id": "walk", "time_ns": START_NS + time * 10**9, "agent_id": agent, "x_m": 3.0 * time,
            "y_m": 40.0 * np.sin(0.02 * time) + 500.0 * number, "cov_xx_m2": 0.25, "cov_xy_m2": 0.0, "cov_yy_m2": 0.25,
            "num_merged": 1, "topic": "/seen", "log_time_ns": 0, "sequence": 0,
        }
        for number, (agent, times) in enumerate(DETECTED_S.items()) for time in times
    ]  # fmt: skip
    rows.sort(key=lambda row: (row["time_ns"], row["agent_id"]))
    return pa.Table.from_pylist(rows, schema=DETECTIONS)


def test_how_far_it_is_is_told_agent_by_agent(tmp_path: Path) -> None:
    told: list[object] = []
    retrospect(mission(tmp_path), CONFIG, RelayedProgress(tell=told.append), num_threads=2)
    shares = [share for share in told if isinstance(share, float)]
    assert shares == pytest.approx([number / 6 for number in range(1, 7)])  # each agent drawn, and mended


def mission(parent: Path, obstacles: tuple[dict[str, object], ...] = (), config: InferConfig = INFER) -> Path:
    directory = parent / "walk"
    directory.mkdir(parents=True)
    write_table(detections(), directory / "detections.parquet", "detections", Frame("map"))
    (directory / "obstacles.json").write_text(json.dumps({"version": 1, "obstacles": list(obstacles)}))
    infer(directory, config, QUIET)
    return directory


def run(directory: Path, **changes: object) -> StageResult:
    return retrospect(directory, dataclasses.replace(CONFIG, **changes), QUIET)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, StageResult]:
    directory = mission(tmp_path_factory.mktemp("done"))
    return directory, run(directory)


def test_stories_are_whole_and_pass_what_was_seen(done):
    directory, result = done
    found = read_stories(directory)
    stories = found.stories
    assert result.status == "done" and {path.name for path in result.outputs} == {MISSION_NAME}
    assert stories.agent_ids == ("T0", "T1", "T2") and stories.num_hypotheses == 20 and found.log_id == "walk"
    assert found.start_ns == START_NS and result.summary["num_steps"] == len(stories.time_s) == 77
    is_there = stories.is_present
    assert (is_there == is_there[:1]).all()
    spans = [stories.time_s[row][[0, -1]].tolist() for row in is_there[0]]
    assert np.round(spans, 9).tolist() == [[0.0, 152.0], [6.0, 30.0], [70.0, 70.0]]
    for agent, (name, times) in enumerate(DETECTED_S.items()):
        table = detections().to_pylist()
        seen = np.array([[row["x_m"], row["y_m"]] for row in table if row["agent_id"] == name])
        away = np.linalg.norm(stories.at(np.array(times, dtype=np.float64))[:, agent] - seen, axis=-1)
        assert away.max() < 0.5 * 6
    steps = np.linalg.norm(np.diff(stories.position_m[:, 0], axis=1), axis=-1)
    assert steps.max() < 20.0  # 6 m on average


def test_it_is_done_once_and_the_same_whatever_the_number_of_threads(done, tmp_path):
    directory, _ = done
    assert run(directory).status == "skipped"
    before = hash_file(directory / MISSION_NAME)
    for threads in (1, 3):
        retrospect(directory, CONFIG, QUIET, force=True, num_threads=threads)
        assert hash_file(directory / MISSION_NAME) == before
    other = mission(tmp_path / "other")
    run(other, seed=1)
    assert hash_file(other / MISSION_NAME) != before


def test_before_and_after_the_detections_as_far_as_asked(tmp_path):
    directory = mission(tmp_path)
    run(directory, before_s=20.0, after_s=60.0)
    stories = read_stories(directory).stories
    times = read_stories(directory).time_ns
    spans = [((times[row][[0, -1]] - START_NS) // 10**9).tolist() for row in stories.is_present[0]]
    assert spans == [[-20, 212], [-14, 90], [50, 130]]
    spread = stories.position_m[:, 0].std(axis=0).max(axis=-1)
    assert spread[-1] > 5.0 * spread[np.searchsorted(times, START_NS + 152 * 10**9)]


def test_obstacles_and_a_stated_speed_are_kept_exactly(tmp_path):
    # the mean way passes through it; both ways round are open
    wall = {"kind": "polygon", "rings_m": [[[130.0, 20.0], [142.0, 20.0], [142.0, 46.0], [130.0, 46.0]]]}
    config = dataclasses.replace(INFER, guidance=GuidanceConfig(max_speed_mps=5.0))
    directory = mission(tmp_path, (wall,), config)
    result = run(directory, num_hypotheses=40)
    stories = read_stories(directory).stories
    obstacles = read_obstacles(directory / "obstacles.json")
    way = torch.from_numpy(stories.position_m[:, 0])
    assert not segments_in_collision(way, obstacles).any() and not states_in_collision(way, obstacles).any()
    speed = np.linalg.norm(np.diff(stories.position_m, axis=2), axis=-1) / np.diff(stories.time_s)
    assert np.nanmax(speed) <= 5.0 * (1 + 1e-4)
    assert len(np.unique(stories.position_m[:, 0, 20, 0])) > 20
    assert result.summary["replaced_share"] < 0.2


def test_what_other_stages_know_better_is_said(tmp_path):
    config = dataclasses.replace(INFER, guidance=GuidanceConfig(max_acceleration_mps2=50.0))
    (remark,) = run(mission(tmp_path, config=config)).summary["remarks"]
    assert "max_acceleration_mps2" in remark


def test_it_can_be_left_out(tmp_path):
    directory = mission(tmp_path)
    result = run(directory, enabled=False)
    assert result.status == "done" and not result.outputs and not (directory / MISSION_NAME).exists()


def test_without_hypotheses_of_windows_one_line_says_what_to_run(tmp_path):
    with pytest.raises(InputError, match="cadence"):
        run(tmp_path)
    write_table(detections(), tmp_path / "detections.parquet", "detections", Frame("map"))
    with pytest.raises(InputError, match="cadence infer") as raised:
        run(tmp_path)
    assert "\n" not in str(raised.value)


def test_later_stages_refuse_stories_of_other_detections(tmp_path):
    directory = mission(tmp_path)
    run(directory)
    check_chain("export", directory, {})
    infer(directory, dataclasses.replace(INFER, seed=5), QUIET)
    with pytest.raises(InputError, match="mission hypotheses were made from another"):
        check_chain("export", directory, {})
    assert run(directory).status == "done"
    check_chain("export", directory, {})


def three_associations(
    time_s, position_m, covariance_m2, origins_s, config, seed, habits=None, on_step=int
) -> list[AssociationHypotheses]:
    """The truth; one detection given to the other agent; one taken for clutter."""
    label = np.stack([TRUE, SWAPPED, CLUTTERED])[:, : len(time_s)]
    return [AssociationHypotheses(label[:, : int((time_s <= origin).sum())], WEIGHT, 2) for origin in origins_s]


@pytest.fixture
def nameless(tmp_path, monkeypatch) -> Path:
    monkeypatch.setattr(associations, "associate", three_associations)
    monkeypatch.setattr(associations, "fit_habits", lambda *_: None)
    monkeypatch.setattr(associations, "is_one_target", lambda *_: False)
    directory = unknown_origin.mission(tmp_path, unknown_origin.detections())
    infer(directory, dataclasses.replace(unknown_origin.CONFIG, num_hypotheses=3), QUIET)
    return directory


def test_every_association_of_the_whole_stream_has_its_share_of_the_stories(nameless):
    run(nameless, num_hypotheses=80)
    stories = read_stories(nameless).stories
    assert stories.agent_ids == ("a0", "a1")
    table, _ = read_table(nameless / "detections.parquet", "detections")
    time_s = (table["time_ns"].to_numpy() - read_stories(nameless).start_ns) * 1e-9
    at = stories.at(time_s)  # [K, A, N, 2]
    seen = np.stack([table["x_m"].to_numpy(), table["y_m"].to_numpy()], -1)
    passes = np.linalg.norm(at - seen, axis=-1) < 30.0
    is_swapped, is_clutter = passes[:, 1, 14], ~passes[:, 1, 15]
    shares = [float((~is_swapped & ~is_clutter).mean()), float(is_swapped.mean()), float((is_clutter & ~is_swapped).mean())]
    assert shares == [0.5, 0.375, 0.125]
    # the last detection is nobody's in some stories: there the agent is gone before
    gone = np.isnan(stories.position_m[:, 1, -1, 0])
    np.testing.assert_array_equal(gone, is_clutter & ~is_swapped)
    assert passes[~is_swapped & ~is_clutter][:, 0, ::2].all()


def test_pasts_are_read_as_they_were_written(nameless):
    table, _ = read_table(nameless / "detections.parquet", "detections")
    found = read_pasts(nameless, table, np.array([START_NS]), 0.0)
    assert found is not None and found.agent_ids == ("a0", "a1")
    np.testing.assert_array_equal(found.at_origins[0].label, np.stack([TRUE, SWAPPED, CLUTTERED]))
    np.testing.assert_array_equal(found.at_origins[0].weight, WEIGHT)
    (nameless / PASTS_NAME).unlink()
    assert read_pasts(nameless, table, np.array([START_NS]), 0.0) is None
