"""How reliability is counted: cases with known answers."""

import numpy as np
import pytest

from benchmarks.publishing import Measurement, as_csv, from_csv
from benchmarks.reliability import Told
from benchmarks.reliability_page import calibration_error, section, tables


def test_what_happens_as_often_as_is_said_has_no_error():
    said = np.array([0.25] * 4 + [0.75] * 4)
    assert calibration_error(said, np.array([1, 0, 0, 0, 1, 1, 1, 0.0])) == 0
    assert calibration_error(said, np.ones(8)) == pytest.approx(0.5)
    assert calibration_error(np.array([0.0, 1.0]), np.array([1.0, 0.0])) == 1
    # errors of opposite sign in one tenth cancel, in two they do not
    assert calibration_error(np.array([0.51, 0.59]), np.array([0.1, 1.0])) == pytest.approx(0.0)
    assert calibration_error(np.array([0.49, 0.59]), np.array([0.08, 1.0])) == pytest.approx(0.41)


def test_tables_hold_every_log_and_all_together():
    told = {
        ("ships", "cadence"): [Told("inside", f"g{i}", 0.9, i < 9, 1.0, 2.0, 1.5 if i else 3.0) for i in range(10)],
        ("flight", "cadence"): [Told("meet", f"h{i}", 0.1, False) for i in range(5)],
        ("ships", "ring"): [],
        ("flight", "ring"): [],
    }
    maps = {key: [("g0", 0.5), ("g1", 1.0)] for key in told}
    found = tables(told, maps)
    rows = {(row["log"], row["estimator"]): row for row in found["reliability"]}
    assert rows["ships", "cadence"]["calibration_error"] == pytest.approx(0.0)
    assert rows["ships", "cadence"]["brier"] == pytest.approx(0.09)
    assert rows["ships", "cadence"]["arrival_held"] == pytest.approx(0.9) and rows["ships", "cadence"]["num_arrivals"] == 10
    assert rows["all", "cadence"]["num_questions"] == 15
    assert rows["flight", "ring"]["map_score"] == pytest.approx(0.75)
    kept = {name: from_csv(as_csv(table)) for name, table in found.items()}
    text = section(Measurement("reliability", {}, kept))
    assert "| ships | cadence | 10 |" in text and "90 % [" in text and "distance rings" in text
