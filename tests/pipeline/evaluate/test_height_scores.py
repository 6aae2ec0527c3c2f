"""Scores of heights, alone and as the third coordinate: by hand, and through a mission; NaN without heights."""

from pathlib import Path

import numpy as np
import pytest
import torch
from fixtures.heights import add_heights
from fixtures.mission import build_mission

from cadence.types import Detections, HypothesisSet, WindowBatch
from pipeline.evaluate.stage import EvaluateConfig, evaluate
from pipeline.progress import Progress
from pipeline.scoring.scores import score_cells


def windows() -> WindowBatch:
    shape = (1, 1, 1)
    seen = Detections(
        torch.full(shape, -2.0), torch.zeros(*shape, 2), torch.eye(2).expand(*shape, 2, 2), torch.ones(shape, dtype=torch.bool)
    )
    return WindowBatch(torch.arange(-2.0, 2.0), seen, torch.zeros(1, dtype=torch.int64), 2)


def test_scores_by_hand() -> None:
    """Hypotheses 3 m beside and at 0 and 8 m of height, the truth at 4 m: CRPS of height 4 - 8 / 4, in space 5 - 8 / 4."""
    position = torch.zeros(1, 2, 1, 4, 2, dtype=torch.float64)
    position[..., 0] = 3.0
    height = torch.tensor([0.0, 8.0])[None, :, None, None].expand(1, 2, 1, 4)
    found = HypothesisSet(position, torch.full((1, 2), 0.5, dtype=torch.float64), (("ok",),), height_m=height)
    truth, known = torch.zeros(1, 1, 4, 2, dtype=torch.float64), torch.ones(1, 1, 4, dtype=torch.bool)
    true_height = torch.tensor([4.0, 4.0, torch.nan, 4.0])[None, None]
    cells = score_cells(found, windows(), truth, known, truth_height_m=true_height)
    np.testing.assert_allclose(cells.column("height_energy_score_m"), [2.0, 2.0, np.nan, 2.0])
    np.testing.assert_allclose(cells.column("energy_score_3d_m"), [3.0, 3.0, np.nan, 3.0])
    flat = score_cells(HypothesisSet(position, found.weight, found.status), windows(), truth, known, truth_height_m=true_height)
    assert np.isnan(flat.column("height_energy_score_m")).all()
    np.testing.assert_array_equal(flat.column("energy_score_m"), cells.column("energy_score_m"))


def test_a_mission_with_heights_has_their_scores(tmp_path: Path) -> None:
    directory = build_mission(tmp_path)
    add_heights(directory)
    evaluate(directory, EvaluateConfig(rivals=("hold",)), Progress(quiet=True))
    lines = (directory / "scores.csv").read_text().splitlines()
    rows = [dict(zip(lines[0].split(","), line.split(","), strict=True)) for line in lines[1:]]
    own = {
        (row["part"], row["metric"]): float(row["value"])
        for row in rows
        if row["estimator"] == "cadence" and row["by"] == "part"
    }
    # twelve hypotheses above the truth by 0 to 11 m: mean 5.5 less half of their mean distance
    assert own["past", "height_energy_score_m"] == pytest.approx(5.5 - 0.5 * 143 / 36, rel=0.05)
    assert own["past", "energy_score_3d_m"] > own["past", "energy_score_m"]
    assert not any(row["estimator"] == "hold" and "height" in row["metric"] for row in rows)
    assert "height energy m" in (directory / "scores.md").read_text()


def test_without_heights_there_are_none(tmp_path: Path) -> None:
    directory = build_mission(tmp_path)
    evaluate(directory, EvaluateConfig(rivals=("hold",)), Progress(quiet=True))
    assert "height" not in (directory / "scores.csv").read_text()
