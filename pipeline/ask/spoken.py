"""One call of `cadence ask`: a question to a mission directory, its answers as text, as JSON and as files."""

import dataclasses
import json
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from cadence.errors import CadenceError, UsageError
from cadence.resampling import effective_number
from pipeline.ask.answers import Answer, answers, refuse_unanswerable
from pipeline.ask.files import write_places
from pipeline.ask.known import Known, open_known
from pipeline.ask.question import Question
from pipeline.ask.words import area_words
from pipeline.counted import counted
from pipeline.lengths import metres
from pipeline.missions import is_mission_directory, no_mission

_MANY = 20
_UNPROVEN = (
    "On measured logs 90 % regions of mission hypotheses held 71 to 98 % of the truth; `cadence evaluate` says it of this log, "
    "where there is truth."
)

_BRACKETS = "In brackets: of shares and areas what drawing more could change, of times where 90 % lie."


def ask_each(
    directories: Sequence[Path], question: Question, out: Path | None, as_json: bool, say: Callable[[str], object],
    complain: Callable[[CadenceError], object], note: Callable[[str], object],
) -> int:  # fmt: skip
    """Ask one mission, or several one after the other; the exit code.

    Of several each answer says whose it is (as JSON in a list), files go into a folder of `out` each, what is no mission is
    left out with a note, and what cannot be answered is complained of and does not stop the others.
    """
    if len(directories) == 1:
        say(ask(directories[0], question, out, as_json))
        return 0
    missions = [directory for directory in directories if is_mission_directory(directory)]
    for other in directories:
        if other not in missions:
            note(f"ask: {other} is no mission directory and is left out")
    if not missions:
        raise no_mission(directories[0])
    texts, code = [], 0
    for directory in missions:
        try:
            text = ask(directory, question, None if out is None else out / directory.name, as_json)
            texts.append(text if as_json else f"{directory.name}:\n" + textwrap.indent(text, "  "))
        except CadenceError as error:
            complain(type(error)(f"{directory}: {error}" if str(directory) not in str(error) else str(error)))
            code = max(code, error.exit_code)
    if texts or as_json:
        say("[\n" + ",\n".join(texts) + "\n]" if as_json else "\n".join(texts))
    return code


def ask(directory: Path, question: Question, out: Path | None = None, as_json: bool = False) -> str:
    """The answers of the results in `directory` as text, or as JSON; with `out`, files of areas are written there."""
    if out is not None and question.ask != "where":
        raise UsageError(f"--out is for `where`, which has areas to write; `{question.ask}` has none")
    refuse_unanswerable(directory, question)
    known = open_known(directory, question.as_of)
    found = answers(known, question)
    paths = write_places(known, found, out) if out is not None else ()
    return _as_json(known, question, found, paths) if as_json else _as_text(known, found, paths)


def _as_text(known: Known, found: Sequence[Answer], paths: Sequence[Path]) -> str:
    """One sentence an answer, its numbers below it, and what they rest on."""
    lines = []
    for answer in found[:_MANY]:
        lines += [answer.sentence, *(f"  {line}" for line in _sizes(answer))]
    if len(found) > _MANY:
        lines.append(f"{len(found) - _MANY} more; --json has all")
    stories = known.stories
    effective = effective_number(stories.weight)
    equal = "" if effective > 0.99 * stories.num_hypotheses else f", of unequal weight, as good as {effective:.0f} equal ones"
    moment = "" if known.as_of_ns is None else f" as of {known.clock.moment(known.as_of_ns)}"
    lines.append(f"From {counted(stories.num_hypotheses, 'hypothesis', 'hypotheses')}{equal}{moment}. {_BRACKETS}")
    if known.as_of_ns is None:
        lines.append(_UNPROVEN)
    return "\n".join([*lines, *map(str, paths)])


def _sizes(answer: Answer) -> list[str]:
    """What does not fit into the sentence of `where`."""
    if answer.place is None:
        return []
    sizes = ", ".join(
        f"{100 * area.level:g} %: {area_words(area.area_m2)} ({area_words(area.low_m2)} to {area_words(area.high_m2)})"
        for area in answer.place.areas
    )
    return [sizes, f"mean distance from the middle {metres(answer.place.spread_m)}"]


def _as_json(known: Known, question: Question, found: Sequence[Answer], paths: Sequence[Path]) -> str:
    stated: dict[str, Any] = {key: value for key, value in dataclasses.asdict(question).items() if value is not None}
    content = {
        "question": stated, "log_id": known.mission.log_id, "as_of_ns": known.as_of_ns,
        "num_stories": known.stories.num_hypotheses, "answers": [answer.record() for answer in found],
        "files": [str(path) for path in paths],
    }  # fmt: skip
    return json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False)
