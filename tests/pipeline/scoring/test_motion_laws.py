"""How hypotheses move against how the truth does: by hand on straight lines, circles and jumps."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from cadence.types import Detections, HypothesisSet, WindowBatch
from pipeline.scoring.motion import motion_rows, true_motion
from pipeline.scoring.scores import METRICS, score_cells

STEPS, ORIGIN, STEP_S = 40, 19, 2.0


def windows(num: int = 2) -> WindowBatch:
    """One agent each, seen at the first step and now."""
    time_s = (torch.arange(STEPS, dtype=torch.float64) - ORIGIN) * STEP_S
    at = torch.stack([time_s[0], time_s[ORIGIN]]).expand(num, 1, 2)
    covariance = torch.eye(2, dtype=torch.float64).expand(num, 1, 2, 2, 2)
    detections = Detections(at, torch.zeros(num, 1, 2, 2).double(), covariance, torch.ones(num, 1, 2, dtype=torch.bool))
    return WindowBatch(time_s, detections, torch.arange(num), ORIGIN)


def line(speed_mps: float, num: int = 2) -> Tensor:
    way = speed_mps * STEP_S * torch.arange(STEPS, dtype=torch.float64)
    return torch.stack([way, torch.zeros(STEPS).double()], dim=-1).expand(num, 1, STEPS, 2)


def hypotheses(*tracks: Tensor) -> HypothesisSet:
    position = torch.stack(tracks, dim=1)
    weight = torch.full(position.shape[:2], 1.0 / len(tracks), dtype=torch.float64)
    return HypothesisSet(position, weight, (("ok",),) * len(position))


KNOWN = torch.ones(2, 1, STEPS, dtype=torch.bool)


def rows(found: HypothesisSet, truth: Tensor, known: Tensor = KNOWN) -> dict[tuple[str, str], float]:
    recorder = true_motion(windows(), truth, known)
    own = recorder.fresh()
    own.watch(lambda index: found)(torch.arange(2))
    return {(row.part, row.metric): row.value for row in motion_rows("own", own.laws(), recorder.laws())}


def test_the_truth_moves_as_the_truth() -> None:
    assert set(rows(hypotheses(line(3.0)), line(3.0)).values()) == {0.0}


def test_half_of_the_hypotheses_twice_as_fast() -> None:
    found = rows(hypotheses(line(3.0), line(6.0)), line(3.0))
    assert found["past", "speed_w1_mps"] == found["future", "speed_w1_mps"] == pytest.approx(1.5)
    assert found["future", "acceleration_w1_mps2"] == pytest.approx(0.0) and found["future", "turn_w1_deg"] == pytest.approx(
        0.0
    )


def test_a_circle_turns_where_the_truth_goes_straight() -> None:
    angle = torch.arange(STEPS, dtype=torch.float64) * math.radians(9.0)
    radius = 6.0 / (2.0 * math.sin(math.radians(4.5)))  # a chord of 6 m a step
    circle = radius * torch.stack([angle.cos(), angle.sin()], dim=-1).expand(2, 1, STEPS, 2)
    found = rows(hypotheses(circle), line(3.0))
    assert found["past", "turn_w1_deg"] == pytest.approx(9.0) and found["past", "speed_w1_mps"] == pytest.approx(0.0, abs=1e-9)
    assert found["past", "acceleration_w1_mps2"] == pytest.approx(2.0 * 6.0 * math.sin(math.radians(4.5)) / STEP_S**2)


def test_steps_whose_truth_is_unknown_do_not_count() -> None:
    jump = line(3.0).clone()
    jump[..., 30:, :] += 500.0
    known = KNOWN.clone()
    known[..., 30] = False
    assert rows(hypotheses(jump), line(3.0), known)["future", "speed_w1_mps"] == pytest.approx(0.0)
    assert rows(hypotheses(jump), line(3.0))["future", "speed_w1_mps"] > 10.0


def test_shares_of_steps_and_tracks_that_are_too_fast() -> None:
    jump = line(3.0).clone()
    jump[..., 30:, 0] += 500.0
    cells = score_cells(hypotheses(jump, line(3.0)), windows(), line(3.0), KNOWN, fastest_m=6.1)
    steps, tracks = (cells.column(name) for name in ("fast_step_share", "fast_track_share"))
    is_future = cells.is_in("future")
    assert np.nansum(steps[is_future]) == pytest.approx(0.5 * 2) and np.nanmax(steps[cells.is_in("past")]) == 0.0
    assert tracks[is_future & (tracks == tracks)].tolist() == [0.5, 0.5]
    assert tracks[cells.is_in("past") & (tracks == tracks)].tolist() == [0.0, 0.0]
    unlimited = score_cells(hypotheses(jump), windows(), line(3.0), KNOWN)
    assert bool(torch.from_numpy(unlimited.value[:, METRICS.index("fast_step_share")]).isnan().all())
