"""The end of an MCAP under construction: definitions, statistics and indexes, kept as the records that will be written.

An index may begin with what another file says of its own data (see `append`), or empty.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from zlib_ng.zlib_ng import crc32

from pipeline.logs.records import HEAD, MAGIC

MAX_ID: Final = 2**16 - 1
"""Ids of channels and schemas are 16 bits wide; schema 0 means that there is none."""

_FOOTER: Final = struct.Struct("<BQQQ")
FOOTER_BYTES: Final = _FOOTER.size + 4 + len(MAGIC)
"""Footer and magic: the end of every file."""
_ORDER: Final = (
    Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS, Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX,
)  # fmt: skip


def empty_statistics() -> records.Statistics:
    """Statistics of a file without any record."""
    return records.Statistics(
        attachment_count=0, channel_count=0, channel_message_counts={}, chunk_count=0, message_count=0,
        message_end_time=0, message_start_time=0, metadata_count=0, schema_count=0,
    )  # fmt: skip


def encode_record(record: records.McapRecord) -> bytes:
    """The record with its head, as it stands in a file."""
    builder = RecordBuilder()
    record.write(builder)
    encoded: bytes = builder.end()  # type: ignore[no-untyped-call]
    return encoded


@dataclass
class Index:
    """What the data section holds so far.

    statistics          of all records that were added
    groups              encoded records of the summary by opcode, without statistics
    max_schema_id       largest id in use, 0 where there is none; as `max_channel_id`
    is_searchable       False where messages lie outside chunks or in chunks without message index: a reader that trusts
                        chunk indexes would miss them, so none are written and readers go through the whole file
    """

    statistics: records.Statistics = field(default_factory=empty_statistics)
    groups: dict[int, bytearray] = field(default_factory=dict)
    max_schema_id: int = 0
    max_channel_id: int = 0
    is_searchable: bool = True

    def add_schema(self, number: int, encoded: bytes) -> None:
        """Take a Schema record (with its head) whose id is new."""
        self.max_schema_id = max(self.max_schema_id, number)
        self.statistics.schema_count += 1
        self._group(Opcode.SCHEMA, encoded)

    def add_channel(self, number: int, encoded: bytes) -> None:
        """Take a Channel record (with its head) whose id is new."""
        self.max_channel_id = max(self.max_channel_id, number)
        self.statistics.channel_count += 1
        self._group(Opcode.CHANNEL, encoded)

    def add_messages(self, counts: Mapping[int, int], first_ns: int, last_ns: int) -> None:
        """Count messages by channel id; their log times lie in [first_ns, last_ns]."""
        total, statistics = sum(counts.values()), self.statistics
        if total:
            is_first = statistics.message_count == 0
            statistics.message_start_time = first_ns if is_first else min(first_ns, statistics.message_start_time)
            statistics.message_end_time = max(last_ns, statistics.message_end_time)
            statistics.message_count += total
            for number, count in counts.items():
                statistics.channel_message_counts[number] = statistics.channel_message_counts.get(number, 0) + count

    def add_chunk(self, index: records.ChunkIndex) -> None:
        """Take a chunk; its messages are counted by `add_messages`."""
        self.statistics.chunk_count += 1
        self._group(Opcode.CHUNK_INDEX, encode_record(index))

    def add_attachment(self, index: records.AttachmentIndex) -> None:
        """Take an attachment."""
        self.statistics.attachment_count += 1
        self._group(Opcode.ATTACHMENT_INDEX, encode_record(index))

    def add_metadata(self, index: records.MetadataIndex) -> None:
        """Take a Metadata record."""
        self.statistics.metadata_count += 1
        self._group(Opcode.METADATA_INDEX, encode_record(index))

    def _group(self, opcode: int, encoded: bytes) -> None:
        self.groups.setdefault(opcode, bytearray()).extend(encoded)

    def ending(self, position: int) -> bytes:
        """Summary, its offsets, footer and magic of a file whose data section ends at `position`."""
        groups: dict[int, bytes | bytearray] = {**self.groups, Opcode.STATISTICS: encode_record(self.statistics)}
        if not self.is_searchable:
            groups.pop(Opcode.CHUNK_INDEX, None)
        summary, offsets = bytearray(), bytearray()
        # Kinds of records that are not known here come from a source and are kept.
        for opcode in (*_ORDER, *sorted(groups.keys() - set(_ORDER))):
            if groups.get(opcode):
                offset = records.SummaryOffset(
                    group_opcode=opcode, group_start=position + len(summary), group_length=len(groups[opcode])
                )
                offsets += encode_record(offset)
                summary += groups[opcode]
        footer = _FOOTER.pack(Opcode.FOOTER, _FOOTER.size - HEAD.size + 4, position, position + len(summary))
        checksum = crc32(footer, crc32(summary + offsets))
        return bytes(summary + offsets + footer + struct.pack("<I", checksum) + MAGIC)
