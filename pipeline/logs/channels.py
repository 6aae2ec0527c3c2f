"""Channels and messages of a log, not decoded: one by one, or as columns."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import repeat
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cadence.arrays import Int64s
from pipeline.logs.rows import Rows


@dataclass(frozen=True)
class Channel:
    """One channel of a log. schema_* are empty where the channel has no schema; message_count None where unknown."""

    id: int
    topic: str
    message_encoding: str
    schema_name: str
    schema_encoding: str
    schema_data: bytes = field(repr=False)
    message_count: int | None
    metadata: Mapping[str, str] = field(repr=False)


class RawMessage(NamedTuple):
    """One message, not decoded. Times are nanoseconds since the epoch that the recorder chose, normally 1970.

    A tuple and not a dataclass: a log has hundreds of thousands, and tuples are made in half the time.
    """

    channel: Channel
    log_time_ns: int
    publish_time_ns: int
    sequence: int
    data: bytes


@dataclass(frozen=True, eq=False)
class Batch:
    """N messages of one channel, by log time; the data of message i are `data[begin[i]:end[i]]`.

    Columns are arrays [N]; publish times are uint64, since recorders that have none write what they like.
    """

    channel: Channel
    log_time_ns: Int64s
    publish_time_ns: npt.NDArray[np.uint64]
    sequence: npt.NDArray[np.uint32]
    data: bytes = field(repr=False)
    begin: Int64s
    end: Int64s

    def __post_init__(self) -> None:
        columns = (self.log_time_ns, self.publish_time_ns, self.sequence, self.end)
        if self.begin.ndim != 1 or any(column.shape != self.begin.shape for column in columns):
            raise ValueError("the columns of a batch must have one length")

    def __len__(self) -> int:
        return len(self.begin)

    def payloads(self) -> Iterator[bytes]:
        """The data of each message."""
        return _payloads(self.data, self.begin, self.end)

    def messages(self) -> Iterator[RawMessage]:
        """Each message by itself."""
        columns = (self.log_time_ns.tolist(), self.publish_time_ns.tolist(), self.sequence.tolist(), self.payloads())
        return _made(repeat(self.channel, len(self)), *columns)


def raw_messages(channels: Mapping[int, Channel], data: bytes, rows: Rows) -> Iterator[RawMessage]:
    """The messages of `rows`, in their order; `data` are the bytes of their block, `channels` theirs by id."""
    named = map(channels.__getitem__, rows.channel_id.tolist())
    times = (rows.log_time_ns.tolist(), rows.publish_time_ns.tolist())
    return _made(named, *times, rows.sequence.tolist(), _payloads(data, rows.begin, rows.end))


def _payloads(data: bytes, begin: Int64s, end: Int64s) -> Iterator[bytes]:
    """The data of messages, copied when they are asked for: a message that was let go leaves its memory to the next."""
    return map(data.__getitem__, map(slice, begin.tolist(), end.tolist()))


def _made(*columns: Iterable[Any]) -> Iterator[RawMessage]:
    """Messages from their columns, without a step of the interpreter for each."""
    return map(tuple.__new__, repeat(RawMessage), zip(*columns, strict=True))


def batches_of(channels: Mapping[int, Channel], data: bytes, rows: Rows) -> Iterator[Batch]:
    """The messages of `rows` by channel, in the order of the channels' ids."""
    rows = rows[np.argsort(rows.channel_id, kind="stable")]
    times = rows.log_time_ns.astype(np.int64)
    ends = [*(np.flatnonzero(np.diff(rows.channel_id)) + 1).tolist(), len(rows)]
    for begin, end in zip([0, *ends], ends, strict=False):
        if end > begin:
            own = slice(begin, end)
            columns = (times[own], rows.publish_time_ns[own], rows.sequence[own], data, rows.begin[own], rows.end[own])
            yield Batch(channels[int(rows.channel_id[begin])], *columns)
