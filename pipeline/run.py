"""All stages for many logs: one bad log never stops the others, and what is done already is skipped."""

import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from cadence.errors import CadenceError
from pipeline.export import ExportConfig, export
from pipeline.extract import ExtractConfig, extract
from pipeline.infer import InferConfig, infer
from pipeline.ingest import IngestConfig, ingest
from pipeline.manifest import StageResult
from pipeline.missions import mission_directories
from pipeline.progress import Progress
from pipeline.report import ReportConfig, report


@dataclass(frozen=True)
class RunConfig:
    """The configuration of every stage of `cadence run`: the tables [ingest], [extract], [infer], [export], [report]."""

    ingest: IngestConfig = field(default_factory=IngestConfig)
    extract: ExtractConfig = field(default_factory=ExtractConfig)
    infer: InferConfig = field(default_factory=InferConfig)
    export: ExportConfig = field(default_factory=ExportConfig)
    report: ReportConfig = field(default_factory=ReportConfig)


@dataclass(frozen=True)
class LogResult:
    """What became of one log: the stages that finished and, where one did not, why.

    directory  its mission directory
    stages     results in the order of the pipeline, up to the first failure
    error      the failure; `exit_code` 1 marks a defect of this program, whose traceback has been shown
    """

    log: Path
    directory: Path
    stages: tuple[StageResult, ...]
    error: CadenceError | None = None


def run(logs: Sequence[Path], out: Path, config: RunConfig, progress: Progress, force: bool = False) -> tuple[LogResult, ...]:
    """Ingest, extract, infer, export and report every log into its own mission directory under `out`.

    Failures stay with their log. `UsageError` where there is no log at all.
    """
    directories = mission_directories(logs, out)
    results = []
    for number, (log, directory) in enumerate(directories.items(), start=1):
        progress.note(f"[{number}/{len(directories)}] {log} -> {directory}")
        result = _run_log(log, directory, config, progress, force)
        results.append(result)
    return tuple(results)


def exit_code(results: Sequence[LogResult]) -> int:
    """0 where every log went through, else the highest code of the failures."""
    return max((result.error.exit_code for result in results if result.error is not None), default=0)


def _run_log(log: Path, directory: Path, config: RunConfig, progress: Progress, force: bool) -> LogResult:
    steps: tuple[tuple[str, Callable[[], StageResult]], ...] = (
        ("ingest", lambda: ingest(log, directory, config.ingest, progress, force)),
        ("extract", lambda: extract(directory, config.extract, progress, force)),
        ("infer", lambda: infer(directory, config.infer, progress, force)),
        ("export", lambda: export(directory, config.export, progress, force)),
        ("report", lambda: report(directory, config.report, progress, force)),
    )
    finished: list[StageResult] = []
    for name, step in steps:
        try:
            finished.append(step())
        except CadenceError as error:
            return LogResult(log, directory, tuple(finished), error)
        except Exception as error:  # a defect met by one log of a long batch must not cost the results of the others
            progress.warn(traceback.format_exc())
            defect = CadenceError(
                f"{log}: defect in {name} ({type(error).__name__}: {error}); please report the traceback above"
            )
            return LogResult(log, directory, tuple(finished), defect)
        progress.note(f"  {name}: {finished[-1].status}")
    return LogResult(log, directory, tuple(finished))
