"""Questions to stories, answered in a sentence and in numbers; the same for the command line, Python, events and report."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cadence.answers import questions
from cadence.answers.estimates import Law, Probability, probability
from cadence.answers.whereabouts import Whereabouts, whereabouts
from cadence.arrays import Float64s
from cadence.errors import InputError
from pipeline.ask.known import Known
from pipeline.ask.parts import part_words
from pipeline.ask.question import Question
from pipeline.ask.sameness import same
from pipeline.ask.sweeps import sweep_words
from pipeline.ask.words import (
    area_words,
    moment_words,
    numbers,
    percent,
    place_words,
    span_words,
    time_numbers,
)
from pipeline.clock import duration
from pipeline.lengths import metres
from pipeline.look_files import SENSORS_NAME
from pipeline.plain_rows import without_nan


@dataclass(frozen=True, eq=False)
class Answer:
    """What the stories say of one agent or pair.

    sentence     in words
    probability  of what was asked; None where it is not a matter of yes or no
    start_ns, end_ns  what the answer is about: the time of the event with 90 %, else what was asked
    numbers      all of it, JSON-able
    place        of where: areas and grid
    """

    question: Question
    agents: tuple[str, ...]
    sentence: str
    probability: Probability | None
    start_ns: int
    end_ns: int
    numbers: dict[str, Any] = field(default_factory=dict)
    place: Whereabouts | None = None

    def record(self) -> dict[str, Any]:
        """The answer for programs."""
        found = {"agents": list(self.agents), "sentence": self.sentence, "start_ns": self.start_ns, "end_ns": self.end_ns}
        return without_nan({**found, "probability": numbers(self.probability), **self.numbers})  # type: ignore[no-any-return]


def answers(known: Known, question: Question) -> tuple[Answer, ...]:
    """The answers to a question, one an agent or pair.

    Raises `UsageError` for an agent, a time or a place that is none, `InputError` where the results cannot answer it.
    """
    refuse_unanswerable(known.directory, question)
    if question.ask == "same":
        return (_same(known, question),)
    if question.ask == "meet":
        return tuple(_meet(known, question))
    agents = range(len(known.stories.agent_ids)) if question.agent is None else [known.agent(question.agent)]
    ask = {"where": _where, "inside": _inside, "arrive": _arrive, "passed": _passed, "searched": _searched}[question.ask]
    found = [ask(known, question, agent) for agent in agents]
    return tuple(sorted((each for each in found if each is not None), key=_rank)) or _nobody(known, question)


def refuse_unanswerable(directory: Path, question: Question) -> None:
    """`InputError` where no results of the log could answer the question."""
    if question.ask != "searched":
        return
    if not (directory / SENSORS_NAME).is_file():
        raise InputError(
            f"{directory}: the log states no footprints of its sensors, so that nobody can say what was searched; "
            "state them in [[extract.sensors]]"
        )


def _rank(answer: Answer) -> tuple[float, tuple[str, ...]]:
    """Who did it first."""
    return -(answer.probability.value if answer.probability and answer.question.ask != "where" else 0.0), answer.agents


def _nobody(known: Known, question: Question) -> tuple[Answer, ...]:
    raise InputError(f"{known.directory}: no story has any agent then; ask about another time ({known.clock.range()})")


def _where(known: Known, question: Question, agent: int) -> Answer | None:
    assert question.at is not None
    at_s = known.seconds(question.at, "at")
    position_m = known.stories.at(np.array([at_s]))[:, agent, 0]
    if not np.isfinite(position_m).any():
        return None
    found = whereabouts(position_m, known.stories.weight)
    at_ns = known.start_ns + round(at_s * 1e9)
    half, most, nearly = found.areas
    name = known.stories.agent_ids[agent]
    there = "" if found.presence.value == 1.0 else f", if it was there at all ({percent(found.presence)})"
    parts, shares = part_words(most.shape, position_m, known.stories.weight)
    sentence = (
        f"At {known.clock.moment(at_ns)} {name} was, with 90 %, within {area_words(most.area_m2)} about "
        f"{place_words(known.frame, found.centre_m, found.spread_m)}{parts}{there}."
    )
    sizes = {
        f"{100 * area.level:g}": {"area_m2": area.area_m2, "low_m2": area.low_m2, "high_m2": area.high_m2}
        for area in (half, most, nearly)
    }
    told = {
        "at_ns": at_ns, "centre_m": list(found.centre_m), "mean_distance_m": found.spread_m, "areas": sizes, "parts": shares,
        "num_effective": found.presence.num_effective,
    }  # fmt: skip
    return Answer(question, (name,), sentence, found.presence, at_ns, at_ns, told, found)


def _inside(known: Known, question: Question, agent: int) -> Answer:
    assert question.area is not None
    span = known.span(question.start, question.end)
    found = questions.inside(known.stories, agent, known.places.area(question.area), span, question.dwell_s)
    asked = found.dwelt if question.dwell_s else found.ever
    longer = f" for {duration(question.dwell_s)} or longer" if question.dwell_s else ""
    name = known.stories.agent_ids[agent]
    words = [f"{name} was in {_called(question)}{longer} {_during(known, question, span)}: {percent(asked)}"]
    if found.ever.value > 0:
        words += [f"there already at the beginning: {percent(found.at_start)}"] if found.at_start.value > 0 else []
        words += [f"it came in first at {_at(known, found.first_entry_s)}"] if found.first_entry_s else []
        words += [f"was gone at {_at(known, found.left_s)}"] if found.left_s else []
        words += [f"stayed {span_words(found.longest_s)} without a break"] if found.longest_s else []
    told = {
        **{key: numbers(getattr(found, key)) for key in ("ever", "dwelt", "at_start", "at_end", "total_s", "longest_s")},
        "first_entry": time_numbers(found.first_entry_s, known.start_ns),
        "left": time_numbers(found.left_s, known.start_ns),
    }
    return _answer(known, question, (name,), "; ".join(words), asked, found.first_entry_s, span, told)


def _arrive(known: Known, question: Question, agent: int) -> Answer:
    assert question.area is not None
    span = known.span(question.start, question.end)
    found = questions.arrive(known.stories, agent, known.places.area(question.area), span)
    name = known.stories.agent_ids[agent]
    words = [f"{name} arrived in {_called(question)} {_during(known, question, span)}: {percent(found.arrived)}"]
    words += [f"at {_at(known, found.arrived_s)}"] if found.arrived_s else []
    if found.place_m is not None and found.place_spread_m is not None:
        words += [f"over its border {_about(known, found.place_m, found.place_spread_m)}"]
    words += [f"it was there from the beginning: {percent(found.was_there)}"] if found.was_there.value > 0 else []
    told = {
        "arrived": numbers(found.arrived), "was_there": numbers(found.was_there),
        "arrival": time_numbers(found.arrived_s, known.start_ns), "place_m": found.place_m,
        "place_spread_m": found.place_spread_m,
    }  # fmt: skip
    return _answer(known, question, (name,), "; ".join(words), found.arrived, found.arrived_s, span, told)


def _passed(known: Known, question: Question, agent: int) -> Answer:
    assert question.line is not None
    span = known.span(question.start, question.end)
    line = known.places.line(question.line)
    found = questions.passed(known.stories, agent, line, span)
    name = known.stories.agent_ids[agent]
    words = [f"{name} passed {question.name or 'the line'} {_during(known, question, span)}: {percent(found.passed)}"]
    if found.passed_s is not None and found.along_m is not None:
        along = found.along_m
        words += [f"first at {_at(known, found.passed_s)}", f"from left to right: {percent(found.to_right)}"]
        words += [f"{metres(along.median)} from its first point ({metres(along.low)} to {metres(along.high)})"]
    told = {
        "passed": numbers(found.passed), "to_right": numbers(found.to_right), "along_m": numbers(found.along_m),
        "passage": time_numbers(found.passed_s, known.start_ns), "num_crossings": numbers(found.num_crossings),
        "line_length_m": line.length_m,
    }  # fmt: skip
    return _answer(known, question, (name,), "; ".join(words), found.passed, found.passed_s, span, told)


def _searched(known: Known, question: Question, agent: int) -> Answer:
    span = known.span(question.start, question.end)
    words, found, told = sweep_words(known, agent, span, _during(known, question, span))
    return _answer(known, question, (known.stories.agent_ids[agent],), words, found.success, None, span, told)


def _meet(known: Known, question: Question) -> Iterator[Answer]:
    assert question.within_m is not None
    span, names = known.span(question.start, question.end), known.stories.agent_ids
    if len(names) < 2:
        raise InputError(f"{known.directory}: there is one agent only, so that no two can meet")
    if question.agent is not None and question.other is not None:
        pairs = [(known.agent(question.agent), known.agent(question.other))]
    else:
        chosen = range(len(names)) if question.agent is None else [known.agent(question.agent)]
        pairs = sorted({(min(a, b), max(a, b)) for a, b in itertools.product(chosen, range(len(names))) if a != b})
        pairs = near_pairs(known, pairs, question.within_m, span)
    found = [_meeting(known, question, one, other, span) for one, other in pairs]
    found = [each for each in found if question.other is not None or (each.probability and each.probability.value > 0)]
    if not found:
        never = np.zeros(len(known.stories.weight), dtype=bool)
        least = percent(probability(known.stories.weight, never))
        during = _during(known, question, span)
        words = f"no two of {len(names)} agents were within {metres(question.within_m)} {during}: {least} each"
        yield _answer(known, question, (), words, None, None, span, {})
    yield from sorted(found, key=_rank)


def near_pairs(
    known: Known, pairs: Sequence[tuple[int, int]], within_m: float, span_s: tuple[float, float]
) -> list[tuple[int, int]]:
    """Those of the pairs whose boxes of all stories come within a distance between any two steps: a quick look at all."""
    time_s = known.stories.time_s
    used = slice(max(int(np.searchsorted(time_s, span_s[0], "right")) - 1, 0), int(np.searchsorted(time_s, span_s[1])) + 1)
    boxes: dict[int, tuple[Float64s, Float64s]] = {}
    for agent in {agent for pair in pairs for agent in pair}:
        track = known.stories.position_m[:, agent, used]
        low, high = np.fmin.reduce(track, axis=0), np.fmax.reduce(track, axis=0)
        boxes[agent] = (np.fmin(low[:-1], low[1:]), np.fmax(high[:-1], high[1:])) if len(low) > 1 else (low, high)
    found = []
    for one, other in pairs:
        (low, high), (other_low, other_high) = boxes[one], boxes[other]
        apart = np.maximum(np.maximum(low - other_high, other_low - high), 0.0)
        if (np.hypot(apart[:, 0], apart[:, 1]) <= within_m).any():  # NaN compares as false
            found.append((one, other))
    return found


def _meeting(known: Known, question: Question, one: int, other: int, span: tuple[float, float]) -> Answer:
    assert question.within_m is not None
    found = questions.meet(known.stories, one, other, question.within_m, question.for_s, span)
    names = (known.stories.agent_ids[one], known.stories.agent_ids[other])
    how = f"within {metres(question.within_m)}" + (f" for {duration(question.for_s)}" if question.for_s else "")
    words = [f"{names[0]} and {names[1]} met ({how}) {_during(known, question, span)}: {percent(found.met)}"]
    if found.met_s is not None and found.lasted_s is not None:
        words += [f"at {_at(known, found.met_s)}", f"for {span_words(found.lasted_s)}"]
    if found.place_m is not None and found.place_spread_m is not None:
        words += [_about(known, found.place_m, found.place_spread_m)]
    if found.nearest_m is not None:
        near = found.nearest_m
        words += [f"nearest {metres(near.median)} ({metres(near.low)} to {metres(near.high)})"]
    told = {
        "met": numbers(found.met), "meeting": time_numbers(found.met_s, known.start_ns), "lasted_s": numbers(found.lasted_s),
        "nearest_m": numbers(found.nearest_m), "place_m": found.place_m, "place_spread_m": found.place_spread_m,
    }  # fmt: skip
    return _answer(known, question, names, "; ".join(words), found.met, found.met_s, span, told)


def _same(known: Known, question: Question) -> Answer:
    assert question.agent is not None and question.other is not None
    words, asked, told = same(known, question.agent, question.other, question.within_m)
    return _answer(known, question, (question.agent, question.other), words, asked, None, known.span_s, told)


def _answer(
    known: Known, question: Question, agents: tuple[str, ...], words: str, asked: Probability | None, when: Law | None,
    span_s: tuple[float, float], told: dict[str, Any],
) -> Answer:  # fmt: skip
    from_s, to_s = span_s if when is None else (when.low, when.high)
    start_ns, end_ns = (known.start_ns + round(at * 1e9) for at in (from_s, to_s))
    return Answer(
        question, agents, f"{words[:1].upper()}{words[1:]}." if not agents else f"{words}.", asked, start_ns, end_ns, told
    )


def _at(known: Known, when: Law | None) -> str:
    assert when is not None
    return moment_words(known.clock, known.start_ns, when)


def _about(known: Known, place_m: tuple[float, float], spread_m: float) -> str:
    return f"at {place_words(known.frame, place_m, spread_m)}, give or take {metres(spread_m)}"


def _called(question: Question) -> str:
    """The area in words: its name, or what was given where that is short."""
    text = question.name or question.area or ""
    return text if len(text) <= 40 and not text.lstrip().startswith("{") else "the area"


def _during(known: Known, question: Question, span_s: tuple[float, float]) -> str:
    if question.start is None and question.end is None:
        return "at some time"
    start, end = (known.clock.moment(known.start_ns + round(at * 1e9)) for at in span_s)
    return f"between {start} and {end}"
