"""The search for records after damage in files without an index: what it finds, and its cost where bytes look like heads."""

import io
import struct
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.logs import resync
from pipeline.logs.reader import open_log
from pipeline.logs.records import MAGIC
from pipeline.logs.resync import RecordSearch, find_recording

MIB = 2**20


def record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def text(content: bytes) -> bytes:
    return struct.pack("<I", len(content)) + content


def message(number: int, channel: int = 5) -> bytes:
    return record(5, struct.pack("<HIQQ", channel, number, 10**18 + number, 0) + b"{}")


CHANNEL = record(4, struct.pack("<HH", 5, 0) + text(b"/a") + text(b"json") + bytes(4))
BEGINNING = MAGIC + record(1, text(b"") + text(b"")) + CHANNEL
MESSAGES = b"".join(map(message, range(50)))
CHUNK = record(6, struct.pack("<QQQII", 1, 2, 3, 4, 4) + b"zstd" + struct.pack("<Q", 7) + b"content")
INDEX = record(7, struct.pack("<HI", 5, 16) + bytes(16))
FOUND = {
    "three messages": message(1) + message(2) + message(3),
    "a chunk and its index": CHUNK + INDEX,
    "a chunk and another": CHUNK * 2,
    "a message and a chunk": message(1) + CHUNK,
    "statistics and an offset": record(11, bytes(46)) + record(14, b"\x0b" + bytes(16)),
    "a message and the end mark": message(1) + record(15, bytes(4)),
}
NOT_FOUND = {
    "two messages": message(1) + message(2) + b"?" * 20,
    "messages of another channel": message(1, 6) + message(2, 6) + message(3, 6),
    "a chunk of contradictory lengths": (CHUNK.replace(b"\x07\0", b"\x08\0")) * 2,
    "the end mark alone": record(15, bytes(4)) + b"?" * 20,
    "a schema that is none": record(3, struct.pack("<HI", 1, 3) + b"\xff\xff\xff" + text(b"x") + text(b"y")) * 3,
}


def found_at(data: bytes, begin: int = 0) -> int:
    return RecordSearch(io.BytesIO(data), len(data)).find(begin, {5}, lambda _: None)


@pytest.mark.parametrize("kind", FOUND)
@pytest.mark.parametrize("before", [0, 1, 100, MIB - 20, MIB - 3, MIB, 3 * MIB + 5])
def test_records_are_found_wherever_they_begin(kind: str, before: int) -> None:
    junk = b"\xee" * before
    assert found_at(junk + FOUND[kind] + b"\xee" * 30) == before


@pytest.mark.parametrize("kind", NOT_FOUND)
def test_what_only_looks_like_records_is_passed(kind: str) -> None:
    data = b"\xee" * 50 + NOT_FOUND[kind]
    assert found_at(data) == len(data)
    assert found_at(data + b"\xee" * 9 + FOUND["three messages"]) == len(data) + 9


@given(st.binary(max_size=200), st.sampled_from(list(FOUND)), st.binary(max_size=200))
def test_a_search_stops_at_records_or_before(before: bytes, kind: str, behind: bytes) -> None:
    assert found_at(before + FOUND[kind] + behind) <= len(before)


def test_a_record_that_ends_outside_the_window_is_followed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resync, "_WINDOW_BYTES", 64)
    large = record(5, struct.pack("<HIQQ", 5, 1, 1, 1) + b"\xee" * 1000)
    assert found_at(b"\xee" * 70 + large * 3) == 70


TRAPS = {
    "zeros": b"\0",
    "schemas": struct.pack("<BQHI", 3, 400_000, 1, 5) + b"aaaaa" + text(b"bbb"),
    "schemas behind each other": record(3, struct.pack("<HI", 1, 3) + b"\xff\xff\xff" + text(b"x") + text(b"y")),
    "channels with long maps": struct.pack("<BQHH", 4, 900_000, 1, 1) + text(b"") + text(b"") + struct.pack("<I", 890_000),
    "indexes of chunks": struct.pack("<BQ", 8, 600_000) + bytes(32) + struct.pack("<I", 590_000),
    "pairs of messages": message(1) * 2 + b"\xee" * 9,
    "metadata": record(12, text(b"\xff") + bytes(4)),
    "small numbers": np.arange(1, 16, dtype="<u8").tobytes(),
}


@pytest.mark.parametrize("kind", TRAPS)
def test_bytes_that_look_like_heads_take_little_time(kind: str, tmp_path: Path) -> None:
    """Minutes a megabyte for some of these, if each place were looked at with all that it claims."""
    trap = TRAPS[kind] * (2 * MIB // len(TRAPS[kind]))
    path = tmp_path / "log.mcap"
    path.write_bytes(BEGINNING + MESSAGES + b"\xff" * 20 + trap + b"\xff" * 9 + MESSAGES + record(15, bytes(4)))
    began = time.process_time()
    log = open_log(path)
    assert time.process_time() - began < 5
    assert not log.health.is_complete and log.health.num_messages >= 50
    if log.health.num_messages < 100:
        assert "too much of it looks like records" in log.health.problems[0]


def test_a_search_that_is_given_up_says_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(resync, "_MAX_PARSED_BYTES", 100_000)
    path = tmp_path / "log.mcap"
    path.write_bytes(BEGINNING + MESSAGES + b"\xff" * 20 + TRAPS["metadata"] * 10_000 + MESSAGES)
    log = open_log(path)
    assert log.health.num_messages == 50 and "too much of it looks like records" in log.health.problems[0]


def test_a_recording_is_found_by_its_header_alone() -> None:
    for before in (0, 5, MIB - 8, MIB - 1):
        data = b"\xee" * before + MAGIC[:5] + BEGINNING
        assert find_recording(io.BytesIO(data), 0, len(data)) == before + 5
        assert find_recording(io.BytesIO(data), before + 6, len(data)) is None
    for broken in (MAGIC + record(1, text(b"a")), MAGIC + record(2, bytes(20)), BEGINNING[:20]):
        assert find_recording(io.BytesIO(broken), 0, len(broken)) is None
