"""A batch as tasks: one mission each, that any process on any machine can run, and an outcome that can be sent back.

Where tasks run is decided by an engine (`pipeline/engines`).
"""

import contextlib
import time
import traceback
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch

from cadence.errors import CadenceError, DeviceError, ImplausibleInputError, NothingDetectedError, PartialInputError
from pipeline.batch.summaries import Status
from pipeline.export.stage import ExportConfig, export
from pipeline.extract.plausibility import suspicions_in
from pipeline.extract.stage import ExtractConfig, extract
from pipeline.infer.stage import InferConfig, infer
from pipeline.ingest.stage import IngestConfig, ingest
from pipeline.locks import locked
from pipeline.manifest import StageResult
from pipeline.missions import find_missions
from pipeline.progress import Progress, Told
from pipeline.report.stage import ReportConfig, report
from pipeline.stores.urls import shown

STAGES = ("ingest", "extract", "infer", "export", "report")


@dataclass(frozen=True)
class RunConfig:
    """The configuration of every stage of `cadence run`: the tables [ingest], [extract], [infer], [export], [report]."""

    ingest: IngestConfig = field(default_factory=IngestConfig)
    extract: ExtractConfig = field(default_factory=ExtractConfig)
    infer: InferConfig = field(default_factory=InferConfig)
    export: ExportConfig = field(default_factory=ExportConfig)
    report: ReportConfig = field(default_factory=ReportConfig)


@dataclass(frozen=True)
class LogTask:
    """One mission to be run.

    index       its place in the order of the user
    parts       its log, or the parts of a split one in the order of the recording: paths or URLs
    directory   its mission directory: path or URL
    size_bytes  of all parts; 0 where unknown
    """

    index: int
    parts: tuple[str, ...]
    directory: str
    size_bytes: int
    config: RunConfig
    force: bool = False

    @property
    def log(self) -> str:
        """Its log, or the first part of it, as it may be shown."""
        return shown(self.parts[0])

    @property
    def name(self) -> str:
        """What the mission is called: the last part of its directory."""
        return self.directory.rstrip("/").rpartition("/")[2]


@dataclass(frozen=True)
class LogOutcome:
    """What became of one log.

    stages     results in the order of the pipeline, up to the first failure
    message    why there are no results, in one line; else empty
    exit_code  of the failure: 1 marks a defect of this program, whose traceback is in `trace`; 0 where it went through, or
               nothing was detected in a log that is whole
    elapsed_s  how long it took
    """

    task: LogTask
    stages: tuple[StageResult, ...] = ()
    message: str = ""
    exit_code: int = 0
    elapsed_s: float = 0.0
    trace: str = ""

    @property
    def status(self) -> Status:
        """What became of the log.

        failed; nothing detected: no results; doubtful: they rest on a suspicion, whether or not the log is damaged as well;
        partial: they rest on a damaged log; skipped: all was done before; done.
        """
        if self.message:
            return "failed" if self.exit_code else "nothing detected"
        if self.suspicions:
            return "doubtful"
        if _is_damaged(self.stages):
            return "partial"
        return "skipped" if all(stage.status == "skipped" for stage in self.stages) else "done"

    @property
    def suspicions(self) -> tuple[str, ...]:
        """What in the log cannot be meant as it stands, a sentence each."""
        return tuple(line for stage in self.stages for line in suspicions_in(stage.summary))


RunTask = Callable[[LogTask, Progress], LogOutcome]
"""What an engine is given to run: `run_task`, or what stands in for it. It can be pickled and raises only for defects."""

Watch = Callable[[LogTask, Told], None]
"""Hears what tasks tell while they run; an engine that cannot hear its tasks need not call it."""

Engine = Callable[[Sequence[LogTask], RunTask, Watch], Generator[LogOutcome, None, None]]
"""Runs every task exactly once and gives the outcomes as they finish. A task whose worker dies has a failed outcome. Closing
the generator early stops the workers."""


def plan_tasks(logs: Sequence[str], out: str, config: RunConfig, force: bool = False) -> tuple[LogTask, ...]:
    """One task for each mission among `logs`: files, folders, patterns or URLs, in their order. See `find_missions`."""
    return tuple(
        LogTask(index, mission.parts, mission.directory, mission.size_bytes, config, force)
        for index, mission in enumerate(find_missions(logs, out))
    )


def run_task(task: LogTask, progress: Progress) -> LogOutcome:
    """Ingest, extract, infer, export and report one mission. Failures are in the outcome, also defects."""
    started_s = time.monotonic()
    finished: list[StageResult] = []
    message, code, trace = "", 0, ""
    try:
        # One thread: results depend on the number of threads, and must not depend on who else is running.
        with _threads(1), locked(Path(task.directory), progress.note):
            for number, stage in enumerate(_RUNS):
                finished.append(stage(task, progress.part(number / len(_RUNS), (number + 1) / len(_RUNS))))
    except NothingDetectedError as error:  # of a damaged log nobody knows: detections may be lost
        message, code = _naming(task, str(error)), error.exit_code * _is_damaged(finished)
    except CadenceError as error:
        message, code = _naming(task, str(error)), error.exit_code
    except MemoryError:
        message, code = f"{task.log}: out of memory; use fewer --workers", DeviceError.exit_code
    except Exception as error:  # a defect met by one log of a long batch must not cost the results of the others
        trace = traceback.format_exc()
        stage_name = STAGES[min(len(finished), len(STAGES) - 1)]
        message = f"{task.log}: defect in {stage_name} ({type(error).__name__}: {error}); please report its traceback"
        code = CadenceError.exit_code
    return LogOutcome(task, tuple(finished), " ".join(message.split()), code, time.monotonic() - started_s, trace)


def run_tasks(
    tasks: Sequence[LogTask], engine: Engine, on_outcome: Callable[[LogOutcome], None], watch: Watch, run: RunTask = run_task
) -> tuple[LogOutcome, ...]:
    """Run all tasks, the longest first, and hear of each outcome as it comes; the outcomes in the order of the tasks."""
    ordered = sorted(tasks, key=lambda task: -task.size_bytes)
    outcomes: dict[int, LogOutcome] = {}
    with contextlib.closing(engine(ordered, run, watch)) as finishing:
        for outcome in finishing:
            outcomes[outcome.task.index] = outcome
            on_outcome(outcome)
    return tuple(outcomes[task.index] for task in tasks)


def exit_code(outcomes: Sequence[LogOutcome]) -> int:
    """The highest code of the failures; without any 8 where something is suspected, else 7 where a log is damaged.

    3 where nothing was detected in any; else 0. Suspicion counts more than damage: a gap is seen as a gap, a wrong place is
    believed.
    """
    if any(outcome.exit_code for outcome in outcomes):
        return max(outcome.exit_code for outcome in outcomes)
    if any(outcome.status == "doubtful" for outcome in outcomes):
        return ImplausibleInputError.exit_code
    if any(outcome.status == "partial" for outcome in outcomes):
        return PartialInputError.exit_code
    return NothingDetectedError.exit_code if _is_nothing_detected(outcomes) else 0


def complaints(outcomes: Sequence[LogOutcome]) -> list[str]:
    """A line for each failure; that nothing was detected in a log is one only where nothing was detected in any."""
    return [outcome.message for outcome in outcomes if outcome.exit_code or _is_nothing_detected(outcomes)]


def _is_damaged(stages: Iterable[StageResult]) -> bool:
    """Whether one of the stages worked on a log of which a part is lost."""
    return any(stage.summary.get("is_complete") is False for stage in stages)


def _is_nothing_detected(outcomes: Sequence[LogOutcome]) -> bool:
    return bool(outcomes) and all(outcome.status == "nothing detected" for outcome in outcomes)


def _naming(task: LogTask, message: str) -> str:
    """The message with the log in front, where it does not say which one it is about."""
    is_named = task.directory in message or any(part.rpartition("/")[2] in message for part in task.parts)
    return message if is_named else f"{task.parts[0]}: {message}"


@contextlib.contextmanager
def _threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _ingest(task: LogTask, progress: Progress) -> StageResult:
    parts = [Path(part) for part in task.parts]
    log = parts if len(parts) > 1 else parts[0]
    return ingest(log, Path(task.directory), task.config.ingest, progress, task.force)


def _extract(task: LogTask, progress: Progress) -> StageResult:
    return extract(Path(task.directory), task.config.extract, progress, task.force)


def _infer(task: LogTask, progress: Progress) -> StageResult:
    return infer(Path(task.directory), task.config.infer, progress, task.force)


def _export(task: LogTask, progress: Progress) -> StageResult:
    return export(Path(task.directory), task.config.export, progress, task.force)


def _report(task: LogTask, progress: Progress) -> StageResult:
    return report(Path(task.directory), task.config.report, progress, task.force)


_RUNS: tuple[Callable[[LogTask, Progress], StageResult], ...] = (_ingest, _extract, _infer, _export, _report)
