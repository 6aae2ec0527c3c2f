"""Channels and messages of a log, not decoded: one by one, or as columns."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

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


@dataclass(frozen=True)
class RawMessage:
    """One message, not decoded. Times are nanoseconds since the epoch that the recorder chose, normally 1970."""

    channel: Channel
    log_time_ns: int
    publish_time_ns: int
    sequence: int
    data: bytes = field(repr=False)


@dataclass(frozen=True, eq=False)
class Batch:
    """N messages of one channel, by log time; the data of message i are `data[begin[i]:end[i]]`.

    Columns are arrays [N]; publish times are uint64, since recorders that have none write what they like.
    """

    channel: Channel
    log_time_ns: npt.NDArray[np.int64]
    publish_time_ns: npt.NDArray[np.uint64]
    sequence: npt.NDArray[np.uint32]
    data: bytes = field(repr=False)
    begin: npt.NDArray[np.int64]
    end: npt.NDArray[np.int64]

    def __post_init__(self) -> None:
        columns = (self.log_time_ns, self.publish_time_ns, self.sequence, self.begin, self.end)
        if len({column.shape for column in columns}) != 1 or self.begin.ndim != 1:
            raise ValueError("the columns of a batch must have one length")

    def __len__(self) -> int:
        return len(self.begin)

    def payloads(self) -> Iterator[bytes]:
        """The data of each message."""
        return (self.data[begin:end] for begin, end in zip(self.begin.tolist(), self.end.tolist(), strict=True))

    def messages(self) -> Iterator[RawMessage]:
        """Each message by itself."""
        columns = (self.log_time_ns.tolist(), self.publish_time_ns.tolist(), self.sequence.tolist(), self.payloads())
        return (RawMessage(self.channel, *values) for values in zip(*columns, strict=True))


def raw_messages(channels: Mapping[int, Channel], data: bytes, rows: Rows) -> Iterator[RawMessage]:
    """The messages of `rows`, in their order; `data` are the bytes of their block, `channels` theirs by id."""
    columns = (rows.channel_id, rows.log_time_ns, rows.publish_time_ns, rows.sequence, rows.begin, rows.end)
    for number, log_time, publish_time, sequence, begin, end in zip(*(column.tolist() for column in columns), strict=True):
        yield RawMessage(channels[number], log_time, publish_time, sequence, data[begin:end])


def batches_of(channels: Mapping[int, Channel], data: bytes, rows: Rows) -> Iterator[Batch]:
    """The messages of `rows` by channel, in the order of the channels' ids."""
    for number in np.unique(rows.channel_id).tolist():
        own = rows[rows.channel_id == number]
        times = own.log_time_ns.astype(np.int64)
        yield Batch(channels[number], times, own.publish_time_ns, own.sequence, data, own.begin, own.end)
