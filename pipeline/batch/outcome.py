"""What a batch consists of and what becomes of it: tasks, outcomes that can be sent between machines, and the exit code."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from cadence.errors import CadenceError, ImplausibleInputError, NothingDetectedError, PartialInputError
from pipeline.manifest import StageResult
from pipeline.stores.urls import shown
from pipeline.suspicions import suspicions_in

if TYPE_CHECKING:  # the configurations of the stages bring torch with them, and the command line shows outcomes
    from pipeline.batch.config import RunConfig

Status = Literal["done", "skipped", "partial", "doubtful", "nothing detected", "failed"]
"""What became of a log; batch.json counts each."""


@dataclass(frozen=True)
class LogTask:
    """One mission to be run.

    index       its place in the order of the user
    parts       its log, or the parts of a split one in the order of the recording: paths or URLs
    directory   its mission directory: path or URL
    size_bytes  of all parts; 0 where unknown
    num_threads  in which its windows are drawn; it changes no result
    """

    index: int
    parts: tuple[str, ...]
    directory: str
    size_bytes: int
    config: "RunConfig"
    force: bool = False
    num_threads: int = 1

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
        if is_damaged(self.stages):
            return "partial"
        return "skipped" if all(stage.status == "skipped" for stage in self.stages) else "done"

    @property
    def suspicions(self) -> tuple[str, ...]:
        """What in the log cannot be meant as it stands, a sentence each."""
        return tuple(line for stage in self.stages for line in suspicions_in(stage.summary))


def exit_code(outcomes: Sequence[LogOutcome], unwritten: Sequence[CadenceError] = ()) -> int:
    """The highest code of the failures; without any 8 where something is suspected, else 7 where a log is damaged.

    3 where nothing was detected in any; else 0. Suspicion counts more than damage: a gap is seen as a gap, a wrong place is
    believed. That a report could not be written (`unwritten`) is a failure, too.
    """
    failures = [outcome.exit_code for outcome in outcomes if outcome.exit_code] + [error.exit_code for error in unwritten]
    if failures:
        return max(failures)
    if any(outcome.status == "doubtful" for outcome in outcomes):
        return ImplausibleInputError.exit_code
    if any(outcome.status == "partial" for outcome in outcomes):
        return PartialInputError.exit_code
    return NothingDetectedError.exit_code if _is_nothing_detected(outcomes) else 0


def complaints(outcomes: Sequence[LogOutcome]) -> list[str]:
    """A line for each failure; that nothing was detected in a log is one only where nothing was detected in any."""
    return [outcome.message for outcome in outcomes if outcome.exit_code or _is_nothing_detected(outcomes)]


def is_damaged(stages: Iterable[StageResult]) -> bool:
    """Whether one of the stages worked on a log of which a part is lost."""
    return any(stage.summary.get("is_complete") is False for stage in stages)


def _is_nothing_detected(outcomes: Sequence[LogOutcome]) -> bool:
    return bool(outcomes) and all(outcome.status == "nothing detected" for outcome in outcomes)
