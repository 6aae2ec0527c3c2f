"""Results as text for people and as JSON for programs."""

import dataclasses
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, get_args

from cadence.errors import ImplausibleInputError, PartialInputError
from pipeline.batch.outcome import LogOutcome, Status
from pipeline.extract.plausibility import few, suspicions_in
from pipeline.manifest import StageResult
from pipeline.stores.urls import shown

SHOWN_STAGES = ("export", "report")
"""Whose files a person wants to open; the others are intermediate."""

MAX_LOGS_WITH_FILES = 3
"""With more logs than this the files of each are not listed."""

BATCH_VERSION = 1
"""Version of batch.json."""


def to_json(value: Any) -> str:
    """Indented JSON; dataclasses become objects, paths strings."""
    return json.dumps(value, indent=2, ensure_ascii=False, default=_jsonable)


def stage_summary(result: StageResult) -> str:
    """What was done in one line, its counts and numbers in the next, then the files."""
    numbers = [_named(name, value) for name, value in result.summary.items() if type(value) in (int, float) and value]
    lines = [f"{result.stage}: {result.status}", *([f"  {', '.join(numbers)}"] if numbers else [])]
    lines += score_lines(result.summary.get("scores", ()))
    lines += [f"  suspected {line}" for line in few(suspicions_in(result.summary))]
    return "\n".join(lines + [f"  {path}" for path in result.outputs])


def stage_exit_code(result: StageResult) -> int:
    """Of one stage that went through: 8 where its results rest on a suspicion, 7 where they do on a damaged log, else 0."""
    if suspicions_in(result.summary):
        return ImplausibleInputError.exit_code
    return PartialInputError.exit_code if result.summary.get("is_complete") is False else 0


def score_lines(scores: Sequence[Mapping[str, Any]]) -> list[str]:
    """The headline of `cadence evaluate` as a table: a row an estimator, a column a part and metric."""
    columns = list(dict.fromkeys((str(score["part"]), str(score["metric"])) for score in scores))
    values = {(score["estimator"], score["part"], score["metric"]): score["value"] for score in scores}
    rows = [["", *(f"{part} {metric}" for part, metric in columns)]]
    for estimator in dict.fromkeys(score["estimator"] for score in scores):
        cells = [values.get((estimator, *column)) for column in columns]
        rows.append([str(estimator), *("-" if cell is None else f"{cell:.4g}" for cell in cells)])
    widths = [max(len(row[i]) for row in rows) for i in range(len(columns) + 1)]
    return ["  " + "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in rows if scores]


def log_record(outcome: LogOutcome) -> dict[str, Any]:
    """The outcome of one log of `cadence run` for programs."""
    error = {"message": outcome.message, "exit_code": outcome.exit_code} if outcome.exit_code else None
    task = outcome.task
    return {
        "log": task.log, "parts": tuple(map(shown, task.parts)), "directory": shown(task.directory),
        "status": outcome.status, "message": outcome.message, "error": error, "size_bytes": task.size_bytes,
        "elapsed_s": round(outcome.elapsed_s, 3), "stages": outcome.stages,
    }  # fmt: skip


def batch_record(outcomes: Sequence[LogOutcome], exit_code: int, elapsed_s: float) -> dict[str, Any]:
    """A batch for programs: batch.json."""
    counts = Counter(outcome.status for outcome in outcomes)
    return {
        "version": BATCH_VERSION,
        "exit_code": exit_code,
        "elapsed_s": round(elapsed_s, 3),
        "num_logs": len(outcomes),
        **{f"num_{status.replace(' ', '_')}": counts[status] for status in get_args(Status)},
        "logs": [log_record(outcome) for outcome in outcomes],
    }


def batch_summary(outcomes: Sequence[LogOutcome]) -> str:
    """A table with a row a log, what was lost and what is suspected, and the files to look at where they are few."""
    numbers = ("num_windows", "num_agents", "num_detections")
    rows = [("log", "status", "windows", "agents", "detections", "time", "")]
    lines = []
    for outcome in outcomes:
        # what infer says of agents and windows goes before what other stages count under the same name
        stages = sorted(outcome.stages, key=lambda stage: stage.stage == "infer")
        summary = {name: value for stage in stages for name, value in stage.summary.items()}
        windows, agents, detections = (str(summary.get(name, "-")) for name in numbers)
        elapsed = f"{outcome.elapsed_s:.1f} s"
        rows.append((outcome.task.name, outcome.status, windows, agents, detections, elapsed, outcome.message))
        for stage in outcome.stages:
            lines += [f"{outcome.task.name}: damaged: {problem}" for problem in stage.summary.get("problems", ())]
            lines += [f"{outcome.task.name}: suspected {line}" for line in few(suspicions_in(stage.summary))]
            if stage.stage in SHOWN_STAGES and len(outcomes) <= MAX_LOGS_WITH_FILES:
                lines += [f"  {path}" for path in stage.outputs]
    return "\n".join([*_table(rows), *lines])


def _table(rows: Sequence[Sequence[str]]) -> list[str]:
    """Columns beside each other: the first two to the left, numbers to the right, the last as long as it is."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]) - 1)]
    aligned = (
        [cell.ljust(width) if i < 2 else cell.rjust(width) for i, (cell, width) in enumerate(zip(row, widths, strict=False))]
        for row in rows
    )
    return ["  ".join([*cells, row[-1]]).rstrip() for cells, row in zip(aligned, rows, strict=True)]


def _named(name: str, value: float) -> str:
    return f"{name.removeprefix('num_').replace('_', ' ')} {round(value, 3) if isinstance(value, float) else value}"


def _jsonable(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    return dict(value) if isinstance(value, Mapping) else str(value)
