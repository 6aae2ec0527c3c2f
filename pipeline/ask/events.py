"""Events: what the results say unasked, each with its probability, its span of time, and how to compute it again.

Gaps, exchanged identities and evidence that contradicts itself come from the tables of extract and infer; who entered, left or
met whom from mission hypotheses, where there are any.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cadence.answers.estimates import Probability, wilson
from pipeline.ask.answers import Answer, answers
from pipeline.ask.known import Known
from pipeline.ask.question import Question
from pipeline.ask.words import percent
from pipeline.clock import Clock, duration
from pipeline.tables import read_table

Kind = Literal["gap", "entered", "left", "may have met", "identity exchange", "contradictory evidence", "answer"]

_NOTABLE_GAP = 5.0
"""A gap is told of an agent that is so many times as long as its median one: its longest."""
_DOUBT = 0.1
"""A detection of unknown origin is in doubt where its second likeliest agent is at least so likely."""
_BAD = ("infeasible", "contradicted", "few_fit", "scarce", "guidance_diverged")
_MEETING_SHARE = 0.005
_LEAST_MEETING = 0.01


@dataclass(frozen=True)
class Event:
    """One event, a row of events.csv.

    agents       their names, two with ` and ` between
    start_ns, end_ns  its span; of what the stories say, where 90 % of them have it
    probability, low, high  of its having happened, with the 95 % interval of more stories; empty: certain, or not known
    recompute    a line of SQL on the Parquet files in the mission directory (DuckDB), or of `cadence ask`
    """

    kind: Kind
    agents: str
    start_ns: int
    end_ns: int
    probability: float | None
    low: float | None
    high: float | None
    sentence: str
    recompute: str


def table_events(directory: Path) -> list[Event]:
    """Events that need no stories: the longest gaps, detections that may be exchanged, windows whose evidence does not fit."""
    detections, _ = read_table(directory / "detections.parquet", "detections")
    windows, _ = read_table(directory / "windows.parquet", "windows")
    time_ns = detections["time_ns"].to_numpy()
    if not len(time_ns):
        return []
    clock = Clock(int(time_ns.min()), int(time_ns.max()))
    found = [*_gaps(detections, clock), *_contradictions(windows, clock)]
    if (directory / "associations.parquet").is_file():
        found += _exchanges(read_table(directory / "associations.parquet", "associations")[0], clock)
    return found


def story_events(known: Known, answered: Sequence[Answer], meeting_m: float | None = None) -> list[Event]:
    """Events of mission hypotheses: of each answer, who entered and left where it was asked, and who may have met.

    Two met where they came within `meeting_m`; by default within a two-hundredth of the mission's extent.
    """
    found = [_of_answer(known, answer) for answer in answered]
    found += [event for answer in answered if answer.question.ask == "inside" for event in _borders(known, answer)]
    if len(known.stories.agent_ids) > 1:
        within = meeting_m or _default_meeting_m(known)
        meetings = answers(known, Question("meet", within_m=float(f"{within:.2g}")))
        likely = [each for each in meetings if each.agents and each.probability and each.probability.value >= _LEAST_MEETING]
        found += [_event("may have met", known, each) for each in likely]
    return found


def ask_line(directory: Path, question: Question) -> str:
    """The call of `cadence ask` that asks a question."""
    words = ["cadence", "ask", str(directory.name), question.ask]
    if question.ask in ("meet", "same"):
        words += [name for name in (question.agent, question.other) if name]
    words += [f"'{text}'" for text in (question.area, question.line) if text]
    flags = {
        "--at": question.at, "--from": question.start, "--to": question.end, "--dwell": question.dwell_s or None,
        "--within": question.within_m, "--for": question.for_s or None, "--as-of": question.as_of,
        "--agent": question.agent if question.ask not in ("meet", "same") else None,
    }  # fmt: skip
    return " ".join([*words, *(f"{flag} {value}" for flag, value in flags.items() if value is not None)])


def _of_answer(known: Known, answer: Answer) -> Event:
    return _event("answer", known, answer)


def _event(kind: Kind, known: Known, answer: Answer) -> Event:
    found = answer.probability
    is_told = found is not None and answer.place is None
    value, low, high = (found.value, found.low, found.high) if found is not None and is_told else (None, None, None)
    one, other = [*answer.agents, None, None][:2]
    question = answer.question
    if question.ask == "meet" and one and other:
        question = Question("meet", agent=one, other=other, within_m=question.within_m, for_s=question.for_s)
    line = ask_line(known.directory, question)
    return Event(kind, " and ".join(answer.agents), answer.start_ns, answer.end_ns, value, low, high, answer.sentence, line)


def _borders(known: Known, answer: Answer) -> Iterator[Event]:
    """Who came in and who went out, where an answer to `inside` says so."""
    ever, name = answer.numbers["ever"], answer.agents[0]
    called = answer.question.name or answer.question.area or "the area"
    pairs: tuple[tuple[Kind, str, str, str], ...] = (
        ("entered", "first_entry", "at_start", "came into"), ("left", "left", "at_end", "went out of")
    )  # fmt: skip
    for kind, key, without, words in pairs:
        when = answer.numbers[key]
        if when is None:
            continue
        num = ever["num_effective"]
        share = min(max(ever["value"] - answer.numbers[without]["value"], 0.0), 1.0)
        found = Probability(share, *wilson(share, num), num)
        sentence = f"{name} {words} {called if len(called) < 40 else 'the area'}: {percent(found)}."
        line = ask_line(known.directory, answer.question)
        yield Event(kind, name, when["low_ns"], when["high_ns"], found.value, found.low, found.high, sentence, line)


def _default_meeting_m(known: Known) -> float:
    position_m = known.stories.position_m[0].reshape(-1, 2)
    extent_m = np.nanmax(position_m, axis=0) - np.nanmin(position_m, axis=0)
    return max(_MEETING_SHARE * float(np.hypot(*extent_m)), 1.0)


def _gaps(detections: pa.Table, clock: Clock) -> Iterator[Event]:
    """The longest time for which each agent was not detected, where it is notable."""
    names = detections["agent_id"].to_pylist()
    time_ns = detections["time_ns"].to_numpy()
    for name in sorted({each for each in names if each is not None}):
        mine = np.sort(time_ns[np.array([each == name for each in names])])
        length = np.diff(mine)
        if len(length) < 2 or length.max() < _NOTABLE_GAP * max(float(np.median(length)), 1.0):
            continue
        start = int(length.argmax())
        start_ns, end_ns = int(mine[start]), int(mine[start + 1])
        sentence = (
            f"{name} was not detected for {duration((end_ns - start_ns) * 1e-9)}, from {clock.moment(start_ns)} to "
            f"{clock.moment(end_ns)}: its longest gap."
        )
        ordered = "lead(time_ns) OVER (PARTITION BY agent_id ORDER BY time_ns)"
        sql = (
            f"SELECT * FROM (SELECT agent_id, time_ns AS start_ns, {ordered} AS end_ns FROM 'detections.parquet') "
            f"WHERE agent_id = {_quoted(name)} ORDER BY end_ns - start_ns DESC LIMIT 1"
        )
        yield Event("gap", name, start_ns, end_ns, None, None, None, sentence, sql)


def _contradictions(windows: pa.Table, clock: Clock) -> Iterator[Event]:
    """Windows that follow each other in which what is known of an agent does not fit together."""
    rows = windows.sort_by([("agent_id", "ascending"), ("window", "ascending")]).to_pylist()
    for (name, status), group in itertools.groupby(rows, key=lambda row: (row["agent_id"], row["status"])):
        found = list(group)
        if status not in _BAD:
            continue
        start_ns, end_ns = found[0]["origin_ns"], found[-1]["origin_ns"]
        many = f"{len(found)} windows from {clock.moment(start_ns)} to {clock.moment(end_ns)}"
        when = f"the window of {clock.moment(start_ns)}" if len(found) == 1 else many
        advice = f": {found[0]['advice'].rstrip('.')}" if found[0]["advice"] else ""
        sql = (
            f"SELECT origin_ns, status, advice FROM 'windows.parquet' WHERE agent_id = {_quoted(name)} "
            f"AND status = {_quoted(status)} AND origin_ns BETWEEN {start_ns} AND {end_ns} ORDER BY origin_ns"
        )
        sentence = f"{name} is {status.replace('_', ' ')} in {when}{advice}."
        yield Event("contradictory evidence", name, start_ns, end_ns, None, None, None, sentence, sql)


def _exchanges(associations: pa.Table, clock: Clock) -> Iterator[Event]:
    """Pairs of agents that may have been taken for each other: detections that could be of either."""
    rows = associations.filter(pc.is_valid(associations["agent_id"])).sort_by([("probability", "descending")]).to_pylist()
    best: dict[int, list[dict[str, object]]] = {}
    for row in rows:
        best.setdefault(row["detection"], []).append(row)
    pairs: dict[tuple[str, str], list[tuple[int, float]]] = {}
    for found in best.values():
        if len(found) > 1 and float(str(found[1]["probability"])) >= _DOUBT:
            first, second = sorted((str(found[0]["agent_id"]), str(found[1]["agent_id"])))
            seen = int(str(found[0]["time_ns"])), float(str(found[1]["probability"]))
            pairs.setdefault((first, second), []).append(seen)
    for (first, second), doubts in sorted(pairs.items()):
        times, shares = zip(*sorted(doubts), strict=True)
        share = float(np.mean(shares))
        sentence = (
            f"{first} and {second} may be exchanged between {clock.moment(times[0])} and {clock.moment(times[-1])}: "
            f"{len(times)} detections could be of either, of the less likely one with {100 * share:.0f} % in the mean."
        )
        sql = (
            "SELECT detection, time_ns, agent_id, probability FROM 'associations.parquet' "
            f"WHERE agent_id IN ({_quoted(first)}, {_quoted(second)}) "
            f"AND probability BETWEEN {_DOUBT} AND {1 - _DOUBT} ORDER BY detection, probability"
        )
        agents = f"{first} and {second}"
        yield Event("identity exchange", agents, int(times[0]), int(times[-1]), share, None, None, sentence, sql)


def _quoted(text: str) -> str:
    return "'" + text.replace("'", "''") + "'"
