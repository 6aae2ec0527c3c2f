"""A batch as tasks: one mission each, that any process on any machine can run, and an outcome that can be sent back.

Where tasks run is decided by an engine (`pipeline/batch/engines`).
"""

import contextlib
import itertools
import time
import traceback
from collections.abc import Callable, Generator, Sequence
from pathlib import Path

from cadence.errors import CadenceError, DeviceError, NothingDetectedError
from pipeline.batch.config import RunConfig
from pipeline.batch.outcome import LogOutcome, LogTask, is_damaged
from pipeline.estimators.presets import refuse_unread
from pipeline.export.stage import export
from pipeline.extract.stage import extract
from pipeline.infer.stage import infer
from pipeline.ingest.stage import ingest
from pipeline.locks import locked
from pipeline.manifest import StageResult
from pipeline.missions import find_missions
from pipeline.out_of_memory import ADVICE, is_out_of_memory
from pipeline.progress import Progress, Told
from pipeline.report.stage import report
from pipeline.retrospect.stage import retrospect

STAGES = ("ingest", "extract", "infer", "retrospect", "export", "report")
_PROGRESS = (0.0, 0.05, 0.1, 0.7, 0.85, 0.95, 1.0)
"""How much of a mission is done before and after each: most of the time goes into infer."""


RunTask = Callable[[LogTask, Progress], LogOutcome]
"""What an engine is given to run: `run_task`, or what stands in for it. It can be pickled and raises only for defects."""

Watch = Callable[[LogTask, Told], None]
"""Hears what tasks tell while they run; an engine that cannot hear its tasks need not call it."""

Engine = Callable[[Sequence[LogTask], RunTask, Watch], Generator[LogOutcome, None, None]]
"""Runs every task exactly once and gives the outcomes as they finish. A task whose worker dies has a failed outcome. Closing
the generator early stops the workers."""


def plan_tasks(logs: Sequence[str], out: str, config: RunConfig, force: bool = False) -> tuple[LogTask, ...]:
    """One task for each mission among `logs`: files, folders, patterns or URLs, in their order. See `find_missions`.

    A checkpoint that is not there, or settings that it does not read, are a `ConfigError` before the first stage begins.
    """
    refuse_unread(config.infer.checkpoint, config.infer)
    return tuple(
        LogTask(index, mission.parts, mission.directory, mission.size_bytes, config, force)
        for index, mission in enumerate(find_missions(logs, out))
    )


def run_task(task: LogTask, progress: Progress) -> LogOutcome:
    """Ingest, extract, infer, retrospect, export and report one mission. Failures are in the outcome, also defects."""
    started_s = time.monotonic()
    finished: list[StageResult] = []
    message, code, trace = "", 0, ""
    try:
        with locked(Path(task.directory), progress.note):
            for stage, (begin, end) in zip(_RUNS, itertools.pairwise(_PROGRESS), strict=True):
                finished.append(stage(task, progress.part(begin, end)))
    except NothingDetectedError as error:  # of a damaged log nobody knows: detections may be lost
        message, code = _naming(task, str(error)), error.exit_code * is_damaged(finished)
    except CadenceError as error:
        message, code = _naming(task, str(error)), error.exit_code
    except Exception as error:  # a defect met by one log of a long batch must not cost the results of the others
        if is_out_of_memory(error):
            message, code = f"{task.log}: {ADVICE}", DeviceError.exit_code
        else:
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


def _naming(task: LogTask, message: str) -> str:
    """The message with the log in front, where it does not say which one it is about."""
    is_named = task.directory in message or any(part.rpartition("/")[2] in message for part in task.parts)
    return message if is_named else f"{task.parts[0]}: {message}"


def _ingest(task: LogTask, progress: Progress) -> StageResult:
    parts = [Path(part) for part in task.parts]
    log = parts if len(parts) > 1 else parts[0]
    return ingest(log, Path(task.directory), task.config.ingest, progress, task.force)


def _extract(task: LogTask, progress: Progress) -> StageResult:
    return extract(Path(task.directory), task.config.extract, progress, task.force)


def _infer(task: LogTask, progress: Progress) -> StageResult:
    return infer(Path(task.directory), task.config.infer, progress, task.force, task.num_threads)


def _retrospect(task: LogTask, progress: Progress) -> StageResult:
    return retrospect(Path(task.directory), task.config.retrospect, progress, task.force, task.num_threads)


def _export(task: LogTask, progress: Progress) -> StageResult:
    return export(Path(task.directory), task.config.export, progress, task.force)


def _report(task: LogTask, progress: Progress) -> StageResult:
    return report(Path(task.directory), task.config.report, progress, task.force)


_RUNS: tuple[Callable[[LogTask, Progress], StageResult], ...] = (
    _ingest, _extract, _infer, _retrospect, _export, _report,
)  # fmt: skip
