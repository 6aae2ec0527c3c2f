"""Scores of all agents together: sets and vectors by hand, agents of unknown origin matched to the truth, tables."""

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
import torch
from fixtures.unknown_origin import CONFIG, START_NS, SWAPPED, TRUE, detections, mission

from cadence.association.types import AssociationHypotheses
from cadence.types import Detections, HypothesisSet, WindowBatch
from pipeline import associations
from pipeline.evaluate.joint import JOINT_METRICS, JointScorer
from pipeline.evaluate.stage import EvaluateConfig, evaluate, score_mission
from pipeline.grids import GridConfig, plan_grid
from pipeline.infer.stage import infer
from pipeline.progress import Progress
from pipeline.scoring.matching import match_to_truth, matched
from pipeline.scoring.scores import PARTS, score_cells
from pipeline.tables import Frame, write_table
from pipeline.windows import build_windows
from schemas.tables import TRUTH

QUIET = Progress(quiet=True)
pytestmark = pytest.mark.usefixtures("few_map_cells")
NUM_STEPS, ORIGIN = 4, 1


def windows(num_agents: int) -> WindowBatch:
    """One window of four steps, every agent detected at its first step."""
    shape = (1, num_agents, 1)
    found = Detections(
        torch.full(shape, -1.0), torch.zeros(*shape, 2), torch.eye(2).expand(*shape, 2, 2), torch.ones(shape) > 0
    )
    return WindowBatch(torch.arange(NUM_STEPS) - 1.0, found, torch.zeros(1, dtype=torch.int64), ORIGIN)


def standing(position_m: list[list[list[float]]], weight: list[float]) -> HypothesisSet:
    """Hypotheses [K][A] of agents that stand still."""
    position = torch.tensor(position_m, dtype=torch.float64)[None, :, :, None].expand(-1, -1, -1, NUM_STEPS, -1)
    return HypothesisSet(position, torch.tensor([weight], dtype=torch.float64), (("ok",) * position.shape[2],))


def joint(
    found: HypothesisSet,
    truth_m: list[list[float]],
    match: list[int],
    is_counted: bool = True,
    is_known: list[bool] | None = None,
) -> dict[str, float]:
    """Scores of the future."""
    num_agents, num_true = found.position_m.shape[2], len(truth_m)
    truth = torch.tensor(truth_m, dtype=torch.float64)[None, :, None].expand(-1, -1, NUM_STEPS, -1)
    scorer = JointScorer(
        windows(num_agents), torch.full((1, num_agents), is_counted), windows(num_true), torch.tensor([match]), truth,
        torch.tensor([is_known or [True] * num_true])[..., None].expand(-1, -1, NUM_STEPS), 10.0,
    )  # fmt: skip
    scorer.watch(lambda index: found)(torch.tensor([0]))
    cells = scorer.cells()
    (row,) = cells.value[cells.part == PARTS.index("future")]
    return dict(zip(JOINT_METRICS, row.tolist(), strict=True))


def test_joint_scores_by_hand() -> None:
    # two hypotheses, in each of which one agent is right and the other 4 m off
    found = standing([[[0, 0], [14, 0]], [[4, 0], [10, 0]]], [0.5, 0.5])
    scores = joint(found, [[0, 0], [10, 0]], [0, 1])
    # every hypothesis is sqrt((0 + 16) / 2) from the truth, and sqrt((16 + 16) / 2) = 4 from the other
    assert scores["joint_energy_score_m"] == pytest.approx(math.sqrt(8.0) - 0.5 * 0.5 * 4.0)
    assert scores["joint_min_ade_m"] == pytest.approx(2.0)  # agent by agent it would be 0
    # the means are 2 m off each: GOSPA = sqrt(4 + 4)
    assert scores["gospa_m"] == pytest.approx(math.sqrt(8.0)) and scores["localisation_error_m"] == pytest.approx(2.0)
    assert (scores["num_missed"], scores["num_false"]) == (0.0, 0.0)


def test_sets_count_the_missed_and_the_false() -> None:
    found = standing([[[0, 3], [500, 0]]], [1.0])
    scores = joint(found, [[0, 0], [100, 0], [200, 0]], [0, -1, -1])
    # one assigned, 3 m off; one false, two missed at 10^2 / 2 each
    assert scores["gospa_m"] == pytest.approx(math.sqrt(9.0 + 150.0))
    assert (scores["num_missed"], scores["num_false"], scores["localisation_error_m"]) == pytest.approx((2.0, 1.0, 3.0))
    assert scores["joint_min_ade_m"] == pytest.approx(3.0)  # of the agents that stand for somebody
    # the truth of the second agent is silent: it is neither false nor missed
    unsaid = joint(found, [[0, 0], [500, 0]], [0, 1], is_known=[True, False])
    assert unsaid["gospa_m"] == pytest.approx(3.0) and unsaid["num_false"] == 0.0
    silent = joint(found, [[0, 0]], [0], is_counted=False)
    assert silent["gospa_m"] == pytest.approx(math.sqrt(50.0)) and silent["num_missed"] == 1.0


def test_agents_of_some_hypotheses_are_scored_by_those() -> None:
    """Half of the weight knows of the second agent: its scores are those of that half alone."""
    nan = math.nan
    partly = standing([[[0, 0], [nan, nan]], [[4, 0], [12, 0]], [[4, 0], [16, 0]]], [0.5, 0.25, 0.25])
    alone = standing([[[0, 0], [12, 0]], [[4, 0], [16, 0]]], [0.5, 0.5])
    truth = torch.tensor([[0.0, 0.0], [10.0, 0.0]], dtype=torch.float64)[None, :, None].expand(-1, -1, NUM_STEPS, -1)
    known = torch.ones(1, 2, NUM_STEPS, dtype=torch.bool)
    one, two = (score_cells(found, windows(2), truth, known) for found in (partly, alone))
    for name in ("ade_m", "min_ade_m", "energy_score_m", "mean_error_m", "spread_m"):
        second = one.agent == 1
        np.testing.assert_allclose(one.column(name)[second], two.column(name)[second])
    assert one.column("ade_m")[one.agent == 0] == pytest.approx(2.0)


def test_agents_are_matched_by_their_detections() -> None:
    config = GridConfig(step_s=2.0, history_steps=32, horizon_steps=4, stride_steps=32)
    named = ["b" if agent else "a" for agent in TRUE]
    table = detections(named)
    found = build_windows(table, plan_grid(table, config), 0)
    match = match_to_truth(
        found, truth(("north", 800.0), ("south", 0.0), ("nobody", 5000.0)), ("north", "south", "nobody"), 9, 99
    )
    assert match.tolist() == [[1, 0, -1]]
    moved = matched(
        HypothesisSet(torch.arange(2.0).reshape(1, 1, 2, 1, 1).expand(1, 1, 2, 3, 2), torch.ones(1, 1), (("ok", "x"),)), match
    )
    assert moved.position_m[0, 0, :2, 0, 0].tolist() == [1.0, 0.0] and bool(moved.position_m[0, 0, 2].isnan().all())
    assert moved.status == (("x", "ok", "no_detections"),)


def truth(*ships: tuple[str, float]) -> pa.Table:
    rows = [
        {"log_id": "walk", "time_ns": START_NS + time * 10**9, "agent_id": name, "x_m": 5.0 * time, "y_m": north}
        for name, north in ships
        for time in range(0, 90, 2)
    ]
    return pa.Table.from_pylist(rows, schema=TRUTH)


def two_associations(
    time_s, position_m, covariance_m2, origins_s, config, seed, habits=None, **_
) -> list[AssociationHypotheses]:
    label = np.stack([TRUE, SWAPPED])
    return [AssociationHypotheses(label[:, : int((time_s <= origin).sum())], np.array([0.75, 0.25]), 2) for origin in origins_s]


def test_unknown_origin_is_scored_against_the_truth(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(associations, "associate", two_associations)
    monkeypatch.setattr(associations, "fit_habits", lambda *_: None)
    directory = mission(tmp_path, detections())
    infer(directory, CONFIG, QUIET)
    write_table(truth(("ship", 0.0), ("tug", 800.0)), directory / "truth.parquet", "truth", Frame("map"))
    config = EvaluateConfig(rivals=("bank", "hold"), num_resamples=20)
    scored = score_mission(directory, config, QUIET)
    assert scored.agent_ids == ("ship", "tug") and scored.is_matched
    assert len({len(cells) for cells in scored.cells.values()}) == 1 and set(scored.cells["cadence"].agent) == {0, 1}
    # rivals see the likeliest association, which is right: the bank is near the truth for both
    assert scored.cells["bank"].column("mean_error_m")[scored.cells["bank"].step <= 0].mean() < 10.0
    evaluate(directory, config, QUIET)
    report = json.loads((directory / "scores.json").read_text())
    rows = {(row["estimator"], row["part"], row["metric"]): row["value"] for row in report["rows"] if row["by"] == "joint"}
    assert {estimator for estimator, _, _ in rows} == {"cadence", "bank", "hold"}
    assert rows["bank", "past", "num_false"] == 0.0 and rows["bank", "past", "gospa_m"] < rows["hold", "past", "gospa_m"]
    text = (directory / "scores.md").read_text()
    assert "## All agents together" in text and "matched to those of the truth" in text and "GOSPA m" in text


def test_known_origin_has_joint_scores_for_several_agents_only(tmp_path: Path) -> None:
    for name, who, count in (("two", lambda agent: "tug" if agent else "ship", 2), ("one", lambda _: "ship", 1)):
        directory = mission(tmp_path / name, detections([who(agent) for agent in TRUE]))
        infer(directory, CONFIG, QUIET)
        write_table(truth(("ship", 0.0), ("tug", 800.0)), directory / "truth.parquet", "truth", Frame("map"))
        scored = score_mission(directory, EvaluateConfig(rivals=("hold",)), QUIET)
        assert bool(scored.joint) == (count > 1) and not scored.is_matched
    cut = dataclasses.replace(EvaluateConfig(), gospa_cutoff_m=5.0)
    assert cut.gospa_cutoff_m == 5.0
    with pytest.raises(ValueError, match="gospa_cutoff_m"):
        EvaluateConfig(gospa_cutoff_m=0.0)
