"""The index at the end of an MCAP: read whole, its checksum verified, or not believed at all."""

import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Set
from dataclasses import dataclass, field
from typing import BinaryIO, Final, NamedTuple, TypeVar

from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from zlib_ng.zlib_ng import crc32

from pipeline.logs.records import DATA_END, HEAD, MAGIC, DamagedRecord, StrictStream, damage, parse_channel, parse_schema, walk

_FOOTER: Final = struct.Struct("<BQQQI")
_Definition = TypeVar("_Definition", records.Channel, records.Schema)
MAX_SUMMARY_BYTES: Final = 2**30
_MAX_GROUP_BYTES: Final = 2**22

_PARSERS: Final[Mapping[Opcode, Callable[[ReadDataStream], records.McapRecord]]] = {
    Opcode.STATISTICS: records.Statistics.read,
    Opcode.CHUNK_INDEX: records.ChunkIndex.read,
    Opcode.METADATA_INDEX: records.MetadataIndex.read,
    Opcode.ATTACHMENT_INDEX: records.AttachmentIndex.read,
    Opcode.SUMMARY_OFFSET: records.SummaryOffset.read,
    Opcode.FOOTER: records.Footer.read,
}
SUMMARY_OPCODES: Final = frozenset(_PARSERS)
"""Records that belong into the summary alone; channels and schemas stand among the data, too."""


@dataclass
class Summary:
    """What the end of the file says about the data. Offsets are those in the file.

    data_end  the byte after the DataEnd record
    chunks    index by the offset of the chunk record
    metadata_spans  offset and length of the bodies of the Metadata records that are indexed
    places    sorted offsets where records are known to begin; empty where no chunk is indexed
    shift     bytes by which the summary lies behind the place that the footer states; offsets in it may be off as much
    """

    data_end: int
    channels: dict[int, records.Channel] = field(default_factory=dict)
    schemas: dict[int, records.Schema] = field(default_factory=dict)
    statistics: records.Statistics | None = None
    chunks: dict[int, records.ChunkIndex] = field(default_factory=dict)
    metadata_spans: list[tuple[int, int]] = field(default_factory=list)
    places: list[int] = field(default_factory=list)
    shift: int = 0

    def add(self, opcode: int, body: bytes, begin: int) -> None:
        """Take a record, in which offsets count from the byte `begin`; `DamagedRecord` where it is none."""
        if opcode == Opcode.CHANNEL:
            channel = parse_channel(body)
            self.channels[channel.id] = channel
        elif opcode == Opcode.SCHEMA:
            schema = parse_schema(body)
            self.schemas[schema.id] = schema
        elif opcode <= Opcode.DATA_END:
            record = parse_summary_record(opcode, body)
            if isinstance(record, records.Statistics):
                self.statistics = record
            elif isinstance(record, records.ChunkIndex):
                record.chunk_start_offset += begin
                self.chunks[record.chunk_start_offset] = record
            elif isinstance(record, records.MetadataIndex | records.AttachmentIndex):
                self.places.append(begin + record.offset)
                if isinstance(record, records.MetadataIndex):
                    self.metadata_spans.append((begin + record.offset + HEAD.size, record.length - HEAD.size))


def read_summary(file: BinaryIO, begin: int, end: int) -> tuple[Summary | None, str]:
    """The summary of the recording in these bytes of the file, without records where there is none.

    None, and a sentence that says what is wrong with it, where it cannot be believed.
    """
    try:
        return _read(file, begin, end), ""
    except DamagedRecord as error:
        return None, f"The index at the end of the file cannot be used ({error}); all records were read without it."


def find_summary(file: BinaryIO, begin: int, end: int, data_end: int) -> Summary | None:
    """The summary directly behind the data, whose end is known, where the footer states another place; None without one."""
    try:
        return _read(file, begin, end, data_end)
    except DamagedRecord:
        return None


def stated_data_end(file: BinaryIO, begin: int, end: int) -> int | None:
    """Where the footer says that the data end; None where it cannot be read or does not say."""
    try:
        footer = _read_footer(file, begin, end)
    except DamagedRecord:
        return None
    return footer.start if footer.is_stated else None


def stated_statistics(file: BinaryIO, begin: int, end: int) -> records.Statistics | None:
    """The statistics at the place that the offsets before the footer state; no checksum covers them. None without any."""
    try:
        footer = _read_footer(file, begin, end)
        if not begin + len(MAGIC) <= footer.offsets <= footer.offset:
            return None
        for opcode, body in _bodies(_span(file, footer.offsets, footer.offset)):
            group = parse_summary_record(opcode, body)
            if isinstance(group, records.SummaryOffset) and group.group_opcode == Opcode.STATISTICS:
                start = begin + group.group_start
                ((opcode, body),) = _bodies(_span(file, start, min(footer.offset, start + group.group_length)))
                found = parse_summary_record(opcode, body)
                return found if isinstance(found, records.Statistics) else None
    except (DamagedRecord, ValueError):  # ValueError: not one record, but none or several
        return None
    return None


def parse_summary_record(opcode: int, body: bytes) -> records.McapRecord:
    """The record of the summary section with this body; `DamagedRecord` where it is none."""
    if opcode not in _PARSERS:
        raise DamagedRecord(f"opcode {opcode} does not belong into the summary")
    with damage():
        stream = StrictStream(body)
        record = _PARSERS[Opcode(opcode)](stream)
    if stream.count != len(body):
        raise DamagedRecord("the lengths in a record of the summary contradict each other")
    return record


def prefer_index(kind: str, known: dict[int, _Definition], indexed: Mapping[int, _Definition]) -> list[str]:
    """Put the definitions of the index into `known`: it has a checksum, records outside chunks have none. What differs."""
    doubts = []
    for number, record in indexed.items():
        if known.setdefault(number, record) != record:
            doubts.append(f"{kind} {number} differs between the data and the index; the index was used.")
            known[number] = record
    return doubts


def unconfirmed(definitions: Set[bytes], repeated: Iterable[tuple[int, bytes]]) -> Set[bytes]:
    """Those of `definitions`, opcode and body, that an index which is damaged does not repeat."""
    return definitions - {bytes([opcode]) + body for opcode, body in repeated}


class _Footer(NamedTuple):
    """The end of a recording: its own offset, the byte after the data as it states it, and the checksum of the summary.

    offsets    where the offsets of the summary's groups are said to lie
    is_stated  False where the recording has no summary; then the data end where the footer begins
    """

    offset: int
    start: int
    offsets: int
    is_stated: bool
    crc: int
    data: bytes


def _read_footer(file: BinaryIO, begin: int, end: int) -> _Footer:
    tail = _FOOTER.size + len(MAGIC)
    if end - begin < tail + len(MAGIC):
        raise DamagedRecord("the file is too short")
    file.seek(end - tail)
    data = file.read(tail)
    opcode, length, start, offset_start, crc = _FOOTER.unpack_from(data)
    if data[_FOOTER.size :] != MAGIC or opcode != Opcode.FOOTER or length != _FOOTER.size - HEAD.size:
        raise DamagedRecord("the end of the file is missing or overwritten")
    is_stated = bool(start or offset_start)
    return _Footer(
        end - tail, begin + (start or offset_start) if is_stated else end - tail, begin + offset_start, is_stated, crc, data
    )  # fmt: skip


def _read(file: BinaryIO, begin: int, end: int, data_end: int | None = None) -> Summary:
    footer = _read_footer(file, begin, end)
    place = footer.start if data_end is None else data_end
    if not footer.is_stated and not footer.crc and data_end is None:
        return Summary(footer.offset)
    if not begin + len(MAGIC) + DATA_END.size <= place <= footer.offset or footer.offset - place > MAX_SUMMARY_BYTES:
        raise DamagedRecord("the footer points nowhere")
    file.seek(place)
    data = file.read(footer.offset - place)
    if footer.crc and crc32(footer.data[: _FOOTER.size - 4], crc32(data)) != footer.crc:
        raise DamagedRecord("its checksum does not match")
    summary = Summary(place, shift=place - footer.start)
    for opcode, body in _bodies(data):
        summary.add(opcode, body, begin)
    if data_end is None:
        _check_places(summary)
    return summary


def _span(file: BinaryIO, begin: int, end: int) -> bytes:
    """These bytes of the file, as far as they are not more than a group of few records takes."""
    file.seek(begin)
    return file.read(max(0, min(end - begin, _MAX_GROUP_BYTES)))


def _bodies(data: bytes) -> Iterator[tuple[int, bytes]]:
    for opcode, begin, end in walk(data):
        yield opcode, data[begin:end]


def _check_places(summary: Summary) -> None:
    """Sort the places where records begin; raises where one of them cannot be."""
    if any(index.chunk_start_offset + index.chunk_length > summary.data_end for index in summary.chunks.values()):
        raise DamagedRecord("a chunk index points outside the data")
    if summary.chunks:
        summary.places = sorted([*summary.places, *summary.chunks, summary.data_end - DATA_END.size])
