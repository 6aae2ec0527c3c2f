"""Tasks on a Ray cluster, or on a Ray of this machine: workers are actors that may die; their task is then run by another."""

import contextlib
import io
import logging
import os
import queue
import signal
import threading
from collections import deque
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from cadence.errors import ConfigError, DeviceError
from pipeline.batch.outcome import LogOutcome, LogTask
from pipeline.batch.tasks import RunTask, Watch
from pipeline.progress import RelayedProgress, Told
from pipeline.stores.urls import is_url

NUM_ATTEMPTS: Final = 3
"""How many workers a task may cost before it counts as failed."""

_REASON_LENGTH: Final = 120
_CANNOT_START: Final = "error raised in its creation task"  # as Ray says it; there is no kind of failure for it
_SETTINGS: Final = {
    "RAY_USAGE_STATS_ENABLED": "0",  # nothing is sent to its makers
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",  # what it will do anyway in future, without saying so each time
    "RAY_DISABLE_FAILURE_SIGNAL_HANDLER": "1",  # being asked to stop is no failure
    "RAY_worker_niceness": "0",  # workers count as much as those of the local engine
}


def run_on_ray(
    tasks: Sequence[LogTask], run: RunTask, watch: Watch, num_workers: int | None = None
) -> Generator[LogOutcome, None, None]:
    """Run the tasks on the cluster at RAY_ADDRESS, else on this machine; None: a worker for each CPU of the cluster.

    A task whose worker dies is run again by another, `NUM_ATTEMPTS` times in all; then it has a failed outcome. Every worker
    takes an equal share of the GPUs that Ray reports, unless infer.device is "cpu". Raises `ConfigError` where Ray is not
    installed, `DeviceError` where the cluster does not answer or its machines do not share the folders of the results.
    """
    ray = _ray()
    # Ray writes on stdout, where our results go, how a worker died; we tell it ourselves.
    with contextlib.redirect_stdout(io.StringIO()), _connected(ray, num_workers), _tokens(tasks) as tokens:
        crew = _Crew(ray, run, tokens, _resources(ray, tasks, num_workers))
        try:
            yield from _run(ray, crew, tasks, watch, _num_workers(ray, tasks, num_workers))
        finally:
            crew.stop()


def _run(ray: Any, crew: "_Crew", tasks: Sequence[LogTask], watch: Watch, limit: int) -> Generator[LogOutcome, None, None]:
    waiting = deque((task, 1) for task in tasks)
    busy: dict[Any, _Job] = {}  # by the stream of what the worker tells
    while waiting or busy:
        while waiting and len(busy) < limit:
            job = crew.start(*waiting.popleft())
            busy[job.told] = job
        for stream in ray.wait(list(busy), num_returns=1, fetch_local=False)[0]:
            job = busy[stream]
            try:
                told: LogOutcome | Told | _Unseen = ray.get(next(stream))
            except ray.exceptions.RayTaskError:
                raise  # a defect: a task keeps its failures in its outcome
            except (ray.exceptions.RayError, StopIteration) as error:
                if _CANNOT_START in str(error):
                    raise DeviceError(
                        f"--engine ray: workers cannot start ({_reason(error)}); "
                        "install the same versions of CADENCE and its libraries on every machine"
                    ) from error
                del busy[stream]
                crew.lose(job)
                if job.attempt < NUM_ATTEMPTS:
                    watch(job.task, f"worker died ({_reason(error)}); started again by another")
                    waiting.appendleft((job.task, job.attempt + 1))
                else:
                    yield _given_up(job.task, error)
                continue
            if isinstance(told, _Unseen):
                raise DeviceError(
                    f"{told.folder}: a machine of the cluster ({told.node}) does not see it; "
                    "put it on storage that all share, or write to a bucket (--out s3://...)"
                )
            if isinstance(told, LogOutcome):
                del busy[stream]
                crew.rest(job)
                yield told
            else:
                watch(job.task, told)


@dataclass(frozen=True)
class _Unseen:
    """A folder of the results that a worker does not see, and its machine."""

    folder: str
    node: str


@dataclass(frozen=True, eq=False)
class _Job:
    """A task, for the how manieth time, the worker that runs it, and the stream of what it tells."""

    task: LogTask
    attempt: int
    worker: Any
    told: Any


class _Worker:
    """The process of an actor: it keeps what it has loaded, and runs one task at a time."""

    def __init__(self, run: RunTask, folder: str, tokens: Sequence[str]) -> None:
        with contextlib.suppress(OSError):  # for relative paths; where it matters, the tokens tell
            os.chdir(folder)
        self._run, self._tokens = run, tokens

    def work(self, task: LogTask) -> Iterator[LogOutcome | Told | _Unseen]:
        """What the task tells while it runs, and its outcome last."""
        for token in self._tokens:
            if not Path(token).is_file():
                yield _Unseen(str(Path(token).parent), os.uname().nodename)
                return
        told: queue.SimpleQueue[LogOutcome | Told | Exception] = queue.SimpleQueue()
        threading.Thread(target=self._tell, args=(task, told), daemon=True).start()
        while True:
            item = told.get()
            if isinstance(item, Exception):
                raise item
            yield item
            if isinstance(item, LogOutcome):
                return

    def _tell(self, task: LogTask, told: "queue.SimpleQueue[LogOutcome | Told | Exception]") -> None:
        try:
            told.put(self._run(task, RelayedProgress(tell=told.put)))
        except Exception as error:  # else nobody would hear of it
            told.put(error)


class _Crew:
    """The actors: those that work, and those that rest with their models loaded."""

    def __init__(self, ray: Any, run: RunTask, tokens: Sequence[str], resources: dict[str, float]) -> None:
        self._ray, self._arguments = ray, (run, str(Path.cwd()), tokens)
        self._actor = ray.remote(_Worker).options(max_restarts=0, **resources)
        self._resting: list[Any] = []
        self._all: list[Any] = []

    def start(self, task: LogTask, attempt: int) -> _Job:
        """Give the task to a worker that rests, or to a new one."""
        if not self._resting:
            self._resting.append(self._actor.remote(*self._arguments))
            self._all.append(self._resting[-1])
        worker = self._resting.pop()
        return _Job(task, attempt, worker, worker.work.options(num_returns="streaming").remote(task))

    def rest(self, job: _Job) -> None:
        """The worker may have the next task."""
        self._resting.append(job.worker)

    def lose(self, job: _Job) -> None:
        """The worker is of no use any more."""
        self._all.remove(job.worker)
        self._ray.kill(job.worker)

    def stop(self) -> None:
        """End all workers, whatever they are doing."""
        for worker in self._all:
            self._ray.kill(worker)


def _given_up(task: LogTask, error: Exception) -> LogOutcome:
    advice = "it may need more memory than there is: use fewer --workers, or larger machines"
    message = f"{task.log}: {NUM_ATTEMPTS} workers died of it ({_reason(error)}); {advice}"
    return LogOutcome(task, message=message, exit_code=DeviceError.exit_code)


def _reason(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[-1].strip()[:_REASON_LENGTH]}" if lines else type(error).__name__


def _ray() -> Any:
    # Before Ray is imported, which reads them.
    for name, value in _SETTINGS.items():
        os.environ.setdefault(name, value)
    try:
        import ray
        import ray.exceptions
    except ImportError as error:
        raise ConfigError("--engine ray: Ray is not installed; pip install cadence[ray]") from error
    return ray


@contextlib.contextmanager
def _connected(ray: Any, num_workers: int | None) -> Iterator[None]:
    """Be connected to a cluster; what was not there before is ended afterwards."""
    if ray.is_initialized():
        yield
        return
    address = os.environ.get("RAY_ADDRESS")
    local = {} if address else {"num_cpus": num_workers, "include_dashboard": False}
    # Ray would end this process at once on SIGTERM; ours lets the work be cleared away.
    before = signal.getsignal(signal.SIGTERM)
    try:
        ray.init(address=address or "local", log_to_driver=False, logging_level=logging.ERROR, **local)
    except SystemExit as error:  # its own way to end on SIGTERM, while it starts
        raise KeyboardInterrupt from error
    except (ConnectionError, RuntimeError, ValueError, TimeoutError) as error:
        where = f"RAY_ADDRESS={address}" if address else "--engine ray"
        raise DeviceError(f"{where}: no Ray can be reached or started ({_reason(error)}); see `ray status`") from error
    finally:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, before)
    try:
        yield
    finally:
        ray.shutdown()


def _num_workers(ray: Any, tasks: Sequence[LogTask], num_workers: int | None) -> int:
    wanted = num_workers or int(ray.cluster_resources().get("CPU", 1))
    return max(1, min(wanted, len(tasks)))


def _resources(ray: Any, tasks: Sequence[LogTask], num_workers: int | None) -> dict[str, float]:
    """What every worker takes: a CPU, and its share of the GPUs where there are some and the tasks may use them."""
    gpus = ray.cluster_resources().get("GPU", 0.0)
    is_used = gpus > 0 and any(task.config.infer.device != "cpu" for task in tasks)
    share = min(1.0, int(100 * gpus / _num_workers(ray, tasks, num_workers)) / 100) if is_used else 0.0
    return {"num_cpus": 1, "num_gpus": max(share, 0.01) if is_used else 0}


@contextlib.contextmanager
def _tokens(tasks: Sequence[LogTask]) -> Iterator[list[str]]:
    """A hidden file in every folder that holds mission directories: a worker that does not find it is elsewhere."""
    folders = dict.fromkeys(Path(task.directory).absolute().parent for task in tasks if not is_url(task.directory))
    tokens = [folder / f".cadence-{os.getpid()}" for folder in folders]
    try:
        for token in tokens:
            token.parent.mkdir(parents=True, exist_ok=True)
            token.touch()
    except OSError as error:
        raise DeviceError(f"{token.parent}: cannot write there ({error.strerror}); choose another folder with --out") from error
    try:
        yield [str(token) for token in tokens]
    finally:
        for token in tokens:
            token.unlink(missing_ok=True)
