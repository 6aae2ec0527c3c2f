"""One walk over all records of an MCAP which finds what is whole, skips what is broken, and counts what was lost.

Every log is opened this way, sound or not: a sound one gives a plan that agrees with its statistics, a damaged one a
plan of what is left. Chunks are decompressed one at a time and their CRCs checked; only the plan stays in memory.
"""

import bisect
import struct
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO, Final

import numpy as np
import numpy.typing as npt
from mcap.opcode import Opcode
from zlib_ng.zlib_ng import crc32

from pipeline.logs.plan import Block, LooseRun, Loss, Plan, is_span
from pipeline.logs.records import (
    CHUNK_HEAD,
    CHUNK_HEAD_BYTES,
    HEAD,
    MAGIC,
    MAX_CHUNK_BYTES,
    MESSAGE,
    MESSAGE_HEAD,
    TEXT_MAGIC,
    DamagedRecord,
    is_chunk_head,
    library_of,
    parse_channel,
    parse_chunk,
    parse_message_index,
    parse_metadata,
    parse_schema,
    unpack_chunk,
    unpack_cut_chunk,
)
from pipeline.logs.resync import find_records
from pipeline.logs.rows import Index, Rows, agrees, leading_rows, rows_at, rows_by_index, rows_by_walk
from pipeline.logs.summary import parse_summary_record, prefer_index, read_summary, unconfirmed

LOOSE_BLOCK_BYTES: Final = 2**20
"""Messages outside chunks are planned in stretches of about this size."""
_MIN_WINDOW_BYTES: Final = 2**12
_READ_BYTES: Final = 2**20
_DATA_END: Final = struct.Struct("<BQI")
_MAX_BODY_BYTES: Final = MAX_CHUNK_BYTES + CHUNK_HEAD_BYTES
_MAX_SMALL_BYTES: Final = 2**26  # channels, schemas, metadata, message indexes; larger ones are not believed


def scan_log(path: Path, size: int, on_bytes: Callable[[int], object] | None = None) -> Plan:
    """Walk the whole file; OSError is the caller's."""
    with path.open("rb") as file:
        scanner = _Scanner(file, size, on_bytes)
        scanner.run()
        return scanner.plan


class _Scanner:
    def __init__(self, file: BinaryIO, size: int, on_bytes: Callable[[int], object] | None) -> None:
        self.file, self.size, self.on_bytes = file, size, on_bytes
        self.plan = Plan()
        self.plan.summary, fault = read_summary(file, size)
        if fault:
            self.plan.remarks.append(fault)
        self.places = self.plan.summary.places if self.plan.summary else []
        self.limit = self.plan.summary.data_end if self.plan.summary else size
        self.crc: int | None = None  # over all data so far; None where the file states none
        self.position = self.reported = 0
        self.loose = LooseRun()
        self.window = _MIN_WINDOW_BYTES  # how far messages outside chunks are looked for at once
        self.previous = 0  # opcode of the record before: a message index follows a chunk or another one
        self.broken_chunk: int | None = None  # index of the loss of the chunk just before, to be counted by its indexes
        self.unchecked: Rows | None = None  # messages of the chunk just before, which has no CRC and differs from its index
        self.num_unknown = self.num_timeless = self.num_bad_indexes = 0
        self.definitions: set[bytes] = set()
        self.chunks: set[int] = set()

    def run(self) -> None:
        """Fill the plan."""
        self.position = self._magic_length()
        if self.position == len(MAGIC) and self._states_checksum():
            self.crc = crc32(MAGIC)
        while self.position < self.limit and not self.plan.reached_end:
            try:
                if self.previous == MESSAGE:
                    self._take_leading_messages()
                if self.position < self.limit:
                    self._record()
            except DamagedRecord as error:
                self._resume(str(error))
            if self.on_bytes is not None:
                self.on_bytes(self.position - self.reported)
                self.reported = self.position
        self._flush_loose()
        if self.on_bytes is not None:
            self.on_bytes(self.size - self.reported)
        self._cross_check()

    def _magic_length(self) -> int:
        """Where the first record begins."""
        self.file.seek(0)
        if self.file.read(len(MAGIC)) == MAGIC:
            return len(MAGIC)
        words = "every CR LF in it became LF, which breaks what held one; copy it in binary mode"
        self.plan.doubts.append(f"The file was copied as text: {words}.")
        return len(TEXT_MAGIC)

    def _read(self, offset: int, length: int) -> bytes:
        self.file.seek(offset)
        data = self.file.read(length)
        if len(data) != length:
            raise DamagedRecord("the file ends inside a record")
        return data

    def _record(self) -> None:
        """Take the record at the position, or raise without having moved."""
        offset = self.position
        head = self._read(offset, HEAD.size)
        opcode, length = HEAD.unpack(head)
        end = offset + HEAD.size + length
        if opcode == Opcode.CHUNK and end > self.limit == self.size:
            self._take_cut_chunk(offset + HEAD.size, length)
            return
        if opcode == 0 or end > self.limit:
            raise DamagedRecord("the file ends inside a record" if opcode else "there is no such record")
        if opcode != Opcode.MESSAGE_INDEX:
            self.broken_chunk = self.unchecked = None
        body = self._take(opcode, offset + HEAD.size, length)
        if not self.plan.reached_end and self.crc is not None:
            self.crc = crc32(head, self.crc)
            if body is None:
                self.crc = self._crc_of_rest(self.crc, offset + HEAD.size, length)
            else:
                self.crc = crc32(body, self.crc)
        self.previous, self.position = opcode, end

    def _states_checksum(self) -> bool:
        """Whether the end mark of the data may have a checksum over all of them: seldom, and it costs time."""
        if self.plan.summary is None:
            return True
        opcode, length, crc = _DATA_END.unpack(self._read(self.limit - _DATA_END.size, _DATA_END.size))
        return (opcode, length, crc) != (Opcode.DATA_END, 4, 0)

    def _crc_of_rest(self, crc: int, offset: int, length: int) -> int:
        for begin in range(offset, offset + length, _READ_BYTES):
            crc = crc32(self._read(begin, min(_READ_BYTES, offset + length - begin)), crc)
        return crc

    def _take(self, opcode: int, offset: int, length: int) -> bytes | None:
        """Plan the record; its body where it was read."""
        if opcode in (Opcode.MESSAGE, Opcode.CHANNEL, Opcode.SCHEMA, Opcode.MESSAGE_INDEX, Opcode.METADATA, Opcode.HEADER):
            if length > (_MAX_BODY_BYTES if opcode == Opcode.MESSAGE else _MAX_SMALL_BYTES):
                raise DamagedRecord("a record is impossibly long")
            return self._take_small(opcode, offset, self._read(offset, length))
        self._flush_loose()
        if opcode == Opcode.CHUNK:
            if length > _MAX_BODY_BYTES:
                self._skip_giant(offset, length)
                return None
            body = self._read(offset, length)
            self._take_chunk(offset, body)
            return body
        if opcode == Opcode.DATA_END:
            self._take_data_end(offset, self._read(offset, length))
        elif opcode == Opcode.ATTACHMENT:
            if length < 28:
                raise DamagedRecord("an attachment is too short")
        elif opcode <= Opcode.DATA_END:
            parse_summary_record(opcode, self._read(offset, length))
            self.plan.doubts.append("The end mark of the data is missing.")
            self.plan.reached_end = True
        else:
            self.num_unknown += 1  # private or future records are to be skipped, unless damage made them
        return None

    def _take_small(self, opcode: int, offset: int, body: bytes) -> bytes:
        if opcode == Opcode.MESSAGE:
            if len(body) < MESSAGE_HEAD.size:
                raise DamagedRecord("a message is too short")
            head = HEAD.pack(opcode, len(body)) + body[: MESSAGE_HEAD.size]
            self._add_loose(offset - HEAD.size, HEAD.size + len(body), rows_at(head, np.zeros(1, np.int64)))
            return body
        if opcode in (Opcode.CHANNEL, Opcode.SCHEMA):
            self._define(opcode, body)
            return body
        self._flush_loose()
        if opcode == Opcode.MESSAGE_INDEX:
            if self.previous not in (Opcode.CHUNK, Opcode.MESSAGE_INDEX):
                self.plan.doubts.append(f"At byte {offset}: a message index without the chunk that it belongs to.")
            self._compare_index(offset, *parse_message_index(body))
        elif opcode == Opcode.METADATA:
            parse_metadata(body)
            self.plan.metadata_spans.append((offset, len(body)))
        elif self.previous == 0:
            self.plan.library = library_of(body)
        return body

    def _take_leading_messages(self) -> None:
        """Plan, many at once, the messages outside chunks that follow each other from the position on, if there are any."""
        data = self._read(self.position, min(self.window, self.limit - self.position))
        rows, length = leading_rows(data)
        if length:
            self._add_loose(self.position, length, rows)
            if self.crc is not None:
                self.crc = crc32(memoryview(data)[:length], self.crc)
            self.position += length
        is_over = length < len(data) and data[length] != MESSAGE
        self.window = _MIN_WINDOW_BYTES if is_over else min(2 * self.window, LOOSE_BLOCK_BYTES)

    def _add_loose(self, offset: int, length: int, rows: Rows) -> None:
        """Add the messages in these bytes of the file to the run of those outside chunks."""
        usable = rows.usable()
        self.num_timeless += len(rows) - len(usable)
        if len(usable):
            self.loose.add(offset, offset + length, usable)
            if self.loose.end - self.loose.begin > LOOSE_BLOCK_BYTES:
                self._flush_loose()

    def _compare_index(self, offset: int, channel_id: int, entries: npt.NDArray[np.void]) -> None:
        """Count what a broken chunk held, or say which index a chunk without checksum differs from."""
        if self.broken_chunk is not None:
            loss = self.plan.losses[self.broken_chunk]
            known = (loss.num_messages or 0) + len(entries)
            self.plan.losses[self.broken_chunk] = Loss(loss.offset, loss.reason, loss.span_ns, known)
        elif self.unchecked is not None and not agrees(self.unchecked, channel_id, entries):
            where = f"At byte {offset}: the messages of a chunk without checksum differ from their index"
            self.plan.doubts.append(f"{where}; times of channel {channel_id} may be wrong.")

    def _take_chunk(self, offset: int, body: bytes) -> None:
        chunk = parse_chunk(body)
        self.chunks.add(offset - HEAD.size)
        self.plan.has_checksums = self.plan.has_checksums and chunk.crc != 0
        try:
            block = self._block_of_chunk(offset, len(body), unpack_chunk(chunk), has_checksum=chunk.crc != 0)
        except DamagedRecord as error:
            span = self._span(offset - HEAD.size, chunk.start_ns, chunk.end_ns)
            self.plan.losses.append(Loss(offset - HEAD.size, str(error), span))
            self.broken_chunk = len(self.plan.losses) - 1
        else:
            if block.num_messages:
                self.plan.blocks.append(block)

    def _skip_giant(self, offset: int, length: int) -> None:
        """Leave out a chunk too large to be read; raises where only its length is damaged."""
        if not is_chunk_head(self._read(offset, CHUNK_HEAD_BYTES), length):
            raise DamagedRecord("the length of a chunk is damaged")
        span = self._header_span(offset - HEAD.size)
        self.plan.losses.append(
            Loss(offset - HEAD.size, f"the chunk is larger than the limit of {MAX_CHUNK_BYTES} bytes", span)
        )
        self.broken_chunk = len(self.plan.losses) - 1

    def _take_cut_chunk(self, offset: int, length: int) -> None:
        """Save the beginning of the chunk in which the file ends."""
        body = self._read(offset, min(self.size - offset, _MAX_BODY_BYTES))
        if not is_chunk_head(body[:CHUNK_HEAD_BYTES], length):
            raise DamagedRecord("a chunk is longer than the file")
        chunk, data = unpack_cut_chunk(body)
        block = self._block_of_chunk(offset, len(body), data, is_cut=True)
        start, end = max(block.end_ns, chunk.start_ns), chunk.end_ns
        saved = sum(block.num_messages.values())
        if saved:
            self._flush_loose()
            self.plan.blocks.append(block)
        reason = f"the file ends inside this chunk; the {saved} messages at its beginning were saved"
        self.plan.losses.append(Loss(offset - HEAD.size, reason, (start, end) if is_span(start, end) else None))
        self.position = self.size

    def _block_of_chunk(self, offset: int, length: int, data: bytes, has_checksum: bool = True, is_cut: bool = False) -> Block:
        """The block of a chunk: planned by the indexes behind it where they agree with it, else by a walk through it."""
        index, index_length = ([], 0) if is_cut else self._index_behind(offset + length)
        found = rows_by_index(data, index) if index_length else None
        if found is None:
            found = rows_by_walk(data, is_cut)
            self.unchecked = None if has_checksum else found[0]
            self.num_bad_indexes += has_checksum and index_length > 0
            index_length = 0
        rows, definitions = found[0].usable(), found[1]
        self.num_timeless += len(found[0]) - len(rows)
        for opcode, body in definitions:  # only now: a chunk whose end is broken must not leave half of itself behind
            self._define(opcode, body)
        return Block(offset, length, "cut" if is_cut else "chunk", *rows.span_ns(), rows.counts(), index_length)

    def _index_behind(self, offset: int) -> tuple[Index, int]:
        """The message indexes that follow a chunk, up to the first that is damaged, and how many bytes they take."""
        begin, found = offset, []
        while offset + HEAD.size <= self.limit:
            opcode, length = HEAD.unpack(self._read(offset, HEAD.size))
            is_whole = length <= _MAX_SMALL_BYTES and offset + HEAD.size + length <= self.limit
            if opcode != Opcode.MESSAGE_INDEX or not is_whole:
                break
            try:
                found.append(parse_message_index(self._read(offset + HEAD.size, length)))
            except DamagedRecord:
                break
            offset += HEAD.size + length
        return (found, offset - begin) if any(len(entries) for _, entries in found) else ([], 0)

    def _define(self, opcode: int, body: bytes) -> None:
        """Take a channel or schema; a second definition that differs is reported, the first stays."""
        key = bytes([opcode]) + body
        if key in self.definitions:
            return
        self.definitions.add(key)
        if opcode == Opcode.CHANNEL:
            channel = parse_channel(body)
            if self.plan.channels.setdefault(channel.id, channel) != channel:
                self.plan.doubts.append(f"Channel {channel.id} ({channel.topic}) is defined twice, differently.")
        else:
            schema = parse_schema(body)
            if self.plan.schemas.setdefault(schema.id, schema) != schema:
                self.plan.doubts.append(f"Schema {schema.id} ({schema.name}) is defined twice, differently.")

    def _take_data_end(self, offset: int, body: bytes) -> None:
        if len(body) != 4:
            raise DamagedRecord("the end mark of the data is too long")
        following = offset + 4
        if self.plan.summary is not None and following != self.limit:
            raise DamagedRecord("an end mark of the data lies where none belongs")
        (expected,) = struct.unpack("<I", body)
        if expected not in (0, self.crc) and not self.plan.losses:
            place = "outside the chunks" if self.plan.has_checksums else "somewhere"
            self.plan.doubts.append(f"The checksum over all data does not match: something was changed {place}.")
        has_loose = any(block.kind == "loose" for block in self.plan.blocks)
        self.plan.has_checksums = expected != 0 or (self.plan.has_checksums and not has_loose)
        self.plan.reached_end = True

    def _flush_loose(self) -> None:
        run, self.loose = self.loose, LooseRun()
        if run.begin >= 0:
            self.plan.blocks.append(run.block())

    def _span(self, offset: int, start: int, end: int) -> tuple[int, int] | None:
        """The time span of the chunk at `offset`: from the index where there is one, else from its own header."""
        index = self.plan.summary.chunks.get(offset) if self.plan.summary else None
        if index is not None:
            return index.message_start_time, index.message_end_time
        return (start, end) if is_span(start, end) else None

    def _resume(self, reason: str) -> None:
        """After damage at the position: note the loss, go on at the next place that can be believed."""
        self._flush_loose()
        offset = self.position
        index = self.plan.summary.chunks.get(offset) if self.plan.summary else None
        span = (index.message_start_time, index.message_end_time) if index else self._header_span(offset)
        following = bisect.bisect_right(self.places, offset)
        if following < len(self.places):
            self.position = self.places[following]
        else:
            self.position = find_records(self.file, offset + 1, self.limit, self.plan.channels)
        where = f"bytes {offset} to {self.position}" if self.position < self.limit else f"everything from byte {offset} on"
        self.plan.losses.append(Loss(offset, f"{reason}; {where} skipped", span))
        self.previous = Opcode.CHUNK  # whatever lay there may have been a chunk with its indexes
        self.broken_chunk = len(self.plan.losses) - 1 if index else None

    def _header_span(self, offset: int) -> tuple[int, int] | None:
        """The time span in the header of a chunk that is cut off."""
        self.file.seek(offset)
        data = self.file.read(HEAD.size + CHUNK_HEAD.size)
        if len(data) < HEAD.size + CHUNK_HEAD.size or data[0] != Opcode.CHUNK:
            return None
        start, end, *_ = CHUNK_HEAD.unpack_from(data, HEAD.size)
        return (start, end) if is_span(start, end) else None

    def _cross_check(self) -> None:
        """Compare with what the summary says."""
        plan, summary = self.plan, self.plan.summary
        if not plan.reached_end and not plan.losses:
            plan.doubts.append("The file ends without its end mark: the recording was cut off.")
        if self.num_timeless:
            plan.doubts.append(f"{self.num_timeless} messages have log times after the year 2262 and cannot be used.")
        if self.num_bad_indexes:
            plan.remarks.append(f"{self.num_bad_indexes} chunks differ from their message indexes, which were not used.")
        if summary is None or summary.statistics is None:
            if self.num_unknown:
                plan.doubts.append(f"{self.num_unknown} unknown records were skipped; no statistics tell whether any mattered.")
        if summary is None:
            self._confirm_definitions()
            return
        plan.doubts += prefer_index("Channel", plan.channels, summary.channels)
        plan.doubts += prefer_index("Schema", plan.schemas, summary.schemas)
        seen = {loss.offset for loss in plan.losses} | {
            block.offset - HEAD.size for block in plan.blocks if block.kind == "chunk"
        }
        for offset, index in summary.chunks.items():
            if offset not in seen and index.message_index_offsets:
                span = (index.message_start_time, index.message_end_time)
                plan.losses.append(Loss(offset, "the chunk that the index names is not there", span))

    def _confirm_definitions(self) -> None:
        """Without checksums the names of channels are believed only where a damaged index repeats them."""
        if self.plan.reached_end and not self.plan.has_checksums:
            tail = self._read(self.position, min(self.size - self.position, _MAX_SMALL_BYTES))
            if num := len(unconfirmed(self.definitions, tail)):
                words = "of channels or schemas are not repeated by the damaged index, and no checksum covers them"
                self.plan.doubts.append(f"{num} definitions {words}.")
