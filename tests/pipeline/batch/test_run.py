"""Many logs through all stages: failures stay with their log, and directories never collide."""

import json
from pathlib import Path

import pytest

import pipeline.batch.tasks as module
from cadence.errors import DeviceError, InputError, NothingDetectedError, UsageError
from pipeline.batch.config import RunConfig
from pipeline.batch.outcome import complaints, exit_code
from pipeline.batch.run import run, selection_settings
from pipeline.batch.summaries import batch_summary
from pipeline.config import stage_config
from pipeline.extract.config import ExtractConfig
from pipeline.manifest import StageResult
from pipeline.missions import mission_directories
from pipeline.progress import Progress

QUIET = Progress(quiet=True)
STAGES = ("ingest", "extract", "infer", "retrospect", "export", "report")


@pytest.fixture
def calls(monkeypatch):
    """Stages replaced by ones that note their call; `calls.failing` maps (stage, log stem) to the error to raise."""

    class Calls(list):
        failing: dict[tuple[str, str], BaseException]
        summaries: dict[tuple[str, str], dict]

    record = Calls()
    record.failing = {}
    record.summaries = {}

    def fake(stage, stem, config, force):
        record.append((stage, stem, config, force))
        if (stage, stem) in record.failing:
            raise record.failing[stage, stem]
        return StageResult(stage, "done", (), record.summaries.get((stage, stem), {}))

    monkeypatch.setattr(
        module, "ingest", lambda log, directory, config, progress, force: fake("ingest", log.stem, config, force)
    )
    for stage in STAGES[1:]:
        monkeypatch.setattr(
            module,
            stage,
            lambda directory, config, progress, force, *_, stage=stage: fake(stage, directory.name, config, force),
        )
    return record


def run_here(stems, out, progress=QUIET, force=False):
    """`run` in this process, where stages can be replaced."""
    return run([f"{stem}.mcap" for stem in stems], str(out), RunConfig(), progress, force, num_workers=0)


def test_every_log_goes_through_every_stage_in_order(calls, tmp_path):
    config = RunConfig()
    outcomes = run_here("ab", tmp_path, force=True)
    expected = [(stage, stem, getattr(config, stage), True) for stem in "ab" for stage in STAGES]
    assert calls == expected
    assert [outcome.task.directory for outcome in outcomes] == [f"{tmp_path}/a", f"{tmp_path}/b"]
    assert all(tuple(stage.stage for stage in outcome.stages) == STAGES for outcome in outcomes)
    assert exit_code(outcomes) == 0 and {outcome.status for outcome in outcomes} == {"done"}


def test_a_bad_log_does_not_stop_the_others(calls, tmp_path, capsys):
    calls.failing = {("extract", "b"): InputError("b.mcap: no detections"), ("export", "c"): DeviceError("disk full")}
    outcomes = run_here("abcd", tmp_path)
    assert [len(outcome.stages) for outcome in outcomes] == [6, 1, 4, 6]
    assert [outcome.message for outcome in outcomes] == ["", "b.mcap: no detections", "c.mcap: disk full", ""]
    assert exit_code(outcomes) == 5
    assert capsys.readouterr() == ("", "")


def test_a_defect_shows_its_traceback_and_does_not_stop_the_others(calls, tmp_path, capsys):
    calls.failing = {("infer", "a"): ZeroDivisionError("division by zero")}
    outcomes = run_here("ab", tmp_path)
    assert outcomes[0].exit_code == 1 and "defect in infer (ZeroDivisionError" in outcomes[0].message
    assert outcomes[1].exit_code == 0 and exit_code(outcomes) == 1
    captured = capsys.readouterr()
    assert "Traceback" in captured.err and captured.out == ""


def test_memory_that_ran_out_is_no_defect(calls, tmp_path):
    for refused in (MemoryError(), RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 9 bytes")):
        calls.failing = {("infer", "a"): refused}
        outcomes = run_here("a", tmp_path)
        assert [(outcome.exit_code, "fewer --workers" in outcome.message, outcome.trace) for outcome in outcomes] == [
            (5, True, "")
        ]


def test_interruption_is_not_a_failure_of_a_log(calls, tmp_path):
    calls.failing = {("infer", "a"): KeyboardInterrupt()}
    with pytest.raises(KeyboardInterrupt):
        run_here("ab", tmp_path)


def test_progress_tells_which_log_is_finished(calls, tmp_path, capsys):
    run_here("ab", tmp_path, Progress())
    captured = capsys.readouterr()
    assert (
        "2 missions, 0.00B; 0 were finished earlier" in captured.err and "[2/2] b: done" in captured.err and captured.out == ""
    )


def test_results_from_a_damaged_log_have_a_code_of_their_own_below_that_of_failures(calls, tmp_path):
    calls.summaries = {("ingest", "b"): {"is_complete": False}}
    outcomes = run_here("ab", tmp_path)
    assert [outcome.status for outcome in outcomes] == ["done", "partial"] and exit_code(outcomes) == 7
    calls.failing = {("infer", "a"): InputError("a.mcap: no")}
    assert exit_code(run_here("ab", tmp_path)) == 3


def test_that_nothing_was_detected_is_a_failure_only_where_it_is_so_of_all(calls, tmp_path):
    calls.failing = {("extract", "b"): NothingDetectedError("b.mcap: no sighting")}
    outcomes = run_here("ab", tmp_path)
    assert [outcome.status for outcome in outcomes] == ["done", "nothing detected"]
    assert exit_code(outcomes) == 0 and complaints(outcomes) == []
    assert batch_summary(outcomes).endswith("b.mcap: no sighting") and "b    nothing detected" in batch_summary(outcomes)
    record = json.loads((tmp_path / "batch.json").read_text())
    assert (record["num_done"], record["num_nothing_detected"], record["num_failed"]) == (1, 1, 0)
    assert (record["logs"][1]["message"], record["logs"][1]["error"]) == ("b.mcap: no sighting", None)
    alone = run_here("b", tmp_path)
    assert exit_code(alone) == 3 and complaints(alone) == ["b.mcap: no sighting"]


def test_where_a_damaged_log_holds_no_detection_they_may_be_lost(calls, tmp_path):
    calls.failing = {("extract", "b"): NothingDetectedError("b.mcap: no sighting")}
    calls.summaries = {("ingest", "b"): {"is_complete": False}}
    outcomes = run_here("ab", tmp_path)
    assert outcomes[1].status == "failed" and exit_code(outcomes) == 3 and complaints(outcomes) == ["b.mcap: no sighting"]


def test_no_log_is_a_wrong_call(tmp_path):
    with pytest.raises(UsageError, match="no log given"):
        run_here("", tmp_path)


def test_report_tells_of_every_log(calls, tmp_path):
    calls.failing = {("extract", "b"): InputError("b.mcap: no detections")}
    report = tmp_path / "more" / "night.json"
    run(["a.mcap", "b.mcap"], str(tmp_path), RunConfig(), QUIET, num_workers=0, report=report)
    record = json.loads(report.read_text())
    assert report.read_text() == (tmp_path / "batch.json").read_text()
    assert (record["num_logs"], record["num_done"], record["num_failed"], record["exit_code"]) == (2, 1, 1, 3)
    assert [log["status"] for log in record["logs"]] == ["done", "failed"]
    assert record["logs"][1]["error"] == {"message": "b.mcap: no detections", "exit_code": 3}


def test_a_report_that_cannot_be_written_does_not_cost_the_outcomes(calls, tmp_path):
    (tmp_path / "batch.json").mkdir()
    report, unwritten = tmp_path / "night.json", []
    outcomes = run(["a.mcap"], str(tmp_path), RunConfig(), QUIET, num_workers=0, report=report, on_unwritten=unwritten.append)
    assert [outcome.status for outcome in outcomes] == ["done"] and json.loads(report.read_text())["num_done"] == 1
    assert [str(error).split(": ")[0] for error in unwritten] == [f"{tmp_path}/batch.json"]
    assert exit_code(outcomes) == 0 and exit_code(outcomes, unwritten) == 5
    with pytest.raises(DeviceError, match=r"batch\.json: cannot write"):
        run_here("a", tmp_path)


def test_a_folder_that_cannot_be_made_is_said_before_any_work(calls, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(DeviceError, match="file/out: cannot write there"):
        run_here("ab", tmp_path / "file" / "out")
    assert calls == []


def test_a_log_may_be_called_like_a_file_beside_the_missions(calls, tmp_path):
    outcomes = run_here(["batch.json", "scores.md", "a"], tmp_path)
    names = [outcome.task.name for outcome in outcomes]
    assert names[0].startswith("batch.json-") and names[1].startswith("scores.md-") and names[2] == "a"
    assert json.loads((tmp_path / "batch.json").read_text())["num_logs"] == 3


def test_a_number_of_workers_that_cannot_be(tmp_path):
    with pytest.raises(UsageError, match="--workers -1"):
        run(["a.mcap"], str(tmp_path), RunConfig(), QUIET, num_workers=-1)


def test_flags_that_select_are_settings_of_extract():
    assert selection_settings(None, None, ()) == []
    flags = selection_settings("10", "2024-05-01T12:30:00Z", ["/a", "/b*"])
    assert stage_config(RunConfig, None, None, flags).extract == ExtractConfig(
        start=10.0, end="2024-05-01T12:30:00Z", topics=("/a", "/b*")
    )


def test_directories_of_logs_that_share_a_stem_differ_and_do_not_depend_on_the_order():
    logs = [Path("one/flight.mcap"), Path("two/flight.mcap"), Path("other.mcap")]
    there, back = mission_directories(logs, Path("out")), mission_directories(logs[::-1], Path("out"))
    assert there == back and list(there) == logs
    assert there[logs[2]] == Path("out/other")
    assert len(set(there.values())) == 3
    assert all(there[log].name.startswith("flight-") for log in logs[:2])


def test_a_log_of_the_same_name_from_another_folder_does_not_replace_earlier_results(tmp_path):
    one, two = tmp_path / "one" / "flight.mcap", tmp_path / "two" / "flight.mcap"
    out = tmp_path / "out"
    for log in (one, two):
        log.parent.mkdir()
        log.touch()
    (out / "flight").mkdir(parents=True)
    (out / "flight" / "catalogue.json").write_text(json.dumps({"path": str(one)}))
    assert mission_directories([one], out) == {one: out / "flight"}
    other = mission_directories([two], out)[two]
    assert other.name.startswith("flight-") and mission_directories([one, two], out) == {one: out / "flight", two: other}
    one.unlink()  # moved: the results may be of use
    assert mission_directories([two], out) == {two: out / "flight"}


def test_a_log_given_twice_is_run_once(tmp_path):
    (tmp_path / "x").mkdir()
    twice = [tmp_path / "a.mcap", tmp_path / "x" / ".." / "a.mcap"]
    assert mission_directories(twice, Path("out")) == {twice[0]: Path("out/a")}
