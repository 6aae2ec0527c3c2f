"""Damage: real and generated logs, cut and changed at many places. Nothing crashes, hangs, or is lost without a word.

Some hundred cases in the quick suite; CADENCE_DAMAGE=400 makes so many cuts and so many changes of every log.
"""

import os
import random
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from fixtures.encoded_logs import CONTAINERS, encoded_log
from fixtures.recorder import FORMS, carried, content, recording, reference
from mcap.writer import CompressionType

from cadence.errors import InputError
from pipeline.logs.decode import Decoder, UndecodableChannel, UndecodableMessage, decoder_for
from pipeline.logs.reader import Channel, RawMessage, open_log

NUM_CASES = int(os.environ.get("CADENCE_DAMAGE", "25"))
REAL = (
    "mcap-explorer_demo", "rosbag2_cdr_test_0", "rosbag2_talker", "rosbag2_wbag_0", "rosbag2parquet_array_msgs_0",
)  # fmt: skip
MAX_SECONDS = 20.0
DECODERS: dict[tuple[Any, ...], Decoder] = {}
NUM_DECODED = 3
"""Messages of each channel of a damaged log that are decoded."""


@dataclass(frozen=True)
class Whole:
    """A log before the damage: its bytes, what they hold, and whether changed bytes inside messages can be noticed."""

    data: bytes
    messages: list[tuple[Any, ...]]
    has_checksums: bool


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("damage") / "log.mcap"


def whole_of(data: bytes, scratch: Path) -> Whole:
    scratch.write_bytes(data)
    log = open_log(scratch)
    assert log.health.is_complete and content(log) == reference(data)
    return Whole(data, reference(data), log.health.has_checksums)


@pytest.fixture(scope="module", params=CONTAINERS)
def generated(request: pytest.FixtureRequest, scratch: Path) -> Whole:
    return whole_of(encoded_log(request.param), scratch)


@pytest.fixture(scope="module", params=REAL)
def real(request: pytest.FixtureRequest, shared_data: Path, scratch: Path) -> Whole:
    return whole_of((shared_data / "formats" / f"{request.param}.mcap").read_bytes(), scratch)


def outline(messages: list[tuple[Any, ...]]) -> list[tuple[Any, ...]]:
    """What is known to be right without checksums: topics, log times and sizes."""
    return [(topic, log_time, len(data)) for topic, _, _, log_time, _, _, data in messages]


def examine(scratch: Path, whole: Whole, data: bytes, what: str) -> None:
    """Open and read a damaged log: refused in one line, or its messages are all there, or its health says that not."""
    scratch.write_bytes(data)
    began = time.perf_counter()
    try:
        log = open_log(scratch)
        found = list(log.messages())
    except InputError as error:
        assert "\n" not in str(error), what
        return
    finally:
        assert time.perf_counter() - began < MAX_SECONDS, what
    health, messages = log.health, [carried(message) for message in found]
    assert len(messages) == health.num_messages, what
    assert all("\n" not in problem for problem in health.problems), what
    if messages != whole.messages and health.is_complete:
        assert not whole.has_checksums and not health.has_checksums, f"{what}: lost or changed without a word"
        assert outline(messages) == outline(whole.messages), f"{what}: lost without a word"
    decode_some(found)


def decoder_of(channel: Channel) -> Decoder:
    """`decoder_for`, asked once for equal channels: to compile a ROS schema takes longer than to read a small log."""
    key = (channel.message_encoding, channel.schema_name, channel.schema_encoding, channel.schema_data)
    if key not in DECODERS:
        DECODERS[key] = decoder_for(channel)
    return DECODERS[key]


def decode_some(messages: list[RawMessage]) -> None:
    """Decode the first messages of each channel; bytes that do not fit may only raise what is foreseen."""
    seen: Counter[int] = Counter()
    for message in messages:
        number = message.channel.id
        seen[number] += 1
        if seen[number] > NUM_DECODED:
            continue
        try:
            decoder_of(message.channel)(message.data)
        except UndecodableChannel:
            seen[number] = NUM_DECODED
        except UndecodableMessage as error:
            assert "\n" not in str(error)


def cut_everywhere(scratch: Path, whole: Whole) -> None:
    """Cut in even steps, and shortly before the end, where index and footer are."""
    size = len(whole.data)
    places = {size * i // NUM_CASES for i in range(NUM_CASES)} | {size - 1 - i * 9 for i in range(NUM_CASES // 4)}
    for place in sorted(places):
        examine(scratch, whole, whole.data[:place], f"cut at byte {place} of {size}")


def change_everywhere(scratch: Path, whole: Whole) -> None:
    """Flip one to three bits; overwrite, take away and put in stretches."""
    noise = random.Random(len(whole.data))
    for case in range(NUM_CASES):
        data = bytearray(whole.data)
        for bit in noise.sample(range(8 * len(data)), noise.randint(1, 3)):
            data[bit // 8] ^= 1 << bit % 8
        examine(scratch, whole, bytes(data), f"bits flipped, case {case}")
    for case in range(NUM_CASES // 2):
        begin = noise.randrange(len(whole.data))
        end = min(len(whole.data), begin + noise.choice([1, 8, 100, 5000]))
        middle = (b"", bytes(end - begin), noise.randbytes(end - begin), whole.data[begin:end] * 2)[case % 4]
        examine(scratch, whole, whole.data[:begin] + middle + whole.data[end:], f"bytes {begin} to {end}, case {case}")


def test_generated_logs_cut(generated: Whole, scratch: Path) -> None:
    cut_everywhere(scratch, generated)


def test_generated_logs_changed(generated: Whole, scratch: Path) -> None:
    change_everywhere(scratch, generated)


def test_real_logs_cut(real: Whole, scratch: Path) -> None:
    cut_everywhere(scratch, real)


def test_real_logs_changed(real: Whole, scratch: Path) -> None:
    change_everywhere(scratch, real)


@pytest.mark.parametrize("form", FORMS)
def test_a_log_that_was_copied_as_text_is_read_where_it_is_whole(form: str, scratch: Path) -> None:
    whole = recording(num_messages=3000, **FORMS[form])
    assert whole.count(b"\r\n") > 2  # the magic at both ends, and some by chance
    scratch.write_bytes(whole.replace(b"\r\n", b"\n"))
    log = open_log(scratch)
    found, wanted = content(log), reference(whole)
    assert not log.health.is_complete and any("copied as text" in problem for problem in log.health.problems)
    assert len(found) > 0.7 * len(wanted)
    # Outside chunks nothing tells that a message is one byte short: it takes one of the next record.
    num_wrong = (Counter(found) - Counter(wanted)).total()
    assert num_wrong <= (whole.count(b"\r\n") if form == "unchunked" else 0)


@pytest.mark.parametrize("num_bytes", range(13))
def test_the_mere_beginning_of_a_log_copied_as_text(num_bytes: int, scratch: Path) -> None:
    scratch.write_bytes(recording().replace(b"\r\n", b"\n")[:num_bytes])
    try:
        assert not open_log(scratch).health.is_complete
    except InputError as error:
        assert num_bytes < 7 and "\n" not in str(error)


@pytest.mark.parametrize("opcode", [3, 4])
def test_names_that_nothing_confirms_are_doubted(opcode: int, scratch: Path) -> None:
    """Without checksums, and with an index that cannot be used: a name that it does not repeat may be wrong."""
    whole = recording(compression=CompressionType.NONE, enable_crcs=False)[:-8]
    scratch.write_bytes(whole)
    health = open_log(scratch).health
    assert health.is_complete and "cannot be used" in health.problems[0]
    damaged = bytearray(whole)
    damaged[whole.index({3: b"Item", 4: b"/b"}[opcode]) + 1] ^= 1
    scratch.write_bytes(damaged)
    health = open_log(scratch).health
    assert not health.is_complete and health.problems[0].startswith("1 definitions of channels or schemas are not repeated")


def test_other_line_ends_are_named(scratch: Path) -> None:
    scratch.write_bytes(recording().replace(b"\n", b"\r\n"))
    with pytest.raises(InputError, match="binary mode"):
        open_log(scratch)


@pytest.mark.parametrize("encoding", CONTAINERS)
def test_generated_logs_hold_messages_that_decode(encoding: str, scratch: Path) -> None:
    scratch.write_bytes(encoded_log(encoding))
    log = open_log(scratch)
    assert {channel.message_encoding for channel in log.channels} <= {encoding, "json"} and len(log.channels) == 2
    for message in log.messages():
        decoder_of(message.channel)(message.data)
