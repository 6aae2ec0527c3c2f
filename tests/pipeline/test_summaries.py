"""Results as people and programs read them."""

import json
from pathlib import Path

from cadence.errors import InputError
from pipeline.manifest import StageResult
from pipeline.run import LogResult
from pipeline.summaries import log_record, log_summary, score_lines, stage_summary, to_json

INGEST = StageResult("ingest", "done", (Path("o/a/catalogue.json"),), {"num_messages": 5, "problems": ["cut off at 10:00"]})
EXPORT = StageResult("export", "skipped", (Path("o/a/a.cadence.mcap"),), {"size_mb": 1.23456, "is_georeferenced": False})


def test_stage_in_words():
    assert stage_summary(INGEST) == "ingest: done\n  messages 5\n  o/a/catalogue.json"
    assert stage_summary(EXPORT) == "export: skipped\n  size mb 1.235\n  o/a/a.cadence.mcap"


def test_logs_in_words_name_the_damage_and_only_the_files_to_open():
    results = [
        LogResult(Path("a.mcap"), Path("o/a"), (INGEST, EXPORT)),
        LogResult(Path("b.mcap"), Path("o/b"), (), InputError("no")),
    ]
    assert log_summary(results).splitlines() == [
        "a.mcap: ok", "  damaged: cut off at 10:00", "  o/a/a.cadence.mcap", "b.mcap: failed",
    ]  # fmt: skip


def test_logs_for_programs():
    good, bad = LogResult(Path("a.mcap"), Path("o/a"), (INGEST,)), LogResult(Path("b.mcap"), Path("o/b"), (), InputError("no"))
    records = json.loads(to_json([log_record(good), log_record(bad)]))
    assert records[0] == {
        "log": "a.mcap", "directory": "o/a", "error": None,
        "stages": [{"stage": "ingest", "status": "done", "outputs": ["o/a/catalogue.json"], "summary": dict(INGEST.summary)}],
    }  # fmt: skip
    assert records[1]["error"] == {"message": "no", "exit_code": 3} and records[1]["stages"] == []


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
