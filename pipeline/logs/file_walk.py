"""A walk from record to record over a file that may be damaged."""

import bisect
from collections.abc import Callable, Collection, Sequence
from typing import BinaryIO, Final, NamedTuple

from mcap.opcode import Opcode

from pipeline.logs.plan import is_span
from pipeline.logs.records import CHUNK_HEAD, HEAD, MAGIC, TEXT_MAGIC, DamagedRecord, parse_message_index
from pipeline.logs.resync import RecordSearch, find_recording
from pipeline.logs.rows import Index

MAX_SMALL_BYTES: Final = 2**26
"""Channels, schemas, metadata and message indexes that are larger are not believed."""

_READ_BYTES: Final = 2**20


class RecordHead(NamedTuple):
    """A record as its head states it, not yet believed: `body` and `end` are offsets in the file."""

    offset: int
    opcode: int
    body: int
    length: int
    end: int


class FileWalk:
    """Stands at one record of a recording after the other.

    begin, end  bytes of the file in which the recording lies
    limit       where the walk ends: behind the data where an index says where that is, else at the end
    places      sorted offsets where records are known to begin; empty where no index tells
    position    of the record at which the walk stands
    search      for records, where no index tells
    unsure      byte from which on nothing tells that the record before the position was one: it may hide a recording's end
    """

    def __init__(self, file: BinaryIO, begin: int, end: int, limit: int, places: Sequence[int]) -> None:
        self.file, self.begin, self.end, self.limit, self.places = file, begin, end, limit, places
        self.is_text = self.read(begin, len(TEXT_MAGIC)) == TEXT_MAGIC
        self.position = begin + len(TEXT_MAGIC if self.is_text else MAGIC)
        self.unsure = self.position
        self.search = RecordSearch(file, limit)

    def read(self, offset: int, length: int) -> bytes:
        """These bytes of the file; `DamagedRecord` where the recording does not have them."""
        self.file.seek(offset)
        data = self.file.read(max(0, min(length, self.end - offset)))
        if len(data) != length:
            raise DamagedRecord("the file ends inside a record")
        return data

    def is_over(self) -> bool:
        """Whether the walk has come to its end."""
        return self.position >= self.limit

    def go(self, position: int, is_sure: bool) -> None:
        """Stand at the record at `position`, behind one that is sure to be whole, or not."""
        self.unsure, self.position = position if is_sure else self.position, position

    def is_at_magic(self) -> bool:
        """Whether magic stands at the position, and no record."""
        self.file.seek(self.position)
        return self.file.read(len(MAGIC)) == MAGIC

    def head(self) -> RecordHead:
        """The head of the record at the position."""
        opcode, length = HEAD.unpack(self.read(self.position, HEAD.size))
        body = self.position + HEAD.size
        return RecordHead(self.position, opcode, body, length, body + length)

    def index_behind(self, offset: int) -> tuple[Index, int]:
        """The message indexes from `offset` on, up to the first that is damaged, and how many bytes they take."""
        begin, found = offset, []
        while offset + HEAD.size <= self.limit:
            opcode, length = HEAD.unpack(self.read(offset, HEAD.size))
            is_whole = length <= MAX_SMALL_BYTES and offset + HEAD.size + length <= self.limit
            if opcode != Opcode.MESSAGE_INDEX or not is_whole:
                break
            try:
                found.append(parse_message_index(self.read(offset + HEAD.size, length)))
            except DamagedRecord:
                break
            offset += HEAD.size + length
        return (found, offset - begin) if any(len(entries) for _, entries in found) else ([], 0)

    def span_at(self, offset: int) -> tuple[int, int] | None:
        """The time span that the head of a chunk at `offset` states; None where there is no such head."""
        try:
            data = self.read(offset, HEAD.size + CHUNK_HEAD.size)
        except DamagedRecord:
            return None
        if data[0] != Opcode.CHUNK:
            return None
        start, end, *_ = CHUNK_HEAD.unpack_from(data, HEAD.size)
        return (start, end) if is_span(start, end) else None

    def pass_damage(self, channel_ids: Collection[int], on_position: Callable[[int], object]) -> int | None:
        """Leave the position for the next place that can be believed: the index tells it, or records are searched for.

        Returns where another recording begins in what was passed or in the record before it, if one does: a recording that
        was cut off takes the beginning of the next one for its own.
        """
        following = bisect.bisect_right(self.places, self.position)
        if following < len(self.places):
            place = self.places[following]
        else:
            place = self.search.find(self.position + 1, channel_ids, on_position)
        other = find_recording(self.file, self.unsure, place)
        self.go(place, is_sure=True)
        return other


def is_same(file: BinaryIO, first: int, second: int, length: int) -> bool:
    """Whether the same bytes stand at two offsets of a file."""
    for step in range(0, length, _READ_BYTES):
        file.seek(first + step)
        data = file.read(min(_READ_BYTES, length - step))
        file.seek(second + step)
        if file.read(len(data)) != data:
            return False
    return True
