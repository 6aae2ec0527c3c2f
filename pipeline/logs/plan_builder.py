"""The plan of a log in the making: what a walk meets is taken record by record, each as a whole or not at all."""

import contextlib
from dataclasses import dataclass, field, replace
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from mcap.opcode import Opcode

from pipeline.logs.file_walk import FileWalk
from pipeline.logs.plan import Block, LooseRun, Loss, Plan, is_span
from pipeline.logs.records import (
    HEAD,
    MESSAGE,
    MESSAGE_HEAD,
    DamagedRecord,
    PackedChunk,
    parse_channel,
    parse_schema,
    unpack_chunk,
    unpack_cut_chunk,
)
from pipeline.logs.rows import Definitions, Rows, agrees, rows_at, rows_by_index, rows_by_walk, rows_in_torn
from pipeline.logs.summary import Summary

LOOSE_BLOCK_BYTES: Final = 2**20
"""Messages outside chunks are planned in stretches of about this size."""


class ChunkFacts(NamedTuple):
    """By what a chunk is known again: an index states the same but for the checksum. `length` is that of the record."""

    length: int
    start_ns: int
    end_ns: int
    crc: int


@dataclass
class Tally:
    """What a walk has met that changes the verdict, but has no place in the plan.

    num_unknown      records of kinds that are not known
    num_timeless     messages whose log times do not fit into int64
    num_bad_indexes  chunks with a checksum that differ from their message indexes
    num_attachments
    definitions      opcode and body of every channel and schema
    chunks           every chunk by its offset, as its head states it
    """

    num_unknown: int = 0
    num_timeless: int = 0
    num_bad_indexes: int = 0
    num_attachments: int = 0
    definitions: set[bytes] = field(default_factory=set)
    chunks: dict[int, ChunkFacts] = field(default_factory=dict)


class PlanBuilder:
    """Makes blocks of chunks and of messages outside chunks, and keeps definitions and losses.

    Message indexes follow their chunk: of the chunk just before it is known which loss it was (`_broken`), or which messages
    were found in it where nothing has confirmed them (`_unchecked`).
    """

    def __init__(self, walk: FileWalk, summary: Summary | None) -> None:
        self._walk = walk
        self.plan = Plan(summary=summary)
        self.tally = Tally()
        self._loose = LooseRun()
        self._broken: int | None = None
        self._unchecked: Rows | None = None

    @property
    def is_broken(self) -> bool:
        """Whether what came last was a chunk that could not be used."""
        return self._broken is not None

    def forget_chunk(self) -> None:
        """What follows is no message index of the chunk before."""
        self._broken = self._unchecked = None

    def add_chunk(self, offset: int, length: int, chunk: PackedChunk) -> None:
        """Take a chunk, whose body is these bytes of the file, with the message indexes behind it."""
        self.plan.has_checksums = self.plan.has_checksums and chunk.crc != 0
        facts = ChunkFacts(HEAD.size + length, chunk.start_ns, chunk.end_ns, chunk.crc)
        self.tally.chunks[offset - HEAD.size] = facts
        span = (chunk.start_ns, chunk.end_ns) if is_span(chunk.start_ns, chunk.end_ns) else None
        try:
            block = self._block(offset, length, unpack_chunk(chunk), has_checksum=chunk.crc != 0)
        except DamagedRecord as error:
            if chunk.crc or chunk.compression:
                self.add_loss(offset - HEAD.size, str(error), span, is_chunk=True)
            else:
                begin = offset + length - len(chunk.data)
                self.add_torn_chunk(begin, bytes(chunk.data), Loss(offset - HEAD.size, str(error), span))
        else:
            if block.num_messages:
                self.plan.blocks.append(block)

    def add_torn_chunk(self, offset: int, data: bytes, loss: Loss) -> None:
        """Take what is left of a chunk that is neither compressed nor covered by a checksum; `data` are its records."""
        entries, index_length = self._walk.index_behind(offset + len(data))
        found, definitions = rows_in_torn(data, entries)
        rows = self._usable(found, [])
        for opcode, body in definitions:
            with contextlib.suppress(DamagedRecord):
                self.add_definition(opcode, body)
        if len(rows):
            self.plan.blocks.append(Block(offset, len(data), "torn", *rows.span_ns(), rows.counts(), index_length))
        num_lost = sum(len(named) for _, named in entries) - len(found) if entries else None
        self.plan.losses.append(replace(loss, reason=f"{loss.reason}; {len(rows)} were saved", num_messages=num_lost))

    def add_cut_chunk(self, offset: int, body: bytes) -> None:
        """Take the beginning of the chunk in which the file ends."""
        chunk, data = unpack_cut_chunk(body)
        rows = self._usable(*rows_by_walk(data, is_cut=True))
        block = Block(offset, len(body), "cut", *rows.span_ns(), rows.counts())
        start, end = max(block.end_ns, chunk.start_ns), chunk.end_ns
        if len(rows):
            self.flush()
            self.plan.blocks.append(block)
        reason = f"the file ends inside this chunk; the {len(rows)} messages at its beginning were saved"
        self.add_loss(offset - HEAD.size, reason, (start, end) if is_span(start, end) else None)

    def add_message(self, offset: int, body: bytes) -> None:
        """Take a message outside chunks whose record begins at `offset`."""
        if len(body) < MESSAGE_HEAD.size:
            raise DamagedRecord("a message is too short")
        head = HEAD.pack(MESSAGE, len(body)) + body[: MESSAGE_HEAD.size]
        self.add_messages(offset, HEAD.size + len(body), rows_at(head, np.zeros(1, np.int64)))

    def add_messages(self, offset: int, length: int, rows: Rows) -> None:
        """Take the messages outside chunks in these bytes of the file."""
        usable = self._usable(rows, [])
        if len(usable):
            self._loose.add(offset, offset + length, usable)
            if self._loose.end - self._loose.begin > LOOSE_BLOCK_BYTES:
                self.flush()

    def add_index(self, offset: int, channel_id: int, entries: npt.NDArray[np.void]) -> None:
        """Count by a message index what a broken chunk held, or say that a chunk without checksum differs from it."""
        if self._broken is not None:
            loss = self.plan.losses[self._broken]
            known = (loss.num_messages or 0) + len(entries)
            self.plan.losses[self._broken] = Loss(loss.offset, loss.reason, loss.span_ns, known)
        elif self._unchecked is not None and not agrees(self._unchecked, channel_id, entries):
            where = f"At byte {offset}: the messages of a chunk without checksum differ from their index"
            self.plan.doubts.append(f"{where}; times of channel {channel_id} may be wrong.")

    def add_definition(self, opcode: int, body: bytes) -> None:
        """Take a channel or schema; a second definition that differs is reported, the first stays."""
        key = bytes([opcode]) + body
        if key in self.tally.definitions:
            return
        self.tally.definitions.add(key)
        if opcode == Opcode.CHANNEL:
            channel = parse_channel(body)
            if self.plan.channels.setdefault(channel.id, channel) != channel:
                self.plan.doubts.append(f"Channel {channel.id} ({channel.topic}) is defined twice, differently.")
        else:
            schema = parse_schema(body)
            if self.plan.schemas.setdefault(schema.id, schema) != schema:
                self.plan.doubts.append(f"Schema {schema.id} ({schema.name}) is defined twice, differently.")

    def add_loss(self, offset: int, reason: str, stated_ns: tuple[int, int] | None, is_chunk: bool = False) -> None:
        """Note that the record at `offset` is lost; its time span is that of the index, else the one that it states.

        The messages of a chunk are counted by the message indexes that may follow.
        """
        index = self.plan.summary.chunks.get(offset) if self.plan.summary else None
        span = (index.message_start_time, index.message_end_time) if index else stated_ns
        self._broken = len(self.plan.losses) if is_chunk or index else None
        self.plan.losses.append(Loss(offset, reason, span))

    def flush(self) -> None:
        """Make a block of the messages outside chunks that came last."""
        run, self._loose = self._loose, LooseRun()
        if run.begin >= 0:
            self.plan.blocks.append(run.block())

    def _block(self, offset: int, length: int, data: bytes, has_checksum: bool) -> Block:
        """The block of a chunk: planned by the indexes behind it where they agree with it, else by a walk through it."""
        entries, index_length = self._walk.index_behind(offset + length)
        found = rows_by_index(data, entries) if index_length else None
        if found is None:
            found = rows_by_walk(data)
            self._unchecked = None if has_checksum else found[0]
            self.tally.num_bad_indexes += has_checksum and index_length > 0
            index_length = 0
        rows = self._usable(*found)
        return Block(offset, length, "chunk", *rows.span_ns(), rows.counts(), index_length)

    def _usable(self, rows: Rows, definitions: Definitions) -> Rows:
        """The rows of a block that can be used; `definitions` are those in it, which is known to be whole."""
        usable = rows.usable()
        self.tally.num_timeless += len(rows) - len(usable)
        for opcode, body in definitions:
            self.add_definition(opcode, body)
        return usable
