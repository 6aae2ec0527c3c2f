"""Results as people and programs read them."""

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
        "  o/a/a.cadence.mcap",
    ]  # fmt: skip


def test_files_of_many_logs_are_not_listed():
    assert not [line for line in batch_summary([GOOD] * 4).splitlines() if "cadence.mcap" in line]


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
        "           past ade_m  future ade_m",
        "  cadence       12.35           100",
        "     hold           -             -",
    ]
    assert score_lines([]) == []
