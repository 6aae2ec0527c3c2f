"""Several recordings in one file, one behind the other, whole or cut off, with or without bytes between them."""

import io
from collections import Counter
from pathlib import Path

import pytest
from fixtures.recorder import FORMS, NUM_MESSAGES, content, of_kind, recording, reference
from hypothesis import given
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.writer import Writer

from pipeline.logs.reader import MissionLog, open_log, reopen

WHOLE = {form: recording(**options) for form, options in FORMS.items()}


def other(num_messages: int = 30, **options: object) -> bytes:
    """A recording whose channels have the ids of `recording`'s, but other names, but for one."""
    file = io.BytesIO()
    writer = Writer(file, chunk_size=400, **options)
    writer.start("", "another recorder")
    schema = writer.register_schema("Item", "jsonschema", b'{"type": "object"}')
    channels = [writer.register_channel(topic, "json", schema) for topic in ("/d", "/b", "/e")]
    writer.add_metadata("mission", {"name": "other"})
    for i in range(num_messages):
        writer.add_message(channels[i % 3], 2 * 10**18 + i, b'{"other": %d}' % i, i, i)
    writer.finish()
    return file.getvalue()


OTHER = other()


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("recordings") / "log.mcap"


def opened(scratch: Path, data: bytes) -> MissionLog:
    scratch.write_bytes(data)
    return open_log(scratch)


@pytest.mark.parametrize("form", FORMS)
def test_two_recordings_are_read_as_two(form: str, scratch: Path) -> None:
    log = opened(scratch, WHOLE[form] + OTHER)
    assert content(log) == reference(WHOLE[form]) + reference(OTHER)
    assert log.health.is_complete and "2 recordings" in log.health.problems[0]
    assert log.health.num_messages_expected == (None if "without summary" in form else NUM_MESSAGES + 30)
    assert [channel.topic for channel in log.channels if channel.topic == "/b"] == ["/b"]
    assert len({channel.id for channel in log.channels}) == len(log.channels) == 5
    assert [content["name"] for _, content in log.metadata()] == ["test", "other"]
    assert log.parts == (scratch,) and log.size_bytes == len(WHOLE[form]) + len(OTHER)
    assert content(reopen([scratch], log.health)) == content(log)
    assert sum(map(len, log.batches())) == NUM_MESSAGES + 30


def test_progress_counts_each_byte_once(scratch: Path) -> None:
    scratch.write_bytes(WHOLE["zstd"] + OTHER + bytes(1000))
    steps: list[int] = []
    log = open_log(scratch, steps.append)
    assert sum(steps) == log.size_bytes == scratch.stat().st_size and min(steps) >= 0
    steps.clear()
    list(log.messages(on_bytes=steps.append))
    assert sum(steps) == log.size_bytes


@pytest.mark.parametrize("first", FORMS)
@given(data=st.data())
def test_a_recording_behind_one_that_was_cut_off_is_whole(first: str, data: st.DataObject, scratch: Path) -> None:
    whole = WHOLE[first]
    cut = data.draw(st.integers(8 + 9, len(whole) - 1))
    log = opened(scratch, whole[:cut] + OTHER)
    found = content(log)
    assert found[-30:] == reference(OTHER)
    assert Counter(found[:-30]) <= Counter(reference(whole))
    if found[:-30] != reference(whole):
        assert not log.health.is_complete


@pytest.mark.parametrize("between", [b"\n", bytes(700), b"\x05" * 300, WHOLE["zstd"][:8]])
@pytest.mark.parametrize("behind", [b"", OTHER])
def test_bytes_behind_the_end_are_named_and_cost_nothing(between: bytes, behind: bytes, scratch: Path) -> None:
    whole = WHOLE["zstd"]
    log = opened(scratch, whole + between + behind)
    assert content(log) == reference(whole) + (reference(OTHER) if behind else [])
    assert log.health.is_complete and log.health.num_messages_expected == NUM_MESSAGES + 30 * bool(behind)
    words = f"{len(between)} bytes from byte {len(whole)} on, behind the end of the recording, are no records."
    assert any(problem.endswith(words) for problem in log.health.problems)


@pytest.mark.parametrize("form", FORMS)
def test_a_recording_that_stands_twice_is_taken_once(form: str, scratch: Path) -> None:
    log = opened(scratch, WHOLE[form] * 2)
    assert content(log) == reference(WHOLE[form]) and log.health.is_complete
    assert log.health.num_messages_expected in (None, NUM_MESSAGES)
    assert any(f"{NUM_MESSAGES} of its messages stand in an earlier recording" in problem for problem in log.health.problems)


def test_the_beginning_of_a_recording_behind_itself_is_taken_once(scratch: Path) -> None:
    whole = WHOLE["zstd"]
    chunk = of_kind(whole, Opcode.CHUNK)[4]
    log = opened(scratch, whole + whole[: chunk.begin])
    assert content(log) == reference(whole) and not log.health.is_complete


def test_an_attached_recording_is_no_second_one(scratch: Path) -> None:
    """Also where the index is damaged, so that the whole file is walked."""
    file = io.BytesIO()
    writer = Writer(file)
    writer.start()
    channel = writer.register_channel("/a", "json", 0)
    writer.add_attachment(1, 1, "other.mcap", "application/mcap", OTHER)
    writer.add_message(channel, 5, OTHER, 5)
    writer.finish()
    for data in (file.getvalue(), file.getvalue()[:-30]):
        log = opened(scratch, data)
        assert len(content(log)) == 1 and log.health.is_complete
        assert not any("recordings" in problem for problem in log.health.problems)


def test_recordings_without_number_are_not_all_planned(scratch: Path) -> None:
    empty = recording(num_messages=0)
    log = opened(scratch, empty * 150)
    assert not log.health.is_complete and any("100th recording" in problem for problem in log.health.problems)
