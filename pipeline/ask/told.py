"""answers.json and events.csv: what export leaves of configured questions and of events, and the report tells."""

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from cadence.errors import ConfigError, InputError, UsageError
from pipeline.ask.answers import Answer, answers
from pipeline.ask.events import Event, story_events, table_events
from pipeline.ask.known import open_known
from pipeline.ask.question import Question
from pipeline.documents import parse_json
from pipeline.plain_rows import rows_as_csv
from pipeline.stories import MISSION_NAME

ANSWERS_NAME, EVENTS_NAME = "answers.json", "events.csv"
ANSWERS_VERSION = 1
_NO_STORIES = "not answered: there are no mission hypotheses; run cadence retrospect, or state as_of"


@dataclass(frozen=True, eq=False)
class Told:
    """Answers to the configured questions, each with what it was called, and events in the order of time."""

    answered: tuple[tuple[Question, tuple[Answer, ...]], ...]
    events: tuple[Event, ...]

    def answers_json(self) -> str:
        """answers.json."""
        boxes = [
            {
                "name": name_of(question), "ask": question.ask,
                "answers": [answer.record() for answer in found] or [_unanswered(question)],
            }
            for question, found in self.answered
        ]  # fmt: skip
        content = {"version": ANSWERS_VERSION, "questions": boxes}
        return json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n"

    def events_csv(self) -> str:
        """events.csv."""
        return rows_as_csv(Event, self.events)


def tell(directory: Path, questions: Sequence[Question], meeting_m: float | None) -> Told:
    """Answers and events of a mission directory; `ConfigError` where a question is about nothing that there is."""
    known = open_known(directory) if (directory / MISSION_NAME).is_file() else None
    answered = []
    for number, question in enumerate(questions):
        try:
            asked = known if question.as_of is None else open_known(directory, question.as_of)
            answered.append((question, () if asked is None else answers(asked, question)))
        except UsageError as error:
            raise ConfigError(f"export.questions[{number}]: {error}") from error
    events = table_events(directory)
    if known is not None:
        told = [answer for question, found in answered for answer in found if question.as_of is None]
        events += story_events(known, told, meeting_m)
    return Told(
        tuple(answered), tuple(sorted(events, key=lambda event: (event.start_ns, event.end_ns, event.kind, event.agents)))
    )


def _unanswered(question: Question) -> dict[str, Any]:
    return {"agents": [], "sentence": f"{name_of(question)}: {_NO_STORIES}."}


def name_of(question: Question) -> str:
    """What a question is called."""
    return question.name or " ".join(
        str(word) for word in (question.ask, question.agent, question.other, question.area, question.line, question.at) if word
    )


def read_told(directory: Path) -> tuple[list[dict[str, Any]], list[Event]]:
    """Boxes of answers.json and rows of events.csv; empty where export has left none. `InputError` for what is damaged."""
    boxes: list[dict[str, Any]] = []
    events: list[Event] = []
    try:
        if (directory / ANSWERS_NAME).is_file():
            content = parse_json((directory / ANSWERS_NAME).read_text(encoding="utf-8"))
            if content["version"] != ANSWERS_VERSION:
                raise ValueError(f"version {content['version']!r}, expected {ANSWERS_VERSION}")
            boxes = list(content["questions"])
        if (directory / EVENTS_NAME).is_file():
            text = (directory / EVENTS_NAME).read_text(encoding="utf-8")
            events = [_event(row) for row in csv.DictReader(io.StringIO(text))]
    except (OSError, ValueError, TypeError, LookupError) as error:
        raise InputError(
            f"{directory}: answers.json or events.csv cannot be read ({error}); run export with --force"
        ) from error
    return boxes, events


def _event(row: dict[str, str]) -> Event:
    numbers = {name: float(row[name]) if row[name] else None for name in ("probability", "low", "high")}
    times = {name: int(row[name]) for name in ("start_ns", "end_ns")}
    words = {field.name: row[field.name] for field in fields(Event) if field.name not in (*numbers, *times)}
    return Event(**words, **times, **numbers)  # type: ignore[arg-type]
