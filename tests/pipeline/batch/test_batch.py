"""Batches: which logs are meant, workers that die, results that do not depend on how many work."""

import functools
import os
import sys
import threading
import time
from pathlib import Path

import pytest
from fixtures.batch import SETTINGS, hidden_in, outcome_or_death, results_of, write_tiny_logs

from cadence.errors import InputError
from pipeline.batch.config import RunConfig
from pipeline.batch.engines.local import run_in_processes, run_in_sequence
from pipeline.batch.outcome import LogTask, exit_code
from pipeline.batch.run import _Shown, choose_engine, run, threads_each
from pipeline.batch.tasks import run_task, run_tasks
from pipeline.config import stage_config
from pipeline.locks import clear_abandoned, locked
from pipeline.missions import find_missions
from pipeline.progress import Doing, Progress, RelayedProgress

pytestmark = pytest.mark.timeout(300)  # on a busy machine the first process takes long to import everything
QUIET = Progress(quiet=True)


def touch(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"x" * 10)
    return path


@pytest.fixture
def tree(tmp_path):
    """A folder with logs at several depths, and what is no log."""
    for name in ("b.mcap", "a/c.mcap", "a/deep/d.mcap", "a/d.txt", ".hidden/e.mcap", "a/.f.mcap", "g.mcap.part"):
        touch(tmp_path / "logs" / name)
    for name in ("out/b/b.cadence.mcap", "out/b/b.combined.mcap"):
        touch(tmp_path / "logs" / name)
    return tmp_path / "logs"


def found(*logs: object) -> list[tuple[str, ...]]:
    return [tuple(Path(part).name for part in mission.parts) for mission in find_missions(list(map(str, logs)), "out")]


def test_folders_are_searched_through_but_not_for_our_own_files(tree):
    assert found(tree) == [("c.mcap",), ("d.mcap",), ("b.mcap",)]
    assert found(tree / "b.mcap", tree) == [("b.mcap",), ("c.mcap",), ("d.mcap",)]


def test_patterns_are_expanded_also_when_quoted(tree):
    assert found(tree / "*.mcap") == [("b.mcap",)]
    assert found(tree / "**" / "*.mcap") == [("c.mcap",), ("d.mcap",), ("b.mcap",)]
    assert found(tree / "[a]") == [("c.mcap",), ("d.mcap",)]


def test_a_name_with_brackets_is_a_name_first(tree):
    touch(tree / "x[1].mcap")
    assert found(tree / "x[1].mcap") == [("x[1].mcap",)]


def test_no_log_where_some_were_promised(tree):
    (tree / "empty").mkdir()
    with pytest.raises(InputError, match="empty: holds no MCAP log"):
        found(tree / "empty")
    with pytest.raises(InputError, match="no MCAP log fits this pattern"):
        found(tree / "z*.mcap")
    assert found(tree / "gone.mcap") == [("gone.mcap",)]  # fails alone, later


def test_parts_of_a_split_recording_are_one_mission(tree):
    for number in (0, 1, 10):
        touch(tree / "bag" / f"bag_{number}.mcap")
    names = "".join(f"  - bag_{number}.mcap\n" for number in (0, 1, 10))
    (tree / "bag" / "metadata.yaml").write_text(f"rosbag2_bagfile_information:\n  relative_file_paths:\n{names}")
    (mission,) = find_missions([str(tree / "bag")], "out")
    assert [Path(part).name for part in mission.parts] == ["bag_0.mcap", "bag_1.mcap", "bag_10.mcap"]
    assert (mission.directory, mission.size_bytes) == ("out/bag", 30)


def tasks_named(*names: str) -> list[LogTask]:
    return [LogTask(i, (name,), f"out/{i}", 9 - i, RunConfig()) for i, name in enumerate(names)]


def test_a_worker_that_dies_costs_only_its_log():
    heard: list[str] = []
    engine = functools.partial(run_in_processes, num_workers=1)
    names = ("good", "killed", "bad", "exits", "good")
    tasks = tasks_named(*names)
    outcomes = run_tasks(tasks, engine, lambda _: None, lambda task, told: heard.append(str(told)), outcome_or_death)
    assert [outcome.exit_code for outcome in outcomes] == [0, 5, 3, 5, 0] and exit_code(outcomes) == 5
    assert [outcome.task for outcome in outcomes] == tasks
    assert "killed: its worker process ended by SIGKILL" in outcomes[1].message and "fewer --workers" in outcomes[1].message
    assert "exits: its worker process ended with exit code 9" in outcomes[3].message
    processes = [text.removeprefix("at work as ") for text in heard]
    assert len(processes) == 5 and len(set(processes)) == 3  # a worker is used again until it dies
    assert str(os.getpid()) not in processes


def test_the_longest_log_comes_first_and_outcomes_keep_the_order():
    tasks = [LogTask(i, (str(i),), f"out/{i}", size, RunConfig()) for i, size in enumerate((5, 9, 5, 7))]
    finished: list[int] = []
    outcomes = run_tasks(
        tasks, run_in_sequence, lambda outcome: finished.append(outcome.task.index), lambda *_: None, outcome_or_death
    )
    assert finished == [1, 3, 0, 2] and [outcome.task.index for outcome in outcomes] == [0, 1, 2, 3]


def test_workers_give_the_same_bytes_and_a_broken_log_costs_only_itself(tmp_path):
    logs = write_tiny_logs(tmp_path / "logs", 3)
    (logs / "aa.mcap").write_bytes(b"not an MCAP")
    (logs / "ab.mcap").write_bytes((logs / "a.mcap").read_bytes()[:40])
    config = stage_config(RunConfig, None, None, [f"{name}={value}" for name, value in SETTINGS.items()])
    alone = run([str(logs)], str(tmp_path / "alone"), config, QUIET, num_workers=0)
    together = run([str(logs)], str(tmp_path / "together"), config, QUIET, num_workers=2)
    assert [outcome.status for outcome in together] == ["done", "failed", "failed", "done", "done"]
    assert [outcome.message for outcome in together] == [outcome.message for outcome in alone]
    assert all(Path(o.task.parts[0]).name in o.message and o.exit_code == 3 for o in together if o.status == "failed")
    results = results_of(tmp_path / "together")
    assert results == results_of(tmp_path / "alone") and len([name for name in results if name.endswith("report.html")]) == 3
    assert hidden_in(tmp_path / "together") == []


def test_what_is_done_is_skipped_also_from_another_number_of_workers(tmp_path):
    logs = write_tiny_logs(tmp_path / "logs", 1)
    config = stage_config(RunConfig, None, None, [f"{name}={value}" for name, value in SETTINGS.items()])
    first = run([str(logs)], str(tmp_path / "out"), config, QUIET)
    again = run([str(logs)], str(tmp_path / "out"), config, QUIET, num_workers=0)
    assert [outcome.status for outcome in (*first, *again)] == ["done", "skipped"]


def test_a_moved_log_is_not_inferred_again_and_of_a_renamed_one_it_is_said(tmp_path, capsys):
    logs = write_tiny_logs(tmp_path / "logs", 1)
    config = stage_config(RunConfig, None, None, [f"{name}={value}" for name, value in SETTINGS.items()])
    run([str(logs / "a.mcap")], str(tmp_path / "out"), config, QUIET)
    (tmp_path / "moved").mkdir()
    moved = (logs / "a.mcap").rename(tmp_path / "moved" / "a.mcap")
    (outcome,) = run([str(moved)], str(tmp_path / "out"), config, Progress())
    assert outcome.task.directory == str(tmp_path / "out" / "a") and "renamed" not in capsys.readouterr().err
    assert {stage.stage for stage in outcome.stages if stage.status == "skipped"} >= {"infer"}
    renamed = moved.rename(moved.with_name("b.mcap"))
    (outcome,) = run([str(renamed)], str(tmp_path / "out"), config, Progress())
    assert outcome.status == "done" and f"{renamed}: is a.mcap renamed; it is run anew" in capsys.readouterr().err
    assert (tmp_path / "out" / "a" / "report.html").is_file()


def test_one_log_needs_no_worker_and_more_have_some():
    assert choose_engine("local", 1, None) is run_in_sequence
    assert choose_engine("local", 5, 0) is run_in_sequence
    chosen = choose_engine("local", 5, 3)
    assert isinstance(chosen, functools.partial) and chosen.keywords == {"num_workers": 3}


@pytest.mark.parametrize(
    ("engine", "num_tasks", "num_workers", "each"),
    [
        ("local", 1, 0, 1),
        ("local", 1, 6, 6),
        ("local", 2, 6, 3),
        ("local", 9, 4, 1),
        ("ray", 1, 8, 1),
        ("local", 10_000, None, 1),
    ],
)
def test_cores_without_a_log_of_their_own_help_inside_one(engine, num_tasks, num_workers, each):
    assert threads_each(engine, num_tasks, num_workers) == each


def test_a_folder_is_held_by_one_at_a_time(tmp_path):
    waits: list[str] = []
    order: list[str] = []

    def second():
        with locked(tmp_path / "mission", waits.append):
            order.append("second")

    with locked(tmp_path / "mission", waits.append):
        thread = threading.Thread(target=second)
        thread.start()
        while not waits:
            time.sleep(0.01)
        order.append("first")
    thread.join()
    assert order == ["first", "second"] and len(waits) == 1 and "another process works there" in waits[0]
    assert not (tmp_path / "mission").exists()  # it stayed empty


def test_what_nobody_holds_is_cleared_away(tmp_path):
    for name in (".infer.dead", ".infer.alive", ".inference", "infer.manifest.json"):
        touch(tmp_path / name / "file")
    with locked(tmp_path / ".infer.alive"):
        clear_abandoned(tmp_path, ".infer.")
        assert sorted(path.name for path in tmp_path.iterdir()) == [".infer.alive", ".inference", "infer.manifest.json"]


def test_bars_are_told_as_shares_of_the_task():
    told: list[object] = []
    progress = RelayedProgress(tell=told.append).part(0.2, 0.6)
    with progress.bar(1000, "infer", "window") as bar:
        for _ in range(1000):
            bar.update()
    progress.bar(None, "unknown").update(5)
    progress.note("a line")
    assert len(told) <= 203 and told[0] == Doing("infer") and told[-2:] == [Doing("unknown"), "a line"]
    assert Doing("infer 10 of 1000 windows") in told
    shares = [share for share in told if isinstance(share, float)]
    assert shares[-1] == pytest.approx(0.6, abs=0.005) and shares == sorted(shares)


def test_missions_count_alike_in_the_bar_whatever_they_weigh(tmp_path, capsys, monkeypatch):
    tasks = [LogTask(i, (f"{i}.mcap",), f"out/{i}", size, RunConfig()) for i, size in enumerate((1, 10**12, 7))]
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    shown = _Shown(tasks, Progress())
    for task in tasks:
        for share in [0.1 * step for step in range(1, 11)]:
            shown.watch(task, share)
        shown.watch(task, Doing("infer"))
        bar = capsys.readouterr().err.split("\r")[-1]
        assert f"{round(100 * (task.index + 1) / 3)}%|" in bar and "B/s" not in bar and "infer" not in bar
    shown.close()


def test_bars_are_for_terminals_and_notes_for_all(capsys, monkeypatch):
    for is_terminal in (False, True):
        monkeypatch.setattr(sys.stderr, "isatty", lambda is_terminal=is_terminal: is_terminal)
        with Progress().bar(3, "extract") as bar, Progress().percent("run") as whole:
            bar.update(1)
            whole.n = 0.5
            whole.set_postfix_str("infer")
            Progress().note("a line")
        shown = capsys.readouterr().err
        assert ("extract" in shown) == is_terminal and ("50%" in shown) == is_terminal and "a line\n" in shown


def test_a_defect_comes_back_with_its_traceback(tmp_path, monkeypatch):
    monkeypatch.setattr("pipeline.batch.tasks.ingest", lambda *_: 1 / 0)
    outcome = run_task(LogTask(0, ("a.mcap",), str(tmp_path / "a"), 0, RunConfig()), QUIET)
    assert outcome.exit_code == 1 and "a.mcap: defect in ingest (ZeroDivisionError" in outcome.message
    assert "1 / 0" in outcome.trace and not (tmp_path / "a").exists()
