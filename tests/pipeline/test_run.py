"""Many logs through all stages: failures stay with their log, and directories never collide."""

from pathlib import Path

import pytest

import pipeline.run as module
from cadence.errors import CadenceError, DeviceError, InputError, UsageError
from pipeline.manifest import StageResult
from pipeline.missions import mission_directories
from pipeline.progress import Progress
from pipeline.run import RunConfig, exit_code, run

STAGES = ("ingest", "extract", "infer", "export", "report")


@pytest.fixture
def calls(monkeypatch):
    """Stages replaced by ones that note their call; `calls.failing` maps (stage, log stem) to the error to raise."""

    class Calls(list):
        failing: dict[tuple[str, str], BaseException]

    record = Calls()
    record.failing = {}

    def fake(stage, stem, config, force):
        record.append((stage, stem, config, force))
        if (stage, stem) in record.failing:
            raise record.failing[stage, stem]
        return StageResult(stage, "done", (), {})

    monkeypatch.setattr(
        module, "ingest", lambda log, directory, config, progress, force: fake("ingest", log.stem, config, force)
    )
    for stage in STAGES[1:]:
        monkeypatch.setattr(
            module, stage, lambda directory, config, progress, force, stage=stage: fake(stage, directory.name, config, force)
        )
    return record


def test_every_log_goes_through_every_stage_in_order(calls, tmp_path):
    config = RunConfig()
    results = run([Path("a.mcap"), Path("b.mcap")], tmp_path, config, Progress(quiet=True), force=True)
    expected = [(stage, stem, getattr(config, stage), True) for stem in "ab" for stage in STAGES]
    assert calls == expected
    assert [result.directory for result in results] == [tmp_path / "a", tmp_path / "b"]
    assert all(tuple(stage.stage for stage in result.stages) == STAGES for result in results)
    assert exit_code(results) == 0


def test_a_bad_log_does_not_stop_the_others(calls, tmp_path, capsys):
    calls.failing = {("extract", "b"): InputError("b.mcap: no detections"), ("export", "c"): DeviceError("disk full")}
    results = run([Path(f"{stem}.mcap") for stem in "abcd"], tmp_path, RunConfig(), Progress(quiet=True))
    assert [len(result.stages) for result in results] == [5, 1, 3, 5]
    assert [None if r.error is None else str(r.error) for r in results] == [None, "b.mcap: no detections", "disk full", None]
    assert exit_code(results) == 5
    assert capsys.readouterr() == ("", "")


def test_a_defect_shows_its_traceback_and_does_not_stop_the_others(calls, tmp_path, capsys):
    calls.failing = {("infer", "a"): ZeroDivisionError("division by zero")}
    results = run([Path("a.mcap"), Path("b.mcap")], tmp_path, RunConfig(), Progress(quiet=True))
    assert type(results[0].error) is CadenceError and "defect in infer (ZeroDivisionError" in str(results[0].error)
    assert results[1].error is None and exit_code(results) == 1
    captured = capsys.readouterr()
    assert "Traceback" in captured.err and captured.out == ""


def test_interruption_is_not_a_failure_of_a_log(calls, tmp_path):
    calls.failing = {("infer", "a"): KeyboardInterrupt()}
    with pytest.raises(KeyboardInterrupt):
        run([Path("a.mcap"), Path("b.mcap")], tmp_path, RunConfig(), Progress(quiet=True))


def test_progress_tells_which_log(calls, tmp_path, capsys):
    run([Path("a.mcap"), Path("b.mcap")], tmp_path, RunConfig(), Progress())
    captured = capsys.readouterr()
    assert "[2/2] b.mcap" in captured.err and "infer: done" in captured.err and captured.out == ""


def test_no_log_is_a_wrong_call(tmp_path):
    with pytest.raises(UsageError, match="no log given"):
        run([], tmp_path, RunConfig(), Progress(quiet=True))


def test_directories_of_logs_that_share_a_stem_differ_and_do_not_depend_on_the_order():
    logs = [Path("one/flight.mcap"), Path("two/flight.mcap"), Path("other.mcap")]
    there, back = mission_directories(logs, Path("out")), mission_directories(logs[::-1], Path("out"))
    assert there == back and list(there) == logs
    assert there[logs[2]] == Path("out/other")
    assert len(set(there.values())) == 3
    assert all(there[log].name.startswith("flight-") for log in logs[:2])


def test_a_log_given_twice_is_run_once(tmp_path):
    (tmp_path / "x").mkdir()
    twice = [tmp_path / "a.mcap", tmp_path / "x" / ".." / "a.mcap"]
    assert mission_directories(twice, Path("out")) == {twice[0]: Path("out/a")}
