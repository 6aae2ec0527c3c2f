"""One pass over a log for all sources of positions: many messages of a channel at once where that is possible."""

from collections import Counter
from collections.abc import Sequence
from typing import Final

import numpy as np

from cadence.errors import InputError
from pipeline.extract.channel_reader import ChannelReader
from pipeline.logs.channels import Batch
from pipeline.logs.decode import UndecodableChannel, UndecodableMessage, decoder_for, with_definition
from pipeline.logs.reader import Channel, MissionLog, RawMessage
from pipeline.logs.records import MAX_TIME_NS
from pipeline.progress import Progress

_MAX_WAITING: Final = 1024
_MAX_WAITING_BYTES: Final = 2**20


def read_positions(
    log: MissionLog,
    readers: Sequence[ChannelReader],
    progress: Progress,
    start_ns: int | None = None,
    end_ns: int | None = None,
    max_detections: int | None = None,
) -> Counter[str]:
    """Feed the messages of the readers' channels with start_ns <= log time < end_ns to them; counts of what was not used.

    `steps_back` counts how often messages turned out not to have been written by time.

    Raises `InputError` as soon as there are more than `max_detections`: before anything is read where the log says so.
    """
    counts: Counter[str] = Counter()
    detecting = [reader for reader in readers if reader.role == "detections"]
    if start_ns is None and end_ns is None:
        _refuse_flood(detecting, sum(reader.channel.message_count or 0 for reader in detecting), max_detections)
    by_channel: dict[int, list[ChannelReader]] = {}
    for reader in readers:
        by_channel.setdefault(reader.channel.id, []).append(reader)
    feeds: dict[int, _Feed] = {}
    for number, served in by_channel.items():
        channel = served[0].channel
        try:
            feeds[number] = _Feed(channel, served)
            if with_definition(channel) is not channel:
                progress.note(
                    f"extract: {channel.topic}: the log has no definition of {channel.schema_name}; the standard one is used"
                )
        except UndecodableChannel as error:
            counts["undecodable"] += channel.message_count or 0
            progress.note(f"extract: {error}")
    topics = {reader.channel.topic for reader in readers}

    def advance(num_bytes: int) -> None:
        _refuse_flood(detecting, sum(len(reader.rows.agents) for reader in detecting), max_detections)
        bar.update(num_bytes)

    with progress.bar(log.size_bytes, "extract", unit="B", scale=True) as bar:
        for raw in log.messages(topics, advance, start_ns, end_ns, lambda: counts.update(steps_back=1)):
            feed = feeds.get(raw.channel.id)
            if feed is not None:
                feed.add(raw)
        for feed in feeds.values():
            feed.flush()
    counts["undecodable"] += sum(feed.num_undecodable for feed in feeds.values())
    if start_ns is not None or end_ns is not None:
        num_read = sum(feed.num_read for feed in feeds.values())
        counts["outside_time_cut"] = sum(feed.channel.message_count or 0 for feed in feeds.values()) - num_read
    for reader in readers:
        reader.check()
        counts.update(reader.counts)
        counts["unread_stamps"] += reader.fields["time"].num_lost if "time" in reader.fields else 0
    return counts


def _refuse_flood(readers: Sequence[ChannelReader], num: int, max_detections: int | None) -> None:
    if max_detections is not None and num > max_detections:
        topics = ", ".join(dict.fromkeys(reader.channel.topic for reader in readers))
        raise InputError(
            f"{topics}: {num} detections or more, over extract.max_detections = {max_detections}; take a part with --start and "
            "--end or --topic, or raise the setting"
        )


class _Feed:
    """Messages of one channel on their way to its readers.

    They wait until there are many, which are then read as columns. Where a reader's fields have no columns, or one of the
    messages is not sound, each is decoded by itself; both ways give the same rows in the same order.
    """

    def __init__(self, channel: Channel, served: Sequence[ChannelReader]) -> None:
        self.channel, self.served = channel, served
        self.num_read = self.num_undecodable = 0
        self._decode = decoder_for(channel)
        self._waiting: list[RawMessage] = []
        self._num_bytes = 0
        try:
            self._columns = [reader.field_columns() for reader in served]
        except UndecodableChannel:
            self._columns = []

    def add(self, raw: RawMessage) -> None:
        """Take the next message."""
        self.num_read += 1
        if not self._columns:
            self._read(raw)
            return
        self._waiting.append(raw)
        self._num_bytes += len(raw.data)
        if len(self._waiting) >= _MAX_WAITING or self._num_bytes >= _MAX_WAITING_BYTES:
            self.flush()

    def flush(self) -> None:
        """Pass on what waits."""
        if self._waiting and not self._read_columns():
            for raw in self._waiting:
                self._read(raw)
        self._waiting, self._num_bytes = [], 0

    def _read(self, raw: RawMessage) -> None:
        try:
            message = self._decode(raw.data)
        except UndecodableMessage:
            self.num_undecodable += 1
            return
        for reader in self.served:
            reader.read(message, raw)

    def _read_columns(self) -> bool:
        """Whether all that waits could be read as columns; nothing has been read where it could not."""
        batch = _batch(self._waiting)
        if (batch.publish_time_ns > MAX_TIME_NS).any():
            return False
        found = [columns.read(batch) for columns in self._columns]
        if None in found:
            return False
        for reader, columns in zip(self.served, found, strict=True):
            if columns is not None:
                reader.read_columns(columns, batch)
        return True


def _batch(messages: Sequence[RawMessage]) -> Batch:
    """Messages of one channel as columns."""
    log_time_ns, publish_time_ns = ([raw[field] for raw in messages] for field in (1, 2))
    end = np.cumsum([len(raw.data) for raw in messages], dtype=np.int64)
    return Batch(
        messages[0].channel, np.array(log_time_ns, np.int64), np.array(publish_time_ns, np.uint64),
        np.array([raw.sequence for raw in messages], np.uint32), b"".join(raw.data for raw in messages),
        begin=np.append(0, end[:-1]), end=end,
    )  # fmt: skip
