"""Mission hypotheses against the truth: which steps count, scores by hand, pooling, and where there are none."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from fixtures.asked import asked_mission
from fixtures.mission import AGENT_IDS, FIRST_ORIGIN_NS, FRAME, START_NS, STEP_NS, STRIDE_NS, build_mission, true_position_m

from cadence.stories import Stories
from pipeline.evaluate.stage import EvaluateConfig, evaluate, evaluate_folder, score_mission
from pipeline.evaluate.tables import pool, verdict
from pipeline.evaluate.whole import WholeCells, score_whole
from pipeline.progress import Progress
from pipeline.results import read_hypothesis_tables
from pipeline.scoring.case import read_case
from pipeline.stories import Block, MissionStories, read_stories, seconds_since, write_stories

QUIET = Progress(quiet=True)
pytestmark = pytest.mark.usefixtures("few_map_cells")
ALONE = EvaluateConfig(rivals=(), num_resamples=50)
BEGIN_S, NUM_STEPS = 20, 121  # from 20 to 140 s


def with_stories(parent: Path, offset_m: float, num_stories: int = 20, apart_m: float = 0.0) -> Path:
    """A mission whose stories are the truth moved north by `offset_m`, and every second one by `apart_m` more."""
    parent.mkdir(parents=True, exist_ok=True)
    directory = build_mission(parent)
    block = Block(0, NUM_STEPS, START_NS + BEGIN_S * STEP_NS, STEP_NS)
    time_s = seconds_since(block.start_ns, [block])
    true_m = np.stack([true_position_m(agent, time_s + BEGIN_S) for agent in range(len(AGENT_IDS))])
    position_m = np.repeat(true_m[None], num_stories, axis=0) + np.array((0.0, offset_m))
    position_m[1::2, ..., 1] += apart_m
    stories = Stories(time_s, position_m, np.full(num_stories, 1 / num_stories), AGENT_IDS)
    write_stories(MissionStories(FRAME, "patrol", block.start_ns, stories, (block,)), directory)
    return directory


def scored(directory: Path) -> WholeCells:
    found = score_mission(directory, ALONE, QUIET).whole
    assert found is not None
    return found


@pytest.mark.parametrize("offset_m", [0.0, 30.0])
def test_stories_beside_the_truth_are_off_by_as_much(tmp_path: Path, offset_m: float) -> None:
    cells = scored(with_stories(tmp_path, offset_m)).mission
    assert cells.column("ade_m") == pytest.approx(offset_m, abs=0.05)
    assert cells.column("energy_score_m") == pytest.approx(offset_m, abs=0.05)  # all stories are the same
    assert cells.column("spread_m") == pytest.approx(0.0, abs=0.01)


def test_two_ways_by_hand(tmp_path: Path) -> None:
    cells = scored(with_stories(tmp_path, 0.0, apart_m=40.0)).mission
    assert cells.column("ade_m") == pytest.approx(20.0, abs=0.05)
    # Half are 0 m off, half 40 m; two of them are 20 m apart on average, of which half is taken off.
    assert cells.column("energy_score_m") == pytest.approx(20.0 - 10.0, abs=0.05)


def test_every_step_counts_once_between_the_ends_of_the_stories_in_the_window_that_sees_most(tmp_path: Path) -> None:
    directory = with_stories(tmp_path, 0.0)
    mission = score_mission(directory, ALONE, QUIET)
    assert mission.whole is not None
    cells, own = mission.whole.windows, mission.cells["cadence"]

    def second(of) -> np.ndarray:
        return (FIRST_ORIGIN_NS + of.window.astype(np.int64) * STRIDE_NS) // STEP_NS + of.step

    steps = list(zip(cells.agent.tolist(), second(cells).tolist(), strict=True))
    assert len(set(steps)) == len(steps) > 150
    is_past = (own.step <= 0) & (second(own) >= BEGIN_S) & (second(own) <= BEGIN_S + NUM_STEPS - 1)
    assert set(steps) == set(zip(own.agent[is_past].tolist(), second(own)[is_past].tolist(), strict=True))
    off = {}
    for agent, time, step in zip(own.agent[is_past], second(own)[is_past], own.step[is_past], strict=True):
        off[int(agent), int(time)] = min(off.get((int(agent), int(time)), np.inf), abs(int(step) + 31.5))
    assert [off[step] for step in steps] == [abs(step + 31.5) for step in cells.step.tolist()]


def test_as_many_stories_as_a_window_has_hypotheses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr(
        "pipeline.evaluate.stage.read_stories", lambda path, count: asked.append(count) or read_stories(path, count)
    )
    scored(with_stories(tmp_path, 0.0))
    assert asked == [12]


def test_tables_tell_both_and_their_ratio(tmp_path: Path) -> None:
    directory = with_stories(tmp_path, 60.0)
    result = evaluate(directory, ALONE, QUIET)
    scores = json.loads((directory / "scores.json").read_text())
    rows = {(r["estimator"], r["metric"]): r for r in scores["rows"] if r["by"] == "mission"}
    assert {name for name, _ in rows} == {"cadence", "mission"} and {r["part"] for r in rows.values()} == {"past"}
    assert rows["mission", "energy_score_m"]["value"] == pytest.approx(60.0, abs=0.1)
    assert rows["mission", "coverage_90"]["value"] == 0.0
    ratio = rows["mission", "energy_score_ratio"]
    assert ratio["value"] == pytest.approx(60.0 / rows["cadence", "energy_score_m"]["value"], rel=0.01)
    assert ratio["low"] <= ratio["value"] <= ratio["high"] and ratio["low"] > 1
    assert rows["mission", "fast_step_share"]["num_cells"] == rows["cadence", "fast_step_share"]["num_cells"] > 100
    text = (directory / "scores.md").read_text()
    assert "| mission hypotheses (all detections) | 60 " in text and "| windows (detections up to each moment) |" in text
    assert "nan" not in text.lower() and "| mission |" not in text
    sentence = next(line for line in result.summary["verdict"] if line.startswith("Mission hypotheses (all detections): "))
    assert "% above that of the windows; the 90 % region holds 0 % of the truth: do not believe it." in sentence
    assert "mission.parquet" in json.loads((directory / "evaluate.manifest.json").read_text())["inputs"]


def test_results_without_mission_hypotheses_have_the_scores_that_they_had(tmp_path: Path) -> None:
    directory = build_mission(tmp_path)
    without = score_mission(directory, ALONE, QUIET)
    assert without.whole is None
    with_them = score_mission(with_stories(tmp_path, 0.0), ALONE, QUIET)
    rows = [dataclasses.astuple(row) for row in pool([with_them], 50, 0).rows if row.by != "mission"]
    np.testing.assert_equal(rows, [dataclasses.astuple(row) for row in pool([without], 50, 0).rows])
    assert not any("all detections" in line for line in verdict(pool([without], 50, 0)))


def test_missions_are_pooled_and_some_may_have_none(tmp_path: Path) -> None:
    folder = tmp_path / "missions"
    folder.mkdir()
    (tmp_path / "two").mkdir()
    first, second = with_stories(tmp_path / "one", 10.0), build_mission(tmp_path / "two")
    for index in range(5):
        (folder / f"m{index}").symlink_to(first)
    (folder / "m5").symlink_to(second)
    evaluate_folder(folder, ALONE, QUIET)
    scores = json.loads((folder / "scores.json").read_text())
    assert scores["grouped_by"] == "log"
    row = next(r for r in scores["rows"] if r["by"] == "mission" and r["estimator"] == "mission" and r["metric"] == "ade_m")
    assert row["num_groups"] == 5 and row["value"] == pytest.approx(10.0, abs=0.05)


def test_nothing_is_compared_that_is_not_the_same(tmp_path: Path) -> None:
    directory = with_stories(tmp_path, 0.0)
    case, stories = read_case(directory, read_hypothesis_tables(directory)), read_stories(directory)
    own = score_mission(directory, ALONE, QUIET).cells["cadence"]

    def never(*_) -> None:
        pytest.fail("there is nothing to score")

    assert score_whole(dataclasses.replace(case, is_matched=True), stories, own, never) is None
    others = dataclasses.replace(stories, stories=dataclasses.replace(stories.stories, agent_ids=("A", "B")))
    assert score_whole(case, others, own, never) is None
    with pytest.raises(ValueError, match="differ in step"):
        WholeCells(own, dataclasses.replace(own, step=own.step + 1), 6)


def test_stories_that_are_far_from_the_truth_do_no_harm(tmp_path: Path) -> None:
    assert scored(asked_mission(tmp_path)).mission.column("ade_m").min() > 500.0
