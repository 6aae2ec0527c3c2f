"""A checkpoint is tested on later detections of the log: one of another place is noticed, one that fits passes."""

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from cadence.bank.bank import Bank
from cadence.errors import ImplausibleInputError
from cadence.types import Detections, HypothesisSet, WindowBatch
from pipeline.estimators.fit_test import FitTest, fit_test
from pipeline.estimators.fitting import FittingData
from pipeline.grids import GridConfig, plan_grid
from pipeline.infer import plan, stage
from pipeline.infer.config import InferConfig
from pipeline.progress import Progress
from pipeline.suspicions import suspicions_in
from pipeline.tables import Frame, write_table
from pipeline.windows import build_windows
from schemas.tables import DETECTIONS

STEP_S = 60.0


def detections(num_minutes: int = 300) -> pa.Table:
    """A walk in curves, seen for five minutes in every twelve."""
    minutes = np.array([m for m in range(num_minutes) if m % 12 < 5])
    row = {"log_id": "walk", "sensor_id": "camera", "agent_id": "T0", "cov_xx_m2": 1.0, "cov_xy_m2": 0.0, "cov_yy_m2": 1.0}
    row |= {"num_merged": 1, "topic": "/seen", "log_time_ns": 0, "sequence": 0}
    places = zip(minutes.tolist(), (800.0 * minutes).tolist(), (4000.0 * np.sin(0.1 * minutes)).tolist(), strict=True)
    rows = [row | {"time_ns": m * 60 * 10**9, "x_m": x_m, "y_m": y_m} for m, x_m, y_m in places]
    return pa.Table.from_pylist(rows, schema=DETECTIONS)


def data() -> FittingData:
    table = detections()
    grid = plan_grid(table, GridConfig(STEP_S, 16, 16, 8))
    return FittingData.of(table, grid, build_windows(table, grid, seed=0))


@dataclass(frozen=True)
class Displaced:
    """A bank whose hypotheses lie elsewhere."""

    bank: Bank
    shift_m: float
    name: str = "displaced"

    def fit(self, tracks: Detections) -> "Displaced":
        return self

    def sample(self, windows: WindowBatch, num_hypotheses: int) -> HypothesisSet:
        found = self.bank.sample(windows, num_hypotheses)
        return dataclasses.replace(found, position_m=found.position_m + self.shift_m)


def test_what_knows_another_place_is_a_misfit_and_what_knows_this_one_is_not() -> None:
    log = data()
    bank = log.fitted_bank()
    here, elsewhere = (fit_test(Displaced(bank, shift_m), log, log.windows) for shift_m in (0.0, 20_000.0))
    assert here is not None and not here.is_misfit and here.in_90 > 0.5
    assert elsewhere is not None and elsewhere.is_misfit and elsewhere.in_90 == 0.0 and elsewhere.ratio > 3.0


@pytest.mark.parametrize(
    ("found", "is_misfit"),
    [
        (FitTest(30, 0.4, -3.0, 0.2), False),
        (FitTest(30, 1.2, 1.0, 0.8), False),
        (FitTest(30, 1.2, 1.0, 0.1), True),
        (FitTest(30, 1.6, 5.0, 0.9), True),
    ],
)
def test_a_misfit_is_worse_than_motion_alone_with_certainty_or_far_off(found: FitTest, is_misfit: bool) -> None:
    assert found.is_misfit == is_misfit


def test_too_few_later_detections_tell_nothing() -> None:
    table = detections(10)
    grid = plan_grid(table, GridConfig(STEP_S, 16, 16, 8))
    log = FittingData.of(table, grid, build_windows(table, grid, seed=0))
    assert fit_test(log.fitted_bank(), log, log.windows) is None


def test_a_strange_log_is_drawn_with_the_default_and_suspected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_table(detections(), tmp_path / "detections.parquet", "detections", Frame("local_enu", 50.8, -1.2))
    (tmp_path / "obstacles.json").write_text(json.dumps({"version": 1, "obstacles": []}))
    monkeypatch.setattr(plan, "DEFAULT", "none")  # quicker
    config = InferConfig(num_hypotheses=2, checkpoint="prison", device="cpu")
    with pytest.raises(ImplausibleInputError, match=r"refused by --strict.*checkpoint of prison: it does not fit this log"):
        stage.infer(tmp_path, dataclasses.replace(config, is_strict=True), Progress(quiet=True))
    result = stage.infer(tmp_path, config, Progress(quiet=True))
    (line,) = suspicions_in(result.summary)
    assert "drawn with 'none' instead" in line and "infer.is_tested = false" in line
    assert result.summary["checkpoint"] == "none" and result.summary["fit_test"]["ratio"] > 1.0
    trusted = stage.infer(tmp_path, dataclasses.replace(config, is_tested=False), Progress(quiet=True))
    assert trusted.summary["checkpoint"] == "prison" and not suspicions_in(trusted.summary)
