"""One walk over all records of an MCAP which finds what is whole, skips what is broken, and counts what was lost.

Every log is opened this way, sound or not: a sound one gives a plan that agrees with its statistics, a damaged one a
plan of what is left. Chunks are decompressed one at a time and their CRCs checked; only the plan stays in memory.
"""

from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO, Final

from mcap.opcode import Opcode

from pipeline.logs.checksum import DataChecksum
from pipeline.logs.file_walk import MAX_SMALL_BYTES, FileWalk, RecordHead
from pipeline.logs.plan import Plan
from pipeline.logs.plan_builder import LOOSE_BLOCK_BYTES, PlanBuilder
from pipeline.logs.records import (
    CHUNK_HEAD_BYTES,
    HEAD,
    MAX_CHUNK_BYTES,
    MESSAGE,
    DamagedRecord,
    is_chunk_head,
    library_of,
    parse_chunk,
    parse_message_index,
    parse_metadata,
)
from pipeline.logs.rows import leading_rows
from pipeline.logs.summary import parse_summary_record, read_summary
from pipeline.logs.verdict import compare_checksum, compare_summary

_MIN_WINDOW_BYTES: Final = 2**12
_MAX_BODY_BYTES: Final = MAX_CHUNK_BYTES + CHUNK_HEAD_BYTES
_SMALL: Final = (Opcode.CHANNEL, Opcode.SCHEMA, Opcode.MESSAGE_INDEX, Opcode.METADATA, Opcode.HEADER)


def scan_log(path: Path, size: int, on_bytes: Callable[[int], object] | None = None) -> Plan:
    """Walk the whole file; OSError is the caller's."""
    with path.open("rb") as file:
        return _Scan(file, size).run(on_bytes)


class _Scan:
    """Leads the walk from record to record: the builder plans what it meets, and the checksum follows."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        summary, fault = read_summary(file, size)
        self.builder = PlanBuilder(summary)
        self.plan = self.builder.plan
        self.plan.remarks += [fault] if fault else []
        limit, places = (summary.data_end, summary.places) if summary else (size, [])
        self.walk = FileWalk(file, size, limit, places)
        self.checksum = DataChecksum(self.walk, has_summary=summary is not None)
        if self.walk.is_text:
            words = "every CR LF in it became LF, which breaks what held one; copy it in binary mode"
            self.plan.doubts.append(f"The file was copied as text: {words}.")
        self.window = _MIN_WINDOW_BYTES  # how far messages outside chunks are looked for at once
        self.previous = 0  # opcode of the record before

    def run(self, on_bytes: Callable[[int], object] | None) -> Plan:
        """The plan of the file."""
        reported = 0
        while not self.walk.is_over() and not self.plan.reached_end:
            try:
                self._step()
            except DamagedRecord as error:
                self._pass_damage(str(error))
            if on_bytes is not None:
                on_bytes(self.walk.position - reported)
                reported = self.walk.position
        self.builder.flush()
        if on_bytes is not None:
            on_bytes(self.walk.size - reported)
        compare_summary(self.plan, self.builder.tally, self.walk)
        return self.plan

    def _step(self) -> None:
        """Take the record at the position; raises `DamagedRecord` without having moved past it."""
        if self.previous == MESSAGE:
            self._take_messages()
            if self.walk.is_over():
                return
        head, limit = self.walk.head(), self.walk.limit
        if head.opcode == Opcode.CHUNK and head.end > limit == self.walk.size:
            self._take_cut_chunk(head)
            return
        if head.opcode == 0 or head.end > limit:
            raise DamagedRecord("the file ends inside a record" if head.opcode else "there is no such record")
        if head.opcode != Opcode.MESSAGE_INDEX:
            self.builder.forget_chunk()
        body = self._take(head)
        if not self.plan.reached_end:
            self.checksum.add(HEAD.pack(head.opcode, head.length))
            if body is None:
                self.checksum.add_span(head.body, head.length)
            else:
                self.checksum.add(body)
        self.previous, self.walk.position = head.opcode, head.end

    def _take_messages(self) -> None:
        """Take, many at once, the messages outside chunks that follow each other from the position on, if there are any."""
        walk = self.walk
        data = walk.read(walk.position, min(self.window, walk.limit - walk.position))
        rows, length = leading_rows(data)
        if length:
            self.builder.add_messages(walk.position, length, rows)
            self.checksum.add(memoryview(data)[:length])
            walk.position += length
        is_over = length < len(data) and data[length] != MESSAGE
        self.window = _MIN_WINDOW_BYTES if is_over else min(2 * self.window, LOOSE_BLOCK_BYTES)

    def _take(self, head: RecordHead) -> bytes | None:
        """Take the record; its body where it was read."""
        if head.opcode == MESSAGE or head.opcode in _SMALL:
            if head.length > (_MAX_BODY_BYTES if head.opcode == MESSAGE else MAX_SMALL_BYTES):
                raise DamagedRecord("a record is impossibly long")
            return self._take_small(head, self.walk.read(head.body, head.length))
        self.builder.flush()
        if head.opcode == Opcode.CHUNK:
            return self._take_chunk(head)
        if head.opcode == Opcode.DATA_END:
            self._take_data_end(head)
        elif head.opcode == Opcode.ATTACHMENT:
            if head.length < 28:
                raise DamagedRecord("an attachment is too short")
        elif head.opcode <= Opcode.DATA_END:
            parse_summary_record(head.opcode, self.walk.read(head.body, head.length))
            self.plan.doubts.append("The end mark of the data is missing.")
            self.plan.reached_end = True
        else:
            self.builder.tally.num_unknown += 1  # private or future records are to be skipped, unless damage made them
        return None

    def _take_small(self, head: RecordHead, body: bytes) -> bytes:
        if head.opcode == MESSAGE:
            self.builder.add_message(head.offset, body)
            return body
        if head.opcode in (Opcode.CHANNEL, Opcode.SCHEMA):
            self.builder.add_definition(head.opcode, body)
            return body
        self.builder.flush()
        if head.opcode == Opcode.MESSAGE_INDEX:
            if self.previous not in (Opcode.CHUNK, Opcode.MESSAGE_INDEX):
                self.plan.doubts.append(f"At byte {head.body}: a message index without the chunk that it belongs to.")
            self.builder.add_index(head.body, *parse_message_index(body))
        elif head.opcode == Opcode.METADATA:
            parse_metadata(body)
            self.plan.metadata_spans.append((head.body, len(body)))
        elif self.previous == 0:
            self.plan.library = library_of(body)
        return body

    def _take_chunk(self, head: RecordHead) -> bytes | None:
        """Take a chunk; one too large to be read is left out, unless only its length is damaged."""
        if head.length <= _MAX_BODY_BYTES:
            body = self.walk.read(head.body, head.length)
            self.builder.add_chunk(head.body, head.length, parse_chunk(body), self.walk.index_behind(head.end))
            return body
        if not is_chunk_head(self.walk.read(head.body, CHUNK_HEAD_BYTES), head.length):
            raise DamagedRecord("the length of a chunk is damaged")
        reason = f"the chunk is larger than the limit of {MAX_CHUNK_BYTES} bytes"
        self.builder.add_loss(head.offset, reason, self.walk.span_at(head.offset), is_chunk=True)
        return None

    def _take_cut_chunk(self, head: RecordHead) -> None:
        """Save the beginning of the chunk in which the file ends."""
        body = self.walk.read(head.body, min(self.walk.size - head.body, _MAX_BODY_BYTES))
        if not is_chunk_head(body[:CHUNK_HEAD_BYTES], head.length):
            raise DamagedRecord("a chunk is longer than the file")
        self.builder.add_cut_chunk(head.body, body)
        self.walk.position = self.walk.size

    def _take_data_end(self, head: RecordHead) -> None:
        if head.length != 4:
            raise DamagedRecord("the end mark of the data is too long")
        if self.plan.summary is not None and head.end != self.walk.limit:
            raise DamagedRecord("an end mark of the data lies where none belongs")
        stated = int.from_bytes(self.walk.read(head.body, head.length), "little")
        compare_checksum(self.plan, stated, self.checksum.value)
        self.plan.reached_end = True

    def _pass_damage(self, reason: str) -> None:
        """After damage at the position: note the loss, go on at the next place that can be believed."""
        walk, offset = self.walk, self.walk.position
        self.builder.flush()
        walk.pass_damage(self.plan.channels)
        where = f"bytes {offset} to {walk.position}" if not walk.is_over() else f"everything from byte {offset} on"
        self.builder.add_loss(offset, f"{reason}; {where} skipped", walk.span_at(offset))
        self.previous = Opcode.CHUNK  # whatever lay there may have been a chunk with its indexes
