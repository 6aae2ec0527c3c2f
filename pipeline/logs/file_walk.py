"""A walk from record to record over a file that may be damaged."""

import bisect
from collections.abc import Collection, Sequence
from typing import BinaryIO, Final, NamedTuple

from mcap.opcode import Opcode

from pipeline.logs.plan import is_span
from pipeline.logs.records import CHUNK_HEAD, HEAD, MAGIC, TEXT_MAGIC, DamagedRecord, parse_message_index
from pipeline.logs.resync import find_records
from pipeline.logs.rows import Index

MAX_SMALL_BYTES: Final = 2**26
"""Channels, schemas, metadata and message indexes that are larger are not believed."""


class RecordHead(NamedTuple):
    """A record as its head states it, not yet believed: `body` and `end` are offsets in the file."""

    offset: int
    opcode: int
    body: int
    length: int
    end: int


class FileWalk:
    """Stands at one record of the data section after the other.

    size      of the file
    limit     where the data section ends at the latest
    places    sorted offsets where records are known to begin; empty where no index tells
    position  of the record at which the walk stands
    """

    def __init__(self, file: BinaryIO, size: int, limit: int, places: Sequence[int]) -> None:
        self.file, self.size, self.limit, self.places = file, size, limit, places
        self.is_text = self.read(0, len(TEXT_MAGIC)) == TEXT_MAGIC
        self.position = len(TEXT_MAGIC if self.is_text else MAGIC)

    def read(self, offset: int, length: int) -> bytes:
        """These bytes of the file; `DamagedRecord` where it does not have them."""
        self.file.seek(offset)
        data = self.file.read(length)
        if len(data) != length:
            raise DamagedRecord("the file ends inside a record")
        return data

    def is_over(self) -> bool:
        """Whether the data section, as far as its end is known, has been passed."""
        return self.position >= self.limit

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
        self.file.seek(offset)
        data = self.file.read(HEAD.size + CHUNK_HEAD.size)
        if len(data) < HEAD.size + CHUNK_HEAD.size or data[0] != Opcode.CHUNK:
            return None
        start, end, *_ = CHUNK_HEAD.unpack_from(data, HEAD.size)
        return (start, end) if is_span(start, end) else None

    def pass_damage(self, channel_ids: Collection[int]) -> None:
        """Leave the position for the next place that can be believed: the index tells it, or records are searched for."""
        following = bisect.bisect_right(self.places, self.position)
        if following < len(self.places):
            self.position = self.places[following]
        else:
            self.position = find_records(self.file, self.position + 1, self.limit, channel_ids)
