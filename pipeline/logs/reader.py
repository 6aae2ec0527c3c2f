"""Mission logs: what an MCAP holds, how sound it is, and its messages in log-time order, in bounded memory.

`open_log` walks the file once (see `salvage`), so the health of a log is known before the first message is used.
"""

import contextlib
import heapq
import math
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import Statistics

from cadence.errors import InputError
from pipeline.logs.plan import Block, Loss, Plan
from pipeline.logs.records import (
    MAGIC,
    MAX_TIME_NS,
    MESSAGE_HEAD,
    DamagedRecord,
    parse_chunk,
    parse_metadata,
    unpack_chunk,
    unpack_cut_chunk,
    walk,
)
from pipeline.logs.salvage import scan_log

_MAX_SENTENCES = 20
_FOREIGN_MAGIC = {
    b"#ROSBAG": "a ROS 1 bag; convert it with `mcap convert in.bag out.mcap`",
    b"SQLite ": "a rosbag2 SQLite file; convert it with `ros2 bag convert` or `mcap convert in.db3 out.mcap`",
    b"PAR1": "a Parquet file",
    b"\x1f\x8b": "compressed with gzip; unpack it first",
    b"\x28\xb5\x2f\xfd": "compressed with zstd; unpack it first",
    b"PK\x03\x04": "a ZIP archive; unpack it first",
}


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


@dataclass(frozen=True)
class MissionLog:
    """A log that has been walked once; messages are read from the file on request.

    start_ns and end_ns are the log times of the first and the last message (both 0 without messages).
    """

    path: Path
    size_bytes: int
    channels: tuple[Channel, ...]
    start_ns: int
    end_ns: int
    health: Health
    library: str = ""
    _blocks: tuple[Block, ...] = field(default=(), repr=False)
    _metadata_spans: tuple[tuple[int, int], ...] = field(default=(), repr=False)

    def messages(
        self, topics: Collection[str] | None = None, on_bytes: Callable[[int], object] | None = None
    ) -> Iterator[RawMessage]:
        """All messages of `topics` (None: of every topic) in log-time order, then in the order of the file.

        Memory: one chunk, and the wanted messages of those chunks that overlap it in time. `on_bytes` is called with the
        number of bytes of the file done since the last call; the calls add up to `size_bytes`.
        """
        wanted = {channel.id: channel for channel in self.channels if topics is None or channel.topic in topics}
        with _open(self.path) as file, _as_input_error(self.path):
            yield from _merge(file, self._blocks, wanted, on_bytes)
        if on_bytes is not None:
            on_bytes(self.size_bytes - sum(block.length for block in self._blocks))

    def metadata(self) -> tuple[tuple[str, dict[str, str]], ...]:
        """Name and content of every Metadata record, in the order of the file."""
        found = []
        with _open(self.path) as file, _as_input_error(self.path):
            for offset, length in self._metadata_spans:
                record = parse_metadata(_read(file, offset, length))
                found.append((record.name, dict(record.metadata)))
        return tuple(found)


def open_log(path: Path | str, on_bytes: Callable[[int], object] | None = None) -> MissionLog:
    """Walk the log at `path` once, checking every checksum; a damaged log opens too, and its health says what is lost.

    `on_bytes` is called as in `MissionLog.messages`. Raises `InputError` where there is no MCAP at `path`.
    """
    path = Path(path)
    size = _check_magic(path)
    try:
        plan = scan_log(path, size, on_bytes)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the disk") from error
    channels = _channels(plan)
    known = {channel.id for channel in channels}
    blocks = tuple(sorted((b for b in plan.blocks if known & b.num_messages.keys()), key=lambda b: (b.start_ns, b.offset)))
    return MissionLog(
        path, size, channels,
        start_ns=min((block.start_ns for block in blocks), default=0),
        end_ns=max((block.end_ns for block in blocks), default=0),
        health=_health(plan, known), library=plan.library,
        _blocks=blocks, _metadata_spans=tuple(plan.metadata_spans),
    )  # fmt: skip


def utc(time_ns: int) -> str:
    """`time_ns` as ISO 8601 in UTC with milliseconds; seconds where it lies outside the calendar."""
    try:
        moment = datetime.fromtimestamp(time_ns // 10**9, UTC)
    except (ValueError, OverflowError, OSError):
        return f"{time_ns / 1e9:.3f} s"
    return f"{moment:%Y-%m-%dT%H:%M:%S}.{time_ns // 10**6 % 1000:03d}Z"


def _check_magic(path: Path) -> int:
    """The size of the file, after a look at its first bytes."""
    if path.is_dir():
        raise InputError(f"{path}: is a folder; give the .mcap file inside it")
    try:
        with path.open("rb") as file:
            head = file.read(len(MAGIC))
            size = file.seek(0, 2)
    except FileNotFoundError as error:
        raise InputError(f"{path}: not found; check the path") from error
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}); check the permissions") from error
    if size == 0:
        raise InputError(f"{path}: is empty; nothing was recorded, or the copy failed")
    if head != MAGIC:
        kind = next((text for magic, text in _FOREIGN_MAGIC.items() if head.startswith(magic)), "something else")
        raise InputError(f"{path}: is not an MCAP file but {kind}")
    return size


def _channels(plan: Plan) -> tuple[Channel, ...]:
    counts = plan.counts()
    channels = []
    for number, record in sorted(plan.channels.items()):
        schema = plan.schemas.get(record.schema_id)
        name, encoding, data = (schema.name, schema.encoding, schema.data) if schema else ("", "", b"")
        metadata = dict(record.metadata)
        channels.append(Channel(number, record.topic, record.message_encoding, name, encoding, data, counts[number], metadata))
    return tuple(channels)


def _health(plan: Plan, known: set[int]) -> Health:
    counts = plan.counts()
    found = counts.total()
    lost = {number: count for number, count in counts.items() if number not in known}
    readable = found - sum(lost.values())
    statistics = plan.summary.statistics if plan.summary else None
    expected = statistics.message_count if statistics else None
    if expected is None and all(loss.num_messages is not None for loss in plan.losses) and plan.reached_end and not plan.doubts:
        expected = found + sum(loss.num_messages or 0 for loss in plan.losses)
    problems = [_sentence(loss) for loss in plan.losses[:_MAX_SENTENCES]]
    if len(plan.losses) > _MAX_SENTENCES:
        problems.append(f"{len(plan.losses) - _MAX_SENTENCES} more damaged places follow.")
    problems += plan.doubts[:_MAX_SENTENCES]
    if lost:
        ids = ", ".join(map(str, sorted(lost)))
        problems.append(f"{sum(lost.values())} messages belong to channels without a definition (id {ids}) and cannot be used.")
    is_complete = not problems
    for number, channel in sorted(plan.channels.items()):
        if channel.schema_id and channel.schema_id not in plan.schemas:
            problems.append(f"Channel {number} ({channel.topic}) names schema {channel.schema_id}, which is not in the file.")
    disagreement = _disagreement(counts, readable, expected, statistics)
    if disagreement:
        is_complete = False
        problems.append(disagreement)
    spans = tuple(sorted({loss.span_ns for loss in plan.losses if loss.span_ns is not None}))
    return Health(is_complete, (*problems, *plan.remarks), readable, expected, spans, plan.has_checksums)


def _disagreement(counts: Counter[int], readable: int, expected: int | None, statistics: Statistics | None) -> str:
    """How the messages that were found differ from what the file says of itself; empty where they agree."""
    if expected is not None and expected != readable:
        return f"The file should hold {expected} messages; {readable} can be read."
    if statistics is not None and statistics.channel_message_counts and +Counter(statistics.channel_message_counts) != +counts:
        return "The numbers of messages of single channels differ from the statistics of the file."
    return ""


def _sentence(loss: Loss) -> str:
    span = ""
    if loss.span_ns is not None:
        start, end = loss.span_ns
        span = f", {utc(start)} to {utc(end)} ({(end - start) / 1e9:.3g} s)"
    count = "" if loss.num_messages is None else f", {loss.num_messages} messages"
    return f"Lost at byte {loss.offset}{span}{count}: {loss.reason}."


def _open(path: Path) -> BinaryIO:
    try:
        return path.open("rb")
    except OSError as error:
        raise InputError(f"{path}: cannot be read any more ({error.strerror}); was it moved?") from error


@contextlib.contextmanager
def _as_input_error(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the disk") from error
    except DamagedRecord as error:
        raise InputError(f"{path}: was changed while it was being read ({error}); run again") from error


def _read(file: BinaryIO, offset: int, length: int) -> bytes:
    file.seek(offset)
    data = file.read(length)
    if len(data) != length:
        raise DamagedRecord("the file has become shorter")
    return data


def _merge(
    file: BinaryIO, blocks: tuple[Block, ...], wanted: Mapping[int, Channel], on_bytes: Callable[[int], object] | None
) -> Iterator[RawMessage]:
    """Messages of blocks sorted by start time; those of blocks that overlap wait in a heap."""
    waiting: list[tuple[int, int, int, RawMessage]] = []
    bounds = [*((block.start_ns, block.offset) for block in blocks[1:]), (math.inf, 0)]
    for block, bound in zip(blocks, bounds, strict=False):
        if wanted.keys() & block.num_messages.keys():
            rows = _rows(file, block, wanted)
            if not waiting and (block.end_ns, block.offset) < bound:
                yield from (row[-1] for row in rows)
            else:
                for row in rows:
                    heapq.heappush(waiting, row)
        while waiting and waiting[0][:2] < bound:
            yield heapq.heappop(waiting)[-1]
        if on_bytes is not None:
            on_bytes(block.length)


def _rows(file: BinaryIO, block: Block, wanted: Mapping[int, Channel]) -> Iterator[tuple[int, int, int, RawMessage]]:
    """(log time, offset of the block, offset inside it, message) of the wanted messages, sorted."""
    data = _read(file, block.offset, block.length)
    if block.kind == "chunk":
        data = unpack_chunk(parse_chunk(data))
    elif block.kind == "cut":
        data = unpack_cut_chunk(data)[1]
    rows = _slices(data, block, wanted)
    return rows if block.is_sorted else iter(sorted(rows, key=lambda row: row[:3]))


def _slices(data: bytes, block: Block, wanted: Mapping[int, Channel]) -> Iterator[tuple[int, int, int, RawMessage]]:
    unpack, size = MESSAGE_HEAD.unpack_from, MESSAGE_HEAD.size
    for opcode, begin, end in walk(data, is_cut=block.kind == "cut"):
        if opcode != Opcode.MESSAGE:
            continue
        channel_id, sequence, log_time, publish_time = unpack(data, begin)
        channel = wanted.get(channel_id)
        if channel is not None and log_time <= MAX_TIME_NS:
            yield log_time, block.offset, begin, RawMessage(channel, log_time, publish_time, sequence, data[begin + size : end])
