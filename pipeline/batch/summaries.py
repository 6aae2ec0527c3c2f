"""Results as text for people and as JSON for programs."""

import dataclasses
import json
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from typing import Any, get_args

from cadence.errors import ImplausibleInputError, PartialInputError
from pipeline.batch.outcome import LogOutcome, Status
from pipeline.counted import counted
from pipeline.manifest import StageResult
from pipeline.place_words import place_words
from pipeline.score_words import METRICS, SCORE_LEGEND, estimator_words, value_words
from pipeline.stores.urls import shown
from pipeline.suspicions import few, suspicions_in

SHOWN_STAGES = ("export", "report")
"""Whose files a person wants to open; the others are intermediate."""

MAX_LOGS_WITH_FILES = 3
"""With more logs than this the files of each are not listed."""

_OPENED_WITH = {
    ".cadence.mcap": "for Foxglove or Lichtblick, together with {log}",
    ".combined.mcap": "for either, by itself",
    ".layout.json": "its layout for Foxglove",
    ".layout.legacy.json": "its layout for Lichtblick",
    "report.html": "open this in a browser",
}
"""What files are for, by the ends of their names, in the order in which they are listed."""

_UNITS = {"s": "s", "m": "m", "mps": "m/s", "bytes": "bytes"}

BATCH_VERSION = 1
"""Version of batch.json."""


def to_json(value: Any) -> str:
    """Indented JSON; dataclasses become objects, paths strings."""
    return json.dumps(value, indent=2, ensure_ascii=False, default=_jsonable)


def stage_summary(result: StageResult) -> str:
    """What was done in one line, its counts and numbers in the next, then the files."""
    numbers = [_named(name, value) for name, value in result.summary.items() if type(value) in (int, float) and value]
    lines = [f"{result.stage}: {result.status}", *([f"  {', '.join(numbers)}"] if numbers else [])]
    lines += [f"  {line}" for line in result.summary.get("verdict", ())]
    if scores := result.summary.get("scores", ()):
        lines += [*score_lines(scores), f"  {SCORE_LEGEND}"]
    lines += [f"  suspected {line}" for line in few(suspicions_in(result.summary))]
    lines += [f"  note: {line}" for line in result.summary.get("remarks", ())]
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
    parts = [part if index == 0 or part != columns[index - 1][0] else "" for index, (part, _) in enumerate(columns)]
    rows = [["", *(f"{part}:" if part else "" for part in parts)]]
    rows += [["", *(METRICS.get(metric, metric.replace("_", " ")) for _, metric in columns)]]
    for estimator in dict.fromkeys(score["estimator"] for score in scores):
        cells = [value_words(metric, values.get((estimator, part, metric))) for part, metric in columns]
        rows.append([estimator_words(str(estimator)), *cells])
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


def batch_summary(outcomes: Sequence[LogOutcome], told: Collection[str] = ()) -> str:
    """A table with a row a log, what was lost, suspected and assumed, and what to open.

    Messages that are `told` elsewhere are left out of the table: a failure is read once.
    """
    numbers = ("num_windows", "num_agents", "num_detections")
    rows = [("log", "status", "windows", "agents", "detections", "time", "")]
    lines = []
    for outcome in outcomes:
        # what infer says of agents and windows goes before what other stages count under the same name
        stages = sorted(outcome.stages, key=lambda stage: stage.stage == "infer")
        summary = {name: value for stage in stages for name, value in stage.summary.items()}
        windows, agents, detections = (str(summary.get(name, "-")) for name in numbers)
        elapsed = f"{outcome.elapsed_s:.1f} s"
        message = "" if outcome.message in told else outcome.message
        rows.append((outcome.task.name, outcome.status, windows, agents, detections, elapsed, message))
        for stage in outcome.stages:
            lines += [f"{outcome.task.name}: damaged: {problem}" for problem in stage.summary.get("problems", ())]
            lines += [f"{outcome.task.name}: suspected {line}" for line in few(suspicions_in(stage.summary))]
        lines += [f"{outcome.task.name}: assumed: {line}" for line in (*few(summary.get("taken", ())), *_assumptions(summary))]
        place = place_words(*map(summary.get("frame", {}).get, ("latitude_deg", "longitude_deg")))
        lines += [f"{outcome.task.name}: note: the zero of its metres is at {place}"] if place else []
        lines += [f"{outcome.task.name}: note: {line}" for line in summary.get("remarks", ())]
    return "\n".join([*_table(rows), *lines, *_to_open(outcomes)])


def _assumptions(summary: Mapping[str, Any]) -> list[str]:
    """What was assumed of detections that do not say whose they are, and which lines say otherwise."""
    num, unnamed, found = summary.get("num_unknown_origin", 0), summary.get("unnamed", {}), summary.get("association")
    if not num or "num_windows" not in summary:
        return []
    of = f" of {', '.join(list(unnamed)[:4])}{' and others' if len(unnamed) > 4 else ''}" if unnamed else ""
    num_agents = 1 if found is None else found["num_agents"]
    told = "were taken for one target" if num_agents == 1 else f"were told apart as those of {counted(num_agents, 'target')}"
    paths = {path for path in unnamed.values() if path is not None}
    ways = [f'agent_path = "{path}" in [[extract.detections]] reads it from the messages' for path in sorted(paths)[:1]]
    ways += ['agent = "NAME" there means one target'] * (num_agents != 1)
    ways.append("infer.association.num_agents = N is how many there are")
    who = counted(num, f"detection{of} does", f"detections{of} do")
    return [f"{who} not say whose they are and {told}; to have it otherwise: {', '.join(ways)}"]


def _to_open(outcomes: Sequence[LogOutcome]) -> list[str]:
    """What to look at, and with what, the page last; of many logs only how their pages are called."""
    finished = [outcome for outcome in outcomes if any(stage.stage == "report" for stage in outcome.stages)]
    if finished and len(outcomes) > MAX_LOGS_WITH_FILES:
        folder = shown(finished[0].task.directory).rpartition("/")[0]
        return [f"open {folder}/*/report.html in a browser, {len(finished)} pages"]
    lines = []
    for outcome in outcomes:
        paths = [str(path) for stage in outcome.stages if stage.stage in SHOWN_STAGES for path in stage.outputs]
        log = outcome.task.log if len(outcome.task.parts) == 1 else f"{outcome.task.log} and its other parts"
        found = [(path, words) for ending, words in _OPENED_WITH.items() for path in paths if path.endswith(ending)]
        width = max((len(path) for path, _ in found), default=0)
        lines += [f"  {path.ljust(width)}  {words.format(log=log)}" for path, words in found]
    return lines


def _table(rows: Sequence[Sequence[str]]) -> list[str]:
    """Columns beside each other: the first two to the left, numbers to the right, the last as long as it is."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]) - 1)]
    aligned = (
        [cell.ljust(width) if i < 2 else cell.rjust(width) for i, (cell, width) in enumerate(zip(row, widths, strict=False))]
        for row in rows
    )
    return ["  ".join([*cells, row[-1]]).rstrip() for cells, row in zip(aligned, rows, strict=True)]


def _named(name: str, value: float) -> str:
    words, _, suffix = name.removeprefix("num_").rpartition("_")
    number = str(round(value, 3) if isinstance(value, float) else value)
    if words and suffix in _UNITS:
        return f"{words.replace('_', ' ')} {number} {_UNITS[suffix]}"
    return f"{name.removeprefix('num_').replace('_', ' ')} {number}"


def _jsonable(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    return dict(value) if isinstance(value, Mapping) else str(value)
