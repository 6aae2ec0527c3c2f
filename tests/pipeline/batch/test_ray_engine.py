"""Tasks on a real Ray of two workers: the same bytes as here, whoever dies; nothing on stdout; nothing left behind."""

import os
import signal
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from fixtures.line_logs import straight_line, write_log

from cadence.errors import ConfigError, DeviceError
from pipeline.batch.config import RunConfig
from pipeline.batch.engines import ray as module
from pipeline.batch.engines.local import run_in_sequence
from pipeline.batch.engines.ray import NUM_ATTEMPTS, run_on_ray
from pipeline.batch.outcome import LogOutcome, LogTask
from pipeline.batch.tasks import plan_tasks, run_task, run_tasks
from pipeline.config import stage_config

pytestmark = pytest.mark.timeout(600)  # Ray takes seconds to start, and many where the machine is busy
CONFIG = stage_config(
    RunConfig,
    None,
    None,
    [
        "infer.checkpoint=none",
        "infer.num_hypotheses=3",
        "infer.grid.stride_steps=16",
        "infer.grid.history_steps=16",
        "infer.grid.horizon_steps=8",
    ],
)


@pytest.fixture(scope="module")
def cluster():
    """One Ray for all tests."""
    pytest.importorskip("ray", reason="needs the extra ray")
    ray = module._ray()
    with pytest.MonkeyPatch.context() as patch:
        folders = [Path(__file__).parents[level] for level in (0, 2, 3)]  # of this module, of fixtures, of the packages
        patch.setenv("PYTHONPATH", os.pathsep.join(map(str, folders)))  # workers import this module for its tasks
        with module._connected(ray, 2):
            yield ray


def die_first(task, progress):
    """The first process that is given the second task is killed in the middle of it."""
    progress.note(f"{task.name} in {os.getpid()}")
    mark = Path(task.directory).parent / ".died"
    if task.name == "log1" and not mark.exists():
        mark.touch()
        run_task(task, progress)
        (Path(task.directory) / "hypotheses.parquet").unlink()  # as if it had not come so far
        os.kill(os.getpid(), signal.SIGKILL)
    return run_task(task, progress)


def die_always(task, progress):
    if task.name == "log1":
        os.kill(os.getpid(), signal.SIGKILL)
    return LogOutcome(task, message=f"by {os.getpid()}", exit_code=3)


def sleep_long(task, progress):
    progress.note(str(os.getpid()))
    time.sleep(500)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file() and p.name != ".died"}


def bare_tasks(out: Path, num_tasks: int) -> list[LogTask]:
    return [LogTask(i, (f"log{i}.mcap",), str(out / f"log{i}"), 0, CONFIG) for i in range(num_tasks)]


def test_the_same_bytes_as_here_though_a_worker_is_killed(cluster, tmp_path, capfd):
    (tmp_path / "logs").mkdir()
    logs = [str(write_log(tmp_path / "logs" / f"log{i}.mcap", straight_line(6 + i))) for i in range(4)]
    heard = []
    outcomes = run_tasks(
        plan_tasks(logs, str(tmp_path / "there"), CONFIG),
        lambda tasks, run, watch: run_on_ray(tasks, run, watch, 2),
        lambda outcome: None,
        lambda task, told: heard.append((task.name, told)),
        die_first,
    )
    assert [(outcome.task.name, outcome.message) for outcome in outcomes] == [(f"log{i}", "") for i in range(4)]
    (died,) = [told for _, told in heard if isinstance(told, str) and "worker died" in told]
    assert "ActorDiedError" in died and "started again by another" in died
    workers = {told.split()[-1] for _, told in heard if isinstance(told, str) and " in " in told and told.startswith("log")}
    assert 2 <= len(workers) <= 3  # two, and one for the one that died: processes are used again
    assert any(isinstance(told, float) for _, told in heard)
    run_tasks(plan_tasks(logs, str(tmp_path / "here"), CONFIG), run_in_sequence, lambda o: None, lambda t, told: None)
    there = contents(tmp_path / "there")
    assert there == contents(tmp_path / "here") and len(there) > 4 * 10
    assert capfd.readouterr() == ("", "")


def test_a_task_that_kills_its_workers_fails_alone(cluster, tmp_path):
    heard = []
    outcomes = {o.task.name: o for o in run_on_ray(bare_tasks(tmp_path, 3), die_always, lambda t, told: heard.append(told), 2)}
    assert outcomes["log1"].exit_code == 5 and f"log1.mcap: {NUM_ATTEMPTS} workers died of it" in outcomes["log1"].message
    assert "\n" not in outcomes["log1"].message
    assert {outcomes[name].exit_code for name in ("log0", "log2")} == {3}
    assert sum("worker died" in str(told) for told in heard) == NUM_ATTEMPTS - 1


def test_stopping_early_ends_the_workers(cluster, tmp_path):
    pids = []

    def stop(task, told):
        pids.append(int(told))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        list(run_on_ray(bare_tasks(tmp_path, 2), sleep_long, stop, 2))
    until_s = time.monotonic() + 60
    while is_alive(pids[0]) and time.monotonic() < until_s:
        time.sleep(0.1)
    assert not is_alive(pids[0])
    assert not list(tmp_path.glob(".cadence-*"))


def is_alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_folders_that_a_machine_does_not_see(cluster, tmp_path, monkeypatch):
    monkeypatch.setattr(Path, "touch", lambda path: None)  # what was written here is not seen there
    with pytest.raises(DeviceError, match=r"does not see it; put it on storage that all share, or .*s3://") as failure:
        list(run_on_ray(bare_tasks(tmp_path, 1), die_always, lambda task, told: None, 1))
    assert str(tmp_path) in str(failure.value)


class FakeRay:
    """A cluster that only has to be counted."""

    def __init__(self, **resources):
        self.resources = resources

    def cluster_resources(self):
        return self.resources


def test_sigterm_while_ray_starts_is_an_interruption(monkeypatch):
    def ends(**options):
        raise SystemExit(signal.SIGTERM)

    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    fake = SimpleNamespace(is_initialized=lambda: False, init=ends)
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt), module._connected(fake, 2):
        pytest.fail("it was not connected")
    assert signal.getsignal(signal.SIGTERM) == before


@pytest.mark.parametrize(
    ("resources", "num_workers", "settings", "expected"),
    [
        ({"CPU": 8.0}, None, [], 0),
        ({"CPU": 8.0, "GPU": 2.0}, None, [], 0.25),
        ({"CPU": 8.0, "GPU": 1.0}, 3, [], 0.33),
        ({"CPU": 8.0, "GPU": 8.0}, 2, [], 1.0),
        ({"CPU": 8.0, "GPU": 2.0}, None, ["infer.device=cpu"], 0),
    ],
)
def test_workers_share_the_gpus(resources, num_workers, settings, expected):
    config = stage_config(RunConfig, None, None, settings)
    tasks = [LogTask(i, (f"{i}.mcap",), f"out/{i}", 0, config) for i in range(20)]
    assert module._resources(FakeRay(**resources), tasks, num_workers) == {"num_cpus": 1, "num_gpus": expected}


def test_without_ray(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ConfigError, match=r"Ray is not installed; pip install cadence\[ray\]"):
        list(run_on_ray(bare_tasks(tmp_path, 1), run_task, lambda task, told: None, 1))
