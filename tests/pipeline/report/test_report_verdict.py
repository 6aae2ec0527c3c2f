"""What the page says first, and that its figures are those of evaluate."""

import json
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from fixtures.mission import build_mission, make_uncertain, rename_agents
from fixtures.unknown_origin import CONFIG, START_NS, SWAPPED, TRUE, detections, mission

from cadence.association.types import AssociationHypotheses
from pipeline import associations
from pipeline.evaluate.stage import EvaluateConfig, evaluate
from pipeline.infer.stage import infer
from pipeline.progress import Progress
from pipeline.report.analysis import analyse, choose_moments
from pipeline.report.config import ReportConfig
from pipeline.report.mission import load_mission
from pipeline.report.scored import Scored, score_mission, truth_of
from pipeline.report.stage import report
from pipeline.report.truth import QUICK, truth_section
from pipeline.report.verdict import verdict_section
from pipeline.tables import Frame, read_table, write_table
from schemas.tables import TRUTH

QUIET = Progress(quiet=True)


def verdict(directory: Path) -> str:
    found = load_mission(directory)
    return verdict_section(found, analyse(found, score_mission(directory, found), lambda _: None), (0, 11))


def told(directory: Path, stage: str, **parts: object) -> None:
    """Change parts of a stage's manifest."""
    path = directory / f"{stage}.manifest.json"
    content = json.loads(path.read_text()) if path.is_file() else {"stage": stage, "inputs": {}, "outputs": {}}
    path.write_text(json.dumps(content | parts))


def test_the_figures_are_those_of_evaluate(tmp_path: Path) -> None:
    directory = build_mission(tmp_path)
    scored = score_mission(directory, load_mission(directory))
    evaluate(directory, EvaluateConfig(rivals=(), num_resamples=2), QUIET)
    rows = json.loads((directory / "scores.json").read_text())["rows"]
    own = {(row["part"], row["metric"]): row["value"] for row in rows if row["by"] in ("part", "motion")}
    for part in ("past", "future"):
        for metric in (*QUICK, "fast_step_share", "fast_track_share"):
            assert scored.mean(part, metric) == pytest.approx(own[part, metric], rel=1e-12), (part, metric)
        for metric in ("speed_w1_mps", "acceleration_w1_mps2", "turn_w1_deg"):
            assert scored.distance(part, metric) == pytest.approx(own[part, metric], rel=1e-12)


def test_few_detections_and_exact_ones_are_doubted(tmp_path: Path) -> None:
    directory = build_mission(tmp_path)
    assert "too few to learn" not in verdict(directory) and "count as exact" not in verdict(directory)
    record = {"sources": ["/radar"], "num_detections": 4, "is_taken": False}
    told(directory, "extract", summary={"accuracy": [record, {**record, "sources": ["/camera"], "is_taken": True}]})
    table, frame = read_table(directory / "detections.parquet", "detections")
    write_table(table.slice(0, 20), directory / "detections.parquet", "detections", frame)
    words = verdict(directory)
    assert "There are 20 detections only: too few to learn" in words and "Detections of /radar count as exact" in words


def test_with_truth_the_page_begins_with_how_far_off_and_how_well_calibrated(tmp_path: Path) -> None:
    directory = build_mission(tmp_path)
    words = verdict(directory)
    scored = score_mission(directory, load_mission(directory))
    for part, span in (("past", "Past and present"), ("future", "Future, up to 32 s ahead")):
        assert f"{span}: on average a hypothesis is {scored.mean(part, 'ade_m'):.3g} m from the truth" in words
        assert f"holds {100 * scored.mean(part, 'coverage_90'):.0f} %" in words
    report(directory, ReportConfig(), QUIET)
    page = (directory / "report.html").read_text()
    assert page.index("In short") < page.index("Steps with a detection") < page.index("How to read this page")


def test_without_truth_nobody_can_say(tmp_path: Path) -> None:
    directory = build_mission(tmp_path)
    (directory / "truth.parquet").unlink()
    words = verdict(directory)
    assert "nobody can say: the log holds no truth" in words and "By its own account, a hypothesis is typically" in words


def test_truth_of_other_names_is_named_and_not_called_silent(tmp_path: Path) -> None:
    directory = build_mission(tmp_path)
    table = rename_truth(directory, {"T0": "Ada", "T1": "Bea"})
    assert table.num_rows
    found = load_mission(directory)
    scored = score_mission(directory, found)
    assert isinstance(scored, str) and "truth is of Ada, Bea, detections are of T0, T1" in scored
    assert scored in truth_section(found, analyse(found, scored, lambda _: None))


def rename_truth(directory: Path, names: dict[str, str]) -> pa.Table:
    table, frame = read_table(directory / "truth.parquet", "truth")
    column = table.schema.get_field_index("agent_id")
    ids = pa.array([names[name] for name in table["agent_id"].to_pylist()], pa.string())
    table = table.set_column(column, table.schema.field(column), ids)
    write_table(table, directory / "truth.parquet", "truth", frame)
    return table


def two_associations(
    time_s, position_m, covariance_m2, origins_s, config, seed, habits=None, **_
) -> list[AssociationHypotheses]:
    label = np.stack([TRUE, SWAPPED])
    return [AssociationHypotheses(label[:, : int((time_s <= origin).sum())], np.array([0.75, 0.25]), 2) for origin in origins_s]


def made(folder: Path) -> Path:
    folder.mkdir()
    return folder


def nameless(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A mission of two agents whose detections do not say whose they are, with hypotheses."""
    monkeypatch.setattr(associations, "associate", two_associations)
    monkeypatch.setattr(associations, "fit_habits", lambda *_: None)
    directory = mission(tmp_path, detections())
    shutil.copy(build_mission(made(tmp_path / "other")) / "catalogue.json", directory)
    infer(directory, CONFIG, QUIET)
    return directory


def test_agents_without_names_are_compared_with_the_truth_that_they_stand_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    directory = nameless(tmp_path, monkeypatch)
    rows = [
        {"log_id": "walk", "time_ns": START_NS + time * 10**9, "agent_id": name, "x_m": 5.0 * time, "y_m": north}
        for name, north in (("tug", 0.0), ("ship", 800.0), ("boat", 5000.0))  # in another order than agents; one is never seen
        for time in range(0, 90, 2)
    ]
    write_table(pa.Table.from_pylist(rows, schema=TRUTH), directory / "truth.parquet", "truth", Frame("map"))
    found = load_mission(directory)
    scored = score_mission(directory, found)
    assert isinstance(scored, Scored) and scored.is_matched and len(scored.errors_m("past"))
    analysis = analyse(found, scored, lambda _: None)
    assert np.isfinite(analysis.error_now_m).any()
    assert "stand for those of the truth" in truth_section(found, analysis)
    last = found.fans[-1]
    true = truth_of(found, scored, last.window, last.agent)
    assert len(true) == 45 and abs(true.position_m[0, 1] - last.datum_m[1]) < 800
    evaluate(directory, EvaluateConfig(rivals=(), num_resamples=2), QUIET)
    row = next(
        row
        for row in json.loads((directory / "scores.json").read_text())["rows"]
        if (row["by"], row["part"], row["metric"]) == ("part", "past", "ade_m")
    )
    assert scored.mean("past", "ade_m") == pytest.approx(row["value"], rel=1e-12)
    report(directory, ReportConfig(), QUIET)
    assert "<small>3 named by the truth</small>" in (directory / "report.html").read_text()


@pytest.mark.parametrize(("limit_mps", "words"), [(1e6, "0 of 132 tracks"), (0.001, "132 of 132 tracks")])
def test_tracks_that_break_a_stated_limit_are_counted(tmp_path: Path, limit_mps: float, words: str) -> None:
    directory = build_mission(tmp_path)
    told(directory, "infer", config={"guidance": {"max_speed_mps": limit_mps}}, summary={"plausible_speed_mps": 3.0})
    said = verdict(directory)
    assert f"{words} break the limit of" in said and "that was stated" in said
    told(directory, "infer", config={"guidance": {"max_speed_mps": None}}, summary={"plausible_speed_mps": 3.0})
    assert "limit of 3 m/s that the detections make plausible" in verdict(directory)


def test_only_some_windows_are_compared_where_all_would_take_long_and_that_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    directory = build_mission(tmp_path)
    whole = score_mission(directory, load_mission(directory))
    monkeypatch.setattr("pipeline.report.scored.MAX_PAIRS", 144 * 96 * 4)
    some = score_mission(directory, load_mission(directory))
    assert whole.every == 1 and some.every > 1 and len(some.cells) < len(whole.cells)
    assert f"one window in {some.every} was compared" in verdict(directory)


def test_what_is_to_doubt_is_said(tmp_path: Path) -> None:
    directory = build_mission(tmp_path)
    words = verdict(directory)
    assert "1 of 12 pairs of a window and an agent: no detections." in words
    table, frame = read_table(directory / "windows.parquet", "windows")
    column = table.schema.get_field_index("status")
    status = pa.array([word.replace("no_detections", "measured") for word in table["status"].to_pylist()], pa.string())
    told_of = table.set_column(column, table.schema.field(column), status)
    write_table(told_of, directory / "windows.parquet", "windows", frame)
    assert "1 of 12 pairs of a window and an agent: no position is known, so that the tracks rest" in verdict(directory)
    make_uncertain(directory, {"T1": 0.62})
    told(
        directory,
        "extract",
        summary={"suspicions": [{"kind": "clock", "subject": "/Radar", "seen": "it jumps", "done": "left out"}]},
    )
    words = verdict(directory)
    assert "1 of 1 may be none" in words and "Clock of /Radar: it jumps; left out." in words


def test_agents_that_are_rather_none_are_no_chosen_moments(tmp_path: Path) -> None:
    directory = build_mission(tmp_path)
    make_uncertain(directory, {"T0": 0.4, "T1": 0.9})
    found = load_mission(directory)
    moments = choose_moments(found, analyse(found, "", lambda _: None), 8)
    assert {found.fans[moment.fan].agent for moment in moments} == {1}
    report(directory, ReportConfig(), QUIET)
    page = (directory / "report.html").read_text()
    assert '"unlikely":[0]' in page and "less than 50 % likely there are left out" in page


def test_extremes_say_of_what_they_are_the_largest(tmp_path: Path) -> None:
    directory = build_mission(tmp_path)
    found = load_mission(directory)
    scored = score_mission(directory, found)
    reasons = [moment.reason for moment in choose_moments(found, analyse(found, scored, lambda _: None), 8)]
    assert any("urthest from the truth" in reason and "of the" not in reason for reason in reasons)
    cut_truth(directory)
    found = load_mission(directory)
    scored = score_mission(directory, found)
    reasons = [moment.reason for moment in choose_moments(found, analyse(found, scored, lambda _: None), 8)]
    assert any("urthest from the truth (of the 6 of 11 windows" in reason for reason in reasons)


def cut_truth(directory: Path) -> None:
    """Only T0 has a truth."""
    table, frame = read_table(directory / "truth.parquet", "truth")
    kept = [index for index, name in enumerate(table["agent_id"].to_pylist()) if name == "T0"]
    write_table(table.take(kept), directory / "truth.parquet", "truth", frame)


def test_a_thinned_run_says_so_at_the_top(tmp_path: Path) -> None:
    directory = build_mission(tmp_path)
    thinning = {"enabled": True, "thin_from": "truth", "mean_gap_s": 60.0, "mean_burst_s": 5.0}
    told(directory, "extract", config={"thinning": thinning}, summary={})
    report(directory, ReportConfig(), QUIET)
    header = (directory / "report.html").read_text().partition("<header>")[2].partition("</header>")[0]
    assert "48 detections were taken out of the log’s truth" in header and "gaps of about 1 min" in header


def test_the_table_of_found_agents_tells_how_likely_each_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    directory = nameless(tmp_path, monkeypatch)
    report(directory, ReportConfig(), QUIET)
    page = (directory / "report.html").read_text()
    table = page.partition("Agents that were found")[2].partition("</table>")[0]
    assert "there at best" in table and table.count("&gt; 99 %") == 2
    assert "2 agents were found, 2 of them the likeliest source" in table
    assert ">Agents</dt><dd>2<" in page.replace("<small></small>", "")


def test_renaming_leaves_the_figures(tmp_path: Path) -> None:
    directory = build_mission(tmp_path)
    before = score_mission(directory, load_mission(directory)).mean("future", "ade_m")
    rename_agents(directory, {"T0": "zoe"})
    assert score_mission(directory, load_mission(directory)).mean("future", "ade_m") == pytest.approx(before)
