"""Worker processes of this machine that do not do what they are told to."""

import multiprocessing.forkserver
import os
import signal
import time
from multiprocessing.context import ForkServerProcess

import pytest

from cadence.errors import DeviceError
from pipeline.batch.engines import local
from pipeline.batch.engines.local import run_in_processes
from pipeline.batch.tasks import LogOutcome, LogTask, RunConfig

pytestmark = pytest.mark.timeout(300)  # on a busy machine the first process takes long to import everything


def bare_tasks(num_tasks):
    return [LogTask(i, (f"log{i}.mcap",), f"out/log{i}", 0, RunConfig()) for i in range(num_tasks)]


def die_after_first_task(task, progress):
    """All but the first kill the process that runs them."""
    if task.index == 0:
        return LogOutcome(task)
    os.kill(os.getpid(), signal.SIGKILL)


def sleep_on(task, progress):
    """Deaf to SIGTERM."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    progress.note(str(os.getpid()))
    time.sleep(500)


def test_a_task_whose_process_dies_has_a_failed_outcome_and_the_rest_go_on():
    outcomes = list(run_in_processes(bare_tasks(3), die_after_first_task, lambda task, told: None, 1))
    assert [outcome.exit_code for outcome in outcomes] == [0, DeviceError.exit_code, DeviceError.exit_code]
    assert "log1.mcap: its worker process ended by SIGKILL; if memory ran out, use fewer --workers" in outcomes[1].message


def test_a_worker_that_is_gone_is_not_given_the_next_task(monkeypatch):
    """Its death is noticed when the task is sent; another worker runs it."""
    given = []

    def gone_at_first(worker, task):
        given.append(task.index)
        if given.count(task.index) == 1 and task.index == 1:
            worker.process.kill()
            worker.process.join()
        return send(worker, task)

    send = local._Worker.give
    monkeypatch.setattr(local._Worker, "give", gone_at_first)
    outcomes = list(run_in_processes(bare_tasks(2), succeed, lambda task, told: None, 1))
    assert [outcome.exit_code for outcome in outcomes] == [0, 0] and given == [0, 1, 1]


def succeed(task, progress):
    return LogOutcome(task)


def test_a_worker_that_does_not_end_is_killed(monkeypatch):
    monkeypatch.setattr(local, "_GRACE_S", 0.2)
    pids = []

    def stop(task, told):
        pids.append(int(told))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        list(run_in_processes(bare_tasks(1), sleep_on, stop, 1))
    with pytest.raises(ProcessLookupError):
        os.kill(pids[0], 0)


def test_a_task_for_which_no_process_can_be_started_is_a_failure_of_its_own(monkeypatch):
    def refuse(process):
        raise OSError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(ForkServerProcess, "start", refuse)
    before = dict(os.environ)
    outcomes = list(run_in_processes(bare_tasks(2), succeed, lambda task, told: None, 2))
    says = "no worker process can be started (Resource temporarily unavailable); use fewer --workers"
    assert [outcome.message for outcome in outcomes] == [f"log0.mcap: {says}", f"log1.mcap: {says}"]
    assert [outcome.exit_code for outcome in outcomes] == [DeviceError.exit_code] * 2
    assert dict(os.environ) == before


def test_a_killed_process_that_forks_workers_costs_no_log():
    server = multiprocessing.forkserver._forkserver
    outcomes = []
    for outcome in run_in_processes(bare_tasks(3), succeed, lambda task, told: None, 1):
        outcomes.append(outcome)
        if len(outcomes) == 1:
            os.kill(server._forkserver_pid, signal.SIGKILL)
    assert [outcome.exit_code for outcome in outcomes] == [0, 0, 0]


def tell_blocked_signals(task, progress):
    return LogOutcome(task, message=",".join(number.name for number in signal.pthread_sigmask(signal.SIG_BLOCK, [])))


def test_workers_never_hear_an_interrupt_and_we_do():
    """Not even one that comes while they and the process that forks them are only starting."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # where tests run in the background it may be ignored
    multiprocessing.forkserver._forkserver._stop()  # others may have started it
    (outcome,) = run_in_processes(bare_tasks(1), tell_blocked_signals, lambda task, told: None, 1)
    assert "SIGINT" in outcome.message.split(",")
    with pytest.raises(KeyboardInterrupt), local._interrupts_held():
        os.kill(os.getpid(), signal.SIGINT)
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, [])
