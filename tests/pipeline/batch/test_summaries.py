"""Results as people and programs read them."""

import dataclasses
import json
from pathlib import Path

from pipeline.batch.config import RunConfig
from pipeline.batch.outcome import LogOutcome, LogTask
from pipeline.batch.summaries import batch_record, batch_summary, log_record, score_lines, stage_summary, to_json
from pipeline.manifest import StageResult

INGEST = StageResult("ingest", "done", (Path("o/a/catalogue.json"),), {"num_messages": 5, "problems": ["cut off at 10:00"]})
EXPORT = StageResult("export", "skipped", (Path("o/a/a.cadence.mcap"),), {"size_mb": 1.23456, "is_georeferenced": False})


def test_stage_in_words():
    assert stage_summary(INGEST) == "ingest: done\n  messages 5\n  o/a/catalogue.json"
    assert stage_summary(EXPORT) == "export: skipped\n  size mb 1.235\n  o/a/a.cadence.mcap"


GOOD = LogOutcome(LogTask(0, ("a.mcap",), "o/a", 9, RunConfig()), (INGEST, EXPORT), elapsed_s=1.25)
BAD = LogOutcome(LogTask(1, ("long.mcap",), "o/long", 9, RunConfig()), (), "long.mcap: no", 3, 0.5)


def test_logs_in_words_name_the_damage_and_only_the_files_to_open():
    assert batch_summary([GOOD, BAD]).splitlines() == [
        "log   status  windows  agents  detections   time",
        "a     done          -       -           -  1.2 s",
        "long  failed        -       -           -  0.5 s  long.mcap: no",
        "a: damaged: cut off at 10:00",
        "  o/a/a.cadence.mcap  for Foxglove or Lichtblick, together with a.mcap",
    ]  # fmt: skip


def test_a_failure_that_is_told_elsewhere_is_not_told_again():
    assert batch_summary([GOOD, BAD], ["long.mcap: no"]).splitlines()[2] == "long  failed        -       -           -  0.5 s"


NAMES = ("report.html", "a.layout.legacy.json", "a.cadence.mcap", "a.layout.json")
REPORT = StageResult("report", "done", tuple(Path("o/a") / name for name in NAMES), {})


def test_what_to_open_is_said_with_what_it_is_for_and_the_page_comes_last():
    outcome = dataclasses.replace(GOOD, stages=(REPORT,))
    assert batch_summary([outcome]).splitlines()[2:] == [
        "  o/a/a.cadence.mcap        for Foxglove or Lichtblick, together with a.mcap",
        "  o/a/a.layout.json         its layout for Foxglove",
        "  o/a/a.layout.legacy.json  its layout for Lichtblick",
        "  o/a/report.html           open this in a browser",
    ]
    many = batch_summary([outcome] * 3 + [BAD]).splitlines()
    assert many[-1] == "open o/*/report.html in a browser, 3 pages" and "cadence.mcap" not in "".join(many)


def test_what_was_assumed_of_detections_without_identity_is_said_with_the_lines_that_say_otherwise():
    extract = StageResult("extract", "done", (), {"num_unknown_origin": 7, "unnamed": {"/xy": "agent_id"}})
    infer = StageResult("infer", "done", (), {"num_windows": 2, "association": {"num_agents": 6}})
    text = batch_summary([dataclasses.replace(GOOD, stages=(extract, infer))])
    assert "a: assumed: 7 detections of /xy do not say whose they are and were told apart as those of 6 targets" in text
    assert 'agent_path = "agent_id"' in text and 'agent = "NAME"' in text and "infer.association.num_agents" in text
    together = batch_summary(
        [dataclasses.replace(GOOD, stages=(extract, StageResult("infer", "done", (), {"num_windows": 2})))]
    )
    assert "were taken for one target" in together
    assert "assumed" not in batch_summary([dataclasses.replace(GOOD, stages=(extract,))])


def test_what_accuracy_was_taken_is_said_at_the_end_too():
    extract = StageResult("extract", "done", (), {"taken": ["/scan: 0.5 m in range are taken"]})
    assert "a: assumed: /scan: 0.5 m in range are taken" in batch_summary([dataclasses.replace(GOOD, stages=(extract,))])


def test_logs_for_programs():
    records = json.loads(to_json([log_record(GOOD), log_record(BAD)]))
    assert records[0]["stages"][0] == {
        "stage": "ingest", "status": "done", "outputs": ["o/a/catalogue.json"], "summary": dict(INGEST.summary),
    }  # fmt: skip
    assert {name: value for name, value in records[0].items() if name != "stages"} == {
        "log": "a.mcap", "parts": ["a.mcap"], "directory": "o/a", "status": "done", "message": "", "error": None,
        "size_bytes": 9, "elapsed_s": 1.25,
    }  # fmt: skip
    assert records[1]["error"] == {"message": "long.mcap: no", "exit_code": 3} and records[1]["stages"] == []


def test_a_batch_for_programs_counts_what_became_of_its_logs():
    record = batch_record([GOOD, BAD], 3, 2.0)
    assert {name: value for name, value in record.items() if name != "logs"} == {
        "version": 1, "exit_code": 3, "elapsed_s": 2.0, "num_logs": 2,
        "num_done": 1, "num_skipped": 0, "num_partial": 0, "num_doubtful": 0, "num_nothing_detected": 0, "num_failed": 1,
    }  # fmt: skip


def test_scores_as_a_table():
    scores = [
        {"estimator": "cadence", "part": "past", "metric": "ade_m", "value": 12.3456},
        {"estimator": "cadence", "part": "future", "metric": "ade_m", "value": 100.0},
        {"estimator": "hold", "part": "past", "metric": "ade_m", "value": None},
    ]
    assert score_lines(scores) == [
        "                         past:     future:",
        "                    mean error  mean error",
        "           cadence      12.3 m       100 m",
        "  stays where seen           -           -",
    ]
    assert score_lines([]) == []
    result = StageResult("evaluate", "done", (), {"verdict": ["Past: good."], "scores": scores})
    assert stage_summary(result).splitlines()[:2] == ["evaluate: done", "  Past: good."]


def test_numbers_of_a_stage_bear_their_units():
    summary = {"num_ticks": 219, "tick_s": 30.0, "size_bytes": 405597, "plausible_speed_mps": 20.5554, "num_agents": 1}
    line = stage_summary(StageResult("export", "done", (), summary)).splitlines()[1]
    assert line == "  ticks 219, tick 30.0 s, size 405597 bytes, plausible speed 20.555 m/s, agents 1"
