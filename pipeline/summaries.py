"""Results as text for people and as JSON for programs."""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from pipeline.manifest import StageResult

if TYPE_CHECKING:
    from pipeline.run import LogResult

SHOWN_STAGES = ("export", "report")
"""Whose files a person wants to open; the others are intermediate."""


def to_json(value: Any) -> str:
    """Indented JSON; dataclasses become objects, paths strings."""
    return json.dumps(value, indent=2, ensure_ascii=False, default=_jsonable)


def stage_summary(result: StageResult) -> str:
    """What was done in one line, its counts and numbers in the next, then the files."""
    numbers = [_named(name, value) for name, value in result.summary.items() if type(value) in (int, float) and value]
    lines = [f"{result.stage}: {result.status}", *([f"  {', '.join(numbers)}"] if numbers else [])]
    lines += score_lines(result.summary.get("scores", ()))
    return "\n".join(lines + [f"  {path}" for path in result.outputs])


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


def log_record(result: "LogResult") -> dict[str, Any]:
    """The result of one log of `cadence run` for `--json`."""
    error = None if result.error is None else {"message": str(result.error), "exit_code": result.error.exit_code}
    return {"log": str(result.log), "directory": str(result.directory), "stages": result.stages, "error": error}


def log_summary(results: Sequence["LogResult"]) -> str:
    """One line for each log, and below it what was lost of a damaged one, and the files to look at."""
    lines = []
    for result in results:
        lines.append(f"{result.log}: {'ok' if result.error is None else 'failed'}")
        lines += [f"  damaged: {problem}" for stage in result.stages for problem in stage.summary.get("problems", ())]
        lines += [f"  {path}" for stage in result.stages if stage.stage in SHOWN_STAGES for path in stage.outputs]
    return "\n".join(lines)


def _named(name: str, value: float) -> str:
    return f"{name.removeprefix('num_').replace('_', ' ')} {round(value, 3) if isinstance(value, float) else value}"


def _jsonable(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    return dict(value) if isinstance(value, Mapping) else str(value)
