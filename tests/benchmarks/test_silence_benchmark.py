"""The benchmark of silence: episodes as arrays, what is compared with what, and ranks."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks import publishing
from benchmarks.silence import KINDS, section, spearman, summary
from benchmarks.silence_episodes import coverage_at, fit_curves, looks_of, read_coverage, read_episode


def test_ranks_and_a_constant_that_has_none():
    assert spearman(np.array([1.0, 2.0, 3.0]), np.array([5.0, 9.0, 11.0])) == pytest.approx(1.0)
    assert spearman(np.array([1.0, 1.0, 3.0, 4.0]), np.array([4.0, 3.0, 2.0, 1.0])) == pytest.approx(-0.9486833)
    assert np.isnan(spearman(np.ones(3), np.array([1.0, 2.0, 3.0])))


def test_runs_are_compared_with_themselves_without_silence():
    rows = []
    for log in range(4):
        for window in range(3):
            for exponent, score in ((0.0, 10.0 + log), (0.6, 0.5 * (10.0 + log))):
                row = {"checkpoint": "none", "sensors": "+".join(KINDS) if exponent else "", "exponent": exponent}
                row |= {"log": f"l{log}", "window": window, "num_effective": 10.0 + window, "inside": 1.0, "spearman": 0.5}
                rows.append(row | {"now": score, "since": score, "past": score, "later": score, "cpu_s": 2.0})
    (line,) = summary(rows)
    assert (line["now"], line["told"], line["cost"], line["windows"], line["logs"]) == pytest.approx((0.5, 0.5, 1.0, 12, 4))
    measured = publishing.Measurement("silence", {}, {"silence": [line]})
    assert "| bank | all | 0.6 | 12 / 4 | 0.50 [0.50, 0.50] |" in section(measured)


def test_recorded_episodes_know_who_saw_the_target(shared_data: Path):
    folder = shared_data / "prison_reference"
    paths = sorted((folder / "low").glob("*.mcap"))[:6]
    if not paths:
        pytest.skip("needs ../shared/data/prison_reference")
    episodes, coverage = [read_episode(path) for path in paths], read_coverage(folder)
    first = episodes[0]
    assert first.sensors_m["camera"].shape[0] == 78 and first.is_hit["search_party"].shape == (5, len(first.truth_m))
    assert len(first.detections()) == first.is_detected.sum()
    curves = fit_curves(episodes, coverage)
    assert set(curves) == set(KINDS) and all(curve.probability[0] > 0.5 for curve in curves.values())
    looks = looks_of(first, curves, coverage)
    hits = sum(len(names) > 0 for some in looks for names in some.seen)
    assert hits == sum(hit.sum() for hit in first.is_hit.values())
    assert 0.2 <= coverage_at(coverage, np.zeros((1, 2)))[0] <= 0.8
