"""Whether the clock of a log can be trusted: silent stretches, clocks that were set while it was recorded."""

from dataclasses import dataclass, field

import numpy as np

from cadence.arrays import Int64s
from pipeline.counted import counted
from pipeline.logs.health import utc
from pipeline.logs.reader import Batch, MissionLog

_MIN_GAP_S = 60.0
_GAP_FACTOR = 100.0
"""Silence is worth a word where it is so long, and so many times the usual time between two messages."""
_BEATS, _BEAT_FACTOR = 10, 3.0
"""So many silences that make up most of a recording are its beat; a gap is longer than they usually are."""
_JUMP_S = 10.0
_MAX_OFFSET_S = 10 * 366 * 86400.0
"""Log and publish time further apart say nothing: recorders that have no publish time write what they like."""
_MAX_SENTENCES = 5


@dataclass(frozen=True)
class TimeRemarks:
    """One sentence each; `clocks` also doubt the times of messages, `gaps` only say when nothing was recorded."""

    gaps: tuple[str, ...]
    clocks: tuple[str, ...]


@dataclass
class _Clock:
    """What one channel's messages have told so far: last sequence number, distance of publish and log time."""

    topic: str
    sequence: int = -1
    offset_s: float = np.nan
    num_backwards: int = 0
    first_backwards_ns: int = 0
    jumps: list[tuple[int, float]] = field(default_factory=list)

    def take(self, batch: Batch) -> None:
        """The next messages in the order of time."""
        numbers = np.concatenate([[max(self.sequence, 0)], batch.sequence.astype(np.int64)])
        # A count that starts again at 0 or wraps around is a new recorder or publisher, not a clock.
        is_backwards = (np.diff(numbers) < 0) & (numbers[1:] > 0)
        if is_backwards.any() and not self.num_backwards:
            self.first_backwards_ns = int(batch.log_time_ns[np.argmax(is_backwards)])
        self.num_backwards += int(is_backwards.sum())
        self.sequence = int(numbers[-1])
        offset = (batch.log_time_ns.astype(np.float64) - batch.publish_time_ns.astype(np.float64)) * 1e-9
        is_stated = np.abs(offset) < _MAX_OFFSET_S
        offset, times = offset[is_stated], batch.log_time_ns[is_stated]
        if len(offset):
            change = np.diff(np.concatenate([[offset[0] if np.isnan(self.offset_s) else self.offset_s], offset]))
            self.jumps += [(int(times[i]), float(change[i])) for i in np.flatnonzero(np.abs(change) > _JUMP_S)]
            self.offset_s = float(offset[-1])

    def remarks(self) -> list[str]:
        """What is odd about the channel."""
        found = []
        if self.num_backwards:
            times = counted(self.num_backwards, "time")
            words = f"sequence numbers go backwards {times}, first at {utc(self.first_backwards_ns)}"
            found.append(f"{self.topic}: {words}: the clock was set back, or several publishers share the topic.")
        if self.jumps:
            when, change = self.jumps[0]
            times = counted(len(self.jumps), "time")
            words = f"log time jumps against publish time {times}, first by {change:+.3g} s at {utc(when)}"
            found.append(f"{self.topic}: {words}: one of the clocks was set, or messages were held up.")
        return found


def time_remarks(log: MissionLog) -> TimeRemarks:
    """What is odd about the times of `log`. Reads it once; memory: eight bytes a message."""
    clocks = {channel.id: _Clock(channel.topic) for channel in log.channels}
    times = []
    for batch in log.batches():
        times.append(batch.log_time_ns)
        clocks[batch.channel.id].take(batch)
    found = [remark for clock in clocks.values() for remark in clock.remarks()]
    joined = np.sort(np.concatenate(times)) if times else np.zeros(0, dtype=np.int64)
    return TimeRemarks(tuple(_gaps(joined, log.health.lost_spans_ns)), _few(found, "more topics have such times."))


def _gaps(time_ns: Int64s, lost_spans_ns: tuple[tuple[int, int], ...]) -> list[str]:
    """The longest stretches between sorted times in which nothing was recorded, those apart in which messages were lost."""
    length = np.diff(time_ns) * 1e-9
    usual = float(np.median(length)) if len(length) else 0.0
    least_s = max(_MIN_GAP_S, _GAP_FACTOR * usual)
    silences = length[length > least_s]
    if len(silences) >= _BEATS and silences.sum() > 0.5 * length.sum():  # bursts at a steady beat are no recorder that failed
        least_s = max(least_s, _BEAT_FACTOR * float(np.median(silences)))
    long = np.flatnonzero(length > least_s)
    spans = [(int(time_ns[i]), int(time_ns[i + 1]), float(length[i])) for i in long]
    spans = [span for span in spans if not any(first < span[1] and last > span[0] for first, last in lost_spans_ns)]
    chosen = sorted(sorted(spans, key=lambda span: -span[2])[:_MAX_SENTENCES])
    sentences = [f"Nothing was recorded from {utc(first)} to {utc(last)} ({seconds:.0f} s)." for first, last, seconds in chosen]
    if len(spans) > len(chosen):
        sentences.append(f"{len(spans) - len(chosen)} shorter such gaps besides.")
    return sentences


def _few(sentences: list[str], of_what: str) -> tuple[str, ...]:
    """The first of them, and how many more there are."""
    rest = [f"{len(sentences) - _MAX_SENTENCES} {of_what}"] if len(sentences) > _MAX_SENTENCES else []
    return (*sentences[:_MAX_SENTENCES], *rest)
