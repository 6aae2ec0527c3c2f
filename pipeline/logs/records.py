"""Records and chunks of an MCAP as bytes, read strictly: every foreign error becomes `DamagedRecord` here.

The only place that calls the record parsers of `mcap` and unpacks chunks, so that the rest of the house knows one kind of
damage. Sizes that a file declares are never believed before they are checked: a short file cannot make us allocate much.
"""

import contextlib
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from typing import Final

import numpy as np
import numpy.typing as npt
import zstandard
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from zlib_ng.zlib_ng import crc32

from pipeline.logs.compression import unpack_lz4, unpack_zstd

MAGIC: Final = b"\x89MCAP0\r\n"
TEXT_MAGIC: Final = b"\x89MCAP0\n"
"""How a file begins that was copied as text: every CR LF in it became LF."""
HEAD: Final = struct.Struct("<BQ")
"""Opcode and length in front of every record."""
MESSAGE_HEAD: Final = struct.Struct("<HIQQ")
"""Channel id, sequence, log time and publish time in front of the data of a message."""
INDEX_ENTRY: Final = np.dtype([("log_time", "<u8"), ("offset", "<u8")])
"""One message in a MessageIndex record; the offset is that of the message record inside the unpacked chunk."""
DATA_END: Final = struct.Struct("<BQI")
"""The end mark of the data as a whole record: opcode, length and the checksum over all data, 0 where there is none."""
CHUNK_HEAD: Final = struct.Struct("<QQQII")
"""Start time, end time, uncompressed size, CRC and length of the name of the compression."""
CHUNK_HEAD_BYTES: Final = 64
"""Enough for `CHUNK_HEAD`, the name of the compression and the length of the data."""
MAX_CHUNK_BYTES: Final = 2**28
"""Largest chunk that is decompressed; recorders write a few megabytes. Reading takes about twice as much memory."""
MESSAGE: Final = int(Opcode.MESSAGE)
"""As a number: to look up the member of an enumeration for every record would take a third of a walk."""
MAX_TIME_NS: Final = 2**63 - 1
"""Latest log time that can be used: times are int64 everywhere else (the year 2262)."""

_MESSAGE_INDEX_HEAD: Final = struct.Struct("<HI")
_FOREIGN = (
    McapError, ValueError, struct.error, zstandard.ZstdError, RuntimeError, EOFError, OverflowError, MemoryError,
)  # fmt: skip
"""What `mcap`, zstandard, lz4 and struct raise on damage; CRCValidationError and UnicodeDecodeError are ValueErrors."""


class DamagedRecord(Exception):
    """A record that cannot be used; internal to the reading of logs, `str` says why."""


@contextlib.contextmanager
def damage() -> Iterator[None]:
    """Turns whatever a parser or decompressor raises on bad bytes into `DamagedRecord`."""
    try:
        yield
    except _FOREIGN as error:
        raise DamagedRecord(str(error) or type(error).__name__) from error


class StrictStream(ReadDataStream):
    """A stream over one record which raises where `mcap` would return fewer bytes than were asked for."""

    def __init__(self, body: bytes) -> None:
        super().__init__(BytesIO(body))

    def read(self, length: int) -> bytes:
        """Exactly `length` bytes."""
        data = super().read(length)
        if len(data) != length:
            raise EndOfFile
        return data


def parse_header(body: bytes) -> records.Header:
    """The Header record with this body; `DamagedRecord` where it is none."""
    with damage():
        record: records.Header = records.Header.read(StrictStream(body))
    return record


def library_of(body: bytes) -> str:
    """Who wrote the file, from the body of its Header record; empty where that cannot be read."""
    try:
        return str(parse_header(body).library)
    except DamagedRecord:
        return ""


def parse_channel(body: bytes) -> records.Channel:
    """The Channel record with this body; `DamagedRecord` where it is none."""
    with damage():
        record: records.Channel = records.Channel.read(StrictStream(body))
    return record


def parse_schema(body: bytes) -> records.Schema:
    """The Schema record with this body; `DamagedRecord` where it is none."""
    with damage():
        record: records.Schema = records.Schema.read(StrictStream(body))
    return record


def parse_metadata(body: bytes) -> records.Metadata:
    """The Metadata record with this body; `DamagedRecord` where it is none."""
    with damage():
        record: records.Metadata = records.Metadata.read(StrictStream(body))
    return record


@dataclass(frozen=True)
class PackedChunk:
    """A Chunk record, still compressed; `data` is a view of its body."""

    start_ns: int
    end_ns: int
    uncompressed_size: int
    crc: int
    compression: str
    data: memoryview = field(repr=False)


def parse_chunk(body: bytes) -> PackedChunk:
    """The Chunk record with this body; `DamagedRecord` where its lengths contradict each other."""
    with damage():
        start, end, size, crc, name_length = CHUNK_HEAD.unpack_from(body)
        name = body[CHUNK_HEAD.size : CHUNK_HEAD.size + name_length].decode()
    if not is_chunk_head(body[: CHUNK_HEAD.size + name_length + 8], len(body)):
        raise DamagedRecord("the lengths in the chunk contradict each other")
    return PackedChunk(start, end, size, crc, name, memoryview(body)[CHUNK_HEAD.size + name_length + 8 :])


def parse_message_index(body: bytes) -> tuple[int, npt.NDArray[np.void]]:
    """Channel id and entries (`INDEX_ENTRY`) of the MessageIndex record with this body."""
    head = _MESSAGE_INDEX_HEAD.size
    channel_id, length = _MESSAGE_INDEX_HEAD.unpack_from(body) if len(body) >= head else (0, -1)
    if length != len(body) - head or length % INDEX_ENTRY.itemsize:
        raise DamagedRecord("the lengths in a message index contradict each other")
    return channel_id, np.frombuffer(body, INDEX_ENTRY, offset=head)


def unpack_chunk(chunk: PackedChunk) -> bytes:
    """The records inside `chunk`, CRC checked; `DamagedRecord` where anything is wrong with it."""
    if chunk.uncompressed_size > MAX_CHUNK_BYTES:
        raise DamagedRecord(f"it declares {chunk.uncompressed_size} bytes, more than the limit of {MAX_CHUNK_BYTES}")
    with damage():
        data = _decompress(chunk)
    if chunk.crc and crc32(data) != chunk.crc:
        raise DamagedRecord("its checksum does not match")
    if not chunk.crc and len(data) != chunk.uncompressed_size:
        raise DamagedRecord(f"it holds {len(data)} bytes instead of {chunk.uncompressed_size}")
    return data


def unpack_cut_chunk(body: bytes) -> tuple[PackedChunk, bytes]:
    """The chunk whose body is cut off by the end of the file, and what can be unpacked of it; no checksum covers that."""
    with damage():
        start, end, size, crc, name_length = CHUNK_HEAD.unpack_from(body)
        compression = body[CHUNK_HEAD.size : CHUNK_HEAD.size + name_length].decode()
        data = body[CHUNK_HEAD.size + name_length + 8 :]
        if compression == "zstd":
            data = unpack_zstd(data, min(size, MAX_CHUNK_BYTES), is_cut=True)
        elif compression == "lz4":
            data = unpack_lz4(data, min(size, MAX_CHUNK_BYTES))
        elif compression:
            raise DamagedRecord(f"it uses the compression {compression!r}, which is not known")
    return PackedChunk(start, end, size, crc, compression, memoryview(b"")), data


def is_chunk_head(head: bytes, length: int) -> bool:
    """Whether `head`, the first bytes of a chunk's body, agrees that the body is `length` bytes long."""
    if len(head) < CHUNK_HEAD.size:
        return False
    inner = CHUNK_HEAD.size + int(CHUNK_HEAD.unpack_from(head)[-1])
    return len(head) >= inner + 8 and int.from_bytes(head[inner : inner + 8], "little") == length - inner - 8


def _decompress(chunk: PackedChunk) -> bytes:
    if chunk.compression == "":
        return bytes(chunk.data)
    if chunk.uncompressed_size == 0 and not chunk.data:
        return b""
    if chunk.compression == "zstd":
        return unpack_zstd(chunk.data, chunk.uncompressed_size)
    if chunk.compression == "lz4":
        return unpack_lz4(chunk.data, chunk.uncompressed_size)
    raise DamagedRecord(f"it uses the compression {chunk.compression!r}, which is not known")


def walk(data: bytes, is_cut: bool = False) -> Iterator[tuple[int, int, int]]:
    """Opcode, begin and end of the body of every record in `data`.

    Raises `DamagedRecord` where the next one cannot be a record, or stops there if the data are known to be cut off.
    """
    unpack, head, least = HEAD.unpack_from, HEAD.size, MESSAGE_HEAD.size  # looked up once: this loop takes every record
    position, size = 0, len(data)
    while position < size:
        begin = position + head
        opcode, length = unpack(data, position) if begin <= size else (0, 0)
        position = begin + length
        # Opcode 0 does not exist; without this test megabytes of zeros would be walked nine bytes at a time.
        if opcode == 0 or position > size or (opcode == MESSAGE and length < least):
            if is_cut:
                return
            raise DamagedRecord("the lengths of the records inside contradict each other")
        yield opcode, begin, position
