"""The index of a log that exists, so that records can be added behind its data without reading them all.

The log's own summary is taken where its checksum and every record head of the data agree with it. Else the index is built
from the data: every chunk is unpacked once.
"""

import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import BinaryIO, Final

from mcap import records
from mcap.opcode import Opcode

from pipeline.logs.index import FOOTER_BYTES, Index
from pipeline.logs.records import (
    CHUNK_HEAD_BYTES,
    HEAD,
    MAGIC,
    MAX_CHUNK_BYTES,
    MESSAGE_HEAD,
    DamagedRecord,
    StrictStream,
    damage,
    is_chunk_head,
    parse_channel,
    parse_chunk,
    parse_metadata,
    parse_schema,
    unpack_chunk,
    walk,
)
from pipeline.logs.summary import Summary, read_summary

_INDEX_HEAD: Final = struct.Struct("<HI")
_MAX_NAMES_BYTES: Final = 2**20  # times, name and media type of an attachment
_IN_SUMMARY: Final = frozenset(
    {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX}
)
_IN_DATA: Final = frozenset(
    {Opcode.MESSAGE, Opcode.CHUNK, Opcode.MESSAGE_INDEX, Opcode.ATTACHMENT, Opcode.METADATA, Opcode.DATA_END}
)


@dataclass
class _Survey:
    """What the heads of the records tell without a look into chunks.

    offsets  of chunks, attachments and metadata, by opcode
    counts   of messages by channel id: those that message indexes name and those outside chunks
    loose    channels of messages outside chunks
    defined  channels that are defined outside chunks
    """

    data_end: int = 0
    checksum: int = 0
    offsets: dict[int, list[int]] = field(
        default_factory=lambda: {kind: [] for kind in (Opcode.CHUNK, Opcode.ATTACHMENT, Opcode.METADATA)}
    )
    counts: Counter[int] = field(default_factory=Counter)
    loose: set[int] = field(default_factory=set)
    defined: set[int] = field(default_factory=set)


@dataclass(frozen=True)
class SourceIndex:
    """Index of a log, the offset of its DataEnd record, and the checksum stated there (0: none)."""

    index: Index
    data_end: int
    checksum: int


def read_index(file: BinaryIO, size: int) -> SourceIndex:
    """The index of a log of `size` bytes; `DamagedRecord` where the log does not hold what it should."""
    if _read(file, 0, min(size, len(MAGIC))) != MAGIC:
        raise DamagedRecord("it does not begin as an MCAP file does")
    survey = _survey(file, size)
    _check_tail(file, survey.data_end + HEAD.size + 4, size)
    summary, _ = read_summary(file, 0, size)
    index = _from_summary(file, size, survey, summary) if summary is not None else None
    if index is None:
        index = _from_data(file, size)
        expected = summary.statistics.message_count if summary is not None and summary.statistics else None
        if expected not in (None, index.statistics.message_count):
            raise DamagedRecord(f"it should hold {expected} messages, and {index.statistics.message_count} are there")
    return SourceIndex(index, survey.data_end, survey.checksum)


def _heads(file: BinaryIO, size: int) -> Iterator[tuple[int, int, int]]:
    """Offset, opcode and length of the body of every record up to DataEnd, which is the last; the caller may seek."""
    position, opcode = len(MAGIC), 0
    while opcode != Opcode.DATA_END:
        opcode, length = HEAD.unpack(_read(file, position, HEAD.size))
        if opcode == 0 or opcode in (Opcode.FOOTER, *_IN_SUMMARY - {Opcode.SCHEMA, Opcode.CHANNEL}):
            raise DamagedRecord(f"at byte {position}: a record that does not belong there")
        if position + HEAD.size + length > size:
            raise DamagedRecord("the file ends inside a record")
        yield position, opcode, length
        position += HEAD.size + length


def _check_tail(file: BinaryIO, position: int, size: int) -> None:
    """Raise where behind the end of the data stands more than a summary, as far as that can be read."""
    opcode = 0
    while position + HEAD.size <= size:
        if opcode == Opcode.FOOTER:
            raise DamagedRecord(f"at byte {position}: more follows behind its end")
        opcode, length = HEAD.unpack(_read(file, position, HEAD.size))
        if opcode in _IN_DATA:
            raise DamagedRecord(f"at byte {position}: records of the data follow behind their end")
        position += HEAD.size + length


def _read(file: BinaryIO, offset: int, length: int) -> bytes:
    file.seek(offset)
    data = file.read(length)
    if len(data) != length:
        raise DamagedRecord("the file ends without the end mark of its data")
    return data


def _survey(file: BinaryIO, size: int) -> _Survey:
    found = _Survey()
    for offset, opcode, length in _heads(file, size):
        body = offset + HEAD.size
        if opcode in found.offsets:
            found.offsets[opcode].append(offset)
        if opcode == Opcode.CHUNK and not is_chunk_head(_read(file, body, min(length, CHUNK_HEAD_BYTES)), length):
            raise DamagedRecord(f"at byte {offset}: the lengths in a chunk contradict each other")
        if opcode == Opcode.MESSAGE:
            if length < MESSAGE_HEAD.size:
                raise DamagedRecord(f"at byte {offset}: a message is too short")
            number = int.from_bytes(_read(file, body, 2), "little")
            found.loose.add(number)
            found.counts[number] += 1
        elif opcode == Opcode.CHANNEL:
            found.defined.add(int.from_bytes(_read(file, body, 2), "little"))
        elif opcode == Opcode.MESSAGE_INDEX:
            number, num_bytes = _INDEX_HEAD.unpack(_read(file, body, _INDEX_HEAD.size))
            found.counts[number] += num_bytes // 16
        elif opcode == Opcode.DATA_END:
            found.data_end, found.checksum = offset, int.from_bytes(_read(file, body, 4), "little")
    return found


def _from_summary(file: BinaryIO, size: int, survey: _Survey, summary: Summary) -> Index | None:
    """The index as the summary states it; None where the summary lacks something that the data hold."""
    end = survey.data_end + HEAD.size + 4
    statistics = summary.statistics
    if statistics is None or summary.data_end != end or +survey.counts != +Counter(statistics.channel_message_counts):
        return None
    groups: dict[int, bytearray] = {}
    pointed: dict[int, list[int]] = {kind: [] for kind in survey.offsets}
    data = _read(file, end, size - end - FOOTER_BYTES)
    for opcode, begin, stop in walk(data):
        if opcode in _IN_SUMMARY or opcode >= 0x80:
            groups.setdefault(opcode, bytearray()).extend(data[begin - HEAD.size : stop])
        if opcode == Opcode.CHUNK_INDEX:
            pointed[Opcode.CHUNK].append(int.from_bytes(data[begin + 16 : begin + 24], "little"))
        elif opcode in (Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX):
            kind = Opcode.ATTACHMENT if opcode == Opcode.ATTACHMENT_INDEX else Opcode.METADATA
            pointed[kind].append(int.from_bytes(data[begin : begin + 8], "little"))
    numbers = (len(summary.schemas), len(summary.channels), sum(survey.counts.values()))
    is_whole = (
        all(sorted(pointed[kind]) == offsets for kind, offsets in survey.offsets.items())
        and numbers == (statistics.schema_count, statistics.channel_count, statistics.message_count)
        and survey.counts.keys() <= summary.channels.keys()
        and survey.loose <= survey.defined
    )
    if not is_whole:
        return None
    largest = max(summary.schemas, default=0), max(summary.channels, default=0)
    return Index(statistics, groups, *largest, is_searchable=not survey.loose)


def _from_data(file: BinaryIO, size: int) -> Index:
    """The index that a writer would have written; every chunk is unpacked and checked."""
    builder = _Builder()
    for offset, opcode, length in _heads(file, size):
        if opcode != Opcode.MESSAGE_INDEX:
            builder.end_chunk()
        body, num_bytes = offset + HEAD.size, min(length, _MAX_NAMES_BYTES) if opcode == Opcode.ATTACHMENT else length
        if opcode in _TAKEN:
            if num_bytes > MAX_CHUNK_BYTES + CHUNK_HEAD_BYTES:
                raise DamagedRecord(f"at byte {offset}: a record of {length} bytes is larger than the limit")
            builder.take(opcode, offset, length, _read(file, body, num_bytes))
    unknown = sorted(builder.index.statistics.channel_message_counts.keys() - builder.channels)
    if unknown:
        raise DamagedRecord(f"messages belong to channels without a definition (id {', '.join(map(str, unknown))})")
    return builder.index


_TAKEN: Final = frozenset(
    {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK, Opcode.MESSAGE_INDEX, Opcode.ATTACHMENT, Opcode.METADATA}
)


class _Builder:
    """Takes the records of a data section one after the other."""

    def __init__(self) -> None:
        self.index = Index()
        self.channels: set[int] = set()
        self._schemas: set[int] = set()
        self._chunk: records.ChunkIndex | None = None  # the one just before, until its message indexes are known
        self._num_waiting = 0  # messages of that chunk that no message index has named so far

    def take(self, opcode: int, offset: int, length: int, body: bytes) -> None:
        """Index the record at `offset`; of attachments `body` is the beginning."""
        if opcode == Opcode.CHUNK:
            self._take_chunk(offset, body)
        elif opcode == Opcode.MESSAGE_INDEX:
            self._take_message_index(offset, body)
        elif opcode == Opcode.MESSAGE:
            self.index.is_searchable = False
            number, _, time_ns, _ = MESSAGE_HEAD.unpack_from(body)
            self.index.add_messages({number: 1}, time_ns, time_ns)
        elif opcode == Opcode.ATTACHMENT:
            self.index.add_attachment(_attachment_index(offset, length, body))
        elif opcode == Opcode.METADATA:
            name = parse_metadata(body).name
            self.index.add_metadata(records.MetadataIndex(offset=offset, length=HEAD.size + length, name=name))
        else:
            self._define(opcode, body)

    def end_chunk(self) -> None:
        """The message indexes of the chunk before, if there was one, are complete."""
        if self._chunk is not None:
            self.index.add_chunk(self._chunk)
            self.index.is_searchable = self.index.is_searchable and self._num_waiting == 0
        self._chunk, self._num_waiting = None, 0

    def _define(self, opcode: int, body: bytes) -> None:
        encoded = HEAD.pack(opcode, len(body)) + body
        if opcode == Opcode.SCHEMA:
            number = parse_schema(body).id
            if number not in self._schemas:
                self._schemas.add(number)
                self.index.add_schema(number, encoded)
        else:
            number = parse_channel(body).id
            if number not in self.channels:
                self.channels.add(number)
                self.index.add_channel(number, encoded)

    def _take_chunk(self, offset: int, body: bytes) -> None:
        chunk = parse_chunk(body)
        data = unpack_chunk(chunk)
        counts: Counter[int] = Counter()
        times = []
        for opcode, begin, end in walk(data):
            if opcode == Opcode.MESSAGE:
                number, _, time_ns, _ = MESSAGE_HEAD.unpack_from(data, begin)
                counts[number] += 1
                times.append(time_ns)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._define(opcode, data[begin:end])
        first_ns, last_ns = min(times, default=0), max(times, default=0)
        self.index.add_messages(counts, first_ns, last_ns)
        self._num_waiting = len(times)
        self._chunk = records.ChunkIndex(
            chunk_start_offset=offset, chunk_length=HEAD.size + len(body), message_start_time=first_ns,
            message_end_time=last_ns, message_index_offsets={}, message_index_length=0, compression=chunk.compression,
            compressed_size=len(chunk.data), uncompressed_size=len(data),
        )  # fmt: skip

    def _take_message_index(self, offset: int, body: bytes) -> None:
        if self._chunk is None:
            raise DamagedRecord(f"at byte {offset}: a message index without its chunk")
        number, num_bytes = _INDEX_HEAD.unpack_from(body)
        self._chunk.message_index_offsets[number] = offset
        self._chunk.message_index_length += HEAD.size + len(body)
        self._num_waiting -= num_bytes // 16


def _attachment_index(offset: int, length: int, body: bytes) -> records.AttachmentIndex:
    with damage():
        stream = StrictStream(body)
        log_time, create_time = stream.read8(), stream.read8()
        name, media_type = stream.read_prefixed_string(), stream.read_prefixed_string()
        data_size = stream.read8()
    if stream.count + data_size + 4 != length:
        raise DamagedRecord(f"at byte {offset}: the lengths in an attachment contradict each other")
    return records.AttachmentIndex(
        offset=offset, length=HEAD.size + length, log_time=log_time, create_time=create_time,
        data_size=data_size, name=name, media_type=media_type,
    )  # fmt: skip
