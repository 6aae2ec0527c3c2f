"""A source log and our side file in one: the source's data as they are, byte for byte, our messages behind them.

Chunks, attachments and metadata of the source are not unpacked, let alone packed again. Our chunks overlap those of the
source in time; readers that follow the index, and ours, put the messages of both in order.
"""

import os
from pathlib import Path
from typing import BinaryIO, Final

from cadence.errors import InputError
from pipeline.files import replacing
from pipeline.logs.index import MAX_ID
from pipeline.logs.packed import unpacked
from pipeline.logs.reader import Channel, MissionLog, open_log
from pipeline.logs.recorder import Packing, Recorder
from pipeline.logs.records import DamagedRecord
from pipeline.logs.source_index import SourceIndex, read_index
from pipeline.progress import Progress

_BLOCK_BYTES: Final = 2**20


def write_combined(source: Path, side: Path, target: Path, packing: Packing, progress: Progress) -> None:
    """Write `target`: all bytes of `source` before the end of its data, then messages and metadata of `side`, one index.

    Schemas and channels of `side` get ids above those of `source`. Memory is bounded by a chunk of either; `target` appears
    when it is complete. Neither input is touched.
    Raises `InputError` where the source's records are damaged: a combined file must not hold less than its source. Chunks
    keep their checksums and are not unpacked: damage inside stays as visible as it was (and the export stage looks for it).
    """
    added = open_log(side)
    if not added.health.is_complete:
        raise InputError(f"{side}: is damaged ({'; '.join(added.health.problems)}); export again")
    with replacing(target) as draft, unpacked(source).open("rb") as source_file, draft.open("wb") as target_file:
        found = _read_index(source, source_file, added)
        _copy(source, source_file, target_file, found.data_end, progress)
        # Continued from what the source states, and not computed: where its bytes were changed, the sum stays wrong.
        recorder = Recorder(target_file, packing, found.index, found.data_end, found.checksum or None)
        _add(added, recorder, progress)
        recorder.finish()


def _read_index(source: Path, file: BinaryIO, added: MissionLog) -> SourceIndex:
    """The index of the source, with room for the channels and schemas of `added`."""
    try:
        found = read_index(file, file.seek(0, os.SEEK_END))
    except DamagedRecord as error:
        raise _damaged(source, str(error)) from error
    num_schemas = len({_schema(channel) for channel in added.channels})
    if found.index.max_channel_id + len(added.channels) > MAX_ID or found.index.max_schema_id + num_schemas > MAX_ID:
        raise InputError(
            f"{source}: uses ids of channels or schemas up to the largest, {MAX_ID}; none is left for ours; "
            "export without combined"
        )
    return found


def _damaged(source: Path, reason: str) -> InputError:
    return InputError(f"{source}: is damaged ({reason}) and cannot be combined; export without combined")


def _copy(source: Path, source_file: BinaryIO, target: BinaryIO, num_bytes: int, progress: Progress) -> None:
    source_file.seek(0)
    with progress.bar(num_bytes, f"combine {source.name}", unit="B", scale=True) as bar:
        while num_bytes:
            block = source_file.read(min(_BLOCK_BYTES, num_bytes))
            if not block:
                raise _damaged(source, "it became shorter meanwhile")
            target.write(block)
            num_bytes -= len(block)
            bar.update(len(block))


def _add(added: MissionLog, recorder: Recorder, progress: Progress) -> None:
    """Record all messages and metadata of `added`, its channels as far as they have messages."""
    schemas: dict[tuple[str, str, bytes], int] = {("", "", b""): 0}
    channels: dict[int, int] = {}
    with progress.bar(added.size_bytes, f"combine {added.path.name}", unit="B", scale=True) as bar:
        for message in added.messages(on_bytes=bar.update):
            channel = message.channel
            if channel.id not in channels:
                schema = _schema(channel)
                if schema not in schemas:
                    schemas[schema] = recorder.add_schema(*schema)
                channels[channel.id] = recorder.add_channel(
                    channel.topic, channel.message_encoding, schemas[schema], channel.metadata
                )
            recorder.add_message(
                channels[channel.id], message.sequence, message.log_time_ns, message.publish_time_ns, message.data
            )
    for name, content in added.metadata():
        recorder.add_metadata(name, content)


def _schema(channel: Channel) -> tuple[str, str, bytes]:
    return channel.schema_name, channel.schema_encoding, channel.schema_data
