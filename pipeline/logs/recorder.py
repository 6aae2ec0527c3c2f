"""The data section of an MCAP under construction: messages into compressed, checked and indexed chunks."""

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import BinaryIO, Final, Literal

import lz4.frame
import numpy as np
import zstandard
from mcap import records
from mcap.opcode import Opcode
from zlib_ng.zlib_ng import crc32

from pipeline.logs.index import Index, encode_record
from pipeline.logs.records import MAGIC, MESSAGE_HEAD

Compression = Literal["zstd", "lz4", "none"]

_MESSAGE: Final = struct.Struct("<BQHIQQ")
"""Opcode, length, and the fields in front of the data of a message."""


@dataclass(frozen=True)
class Packing:
    """How messages are put into chunks; the defaults are chosen by measurement (docs/benchmarks/logs.md).

    compression  zstd, lz4 or none
    chunk_bytes  a chunk ends with the message that fills it; before compression
    level        how hard zstd tries
    """

    compression: Compression = "zstd"
    chunk_bytes: int = 2 * 2**20
    level: int = 1

    def compressor(self) -> Callable[[bytes], bytes]:
        """What packs the content of a chunk; the same bytes for the same content."""
        if self.compression == "zstd":
            return zstandard.ZstdCompressor(level=self.level).compress
        return lz4.frame.compress if self.compression == "lz4" else bytes


class Recorder:
    """Appends to a data section; its messages should come in the order of their times: chunks then do not overlap.

    `index` is that of what `file` holds already, `position` its size, and `checksum` its CRC (None: unknown; DataEnd then
    says nothing, as the format allows).
    """

    def __init__(self, file: BinaryIO, packing: Packing, index: Index, position: int = 0, checksum: int | None = 0) -> None:
        self._file, self._index, self._position, self._checksum = file, index, position, checksum
        self._packing, self._compress = packing, packing.compressor()
        self._chunk = bytearray()
        self._entries: dict[int, list[tuple[int, int]]] = {}

    def start(self, profile: str, library: str) -> None:
        """Write what a file begins with."""
        self._put(MAGIC + encode_record(records.Header(profile=profile, library=library)))

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """The id of a new schema."""
        number = self._index.max_schema_id + 1
        encoded = encode_record(records.Schema(id=number, name=name, encoding=encoding, data=data))
        self._index.add_schema(number, encoded)
        self._chunk += encoded
        return number

    def add_channel(self, topic: str, encoding: str, schema_id: int, metadata: Mapping[str, str] | None = None) -> int:
        """The id of a new channel; `schema_id` 0: without schema."""
        number = self._index.max_channel_id + 1
        channel = records.Channel(
            id=number, topic=topic, message_encoding=encoding, schema_id=schema_id, metadata=dict(metadata or {})
        )
        encoded = encode_record(channel)
        self._index.add_channel(number, encoded)
        self._chunk += encoded
        return number

    def add_message(self, channel_id: int, sequence: int, log_time_ns: int, publish_time_ns: int, data: bytes) -> None:
        """Append a message; the chunk is written when it is full."""
        self._entries.setdefault(channel_id, []).append((log_time_ns, len(self._chunk)))
        length = MESSAGE_HEAD.size + len(data)
        self._chunk += _MESSAGE.pack(Opcode.MESSAGE, length, channel_id, sequence, log_time_ns, publish_time_ns)
        self._chunk += data
        if len(self._chunk) >= self._packing.chunk_bytes:
            self._end_chunk()

    def add_metadata(self, name: str, content: Mapping[str, str]) -> None:
        """Append a Metadata record; it lies outside of chunks."""
        encoded = encode_record(records.Metadata(name=name, metadata=dict(content)))
        offset = self._put(encoded)
        self._index.add_metadata(records.MetadataIndex(offset=offset, length=len(encoded), name=name))

    def finish(self) -> None:
        """Write the last chunk, the end mark of the data, and the index."""
        self._end_chunk()
        self._put(encode_record(records.DataEnd(self._checksum or 0)))
        self._file.write(self._index.ending(self._position))

    def _put(self, data: bytes) -> int:
        """Write; the offset of what was written."""
        offset = self._position
        self._file.write(data)
        self._position += len(data)
        if self._checksum is not None:
            self._checksum = crc32(data, self._checksum)
        return offset

    def _end_chunk(self) -> None:
        if not self._entries:
            return  # definitions alone are in the index; nobody needs a chunk of them
        entries = {number: np.array(rows, dtype="<u8") for number, rows in self._entries.items()}
        first_ns = min(int(rows[:, 0].min()) for rows in entries.values())
        last_ns = max(int(rows[:, 0].max()) for rows in entries.values())
        packed = self._compress(bytes(self._chunk))
        name = "" if self._packing.compression == "none" else self._packing.compression
        chunk = records.Chunk(
            compression=name, data=packed, message_start_time=first_ns, message_end_time=last_ns,
            uncompressed_crc=crc32(self._chunk), uncompressed_size=len(self._chunk),
        )  # fmt: skip
        encoded = encode_record(chunk)
        offset = self._put(encoded)
        begin = self._position
        offsets = {number: self._put(_encode_entries(number, rows)) for number, rows in entries.items()}
        self._index.add_messages({number: len(rows) for number, rows in entries.items()}, first_ns, last_ns)
        self._index.add_chunk(
            records.ChunkIndex(
                chunk_start_offset=offset, chunk_length=len(encoded), message_start_time=first_ns, message_end_time=last_ns,
                message_index_offsets=offsets, message_index_length=self._position - begin, compression=name,
                compressed_size=len(packed), uncompressed_size=len(self._chunk),
            )
        )  # fmt: skip
        self._chunk, self._entries = bytearray(), {}


def _encode_entries(channel_id: int, rows: np.ndarray[tuple[int, ...], np.dtype[np.uint64]]) -> bytes:
    """A MessageIndex record from rows of log time and offset."""
    data = rows.tobytes()
    return struct.pack("<BQHI", Opcode.MESSAGE_INDEX, len(data) + 6, channel_id, len(data)) + data
