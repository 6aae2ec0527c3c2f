"""Kill -9 at random moments, Ctrl-C, SIGTERM: what is there is never half, and a run that goes on ends with the same bytes.

`CADENCE_KILLS=50` tries more moments, and Ctrl-C on Ray.
"""

import json
import os
import random
import signal
import time
from pathlib import Path

import pytest
from fixtures.batch import hidden_in, processes_of, results_of, start, start_command, write_tiny_logs

from pipeline.files import hash_file
from pipeline.locks import locked

pytestmark = pytest.mark.timeout(300)  # on a busy machine the first process takes long to import everything
NUM_KILLS = int(os.environ.get("CADENCE_KILLS", "6"))


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """Logs, what an undisturbed run makes of them, and how long that takes."""
    logs = write_tiny_logs(tmp_path_factory.mktemp("undisturbed") / "logs", 2)
    durations_s = []
    for out in (logs.parent / "warm", logs.parent / "out"):
        begin_s = time.monotonic()
        process = start(logs, "--out", out)
        process.join()
        durations_s.append(time.monotonic() - begin_s)
        assert process.exitcode == 0
    assert results_of(logs.parent / "warm") == results_of(logs.parent / "out")
    return logs, results_of(logs.parent / "out"), min(durations_s)


def assert_nothing_is_half(out: Path, whole: dict[str, str]) -> None:
    """Whatever carries a name that results have is a whole result; a manifest is there only with all that it tells of."""
    for path in out.rglob("*"):
        name = str(path.relative_to(out))
        if path.is_file() and not any(part.startswith(".") for part in Path(name).parts) and path.name != "batch.json":
            assert hash_file(path) == whole[name], name
            if name.endswith(".manifest.json"):
                outputs = json.loads(path.read_text())["outputs"]
                assert all(hash_file(path.parent / output) == digest for output, digest in outputs.items())


@pytest.mark.timeout(60 + 30 * NUM_KILLS)
def test_killed_at_any_moment_and_resumed_it_ends_with_the_same_bytes(undisturbed, tmp_path):
    logs, whole, duration_s = undisturbed
    moment = random.Random(7)
    num_killed = 0
    for number in range(NUM_KILLS):
        out = tmp_path / str(number)
        # A chain of kills on one folder: each goes on where the last was stopped.
        for share in sorted(moment.uniform(0.0, 1.0) for _ in range(1 + number % 2)):
            process = start(logs, "--out", out)
            process.join(share * duration_s)
            process.kill()
            process.join()
            num_killed += process.exitcode == -9
            if out.is_dir():
                assert_nothing_is_half(out, whole)
        last = start(logs, "--out", out)
        last.join()
        assert last.exitcode == 0
        assert results_of(out) == whole and hidden_in(out) == []
    assert num_killed


def test_a_killed_run_with_workers_leaves_none_behind_and_can_be_resumed_at_once(undisturbed, tmp_path):
    logs, whole, _ = undisturbed
    out = tmp_path / "out"
    first = start(logs, "--out", out, "--workers", 1)
    while not list(out.glob("*/*")) and first.is_alive():
        time.sleep(0.02)
    first.kill()
    first.join()
    again = start(logs, "--out", out)
    again.join()
    assert (first.exitcode, again.exitcode) == (-9, 0)
    assert results_of(out) == whole and hidden_in(out) == []


def test_two_runs_on_one_folder_do_not_harm_each_other(undisturbed, tmp_path):
    logs, whole, _ = undisturbed
    both = [start(logs, "--out", tmp_path / "out") for _ in range(2)]
    for process in both:
        process.join()
    assert [process.exitcode for process in both] == [0, 0]
    assert results_of(tmp_path / "out") == whole and hidden_in(tmp_path / "out") == []


@pytest.mark.parametrize(
    ("engine", "number", "is_long"),
    [
        ("local", signal.SIGINT, False),
        ("local", signal.SIGTERM, False),
        ("ray", signal.SIGTERM, False),
        ("ray", signal.SIGINT, True),
    ],
)
def test_stopped_with_workers_it_leaves_none_and_can_be_resumed(undisturbed, tmp_path, engine, number, is_long):
    if engine == "ray":
        pytest.importorskip("ray", reason="needs the extra ray")
    if is_long and "CADENCE_KILLS" not in os.environ:
        pytest.skip("takes long: set CADENCE_KILLS")
    logs, whole, _ = undisturbed
    out, mark = tmp_path / "out", str(tmp_path)
    with locked(out / "b"):  # while we hold it, the run cannot end by itself
        command = start_command(mark, logs, "--out", out, "--workers", 2, "--engine", engine)
        while not list(out.glob("a/*")) and command.poll() is None:
            time.sleep(0.005)
        assert len(processes_of(mark)) > 2
        begin_s = time.monotonic()
        if number == signal.SIGINT:
            os.killpg(command.pid, number)  # as a terminal does it
        else:
            command.send_signal(number)
        _, said = command.communicate(timeout=60)
    assert command.returncode == 130
    assert said == "cadence: interrupted; finished stages are kept, the same command continues after them\n"
    while processes_of(mark) and time.monotonic() < begin_s + 60:
        time.sleep(0.05)
    assert processes_of(mark) == []
    assert_nothing_is_half(out, whole)
    assert hidden_in(out) == [] or engine == "ray"  # whose workers are killed
    again = start(logs, "--out", out)
    again.join()
    assert again.exitcode == 0 and results_of(out) == whole and hidden_in(out) == []


def test_terminated_it_clears_up_and_says_how_to_go_on(undisturbed, tmp_path):
    logs, whole, _ = undisturbed
    out = tmp_path / "out"
    first = start(logs, "--out", out)
    while not list(out.glob("*/.*")) and first.is_alive():
        time.sleep(0.002)
    first.terminate()
    first.join()
    assert first.exitcode == 130 and hidden_in(out) == []
    again = start(logs, "--out", out)
    again.join()
    assert again.exitcode == 0 and results_of(out) == whole
