"""MapScore of stored hypotheses, rivals and distance rings."""

import numpy as np
import pytest
import torch
from fixtures.mission import build_mission

from cadence.types import Detections, HypothesisSet, WindowBatch
from pipeline.evaluate.maps import MapCells, MapScorer, map_rows
from pipeline.evaluate.stage import EvaluateConfig, score_mission
from pipeline.evaluate.tables import as_markdown, pool
from pipeline.progress import Progress


def windows_along_a_line() -> tuple[WindowBatch, torch.Tensor, torch.Tensor]:
    """Two windows of one agent that goes east at 10 m/s, seen every 10 s until the origin; steps of 10 s."""
    time_s = torch.arange(-200.0, 1.0, 10.0, dtype=torch.float64).expand(2, 1, -1).clone()
    position = torch.stack([10.0 * time_s, torch.zeros_like(time_s)], dim=-1)
    covariance = torch.eye(2, dtype=torch.float64).expand(2, 1, time_s.shape[-1], 2, 2).clone()
    grid = torch.arange(-10.0, 11.0, dtype=torch.float64) * 10.0
    seen = Detections(time_s, position, covariance, torch.ones_like(time_s, dtype=torch.bool))
    batch = WindowBatch(grid, seen, torch.arange(2), 10)
    truth = torch.stack([10.0 * grid, torch.zeros_like(grid)], dim=-1).expand(2, 1, -1, 2).clone()
    return batch, truth, torch.ones(2, 1, len(grid), dtype=torch.bool)


def drawn(truth: torch.Tensor, shift_m: float) -> HypothesisSet:
    """Twenty hypotheses around the truth, moved north."""
    noise = torch.randn(2, 20, 1, 1, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 20.0
    position = truth[:, None] + noise + torch.tensor([0.0, shift_m])
    return HypothesisSet(position, torch.full((2, 20), 0.05, dtype=torch.float64), (("ok",),) * 2)


def test_hypotheses_near_the_truth_score_higher_than_others_and_than_rings():
    batch, truth, is_known = windows_along_a_line()
    scorer = MapScorer.of(batch, truth, is_known, np.array([[0.0, 0.0], [500.0, 100.0]]))
    means = []
    for shift_m in (0.0, 400.0):
        mine = scorer.fresh()
        mine.watch(lambda index, shift_m=shift_m: drawn(truth, shift_m))(torch.arange(2))
        means.append(mine.cells().value.mean())
    rings = scorer.rings()
    assert len(rings.value) == 42 and means[0] > 0.97 > means[1]
    future = rings.step > 0
    assert 0.3 < rings.value[future].mean() < means[0]
    assert rings.value[~future].mean() > 0.95  # just seen


def test_nothing_to_score_is_no_row():
    batch, truth, is_known = windows_along_a_line()
    scorer = MapScorer.of(batch, truth, torch.zeros_like(is_known), np.zeros((2, 2)))
    assert len(scorer.cells().value) == len(scorer.rings().value) == 0
    assert list(map_rows([({"a": scorer.cells()}, 2)], False, 10, 0)) == []


def test_intervals_are_over_logs_where_there_are_several():
    cells = [MapCells(*np.zeros((3, 4), np.int32), np.ones(4), np.full(4, value)) for value in (0.2, 0.4)]
    rows = list(map_rows([({"a": each}, 1) for each in cells], True, 200, 0))
    assert [row.part for row in rows] == ["past", "between"]
    assert rows[0].value == pytest.approx(0.3) and (rows[0].low, rows[0].high) == (pytest.approx(0.2), pytest.approx(0.4))


def test_evaluate_tells_map_scores_beside_the_rings(tmp_path):
    directory = build_mission(tmp_path)
    config = EvaluateConfig(rivals=("hold",), num_resamples=20)
    report = pool([score_mission(directory, config, Progress(quiet=True))], 20, 0)
    found = {(row.estimator, row.part): row.value for row in report.rows if row.metric == "map_score"}
    assert {name for name, _ in found} == {"cadence", "hold", "ring"}
    assert all(-1.0 <= value <= 1.0 for value in found.values()) and found["cadence", "past"] > 0.9
    text = as_markdown(report)
    assert "MapScore" in text and "| ring |" in text
