"""A source log and our side file in one: every record of the source as it was, our messages among them by time."""

import contextlib
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import zstandard
from mcap import records
from mcap.exceptions import McapError
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

from cadence.errors import InputError
from pipeline.logs.writer import Compression, LogWriter
from pipeline.progress import Progress

_FOREIGN = (McapError, zstandard.ZstdError, RuntimeError, EOFError, MemoryError, ValueError, struct.error)


def write_combined(source: Path, side: Path, target: Path, compression: Compression, progress: Progress) -> None:
    """Write `target` with all of `source` (messages, schemas, channels, attachments, metadata) and all of `side`.

    Message bytes, times and sequence numbers are those of the source; ids and chunks are new. Neither input is touched.
    Raises `InputError` where the source is damaged: a combined file must not hold less than its source.
    """
    with source.open("rb") as source_file, side.open("rb") as side_file, progress.bar(None, "combine", "message") as bar:
        ours = _records(side, side_file)
        theirs = _records(source, source_file)
        header = next(theirs, None)
        profile = header.profile if isinstance(header, records.Header) else ""
        with LogWriter(target, compression, profile) as writer:
            added, copied = _Copier(side, writer.raw), _Copier(source, writer.raw)
            waiting = added.next_message(ours)
            for record in theirs:
                if isinstance(record, records.Message):
                    while waiting is not None and waiting.log_time < record.log_time:
                        added.copy(waiting)
                        waiting = added.next_message(ours)
                    bar.update(1)
                copied.copy(record)
            while waiting is not None:
                added.copy(waiting)
                waiting = added.next_message(ours)


class _Copier:
    """Copies records of one log; its schemas and channels get new ids in the target."""

    def __init__(self, path: Path, writer: Writer) -> None:
        self._path = path
        self._writer = writer
        self._schema_ids = {0: 0}  # 0 means: no schema
        self._channel_ids: dict[int, int] = {}

    def next_message(self, found: Iterator[Any]) -> records.Message | None:
        """The next message; whatever comes before it is copied."""
        for record in found:
            if isinstance(record, records.Message):
                return record
            self.copy(record)
        return None

    def copy(self, record: Any) -> None:
        """Write one record; those of the summary are made anew by the writer."""
        match record:
            case records.Schema() if record.id not in self._schema_ids:
                self._schema_ids[record.id] = self._writer.register_schema(record.name, record.encoding, record.data)
            case records.Channel() if record.id not in self._channel_ids:
                schema_id = self._known(self._schema_ids, record.schema_id)
                self._channel_ids[record.id] = self._writer.register_channel(
                    record.topic, record.message_encoding, schema_id, record.metadata
                )
            case records.Message():
                self._writer.add_message(
                    self._known(self._channel_ids, record.channel_id),
                    record.log_time,
                    record.data,
                    record.publish_time,
                    record.sequence,
                )
            case records.Attachment():
                self._writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, record.data)
            case records.Metadata():
                self._writer.add_metadata(record.name, record.metadata)
            case _:
                pass

    def _known(self, ids: dict[int, int], number: int) -> int:
        if number not in ids:
            raise InputError(f"{self._path}: is damaged (a channel or schema is missing); export without combined")
        return ids[number]


def _records(path: Path, file: BinaryIO) -> Iterator[Any]:
    """Records in the order of the file, chunks unpacked and checked."""
    with _as_input_error(path):
        yield from StreamReader(file, validate_crcs=True).records


@contextlib.contextmanager
def _as_input_error(path: Path) -> Iterator[None]:
    try:
        yield
    except _FOREIGN as error:
        raise InputError(
            f"{path}: is damaged ({str(error) or type(error).__name__}) and cannot be combined; export without combined"
        ) from error
