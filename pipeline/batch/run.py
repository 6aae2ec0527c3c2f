"""`cadence run`: plan a batch, run it, report it. One bad log never stops the others, and what is done already is skipped."""

import contextlib
import json
import os
import signal
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Literal

from tqdm import tqdm

from cadence.errors import CadenceError, DeviceError, UsageError
from pipeline.batch.config import RunConfig
from pipeline.batch.engines.local import run_in_processes, run_in_sequence
from pipeline.batch.engines.ray import run_on_ray
from pipeline.batch.outcome import LogOutcome, LogTask, exit_code
from pipeline.batch.remote import SOURCE_NAME, run_anywhere, write_text
from pipeline.batch.summaries import batch_record, to_json
from pipeline.batch.tasks import STAGES, Engine, plan_tasks, run_tasks
from pipeline.catalogue import Catalogue, read_catalogue
from pipeline.files import hash_file
from pipeline.manifest import manifest_path
from pipeline.missions import CATALOGUE_NAME, REPORT_NAME
from pipeline.progress import Doing, Progress, Told
from pipeline.stores.urls import is_url
from pipeline.threads import num_cores

_WORKER_BYTES = 2_000_000_000
_MEMINFO = Path("/proc/meminfo")
_LEAST_SHARE = 0.1
"""Of the work, that must be done for the time it took to say how long the rest takes."""

EngineName = Literal["local", "ray"]


def run(
    logs: Sequence[str], out: str, config: RunConfig, progress: Progress, force: bool = False,
    engine: EngineName = "local", num_workers: int | None = None, report: Path | str | None = None,
    on_unwritten: Callable[[CadenceError], object] | None = None,
) -> tuple[LogOutcome, ...]:  # fmt: skip
    """Run all stages on every mission among `logs`, each in its own mission directory under `out`; outcomes in their order.

    Writes `out`/batch.json, and the same to `report`; `on_unwritten` hears of one that cannot be written, so that the
    outcomes are not lost with it (without it, that is raised). `num_workers`: cores to use, as processes for several logs and
    as threads inside one; 0: this process and one thread; None chooses. It changes no byte of the results.
    Raises `UsageError` or `InputError` where there is no log at all, `DeviceError` where nothing can be written to `out`.
    """
    started_s = time.monotonic()
    out = out.removeprefix("file://").rstrip("/") or "/"
    tasks = plan_tasks(logs, out, config, force)
    _make_folder(out)
    chosen = choose_engine(engine, len(tasks), num_workers)
    tasks = tuple(replace(task, num_threads=threads_each(engine, len(tasks), num_workers)) for task in tasks)
    if len(tasks) > 1:
        progress.note(_plan_line(tasks))
    for line in _renamed(tasks, out):
        progress.note(line)
    with _interruptible(), contextlib.closing(_Shown(tasks, progress)) as shown:
        outcomes = run_tasks(tasks, chosen, shown.finished, shown.watch, run_anywhere)
    text = to_json(batch_record(outcomes, exit_code(outcomes), time.monotonic() - started_s)) + "\n"
    _write_everywhere([f"{out}/{REPORT_NAME}", *([str(report)] if report is not None else [])], text, on_unwritten)
    return outcomes


def _make_folder(out: str) -> None:
    """What every log would fail with is said once, before any work is done."""
    if not is_url(out):
        try:
            Path(out).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise DeviceError(f"{out}: cannot write there ({error.strerror}); choose another folder with --out") from error


def _write_everywhere(places: Sequence[str], text: str, on_unwritten: Callable[[CadenceError], object] | None) -> None:
    failures = []
    for place in places:
        try:
            write_text(place, text)
        except CadenceError as error:
            failures.append(error)
    for failure in failures:
        if on_unwritten is None:
            raise failure
        on_unwritten(failure)


def selection_settings(start: str | None, end: str | None, topics: Sequence[str]) -> list[str]:
    """The flags that select a part of a log, as overrides of the settings of `extract`."""
    times = [f"extract.{name}={value}" for name, value in (("start", start), ("end", end)) if value is not None]
    return times + ([f"extract.topics={json.dumps(list(topics))}"] if topics else [])


def choose_engine(name: EngineName, num_tasks: int, num_workers: int | None) -> Engine:
    """The engine, with as many workers as there are tasks, cores and room in memory for, unless `num_workers` says it.

    Ray counts the cores of its cluster.
    """
    if num_workers is not None and num_workers < 0:
        raise UsageError(f"--workers {num_workers}: must not be negative")
    if name == "ray":
        return partial(run_on_ray, num_workers=num_workers or None)
    if num_workers is None:
        num_workers = 0 if num_tasks == 1 else max(1, min(num_cores(), _free_bytes() // _WORKER_BYTES))
    return partial(run_in_processes, num_workers=num_workers) if num_workers else run_in_sequence


def threads_each(name: EngineName, num_tasks: int, num_workers: int | None) -> int:
    """In how many threads each task draws: cores that have no task of their own (or as many more as `num_workers` says) help.

    On Ray, which counts them itself, a task has one.
    """
    if name == "ray" or num_workers == 0:
        return 1
    return max(1, (num_workers or num_cores()) // max(num_tasks, 1))


def _plan_line(tasks: Sequence[LogTask]) -> str:
    """What is ahead. Whether it is really done is found out log by log, by what is in the files."""
    size = tqdm.format_sizeof(sum(task.size_bytes for task in tasks), "B")
    num_finished = sum(manifest_path(STAGES[-1], Path(task.directory)).is_file() for task in tasks)
    return f"{len(tasks)} missions, {size}; {num_finished} were finished earlier, and are skipped where nothing has changed"


def _renamed(tasks: Sequence[LogTask], out: str) -> Iterator[str]:
    """A line for each log on disk that is new in `out`, where one of the same content was run, and is gone from its place."""
    new = [t for t in tasks if len(t.parts) == 1 and not any(map(is_url, (*t.parts, out))) and not Path(t.directory).exists()]
    gone = defaultdict[int, list[tuple[Catalogue, Path]]](list)
    for path in sorted(Path(out).glob(f"*/{CATALOGUE_NAME}")) if new else ():
        with contextlib.suppress(CadenceError):
            found = read_catalogue(path.parent)
            if found.path.parent.name != SOURCE_NAME and not found.path.exists():
                gone[found.size_bytes].append((found, path.parent))
    for task in [task for task in new if task.size_bytes in gone]:
        digest = ""
        with contextlib.suppress(CadenceError):  # a log that cannot be read says so itself, later
            digest = hash_file(Path(task.parts[0]))
        for found, directory in gone[task.size_bytes]:
            if found.sha256 == digest:
                yield f"{task.log}: is {found.path.name} renamed; it is run anew, as results bear its name; {directory} stays"


class _Shown:
    """A batch on stderr: one bar over all missions, a line for each that is finished."""

    def __init__(self, tasks: Sequence[LogTask], progress: Progress) -> None:
        self._progress, self._num_tasks, self._num_finished = progress, len(tasks), 0
        self._shares = {task.index: 0.0 for task in tasks}
        self._bar, self._begun_s = progress.percent("run"), time.monotonic()

    def watch(self, task: LogTask, told: Told) -> None:
        """A line of text, what the task is at, or how much of it is done."""
        if isinstance(told, Doing):
            if self._num_tasks == 1:
                self._bar.set_postfix_str(told)
        elif isinstance(told, str):
            self._progress.note(told if self._num_tasks == 1 else f"{task.name}: {told}")
        elif told > self._shares[task.index]:
            self._shares[task.index] = told
            # Missions count alike: the size of a log says little about the work in it.
            self._bar.n = min(sum(self._shares.values()) / self._num_tasks, 1.0)
            if self._num_tasks > 1 and self._bar.n > _LEAST_SHARE:
                left_s = (time.monotonic() - self._begun_s) * (1.0 / self._bar.n - 1.0)
                self._bar.set_postfix_str(f"about {tqdm.format_interval(left_s)} left", refresh=False)
            self._bar.refresh()

    def finished(self, outcome: LogOutcome) -> None:
        """The task is done with."""
        self.watch(outcome.task, 1.0)
        self._num_finished += 1
        if outcome.trace:
            self._progress.warn(outcome.trace)
        if self._num_tasks > 1:  # of one the table says it at once
            counted = f"[{self._num_finished}/{self._num_tasks}]"
            self._progress.note(f"{counted} {outcome.task.name}: {outcome.status} ({outcome.elapsed_s:.1f} s)")

    def close(self) -> None:
        """Take the bar away."""
        self._bar.close()


@contextlib.contextmanager
def _interruptible() -> Iterator[None]:
    """SIGTERM stops as Ctrl-C does: workers are stopped, what is half done is cleared away."""
    if threading.current_thread() is not threading.main_thread():  # only there may handlers be set
        yield
        return
    before = signal.signal(signal.SIGTERM, _interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def _free_bytes() -> int:
    """Memory that processes may still take; where the system does not tell, all there is."""
    try:
        line = next(line for line in _MEMINFO.read_text(encoding="utf-8").splitlines() if line.startswith("MemAvailable:"))
    except (OSError, StopIteration):
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return int(line.split()[1]) * 1024
