"""The benchmark of estimators on real logs: pooling over seeds, resuming, and its page and chart, on made-up results."""

import dataclasses
from pathlib import Path

import pytest

from benchmarks import real_logs
from benchmarks.publishing import Measurement
from benchmarks.real_logs import Result, draw_chart, section, table, tables
from cadence.errors import CadenceError
from pipeline.scoring.scores import METRICS, PARTS


def result(estimator: str, seed: int, energy: float, groups: tuple[str, ...] = ("a", "b", "c"), rate: float = 0.05) -> Result:
    sums = {part: {metric: [energy * 10.0 * (i + 1) for i in range(len(groups))] for metric in METRICS} for part in PARTS}
    counts = {part: {metric: [10] * len(groups) for metric in METRICS} for part in PARTS}
    return Result(
        real_logs.RESULT_VERSION, estimator, "ships", "ships", rate, seed, 50, 20.0, 30, 400, 40.0, 0.1, 1.0, list(groups),
        sums, counts,
    )  # fmt: skip


def test_ratio_is_to_the_best_rival_over_all_seeds() -> None:
    results = [result("cadence", seed, 1.8) for seed in (0, 1)]
    results += [result("cv", 0, 2.0), result("cv", 1, 2.2), result("ou", 0, 3.0), result("ou", 1, 1.0)]
    row = next(row for row in table(results) if row.estimator == "cadence" and row.part == "past")
    assert row.better == "ou" and row.num_cells == 60
    assert row.ratio is not None and row.ratio.value == pytest.approx(1.8 / 2.0)
    assert row.means["ade_m"].value == pytest.approx(3.6)


def test_seeds_that_an_estimator_lacks_are_left_out() -> None:
    results = [result("cadence", 0, 1.0), result("cv", 0, 2.0), result("cv", 1, 9.0)]
    row = next(row for row in table(results) if row.estimator == "cadence")
    assert row.ratio is not None and row.ratio.value == pytest.approx(0.5)


def test_flights_of_one_log_are_pooled_as_groups() -> None:
    flights = [dataclasses.replace(result("cadence", 0, energy), case=case) for case, energy in (("east", 1.0), ("west", 3.0))]
    flights += [dataclasses.replace(result("ou", 0, energy), case=case) for case, energy in (("east", 2.0), ("west", 2.0))]
    row = next(row for row in table(flights) if row.estimator == "cadence" and row.part == "past")
    assert row.ratio is not None and row.ratio.value == pytest.approx(1.0) and row.num_cells == 60
    assert row.ratio.low < 1.0 < row.ratio.high


def test_other_cells_are_refused() -> None:
    with pytest.raises(CadenceError, match="different cells"):
        table([result("cadence", 0, 1.0), result("cv", 0, 2.0, groups=("a", "b"))])


def test_tables_section_and_chart(tmp_path: Path) -> None:
    energies = {"cadence": 1.0, "bank": 1.5, "cv": 2.0, "ou": 2.5, "linear": 3.0, "hold": 4.0}
    results = [result(name, 0, energy, rate=rate) for rate in (0.05, 0.3) for name, energy in energies.items()]
    rows = table(results)
    found = Measurement("real_logs", {}, tables(rows, results))
    (row,) = found.rows(detections_percent=30, part="past", estimator="cadence")
    assert (row["energy_m"], row["ratio"], row["ratio_to"], row["num_cells"]) == (2.0, 0.5, "cv", 30)
    (windows,) = found.rows("windows", detections_percent=5)
    assert (windows["step_s"], windows["num_windows_least"], windows["seeds"]) == (20.0, 30, "0")
    text = section(found)
    assert "Of 4 cells" in text and "ahead in 4 with its whole interval, behind in 0." in text
    assert "| ships, 30 % | 0.50 [0.50, 0.50] | 0.75 | cv | 0.50 [0.50, 0.50] | 0.75 | cv | 200, 200 % |" in text
    draw_chart(rows, tmp_path / "chart.png")
    assert (tmp_path / "chart.png").stat().st_size > 5000


def test_one_thinned_flight_and_again_from_the_work_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    if not real_logs.DATA.is_dir():
        pytest.skip("../shared/data is not here")
    arguments = ["--work", str(tmp_path), "--logs", "flight", "--rates", "0.3", "--seeds", "0", "--hypotheses", "5"]
    arguments += ["--estimators", "linear", "hold", "--quiet"]
    assert real_logs.main(arguments) == 0
    text = capsys.readouterr().out
    assert text.count("\n") == 7
    monkeypatch.setattr(real_logs, "prepare", lambda *_: pytest.fail("there are results already"))
    assert real_logs.main(arguments) == 0
    assert capsys.readouterr().out == text
