"""Chunks whose compressed bytes are several frames, with frames to be skipped among them: the formats allow both."""

import io
import random
import struct
import time
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import mcap.writer
import pytest
import zstandard
from mcap.writer import CompressionType, Writer

from pipeline.logs.compression import unpack_lz4, unpack_zstd
from pipeline.logs.reader import open_log

DATA = random.Random(1).randbytes(4000) * 5
SKIPPED = struct.pack("<II", 0x184D2A53, 5) + b"skip!"
PACK = {"zstd": zstandard.compress, "lz4": lz4.frame.compress}
UNPACK = {"zstd": unpack_zstd, "lz4": unpack_lz4}
FRAMES: dict[str, Callable[[Callable[[bytes], bytes], bytes], bytes]] = {
    "one frame": lambda pack, data=DATA: pack(data),
    "two frames": lambda pack, data=DATA: pack(data[:100]) + pack(data[100:]),
    "many frames": lambda pack, data=DATA: b"".join(pack(data[i : i + 50]) for i in range(0, len(data), 50)),
    "empty frames": lambda pack, data=DATA: pack(b"") + pack(data) + pack(b""),
    "skipped at the beginning": lambda pack, data=DATA: SKIPPED * 2 + pack(data),
    "skipped in between and behind": lambda pack, data=DATA: pack(data[:100]) + SKIPPED + pack(data[100:]) + SKIPPED,
}


@pytest.mark.parametrize("kind", UNPACK)
@pytest.mark.parametrize("frames", FRAMES)
def test_all_frames_are_unpacked_and_no_more_than_asked_for(kind: str, frames: str) -> None:
    packed = FRAMES[frames](PACK[kind])
    for view in (packed, memoryview(packed)):
        assert UNPACK[kind](view, len(DATA)) == DATA
    assert UNPACK[kind](packed, 60) == DATA[:61]


@pytest.mark.parametrize("kind", UNPACK)
@pytest.mark.parametrize("packed", [b"no frame at all", PACK["zstd"](DATA)[:9] + b"xx", PACK["lz4"](DATA)[:9] + b"xx"])
def test_what_is_no_frame_raises_or_gives_nothing(kind: str, packed: bytes) -> None:
    try:
        assert UNPACK[kind](packed, len(DATA)) == b""
    except (zstandard.ZstdError, RuntimeError):
        pass


@pytest.mark.parametrize("kind", UNPACK)
@pytest.mark.parametrize("frame", [SKIPPED, None])
def test_a_megabyte_of_empty_frames_takes_no_time(kind: str, frame: bytes | None) -> None:
    one = frame or PACK[kind](b"")
    began = time.process_time()
    assert UNPACK[kind](one * (2**20 // len(one)), 100) == b""
    assert time.process_time() - began < 5


@pytest.mark.parametrize("kind", UNPACK)
@pytest.mark.parametrize("frames", FRAMES)
@pytest.mark.parametrize("has_checksums", [True, False])
def test_a_log_of_such_chunks_is_sound(
    kind: str, frames: str, has_checksums: bool, write_log: Callable[[bytes], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Library:
        compress = staticmethod(lambda data: FRAMES[frames](PACK[kind], data))

    class Lz4:
        frame = Library

    monkeypatch.setattr(mcap.writer, "zstandard", Library)
    monkeypatch.setattr(mcap.writer, "lz4", Lz4)
    file = io.BytesIO()
    compression = {"zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4}[kind]
    writer = Writer(file, chunk_size=2000, compression=compression, enable_crcs=has_checksums)
    writer.start()
    channel = writer.register_channel("/a", "json", 0)
    for i in range(100):
        writer.add_message(channel, i + 1, b'{"i": %60d}' % i, i)
    writer.finish()
    monkeypatch.undo()
    log = open_log(write_log(file.getvalue()))
    assert log.health.is_complete and not log.health.problems
    assert [message.log_time_ns for message in log.messages()] == list(range(1, 101))
