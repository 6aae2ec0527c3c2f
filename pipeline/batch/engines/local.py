"""Tasks on this machine: one after the other in this process, or in worker processes that may die without harm to others."""

import contextlib
import functools
import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerContext, ForkServerProcess
from types import FrameType

from cadence.errors import DeviceError
from pipeline.batch.outcome import LogOutcome, LogTask
from pipeline.batch.tasks import STAGES, RunTask, Watch
from pipeline.progress import RelayedProgress, Told

PRELOADED = ["pipeline.batch.run", "pipeline.estimators.general", *(f"pipeline.{stage}.writing" for stage in STAGES)]
"""What workers need, so that they start with it and share its memory."""

_GRACE_S = 10.0
_NUM_STARTS = 2
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def run_in_sequence(tasks: Sequence[LogTask], run: RunTask, watch: Watch) -> Generator[LogOutcome, None, None]:
    """Run the tasks one after the other in this process."""
    for task in tasks:
        yield run(task, RelayedProgress(tell=functools.partial(watch, task)))


def run_in_processes(
    tasks: Sequence[LogTask], run: RunTask, watch: Watch, num_workers: int
) -> Generator[LogOutcome, None, None]:
    """Run the tasks in `num_workers` processes, each with one thread. A task whose process dies has a failed outcome."""
    waiting = deque(tasks)
    workers: dict[Connection, _Worker] = {}
    # Forked from a process that has imported everything and runs no threads: workers start at once and share that memory.
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(PRELOADED)
    try:
        while waiting or workers:
            while waiting and len(workers) < num_workers:
                task = waiting.popleft()
                try:
                    worker = _start(context, run, task)
                except DeviceError as error:  # the results of the others must not be lost with it
                    yield LogOutcome(task, message=f"{task.log}: {error}", exit_code=error.exit_code)
                else:
                    workers[worker.connection] = worker
            for connection in wait(list(workers)) if workers else ():
                worker = workers[connection]  # type: ignore[index]
                told = worker.hear()
                if not isinstance(told, LogOutcome):
                    watch(worker.task, told)
                    continue
                is_reused = worker.process.is_alive() and bool(waiting) and worker.give(waiting[0])
                if is_reused:
                    worker.task = waiting.popleft()
                else:
                    workers.pop(worker.connection).stop()
                yield told
    finally:
        _stop_all(list(workers.values()))


@dataclass
class _Worker:
    """A process, the connection to it, and the task that it is running."""

    process: ForkServerProcess
    connection: Connection
    task: LogTask

    def hear(self) -> LogOutcome | Told:
        """What the process says next; where it died, the failed outcome of its task."""
        try:
            told: LogOutcome | Told = self.connection.recv()
        except (EOFError, OSError):
            self.process.join(_GRACE_S)
            return LogOutcome(self.task, message=self._death(), exit_code=DeviceError.exit_code)
        return told

    def give(self, task: LogTask) -> bool:
        """Send the next task; False where the process is gone."""
        try:
            self.connection.send(task)
        except OSError:
            return False
        return True

    def stop(self) -> None:
        """Close the connection, which ends an idle process, and wait for it; one that does not end is killed."""
        self.connection.close()
        self.process.join(_GRACE_S)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()

    def _death(self) -> str:
        code = self.process.exitcode
        how = f"by {signal.Signals(-code).name}" if code is not None and code < 0 else f"with exit code {code}"
        advice = "; if memory ran out, use fewer --workers" if code == -signal.SIGKILL else ""
        return f"{self.task.log}: its worker process ended {how}{advice}; run again to try it once more"


def _start(context: ForkServerContext, run: RunTask, task: LogTask) -> _Worker:
    for _ in range(_NUM_STARTS - 1):  # where the process that forks them was killed, the next call finds a new one
        with contextlib.suppress(DeviceError):
            return _start_once(context, run, task)
    return _start_once(context, run, task)


def _start_once(context: ForkServerContext, run: RunTask, task: LogTask) -> _Worker:
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(theirs, run), daemon=True)
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))  # libraries read it when they are first imported
    try:
        with _interrupts_held():
            process.start()
    except (OSError, EOFError) as error:
        reason = getattr(error, "strerror", None) or "the process that starts them ended"
        raise DeviceError(f"no worker process can be started ({reason}); use fewer --workers") from error
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})
    theirs.close()  # else its end would go unnoticed
    worker = _Worker(process, ours, task)
    worker.give(task)
    return worker


@contextlib.contextmanager
def _interrupts_held() -> Iterator[None]:
    """What is started meanwhile never hears Ctrl-C, which reaches every process of a terminal; we hear it all the same."""
    resource_tracker.ensure_running()  # where it starts, it lets interrupts through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _stop_all(workers: Sequence[_Worker]) -> None:
    """Ask all to stop, so that they clear up, and then wait."""
    for worker in workers:
        worker.process.terminate()
    for worker in workers:
        worker.stop()


def _work(connection: Connection, run: RunTask) -> None:
    """The life of a worker: tasks until the connection is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of the terminal's processes the parent decides what Ctrl-C means
    signal.signal(signal.SIGTERM, _leave)
    threading.Thread(target=_leave_with_parent, daemon=True).start()
    progress = RelayedProgress(tell=connection.send)
    try:
        while True:
            task: LogTask = connection.recv()
            connection.send(run(task, progress))
    except (EOFError, OSError):  # nobody listens any more
        return


def _leave(number: int, frame: FrameType | None) -> None:
    """Unwind, so that temporary folders are cleared away."""
    raise SystemExit(128 + number)


def _leave_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)
