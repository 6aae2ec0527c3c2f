"""Reading by indexes: columns, time ranges, indexes that lie, logs that were checked before, recordings in parts."""

import io
import random
import shutil
import struct

import numpy as np
import pytest
from fixtures.recorder import FORMS, NUM_MESSAGES, START_NS, STEP_NS, content, recording, reference
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import NonSeekingReader
from mcap.records import ChunkIndex
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from cadence.errors import InputError
from pipeline.logs import plan_builder, rows, timeline
from pipeline.logs.indexed import plan_by_index
from pipeline.logs.reader import MissionLog, open_log, open_parts, reopen
from pipeline.logs.records import parse_chunk, parse_message_index, unpack_chunk, walk

INDEXED = ("zstd", "lz4", "plain")
WHOLE = {form: recording(**options) for form, options in FORMS.items()}
MESSAGES = {form: reference(data) for form, data in WHOLE.items()}
METADATA = "rosbag2_bagfile_information:\n  relative_file_paths:\n    - bag_0.mcap\n    - bag_1.mcap\n    - bag_2.mcap\n"


@pytest.fixture(scope="module")
def scratch(tmp_path_factory):
    return tmp_path_factory.mktemp("indexes") / "log.mcap"


def chunk_indexes(data: bytes) -> list[ChunkIndex]:
    return [record for record in StreamReader(io.BytesIO(data)).records if isinstance(record, ChunkIndex)]


def in_columns(log: MissionLog, **selection) -> list[tuple]:
    """The messages of `batches`, brought into the order of `messages`."""
    found = []
    for batch in log.batches(**selection):
        assert len(batch) == len(batch.log_time_ns) > 0 and (np.diff(batch.log_time_ns) >= 0).all()
        assert [m.data for m in batch.messages()] == list(batch.payloads())
        found += batch.messages()
    return sorted((m.log_time_ns, m.sequence, m.channel.topic, m.publish_time_ns, m.data) for m in found)


def one_by_one(log: MissionLog, **selection) -> list[tuple]:
    return sorted((m.log_time_ns, m.sequence, m.channel.topic, m.publish_time_ns, m.data) for m in log.messages(**selection))


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("disorder", [0, 7, NUM_MESSAGES])
def test_columns_hold_what_the_messages_hold(form, disorder, write_log):
    shuffle = random.Random(disorder)
    order = sorted(range(NUM_MESSAGES), key=lambda i: i + shuffle.uniform(0, disorder))
    log = open_log(write_log(recording(order=order, **FORMS[form])))
    for topics in (None, {"/b"}, {"/a", "/c"}, {"/nothing"}):
        assert in_columns(log, topics=topics) == one_by_one(log, topics=topics)
    steps: list[int] = []
    assert sum(map(len, log.batches(on_bytes=steps.append))) == NUM_MESSAGES and sum(steps) == log.size_bytes


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    for form, data in WHOLE.items():
        (folder / f"{form}.mcap").write_bytes(data)
    return {form: open_log(folder / f"{form}.mcap") for form in FORMS}


@given(
    form=st.sampled_from(list(FORMS)), begin=st.integers(-5, NUM_MESSAGES + 5), length=st.integers(0, NUM_MESSAGES),
    offset=st.sampled_from([-1, 0, 1]),
)  # fmt: skip
def test_time_range_is_that_of_the_reference_reader(form, begin, length, offset, logs):
    start = max(0, START_NS + begin * STEP_NS + offset)
    end = max(0, start + length * STEP_NS)
    reader = NonSeekingReader(io.BytesIO(WHOLE[form]))
    wanted = [(m.log_time, m.data) for _, _, m in reader.iter_messages(starting_at=start, ending_before=end)]
    assert [(m.log_time_ns, m.data) for m in logs[form].messages(start_ns=start, end_ns=end)] == wanted
    assert in_columns(logs[form], start_ns=start, end_ns=end) == one_by_one(logs[form], start_ns=start, end_ns=end)


def test_only_chunks_in_the_time_range_are_unpacked(write_log, monkeypatch):
    log = open_log(write_log(recording()))
    unpacked = []
    monkeypatch.setattr(timeline, "unpack_chunk", lambda chunk: unpacked.append(chunk.start_ns) or unpack_chunk(chunk))
    (message,) = log.messages(start_ns=START_NS + 50 * STEP_NS, end_ns=START_NS + 50 * STEP_NS + 1)
    assert message.sequence == 50 and len(unpacked) == 1
    assert list(log.messages({"/a"}, end_ns=START_NS)) == [] and len(unpacked) == 1


@pytest.mark.parametrize("form", INDEXED)
def test_sound_chunks_are_not_walked(form, write_log, monkeypatch):
    path = write_log(recording(**FORMS[form]))
    for module in (plan_builder, timeline):
        monkeypatch.setattr(module, "rows_by_walk", lambda *_: pytest.fail("walked"))
    assert len(list(open_log(path).messages())) == NUM_MESSAGES


def test_rows_by_index_are_those_of_the_walk():
    whole = recording()
    for index in chunk_indexes(whole):
        begin, end = index.chunk_start_offset, index.chunk_start_offset + index.chunk_length
        data = unpack_chunk(parse_chunk(whole[begin + 9 : end]))
        behind = whole[end : end + index.message_index_length]
        entries = [parse_message_index(behind[b:e]) for _, b, e in walk(behind)]
        by_walk, definitions = rows.rows_by_walk(data)
        found = rows.rows_by_index(data, entries)
        assert found is not None and found[1] == definitions
        some = rows.indexed_rows(data, behind, {1, 3})
        for name in ("channel_id", "sequence", "log_time_ns", "publish_time_ns", "begin", "end"):
            assert np.array_equal(getattr(found[0], name), getattr(by_walk, name))
            assert np.array_equal(getattr(some, name), getattr(by_walk, name)[by_walk.channel_id != 2])
        for lie in lies(entries, len(data)):
            assert rows.rows_by_index(data, lie) is None


def lies(entries, size):
    """The index of a chunk, wrong in every way that could hide a message."""
    (number, first), *others = entries
    yield [(number, first[1:]), *others]  # a message is not named
    yield others  # a channel is not named
    yield [(number + 7, first), *others]  # another channel
    yield [(number, np.concatenate([first[:1], first])), *others]  # named twice
    for field, value in (("offset", 1), ("log_time", 1), ("offset", size), ("offset", 2**63)):
        wrong = first.copy()
        wrong[field][0] += np.uint64(value)
        yield [(number, wrong), *others]


@pytest.mark.parametrize("form", INDEXED)
@settings(max_examples=20)
@given(data=st.data())
def test_a_message_index_that_lies_is_noticed_and_costs_nothing(form, data, scratch):
    """Any bits of the message indexes, while the chunks are sound: all messages are read, and the fault is told."""
    whole = bytearray(WHOLE[form])
    index = data.draw(st.sampled_from(chunk_indexes(bytes(whole))))
    begin = index.chunk_start_offset + index.chunk_length
    bits = data.draw(
        st.lists(st.integers(8 * begin, 8 * (begin + index.message_index_length) - 1), min_size=1, max_size=4, unique=True)
    )
    for bit in bits:
        whole[bit // 8] ^= 1 << bit % 8
    scratch.write_bytes(whole)
    log = open_log(scratch)
    assert log.health.problems
    found = content(log)
    assert [message for message in found if message in MESSAGES[form]] == MESSAGES[form]
    assert found == MESSAGES[form] or not log.health.is_complete  # where the index has become a message
    assert one_by_one(log) == in_columns(log)
    assert content(reopen([scratch], log.health)) == found


def test_index_of_another_chunk_is_noticed(write_log):
    """Message indexes of one chunk are copied over those of another with the same channels."""
    whole = recording(compression=CompressionType.NONE)
    first, second = chunk_indexes(whole)[1:3]
    begins = [index.chunk_start_offset + index.chunk_length for index in (first, second)]
    assert first.message_index_length == second.message_index_length
    damaged = bytearray(whole)
    damaged[begins[1] : begins[1] + second.message_index_length] = whole[begins[0] : begins[0] + first.message_index_length]
    log = open_log(write_log(bytes(damaged)))
    assert content(log) == reference(whole) and log.health.is_complete
    assert log.health.problems == ("1 chunk differs from its message indexes, which were not used.",)


@pytest.mark.parametrize("held", [1, 3000, timeline.MAX_HELD_BYTES])
@pytest.mark.parametrize("disorder", [5, NUM_MESSAGES])
def test_few_bytes_are_held_where_chunks_overlap(held, disorder, write_log, monkeypatch):
    """With hardly any room, chunks are read again and again, and the messages are still the same."""
    shuffle = random.Random(disorder)
    order = sorted(range(NUM_MESSAGES), key=lambda i: i + shuffle.uniform(0, disorder))
    log = open_log(write_log(recording(order=order)))
    monkeypatch.setattr(timeline, "MAX_HELD_BYTES", held)
    assert [m.sequence for m in log.messages()] == list(range(NUM_MESSAGES))
    assert [m.sequence for m in log.messages({"/b"})] == list(range(1, NUM_MESSAGES, 3))


def test_a_loop_that_stops_early_leaves_nothing_open(write_log):
    path = write_log(recording())
    for message in open_log(path).messages():
        if message.sequence == 3:
            break
    shutil.move(path, path.with_name("moved.mcap"))


@pytest.mark.parametrize("form", FORMS)
def test_reopened_log_is_the_log(form, write_log, monkeypatch):
    path = write_log(recording(**FORMS[form]))
    log = open_log(path)
    if form in INDEXED:
        monkeypatch.setattr(plan_builder, "unpack_chunk", lambda _: pytest.fail("unpacked"))
    again = reopen([path], log.health)
    assert again == log or form not in INDEXED
    assert content(again) == content(log) and again.metadata() == log.metadata() and again.health == log.health


def test_index_without_every_message_is_left_to_the_walk(write_log):
    file = io.BytesIO()
    writer = Writer(file, chunk_size=100)
    writer.start()
    channel = writer.register_channel("/a", "json", 0)
    for i in range(9):
        writer.add_message(channel, i, b"%60d" % i, i)
    writer._Writer__chunk_indices.pop()
    writer.finish()
    assert plan_by_index(write_log(file.getvalue())) is None
    assert plan_by_index(write_log(recording(has_summary=False))) is None
    assert plan_by_index(write_log(recording()[:-30])) is None
    assert plan_by_index(write_log(recording())) is not None
    assert plan_by_index(write_log(b"").with_name("gone.mcap")) is None


def split(tmp_path, bounds=(0, 50, 70, NUM_MESSAGES), interleaved=False):
    """The recording of `fixtures.recorder` in several files, whose ids of channels differ."""
    folder = tmp_path / "bag"
    folder.mkdir()
    paths = []
    for part in range(len(bounds) - 1):
        numbers = range(part, NUM_MESSAGES, len(bounds) - 1) if interleaved else range(bounds[part], bounds[part + 1])
        with (folder / f"bag_{part}.mcap").open("wb") as file:
            writer = Writer(file, chunk_size=700)
            writer.start("", "recorder")
            schema = writer.register_schema("Item", "jsonschema", b'{"type": "object"}')
            names = ["/a", "/b", "/c"][part:] + ["/a", "/b", "/c"][:part]
            channels = {name: writer.register_channel(name, "json", schema) for name in names}
            if part == 1:
                other = writer.register_schema("Other", "jsonschema", b"{}")
                writer.add_message(writer.register_channel("/a", "json", other), START_NS + 1, b"{}", START_NS + 1, 999)
            writer.add_metadata("part", {"number": str(part)})
            for i in numbers:
                time = START_NS + i * STEP_NS
                writer.add_message(channels["/" + "abc"[i % 3]], time, b'{"x": %d}' % i, time, i)
            writer.finish()
        paths.append(folder / f"bag_{part}.mcap")
    (folder / "metadata.yaml").write_text(METADATA)
    return paths


@pytest.mark.parametrize("interleaved", [False, True])
def test_parts_are_one_log(interleaved, tmp_path):
    paths = split(tmp_path, interleaved=interleaved)
    log = open_parts(paths)
    assert [m.sequence for m in log.messages()] == [0, 999, *range(1, NUM_MESSAGES)]
    assert [(c.topic, c.schema_name, c.message_count) for c in log.channels] == [
        ("/a", "Item", 40), ("/b", "Item", 40), ("/c", "Item", 40), ("/a", "Other", 1),
    ]  # fmt: skip
    assert len({c.id for c in log.channels}) == 4 and all(m.channel in log.channels for m in log.messages(["/b"]))
    assert [m.sequence for m in log.messages({"/b"})] == list(range(1, NUM_MESSAGES, 3))
    assert in_columns(log) == one_by_one(log)
    assert (log.start_ns, log.end_ns) == (START_NS, START_NS + (NUM_MESSAGES - 1) * STEP_NS)
    assert log.health.is_complete and not log.health.problems and log.health.num_messages == NUM_MESSAGES + 1
    assert log.size_bytes == sum(path.stat().st_size for path in paths) and log.parts == tuple(paths)
    assert (log.name, log.path) == ("bag", paths[0])
    assert log.metadata() == tuple(("part", {"number": str(i)}) for i in range(3))
    again = reopen(paths, log.health)
    assert again == log
    steps: list[int] = []
    open_parts(paths, steps.append)
    list(log.messages(on_bytes=steps.append))
    assert sum(steps) == 2 * log.size_bytes


def test_lost_and_damaged_parts_are_named(tmp_path):
    paths = split(tmp_path)
    paths[2].write_bytes(b"")  # as a recorder leaves it that was killed
    log = open_parts(paths)
    assert not log.health.is_complete and "bag_2.mcap: is empty" in log.health.problems[0]
    assert log.health.num_messages_expected is None and len(list(log.messages())) == 71
    paths[2].unlink()
    log = open_parts(paths[:2])
    assert not log.health.is_complete and log.health.problems[0].startswith("bag_2.mcap: is named in")
    assert len(list(reopen(paths[:2], log.health).messages())) == 71
    data = paths[1].read_bytes()
    paths[1].write_bytes(data[: len(data) // 4])
    log = open_parts(paths[:2])
    assert len(log.health.problems) > 1 and log.health.problems[1].startswith("bag_1.mcap: ")
    assert 50 < len(list(log.messages())) == log.health.num_messages < 71


def test_what_is_no_part_is_refused(tmp_path):
    paths = split(tmp_path)
    with pytest.raises(InputError, match="not found"):
        open_parts([paths[0], tmp_path / "gone.mcap"])
    with pytest.raises(InputError, match="without parts"):
        open_parts([])
    for path in paths:
        path.write_bytes(b"no log")
    with pytest.raises(InputError, match="not an MCAP"):
        open_parts(paths)


def test_batches_and_rows_check_their_columns():
    zero, one = np.zeros(0, np.int64), np.zeros(1, np.int64)
    with pytest.raises(ValueError, match="one length"):
        rows.Rows(zero, zero, zero, zero, zero, one)
    log_time = struct.pack("<QQ", 1, 2)
    assert parse_message_index(struct.pack("<HI", 3, 16) + log_time)[1]["offset"].tolist() == [2]
