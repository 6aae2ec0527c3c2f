"""Small files that ask for gigabytes or minutes, read in a process of their own: refused at once and in little memory."""

import json
import struct
import subprocess
import sys
import zlib
from pathlib import Path
from typing import Any

import lz4.frame
import pytest
import zstandard

from pipeline.logs.records import MAGIC, MESSAGE_HEAD

ROOT = Path(__file__).resolve().parents[3]
GIB, MIB = 2**30, 2**20
MAX_SECONDS, MAX_BYTES = 2.0, 600e6
_BLOCK = 2**17
"""Largest block of a zstd frame."""

READ = """
import json, resource, sys, time
from pathlib import Path
from cadence.errors import CadenceError
from pipeline.logs.reader import open_log

# Far above what is asked for: whoever breaks the promise must not take the machine with them.
pages = int(Path("/proc/self/statm").read_text().split()[0])
resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + 3 * 2**30,) * 2)
began, found = time.process_time(), {"messages": 0, "is_complete": False, "problems": []}
try:
    log = open_log(sys.argv[1])
    found = {"messages": sum(1 for _ in log.messages()), "is_complete": log.health.is_complete, "problems": log.health.problems}
except CadenceError as error:
    found["problems"] = [str(error)]
found["seconds"] = time.process_time() - began
# Not ru_maxrss, which begins at what the parent had when it forked.
status = Path("/proc/self/status").read_text().splitlines()
found["bytes"] = next(int(line.split()[1]) * 1024 for line in status if line.startswith("VmHWM"))
print(json.dumps(found))
"""


def record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def frame(head: bytes, num_zeros: int) -> bytes:
    """A zstd frame of `head` and so many zeros, four bytes for each 128 KiB (RFC 8878: blocks of one repeated byte)."""
    count, rest = divmod(num_zeros, _BLOCK)
    assert rest == 0 and len(head) < _BLOCK
    blocks = struct.pack("<I", len(head) << 3)[:3] + head
    blocks += (struct.pack("<I", _BLOCK << 3 | 1 << 1)[:3] + b"\0") * (count - 1)
    blocks += struct.pack("<I", _BLOCK << 3 | 1 << 1 | 1)[:3] + b"\0"
    size = struct.pack("<I", (len(head) + num_zeros) % 2**32)
    return b"\x28\xb5\x2f\xfd" + bytes([0b1000_0000, 7 << 3]) + size + blocks


def bomb(packed: bytes, size: int, crc: int = 0, compression: bytes = b"zstd") -> bytes:
    """A whole file with one channel and one chunk that states `size` and `crc`."""
    chunk = struct.pack("<QQQII", 1, 2, size, crc, len(compression)) + compression + struct.pack("<Q", len(packed)) + packed
    text = struct.pack("<I", 2) + b"/a" + struct.pack("<I", 4) + b"json" + struct.pack("<I", 0)
    channel = struct.pack("<HH", 1, 0) + text
    end = record(15, bytes(4)) + record(2, bytes(20)) + MAGIC
    return MAGIC + record(1, bytes(8)) + record(4, channel) + record(6, chunk) + end


def message_of_zeros(size: int) -> bytes:
    """The beginning of a message of `size` bytes."""
    return struct.pack("<BQ", 5, MESSAGE_HEAD.size + size) + MESSAGE_HEAD.pack(1, 0, 1, 1)


def crc_of_zeros(size: int) -> int:
    crc = 0
    for _ in range(size // MIB):
        crc = zlib.crc32(bytes(MIB), crc)
    return crc


def read_apart(path: Path) -> dict[str, Any]:
    done = subprocess.run(
        [sys.executable, "-c", READ, str(path)], cwd=ROOT, capture_output=True, text=True, timeout=100, check=False
    )
    assert done.returncode == 0, done.stderr
    result: dict[str, Any] = json.loads(done.stdout)
    return result


BOMBS = {
    "a message of 2 GiB": lambda: bomb(frame(message_of_zeros(2 * GIB), 2 * GIB), 2 * GIB + 31),
    "a message of 2 GiB, said to be small": lambda: bomb(frame(message_of_zeros(2 * GIB), 2 * GIB), 5000),
    "a loose message of 2 GiB": lambda: MAGIC + record(1, bytes(8)) + message_of_zeros(2 * GIB) + bytes(65_000),
    "256 MiB of zeros": lambda: bomb(frame(b"", 256 * MIB), 256 * MIB, crc_of_zeros(256 * MIB)),
    "lz4, said to be small": lambda: bomb(lz4.frame.compress(bytes(512 * MIB)), 5000, compression=b"lz4"),
}


@pytest.mark.parametrize("name", BOMBS)
def test_bombs_are_refused_at_once_and_in_little_memory(name: str, tmp_path: Path) -> None:
    path = tmp_path / "bomb.mcap"
    path.write_bytes(BOMBS[name]())
    assert path.stat().st_size < 3 * MIB
    found = read_apart(path)
    assert found["messages"] == 0 and not found["is_complete"] and found["problems"]
    assert found["seconds"] < MAX_SECONDS and found["bytes"] < MAX_BYTES


def test_the_frames_are_what_they_say() -> None:
    packed = frame(b"head", 4 * _BLOCK)
    assert zstandard.decompress(packed) == b"head" + bytes(4 * _BLOCK)
    assert len(frame(b"", 256 * MIB)) < 9000 and len(frame(b"", 2 * GIB)) < 66_000


def test_a_chunk_that_is_large_but_true_is_read(tmp_path: Path) -> None:
    path = tmp_path / "large.mcap"
    size = 32 * MIB
    path.write_bytes(bomb(frame(message_of_zeros(size), size), size + 31))
    assert read_apart(path)["messages"] == 1
