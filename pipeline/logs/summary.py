"""The index at the end of an MCAP: read whole, its checksum verified, or not believed at all."""

import struct
from collections.abc import Callable, Iterator, Mapping, Set
from dataclasses import dataclass, field
from typing import BinaryIO, Final, TypeVar

from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from zlib_ng.zlib_ng import crc32

from pipeline.logs.records import HEAD, MAGIC, DamagedRecord, StrictStream, damage, parse_channel, parse_schema, walk

_FOOTER: Final = struct.Struct("<BQQQI")
_Definition = TypeVar("_Definition", records.Channel, records.Schema)
MAX_SUMMARY_BYTES: Final = 2**30

_PARSERS: Final[Mapping[Opcode, Callable[[ReadDataStream], records.McapRecord]]] = {
    Opcode.STATISTICS: records.Statistics.read,
    Opcode.CHUNK_INDEX: records.ChunkIndex.read,
    Opcode.METADATA_INDEX: records.MetadataIndex.read,
    Opcode.ATTACHMENT_INDEX: records.AttachmentIndex.read,
    Opcode.SUMMARY_OFFSET: records.SummaryOffset.read,
    Opcode.FOOTER: records.Footer.read,
}


@dataclass
class Summary:
    """What the end of the file says about the data.

    data_end  the byte after the DataEnd record
    chunks    index by the offset of the chunk record
    metadata_spans  offset and length of the bodies of the Metadata records that are indexed
    places    sorted offsets where records are known to begin; empty where no chunk is indexed
    """

    data_end: int
    channels: dict[int, records.Channel] = field(default_factory=dict)
    schemas: dict[int, records.Schema] = field(default_factory=dict)
    statistics: records.Statistics | None = None
    chunks: dict[int, records.ChunkIndex] = field(default_factory=dict)
    metadata_spans: list[tuple[int, int]] = field(default_factory=list)
    places: list[int] = field(default_factory=list)


def read_summary(file: BinaryIO, size: int) -> tuple[Summary | None, str]:
    """The summary (without records where the file has none), or None and a sentence that says what is wrong with it."""
    try:
        return _read(file, size), ""
    except DamagedRecord as error:
        return None, f"The index at the end of the file cannot be used ({error}); all records were read without it."


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


def unconfirmed(definitions: Set[bytes], tail: bytes) -> set[bytes]:
    """Those of `definitions`, opcode and body, that are not repeated in `tail`, the bytes of an index that is damaged."""
    missing = set(definitions)
    for opcode, begin, end in walk(tail, is_cut=True):
        missing.discard(bytes([opcode]) + tail[begin:end])
    return missing


def _read(file: BinaryIO, size: int) -> Summary:
    tail = _FOOTER.size + len(MAGIC)
    if size < tail + len(MAGIC):
        raise DamagedRecord("the file is too short")
    file.seek(size - tail)
    footer = file.read(tail)
    opcode, length, start, offset_start, crc = _FOOTER.unpack_from(footer)
    if footer[_FOOTER.size :] != MAGIC or opcode != Opcode.FOOTER or length != _FOOTER.size - HEAD.size:
        raise DamagedRecord("the end of the file is missing or overwritten")
    footer_offset = size - tail
    if start == 0 and offset_start == 0 and not crc:
        return Summary(footer_offset)
    begin = start or offset_start or footer_offset
    if not len(MAGIC) < begin <= footer_offset or footer_offset - begin > MAX_SUMMARY_BYTES:
        raise DamagedRecord("the footer points nowhere")
    file.seek(begin)
    data = file.read(footer_offset - begin)
    if crc and crc32(footer[: _FOOTER.size - 4], crc32(data)) != crc:
        raise DamagedRecord("its checksum does not match")
    summary = Summary(begin)
    for number, body in _bodies(data):
        _add(summary, number, body)
    if summary.chunks:
        summary.places = sorted([*summary.places, *summary.chunks, begin - HEAD.size - 4])
    return summary


def _bodies(data: bytes) -> Iterator[tuple[int, bytes]]:
    for opcode, begin, end in walk(data):
        yield opcode, data[begin:end]


def _add(summary: Summary, opcode: int, body: bytes) -> None:
    if opcode == Opcode.CHANNEL:
        channel = parse_channel(body)
        summary.channels[channel.id] = channel
    elif opcode == Opcode.SCHEMA:
        schema = parse_schema(body)
        summary.schemas[schema.id] = schema
    elif opcode <= Opcode.DATA_END:
        record = parse_summary_record(opcode, body)
        if isinstance(record, records.Statistics):
            summary.statistics = record
        elif isinstance(record, records.ChunkIndex):
            if record.chunk_start_offset + record.chunk_length > summary.data_end:
                raise DamagedRecord("a chunk index points outside the data")
            summary.chunks[record.chunk_start_offset] = record
        elif isinstance(record, records.MetadataIndex | records.AttachmentIndex):
            summary.places.append(record.offset)
            if isinstance(record, records.MetadataIndex):
                summary.metadata_spans.append((record.offset + HEAD.size, record.length - HEAD.size))
