"""Where records begin again after damage, in a file whose index does not tell, and where another recording begins."""

import re
import struct
from collections.abc import Callable, Collection, Mapping
from functools import partial
from typing import BinaryIO, Final

import numpy as np
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
_BELIEVED: Final = 3  # points that make a place believable, see `_points`
_MAX_PARSED_BYTES: Final = 2**25
_CHECK_BYTES: Final = 2**8  # what a look at one place costs, in bytes that are parsed
_BEGINNING: Final = re.compile(re.escape(MAGIC) + rb"\x01[\x00-\xff]{2}\x00{6}")  # magic and the head of a small header
_BEGINNING_BYTES: Final = len(MAGIC) + HEAD.size
_MAX_HEADER_BYTES: Final = 2**16
_PARSERS: Final[Mapping[int, Callable[[bytes], object]]] = {
    Opcode.CHANNEL: parse_channel,
    Opcode.SCHEMA: parse_schema,
    Opcode.METADATA: parse_metadata,
    **{opcode: partial(parse_summary_record, opcode) for opcode in SUMMARY_OPCODES},
}
_LEAST: Final = np.full(256, 2**62)
"""The least length of a record by its opcode; more than any file has for what is not looked for."""
for _opcode, _length in (
    (Opcode.MESSAGE, MESSAGE_HEAD.size), (Opcode.CHUNK, CHUNK_HEAD.size + 8), (Opcode.MESSAGE_INDEX, 6), (Opcode.DATA_END, 4),
    (Opcode.CHANNEL, 16), (Opcode.SCHEMA, 14), (Opcode.METADATA, 8), (Opcode.STATISTICS, 46), (Opcode.CHUNK_INDEX, 64),
    (Opcode.ATTACHMENT_INDEX, 48), (Opcode.METADATA_INDEX, 20), (Opcode.SUMMARY_OFFSET, 17), (Opcode.FOOTER, 20),
):  # fmt: skip
    _LEAST[_opcode] = _length


class RecordSearch:
    """Looks for records in one recording, `limit` its end, where nothing tells where they begin.

    All of the searches together parse a limited number of bytes: files can be made of nothing but beginnings of records.

    is_given_up  whether a search has ended because of that
    """

    def __init__(self, file: BinaryIO, limit: int) -> None:
        self.file, self.limit = file, limit
        self.is_given_up = False
        self._budget = _MAX_PARSED_BYTES

    def find(self, begin: int, channel_ids: Collection[int], on_position: Callable[[int], object]) -> int:
        """The first place from `begin` on where plausible records follow each other; the limit where there is none."""
        for window in range(begin, self.limit, _WINDOW_BYTES):
            on_position(window)
            self.file.seek(window)
            data = self.file.read(min(2 * _WINDOW_BYTES, self.limit - window))
            for offset in _candidates(data, self.limit - window):
                if offset >= _WINDOW_BYTES:
                    break
                if self._is_believable(window + offset, channel_ids):
                    return window + offset
                if self._budget < 0:
                    self.is_given_up = True
                    return self.limit
        return self.limit

    def _is_believable(self, offset: int, channel_ids: Collection[int]) -> bool:
        """Whether plausible records follow each other from `offset` on, enough of them or up to the end."""
        points = 0
        while points < _BELIEVED and offset < self.limit:
            self._budget -= _CHECK_BYTES
            self.file.seek(offset)
            head = self.file.read(HEAD.size)
            if len(head) < HEAD.size:
                return False
            opcode, length = HEAD.unpack(head)
            found = self._points(opcode, length, channel_ids) if offset + HEAD.size + length <= self.limit else 0
            if found == 0:
                return False
            if opcode == Opcode.DATA_END:
                return points > 0
            points += found
            offset += HEAD.size + length
        return True

    def _points(self, opcode: int, length: int, channel_ids: Collection[int]) -> int:
        """How much the record whose body begins here speaks for itself: 2 where lengths inside agree with the outer one."""
        if opcode == Opcode.MESSAGE and length >= MESSAGE_HEAD.size:
            return int(struct.unpack("<H", self.file.read(2))[0] in channel_ids)
        if opcode == Opcode.CHUNK and length > CHUNK_HEAD.size:
            return 2 * int(is_chunk_head(self.file.read(CHUNK_HEAD_BYTES), length))
        if opcode == Opcode.MESSAGE_INDEX and length >= 6:
            return 2 * (struct.unpack("<xxI", self.file.read(6))[0] == length - 6 and (length - 6) % 16 == 0)
        if opcode in _PARSERS and length <= _WINDOW_BYTES:
            self._budget -= length
            try:
                _PARSERS[opcode](self.file.read(length))
            except DamagedRecord:
                return 0
            return 2
        return int(opcode == Opcode.DATA_END and length == 4)


def _candidates(data: bytes, size: int) -> list[int]:
    """Where in `data` the head of a record may stand that another may follow, or the end of the `size` bytes there are."""
    heads = np.frombuffer(data, np.uint8)
    num_places = max(0, len(heads) - HEAD.size + 1)
    places = np.flatnonzero(_LEAST[heads[:num_places]] < size)
    places = places[(heads[places + 6] | heads[places + 7] | heads[places + 8]) == 0]  # lengths are below 2**40
    lengths = np.zeros(len(places), np.int64)
    for byte in range(5):
        lengths |= heads[places + 1 + byte].astype(np.int64) << 8 * byte
    is_long_enough = lengths >= _LEAST[heads[places]]
    places, ends = places[is_long_enough], (places + HEAD.size + lengths)[is_long_enough]
    is_place = np.zeros(num_places + 1, np.bool_)
    is_place[places] = True
    # The end mark is followed by anything; what ends outside is looked at by itself.
    is_followed = (ends == size) | is_place[np.minimum(ends, num_places)] | (heads[places] == Opcode.DATA_END)
    found: list[int] = places[is_followed | ((ends >= num_places) & (ends < size))].tolist()
    return found


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
