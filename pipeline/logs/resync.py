"""Where records begin again after damage, in a file whose index does not tell, and where another recording begins."""

import re
import struct
from collections.abc import Callable, Collection, Mapping
from functools import partial
from typing import BinaryIO, Final

from mcap.opcode import Opcode

from pipeline.logs.records import (
    CHUNK_HEAD,
    CHUNK_HEAD_BYTES,
    HEAD,
    MAGIC,
    MESSAGE_HEAD,
    DamagedRecord,
    is_chunk_head,
    parse_channel,
    parse_header,
    parse_metadata,
    parse_schema,
)
from pipeline.logs.summary import SUMMARY_OPCODES, parse_summary_record

_WINDOW_BYTES: Final = 2**20
_MAX_SEARCH_BYTES: Final = 2**28
_BELIEVED: Final = 3  # points that make a place believable, see `_points`
_CANDIDATE: Final = re.compile(rb"[\x01-\x0f](?=[\x00-\xff]{5}\x00{3})")  # an opcode and a length below 2**40
_BEGINNING: Final = re.compile(re.escape(MAGIC) + rb"\x01[\x00-\xff]{2}\x00{6}")  # magic and the head of a small header
_BEGINNING_BYTES: Final = len(MAGIC) + HEAD.size
_MAX_HEADER_BYTES: Final = 2**16
_PARSERS: Final[Mapping[int, Callable[[bytes], object]]] = {
    Opcode.CHANNEL: parse_channel,
    Opcode.SCHEMA: parse_schema,
    Opcode.METADATA: parse_metadata,
    **{opcode: partial(parse_summary_record, opcode) for opcode in SUMMARY_OPCODES},
}


def find_records(file: BinaryIO, begin: int, limit: int, channel_ids: Collection[int]) -> int:
    """The first place from `begin` on where plausible records follow each other; `limit` where there is none."""
    for window in range(begin, min(limit, begin + _MAX_SEARCH_BYTES), _WINDOW_BYTES):
        file.seek(window)
        data = file.read(_WINDOW_BYTES + HEAD.size - 1)
        for match in _CANDIDATE.finditer(data):
            _, length = HEAD.unpack_from(data, match.start())
            offset = window + match.start()
            if offset + HEAD.size + length <= limit and _is_believable(file, offset, limit, channel_ids):
                return offset
    return limit


def begins_recording(file: BinaryIO, offset: int, limit: int) -> bool:
    """Whether a recording begins at `offset`: magic, and a header whose lengths agree with each other."""
    file.seek(offset)
    start = file.read(len(MAGIC) + HEAD.size)
    if start[: len(MAGIC)] != MAGIC or len(start) < len(MAGIC) + HEAD.size:
        return False
    opcode, length = HEAD.unpack_from(start, len(MAGIC))
    if opcode != Opcode.HEADER or length > _MAX_HEADER_BYTES or offset + len(start) + length > limit:
        return False
    try:
        parse_header(file.read(length))
    except DamagedRecord:
        return False
    return True


def find_recording(file: BinaryIO, begin: int, end: int) -> int | None:
    """The first place in these bytes of the file at which a recording begins."""
    for window in range(begin, end, _WINDOW_BYTES):
        file.seek(window)
        for match in _BEGINNING.finditer(file.read(min(_WINDOW_BYTES + _BEGINNING_BYTES - 1, end - window))):
            if begins_recording(file, window + match.start(), end):
                return window + match.start()
    return None


def _is_believable(file: BinaryIO, offset: int, limit: int, channel_ids: Collection[int]) -> bool:
    """Whether plausible records follow each other from `offset` on, enough of them or up to the end."""
    points = 0
    while points < _BELIEVED and offset < limit:
        file.seek(offset)
        head = file.read(HEAD.size)
        if len(head) < HEAD.size:
            return False
        opcode, length = HEAD.unpack(head)
        found = _points(file, opcode, length, channel_ids) if offset + HEAD.size + length <= limit else 0
        if found == 0:
            return False
        if opcode == Opcode.DATA_END:
            return points > 0
        points += found
        offset += HEAD.size + length
    return True


def _points(file: BinaryIO, opcode: int, length: int, channel_ids: Collection[int]) -> int:
    """How much the record whose body begins here speaks for itself: 2 where lengths inside agree with the outer one."""
    if opcode == Opcode.MESSAGE and length >= MESSAGE_HEAD.size:
        return int(struct.unpack("<H", file.read(2))[0] in channel_ids)
    if opcode == Opcode.CHUNK and length > CHUNK_HEAD.size:
        return 2 * is_chunk_head(file.read(CHUNK_HEAD_BYTES), length)
    if opcode == Opcode.MESSAGE_INDEX and length >= 6:
        return 2 * (struct.unpack("<xxI", file.read(6))[0] == length - 6 and (length - 6) % 16 == 0)
    if opcode in _PARSERS and length <= _WINDOW_BYTES:
        try:
            _PARSERS[opcode](file.read(length))
        except DamagedRecord:
            return 0
        return 2
    return int(opcode == Opcode.DATA_END and length == 4)
