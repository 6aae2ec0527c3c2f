"""How sound a log is: the verdict on what a walk over it has found, in sentences for people."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime

from pipeline.counted import counted
from pipeline.logs.plan import Loss, Plan

_MAX_SENTENCES = 20


@dataclass(frozen=True)
class Health:
    """How sound a log is.

    is_complete            False where messages are lost, or may be
    problems               one sentence each, also for faults without loss
    num_messages           messages that `MissionLog.messages` gives
    num_messages_expected  messages that the recorder wrote; None where nothing in the file says so
    lost_spans_ns          log-time spans in which messages are lost, as far as they are known (first, last)
    has_checksums          False where changed bytes inside messages could not have been noticed
    """

    is_complete: bool
    problems: tuple[str, ...]
    num_messages: int
    num_messages_expected: int | None
    lost_spans_ns: tuple[tuple[int, int], ...]
    has_checksums: bool = True


def health_of(plans: Sequence[Plan]) -> Health:
    """The health of one file, by the plans of the recordings that it holds."""
    if len(plans) == 1:
        return _health_of(plans[0])
    named = [(f"Recording {number}, byte {plan.begin} on", _health_of(plan)) for number, plan in enumerate(plans, start=1)]
    remark = f"The file holds {len(plans)} recordings, one behind the other: they are read as parts of one mission."
    health = united_health(named)
    return replace(health, problems=(remark, *health.problems))


def _health_of(plan: Plan) -> Health:
    """The health of one recording; messages of channels without definition count as lost."""
    counts = plan.counts()
    found = counts.total()
    lost = {number: count for number, count in counts.items() if number not in plan.channels}
    readable = found - sum(lost.values())
    expected = plan.statistics.message_count - plan.repeated.total() if plan.statistics else None
    problems = [_sentence(loss) for loss in plan.losses[:_MAX_SENTENCES]]
    if len(plan.losses) > _MAX_SENTENCES:
        problems.append(f"{len(plan.losses) - _MAX_SENTENCES} more damaged places follow.")
    problems += plan.doubts[:_MAX_SENTENCES]
    if lost:
        ids = ", ".join(map(str, sorted(lost)))
        whose = counted(sum(lost.values()), "message belongs", "messages belong")
        problems.append(f"{whose} to channels without a definition (id {ids}) and cannot be used.")
    is_complete = not problems
    for number, channel in sorted(plan.channels.items()):
        if channel.schema_id and channel.schema_id not in plan.schemas:
            problems.append(f"Channel {number} ({channel.topic}) names schema {channel.schema_id}, which is not in the file.")
    if expected not in (None, readable):
        is_complete = False
        problems.append(f"The file should hold {expected} messages; {readable} can be read.")
    elif expected is not None and not plan.is_counted():
        is_complete = False
        problems.append("The numbers of messages of single channels differ from the statistics of the file.")
    spans = tuple(sorted({loss.span_ns for loss in plan.losses if loss.span_ns is not None}))
    return Health(is_complete, (*problems, *plan.remarks), readable, expected, spans, plan.has_checksums)


def united_health(parts: Sequence[tuple[str, Health]], unread: Sequence[str] = ()) -> Health:
    """The health of a mission in several named parts; `unread` says of each part that is lost as a whole why it is."""
    problems = [*unread, *(f"{name}: {problem}" for name, health in parts for problem in health.problems)]
    expected = [health.num_messages_expected for _, health in parts]
    return Health(
        is_complete=not unread and all(health.is_complete for _, health in parts),
        problems=tuple(problems),
        num_messages=sum(health.num_messages for _, health in parts),
        num_messages_expected=None if unread or None in expected else sum(number or 0 for number in expected),
        lost_spans_ns=tuple(sorted({span for _, health in parts for span in health.lost_spans_ns})),
        has_checksums=all(health.has_checksums for _, health in parts),
    )


def utc(time_ns: int) -> str:
    """`time_ns` as ISO 8601 in UTC with milliseconds; seconds where it lies outside the calendar."""
    try:
        moment = datetime.fromtimestamp(time_ns // 10**9, UTC)
    except (ValueError, OverflowError, OSError):
        return f"{time_ns / 1e9:.3f} s"
    return f"{moment:%Y-%m-%dT%H:%M:%S}.{time_ns // 10**6 % 1000:03d}Z"


def _sentence(loss: Loss) -> str:
    span = ""
    if loss.span_ns is not None:
        start, end = loss.span_ns
        span = f", {utc(start)} to {utc(end)} ({(end - start) / 1e9:.3g} s)"
    count = "" if loss.num_messages is None else f", {counted(loss.num_messages, 'message')}"
    return f"Lost at byte {loss.offset}{span}{count}: {loss.reason}."
