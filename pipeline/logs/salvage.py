"""One walk over all records of a recording which finds what is whole, skips what is broken, and counts what was lost.

Every log is read this way, sound or not: a sound one gives a plan that agrees with its statistics, a damaged one a plan of
what is left. Chunks are decompressed one at a time and their CRCs checked; only the plan stays in memory.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import BinaryIO, Final

from mcap.opcode import Opcode

from pipeline.logs.checksum import DataChecksum
from pipeline.logs.file_walk import MAX_SMALL_BYTES, FileWalk, RecordHead
from pipeline.logs.plan import Loss
from pipeline.logs.plan_builder import LOOSE_BLOCK_BYTES, PlanBuilder
from pipeline.logs.records import (
    CHUNK_HEAD_BYTES,
    HEAD,
    MAGIC,
    MAX_CHUNK_BYTES,
    MESSAGE,
    DamagedRecord,
    is_chunk_head,
    library_of,
    parse_chunk,
    parse_message_index,
    parse_metadata,
)
from pipeline.logs.resync import begins_recording, find_recording
from pipeline.logs.rows import leading_rows
from pipeline.logs.summary import SUMMARY_OPCODES, parse_summary_record, read_summary, stated_data_end
from pipeline.logs.tail import EndMark, Tail
from pipeline.logs.verdict import judge

_MIN_WINDOW_BYTES: Final = 2**12
_MAX_BODY_BYTES: Final = MAX_CHUNK_BYTES + CHUNK_HEAD_BYTES
_DEFINITIONS: Final = (Opcode.CHANNEL, Opcode.SCHEMA)
_DATA: Final = (MESSAGE, Opcode.CHUNK, Opcode.MESSAGE_INDEX, Opcode.ATTACHMENT, Opcode.METADATA)
_SMALL: Final = (*_DEFINITIONS, Opcode.MESSAGE_INDEX, Opcode.METADATA, Opcode.HEADER)


class Scan:
    """Leads the walk from record to record: the builder plans what it meets, and the checksum follows.

    Where the summary cannot be found by the footer nothing tells where the data end: the walk goes on behind their end mark,
    up to the end of the file or the beginning of another recording.

    plan       of the recording; complete when the scan has run
    end        the byte behind the recording
    following  where another recording begins; the end of the file where none does
    """

    def __init__(self, file: BinaryIO, begin: int, end: int) -> None:
        summary, self.fault = read_summary(file, begin, end)
        limit, places = (summary.data_end, summary.places) if summary else (end, [])
        self.walk = FileWalk(file, begin, end, limit, places)
        self.builder = PlanBuilder(self.walk, summary)
        self.plan = self.builder.plan
        self.plan.begin, self.plan.end = begin, end
        if self.walk.is_text:
            words = "every CR LF in it became LF, which breaks what held one; copy it in binary mode"
            self.plan.doubts.append(f"The file was copied as text: {words}.")
        self.checksum = DataChecksum(self.walk, has_summary=summary is not None)
        self.tail = Tail()
        self.end = self.following = end
        self.window = _MIN_WINDOW_BYTES  # how far messages outside chunks are looked for at once
        self.previous = 0  # opcode of the record before

    def run(self, on_position: Callable[[int], object]) -> None:
        """Walk over the recording, with `on_position` called on the way. The plan is not judged where `end` has moved."""
        walk = self.walk
        while not walk.is_over():
            try:
                self._step()
            except DamagedRecord as error:
                self._pass_damage(str(error), on_position)
            on_position(walk.position)
        if self.following == walk.end:
            self._look_back()
        if self.end == walk.end:
            self.builder.flush()
            judge(self.plan, self.builder.tally, self.tail, walk, self.fault)

    def _step(self) -> None:
        """Take the record at the position; raises `DamagedRecord` without having moved past it."""
        walk = self.walk
        if self.previous == MESSAGE:
            self._take_messages()
            if walk.is_over():
                return
        if self.plan.summary is None and walk.is_at_magic():
            self._take_magic()
            return
        head = walk.head()
        if head.opcode == Opcode.CHUNK and head.end > walk.limit == walk.end:
            self._take_cut_chunk(head)
            return
        if head.opcode == 0 or head.end > walk.limit:
            raise DamagedRecord("the file ends inside a record" if head.opcode else "there is no such record")
        if head.opcode != Opcode.MESSAGE_INDEX:
            self.builder.forget_chunk()
        if head.opcode == Opcode.DATA_END:
            self._take_data_end(head)
        elif head.opcode in SUMMARY_OPCODES or (self.tail.is_open and head.opcode in _DEFINITIONS):
            self._take_summary_record(head)
        else:
            self._take_data(head)
        self.previous = head.opcode
        walk.go(
            head.end, is_sure=head.opcode == Opcode.ATTACHMENT or (head.opcode == Opcode.CHUNK and not self.builder.is_broken)
        )

    def _take_messages(self) -> None:
        """Take, many at once, the messages outside chunks that follow each other from the position on, if there are any."""
        walk = self.walk
        data = walk.read(walk.position, min(self.window, walk.limit - walk.position))
        rows, length = leading_rows(data)
        if length:
            self.builder.add_messages(walk.position, length, rows)
            self.checksum.add(memoryview(data)[:length])
            walk.go(walk.position + length, is_sure=False)
        is_over = length < len(data) and data[length] != MESSAGE
        self.window = _MIN_WINDOW_BYTES if is_over else min(2 * self.window, LOOSE_BLOCK_BYTES)

    def _take_data(self, head: RecordHead) -> None:
        """Take a record of the data section."""
        if self.tail.is_open and head.opcode in _DATA:
            self._return_to_data(head.offset)
        body = self._take(head)
        self.checksum.add(HEAD.pack(head.opcode, head.length))
        if body is None:
            self.checksum.add_span(head.body, head.length)
        else:
            self.checksum.add(body)

    def _take(self, head: RecordHead) -> bytes | None:
        """Plan the record; its body where it was read."""
        if head.opcode == MESSAGE or head.opcode in _SMALL:
            if head.length > (_MAX_BODY_BYTES if head.opcode == MESSAGE else MAX_SMALL_BYTES):
                raise DamagedRecord("a record is impossibly long")
            return self._take_small(head, self.walk.read(head.body, head.length))
        self.builder.flush()
        if head.opcode == Opcode.CHUNK:
            return self._take_chunk(head)
        if head.opcode == Opcode.ATTACHMENT:
            if head.length < 28:
                raise DamagedRecord("an attachment is too short")
            self.builder.tally.num_attachments += 1
        elif not self.tail.is_confirmed:
            self.builder.tally.num_unknown += 1  # private or future records are to be skipped, unless damage made them
        return None

    def _take_small(self, head: RecordHead, body: bytes) -> bytes:
        if head.opcode == MESSAGE:
            self.builder.add_message(head.offset, body)
            return body
        if head.opcode in _DEFINITIONS:
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
            self.builder.add_chunk(head.body, head.length, parse_chunk(body))
            return body
        if not is_chunk_head(self.walk.read(head.body, CHUNK_HEAD_BYTES), head.length):
            raise DamagedRecord("the length of a chunk is damaged")
        reason = f"the chunk is larger than the limit of {MAX_CHUNK_BYTES} bytes"
        self.builder.add_loss(head.offset, reason, self.walk.span_at(head.offset), is_chunk=True)
        return None

    def _take_cut_chunk(self, head: RecordHead) -> None:
        """Save the beginning of the chunk in which the file ends, or the recording, where another one begins inside it."""
        other = find_recording(self.walk.file, head.body, self.walk.end)
        if other is not None:
            self._stop(other)
            return
        body = self.walk.read(head.body, min(self.walk.end - head.body, _MAX_BODY_BYTES))
        if not is_chunk_head(body[:CHUNK_HEAD_BYTES], head.length):
            raise DamagedRecord("a chunk is longer than the file")
        if self.tail.is_open:
            self._return_to_data(head.offset)
        self.builder.add_cut_chunk(head.body, body)
        self.walk.go(self.walk.end, is_sure=False)

    def _take_data_end(self, head: RecordHead) -> None:
        if head.length != 4:
            raise DamagedRecord("the end mark of the data is too long")
        if self.plan.summary is not None and head.end != self.walk.limit:
            raise DamagedRecord("an end mark of the data lies where none belongs")
        stated = int.from_bytes(self.walk.read(head.body, head.length), "little")
        if self.tail.is_open:
            self._return_to_data(head.offset)
        place = stated_data_end(self.walk.file, self.walk.begin, self.walk.end)
        self._open_tail(head.offset, EndMark(head.end, stated, self.checksum.value, is_confirmed=head.end == place))

    def _take_summary_record(self, head: RecordHead) -> None:
        if self.plan.summary is not None:
            raise DamagedRecord("a record of the index lies among the data")
        if head.length > MAX_SMALL_BYTES:
            raise DamagedRecord("a record is impossibly long")
        body = self.walk.read(head.body, head.length)
        if not self.tail.is_open:
            parse_summary_record(head.opcode, body)
            self._open_tail(head.offset, None)
        self.tail.take(head.opcode, body)

    def _open_tail(self, offset: int, mark: EndMark | None) -> None:
        """The data end here, as far as is known."""
        self.builder.flush()
        self.tail = Tail(offset, mark, num_losses=len(self.plan.losses))

    def _return_to_data(self, offset: int) -> None:
        """At `offset` a record of the data lies behind their end: that was not the end, unless the footer points there, too."""
        if self.tail.is_confirmed:
            raise DamagedRecord("data lie behind their end")
        what = "an end mark of the data" if self.tail.mark is not None else "a record of the index"
        self.plan.doubts.append(f"At byte {self.tail.begin}: {what}, but records of the data follow (byte {offset}).")
        for opcode, body in self.tail.definitions:
            self.builder.add_definition(opcode, body)
        self.tail = Tail()

    def _take_magic(self) -> None:
        """Magic closes a recording, or another one begins with it."""
        walk = self.walk
        if begins_recording(walk.file, walk.position, walk.end):
            self._stop(walk.position)
        elif self.previous == Opcode.FOOTER and self.tail.closing < 0:
            walk.go(walk.position + len(MAGIC), is_sure=True)
            self.tail.closing = walk.position
        else:
            raise DamagedRecord("there is no such record")

    def _stop(self, place: int) -> None:
        """Another recording begins at `place`; this one ends there, or where it was closed."""
        self.end, self.following = self.tail.closing if self.tail.closing >= 0 else place, place
        self.walk.go(self.walk.end, is_sure=True)

    def _look_back(self) -> None:
        """The walk is over: bytes may follow the end, and the index behind the data may be that of a second recording.

        Offsets count from the beginning of a recording: where those of the index lead to another one, it is the index of that.
        """
        walk, mark = self.walk, self.tail.mark
        stated = stated_data_end(walk.file, walk.begin, walk.end)
        place = walk.begin if mark is None or stated is None else walk.begin + mark.end - stated
        if self.plan.summary is None and place > walk.begin and begins_recording(walk.file, place, walk.end):
            self.end = self.following = place
        elif self.tail.closing >= 0:
            self.end = self.tail.closing

    def _pass_damage(self, reason: str, on_position: Callable[[int], object]) -> None:
        """After damage at the position: note the loss, go on at the next place that can be believed."""
        walk, offset = self.walk, self.walk.position
        self.builder.flush()
        span = walk.span_at(offset)
        other = walk.pass_damage(self.plan.channels, on_position)
        if other is not None:
            self._stop(other)
            return
        where = f"bytes {offset} to {walk.position}" if not walk.is_over() else f"everything from byte {offset} on"
        where += " (too much of it looks like records)" if walk.search.is_given_up else ""
        loss = Loss(offset, f"{reason}; {where} skipped", span)
        if not self._save_torn(loss):
            self.builder.add_loss(loss.offset, loss.reason, loss.span_ns)
        self.previous = Opcode.CHUNK  # whatever lay there may have been a chunk with its indexes

    def _save_torn(self, loss: Loss) -> bool:
        """Save what is left of a chunk whose head is damaged, where its index says that it is not compressed."""
        index = self.plan.summary.chunks.get(loss.offset) if self.plan.summary is not None else None
        if index is None or index.compression or self.plan.has_checksums:
            return False
        if index.uncompressed_size > min(index.chunk_length, MAX_CHUNK_BYTES):
            return False
        span = index.message_start_time, index.message_end_time
        begin = loss.offset + index.chunk_length - index.uncompressed_size
        data = self.walk.read(begin, index.uncompressed_size)
        self.builder.add_torn_chunk(begin, data, replace(loss, span_ns=span))
        return True
