"""The checksum over all data of a file, which the end mark of the data may state."""

from typing import Final

from mcap.opcode import Opcode
from zlib_ng.zlib_ng import crc32

from pipeline.logs.file_walk import FileWalk
from pipeline.logs.records import DATA_END, MAGIC

_READ_BYTES: Final = 2**20


class DataChecksum:
    """Follows a walk over the data, as far as their checksum is stated: seldom, and it costs time.

    value  CRC-32 over all data so far; None where it is not followed
    """

    def __init__(self, walk: FileWalk, has_summary: bool) -> None:
        self.walk = walk
        is_wanted = not walk.is_text and (not has_summary or self._is_stated())
        self.value: int | None = crc32(MAGIC) if is_wanted else None

    def _is_stated(self) -> bool:
        """Whether there is one in the end mark of the data, whose place is known by the summary behind it."""
        if self.walk.limit - DATA_END.size < self.walk.position:
            return False
        end_mark = DATA_END.unpack(self.walk.read(self.walk.limit - DATA_END.size, DATA_END.size))
        return end_mark != (Opcode.DATA_END, 4, 0)

    def add(self, data: bytes | memoryview) -> None:
        """Take the next bytes of the file."""
        if self.value is not None:
            self.value = crc32(data, self.value)

    def add_span(self, offset: int, length: int) -> None:
        """Take the next bytes of the file, which nobody has read so far."""
        if self.value is not None:
            for begin in range(offset, offset + length, _READ_BYTES):
                self.add(self.walk.read(begin, min(_READ_BYTES, offset + length - begin)))
