import io
import struct
import time
import tracemalloc
import zlib

import pytest
import zstandard
from fixtures.recorder import FORMS, NUM_MESSAGES, START_NS, content, recording, reference
from hypothesis import given
from hypothesis import strategies as st
from mcap.records import ChunkIndex
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, IndexType, Writer

from cadence.errors import InputError
from pipeline.logs.reader import open_log

MAGIC = b"\x89MCAP0\r\n"
WHOLE = {form: recording(**options) for form, options in FORMS.items()}
MESSAGES = {form: reference(data) for form, data in WHOLE.items()}


@pytest.fixture(scope="module")
def scratch(tmp_path_factory):
    return tmp_path_factory.mktemp("damaged") / "log.mcap"


def read(scratch, data: bytes):
    scratch.write_bytes(data)
    log = open_log(scratch)
    messages = content(log)
    assert len(messages) == log.health.num_messages
    return log.health, messages


def assert_no_silent_loss(scratch, form: str, data: bytes) -> None:
    """Either the file is refused, or its messages are those of the whole file, or its health says that they are not."""
    try:
        health, messages = read(scratch, data)
    except InputError as error:
        assert "\n" not in str(error)
        return
    if messages != MESSAGES[form]:
        assert not health.is_complete and health.problems
    assert all("\n" not in problem for problem in health.problems)


def chunk_indexes(data: bytes) -> list[ChunkIndex]:
    return [record for record in StreamReader(io.BytesIO(data)).records if isinstance(record, ChunkIndex)]


def record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def chunk(
    content: bytes, compression: bytes = b"", size: int | None = None, crc: int = 0, packed: bytes | None = None
) -> bytes:
    packed = content if packed is None else packed
    head = struct.pack("<QQQII", START_NS, START_NS + 10, len(content) if size is None else size, crc, len(compression))
    return record(6, head + compression + struct.pack("<Q", len(packed)) + packed)


@pytest.mark.parametrize("form", FORMS)
@given(data=st.data())
def test_truncation_never_loses_silently(form, data, scratch):
    whole = WHOLE[form]
    assert_no_silent_loss(scratch, form, whole[: data.draw(st.integers(0, len(whole) - 1))])


@pytest.mark.parametrize("form", FORMS)
@given(data=st.data())
def test_flipped_bits_never_lose_silently(form, data, scratch):
    damaged = bytearray(WHOLE[form])
    for bit in data.draw(st.lists(st.integers(0, 8 * len(damaged) - 1), min_size=1, max_size=3, unique=True)):
        damaged[bit // 8] ^= 1 << bit % 8
    assert_no_silent_loss(scratch, form, bytes(damaged))


@pytest.mark.parametrize("form", ["zstd", "unchunked", "plain without summary"])
def test_a_flipped_bit_in_any_place_never_loses_silently(form, scratch):
    for offset in range(0, len(WHOLE[form]), 53):
        damaged = bytearray(WHOLE[form])
        damaged[offset] ^= 1 << offset % 8
        assert_no_silent_loss(scratch, form, bytes(damaged))


@pytest.mark.parametrize("form", FORMS)
@given(data=st.data())
def test_removed_inserted_and_zeroed_bytes_never_lose_silently(form, data, scratch):
    whole = WHOLE[form]
    begin = data.draw(st.integers(0, len(whole) - 1))
    end = min(len(whole), begin + data.draw(st.integers(0, 300)))
    middle = data.draw(st.one_of(st.just(b""), st.binary(max_size=20), st.just(bytes(end - begin))))
    assert_no_silent_loss(scratch, form, whole[:begin] + middle + whole[end:])


@pytest.mark.parametrize("form", ["zstd", "lz4", "plain", "zstd without summary"])
def test_one_broken_chunk_costs_its_messages_only_and_is_named(form, scratch):
    indexed = recording(**FORMS[form] | {"has_summary": True})
    broken = chunk_indexes(indexed)[4]
    damaged = bytearray(WHOLE[form])
    start = damaged.index(indexed[broken.chunk_start_offset :][:40])
    damaged[start + broken.chunk_length - 20] ^= 0xFF
    health, messages = read(scratch, bytes(damaged))
    kept = [m for m in MESSAGES[form] if not broken.message_start_time <= m[3] <= broken.message_end_time]
    assert 0 < len(kept) < NUM_MESSAGES and messages == kept
    assert health.lost_spans_ns == ((broken.message_start_time, broken.message_end_time),)
    assert not health.is_complete and f"byte {start}" in health.problems[0]
    if form != "zstd without summary":
        assert health.num_messages_expected == NUM_MESSAGES
        assert f"{NUM_MESSAGES - len(kept)} messages" in health.problems[0]  # counted by the message indexes behind it


def test_chunk_with_damaged_length_is_skipped_by_the_index_or_by_search(scratch):
    for form in ("zstd", "zstd without summary"):
        broken = chunk_indexes(WHOLE["zstd"])[3]
        damaged = bytearray(WHOLE[form])
        start = damaged.index(WHOLE["zstd"][broken.chunk_start_offset :][:40])
        damaged[start + 4] ^= 1  # the length of the record grows by 16 MiB
        health, messages = read(scratch, bytes(damaged))
        kept = [m for m in MESSAGES[form] if not broken.message_start_time <= m[3] <= broken.message_end_time]
        assert messages == kept and not health.is_complete


@pytest.mark.parametrize("form", FORMS)
def test_lost_footer_costs_no_message(form, scratch):
    health, messages = read(scratch, WHOLE[form][:-20])
    assert messages == MESSAGES[form]
    assert health.is_complete and "index at the end" in health.problems[-1]


@pytest.mark.parametrize("compression", ["zstd", "lz4", "plain"])
def test_beginning_of_the_last_chunk_is_saved(compression, scratch):
    whole = recording(num_messages=12000, chunk_size=2**22, **FORMS[compression])
    (only,) = chunk_indexes(whole)
    health, messages = read(scratch, whole[: only.chunk_start_offset + only.chunk_length * 3 // 4])
    wanted = reference(whole)
    assert messages == wanted[: len(messages)] and len(wanted) // 3 < len(messages) < len(wanted)
    assert not health.is_complete and health.num_messages_expected is None
    if compression != "plain":
        assert health.lost_spans_ns == ((messages[-1][3], wanted[-1][3]),)


def test_half_of_a_real_flight_is_saved(shared_data, scratch):
    whole = (shared_data / "flights" / "cubs2_cub_stabilize.mcap").read_bytes()
    health, messages = read(scratch, whole[: len(whole) // 2])
    wanted = reference(whole)
    assert messages == wanted[: len(messages)] and len(messages) > 0.4 * len(wanted)
    assert not health.is_complete


def test_missing_definitions_are_named(scratch):
    """The chunk that defines the channels is broken and no index repeats them: later messages cannot be used."""
    damaged = bytearray(WHOLE["zstd without summary"])
    damaged[damaged.index(b"zstd") + 20] ^= 0xFF
    health, messages = read(scratch, bytes(damaged))
    assert messages == [] and not health.is_complete
    assert any("without a definition" in problem for problem in health.problems)


def test_index_gives_the_definitions_that_a_broken_chunk_held(scratch):
    damaged = bytearray(WHOLE["zstd"])
    damaged[damaged.index(b"zstd") + 20] ^= 0xFF
    health, messages = read(scratch, bytes(damaged))
    assert len(messages) > NUM_MESSAGES // 2 and not health.is_complete


def test_vanished_chunk_is_noticed_by_the_index(scratch):
    lost = chunk_indexes(WHOLE["zstd"])[2]
    damaged = bytearray(WHOLE["zstd"])
    damaged[lost.chunk_start_offset] = 0x86  # a private record, which readers have to skip
    health, messages = read(scratch, bytes(damaged))
    assert len(messages) < NUM_MESSAGES and (lost.message_start_time, lost.message_end_time) in health.lost_spans_ns


def test_statistics_that_disagree_are_an_alarm(scratch):
    file = io.BytesIO()
    writer = Writer(file)
    writer.start()
    channel = writer.register_channel("/a", "json", 0)
    writer.add_message(channel, 1, b"{}", 1)
    writer._Writer__statistics.message_count += 2
    writer.finish()
    health, messages = read(scratch, file.getvalue())
    assert len(messages) == 1 and health.num_messages_expected == 3 and not health.is_complete
    assert "should hold 3 messages" in health.problems[0]


def test_changed_topic_outside_chunks_is_noticed_and_the_index_wins(scratch):
    damaged = bytearray(WHOLE["unchunked"])
    damaged[damaged.index(b"/b")] ^= 1
    health, messages = read(scratch, bytes(damaged))
    assert messages == MESSAGES["unchunked"] and not health.is_complete


def test_changed_times_and_channels_in_chunks_without_checksum_are_noticed(scratch):
    """Most recorders of ROS 2 write no checksums; their indexes and statistics still tell."""
    whole = recording(compression=CompressionType.NONE, enable_crcs=False)
    health, messages = read(scratch, whole)
    assert health.is_complete and not health.problems and not health.has_checksums
    start = whole.index(record_head(70))
    for offset, words in ((start + 9 + 8, "times of channel"), (start + 9, "may be wrong")):
        damaged = bytearray(whole)
        damaged[offset] ^= 3
        health, found = read(scratch, bytes(damaged))
        assert found != messages and not health.is_complete and words in " ".join(health.problems)


def test_changed_channel_without_message_index_is_noticed_by_the_statistics(scratch):
    whole = recording(compression=CompressionType.NONE, enable_crcs=False, index_types=IndexType.NONE)
    damaged = bytearray(whole)
    damaged[whole.index(record_head(70)) + 9] ^= 3
    health, _ = read(scratch, bytes(damaged))
    assert not health.is_complete and "statistics" in health.problems[0]


def record_head(number: int) -> bytes:
    """Where message `number` of a recording begins, up to its channel id."""
    body = b'{"x": %d, "noise": "' % number
    whole = recording(compression=CompressionType.NONE, enable_crcs=False)
    begin = whole.index(body) - 22 - 9
    return whole[begin : begin + 9 + 6]


def test_times_beyond_int64_are_left_out_and_counted(scratch):
    for options in ({}, {"use_chunking": False}):
        file = io.BytesIO()
        writer = Writer(file, **options)
        writer.start()
        channel = writer.register_channel("/a", "json", 0)
        writer.add_message(channel, 2**64 - 1, b"{}", 1)
        writer.add_message(channel, 5, b"{}", 1)
        writer.finish()
        health, messages = read(scratch, file.getvalue())
        assert [m[3] for m in messages] == [5] and not health.is_complete
        assert any("2262" in problem for problem in health.problems)


def test_many_damaged_places_make_few_sentences(scratch):
    whole = recording(num_messages=1200)
    damaged = bytearray(whole)
    for index in chunk_indexes(whole):
        damaged[index.chunk_start_offset + index.chunk_length - 5] ^= 0xFF
    health, _ = read(scratch, bytes(damaged))
    assert len(health.lost_spans_ns) > 50 and len(health.problems) < 30


@pytest.mark.parametrize("compression", [b"", b"zstd", b"lz4", b"brotli"])
def test_declared_sizes_are_not_believed(compression, scratch):
    packed = zstandard.compress(b"abc") if compression == b"zstd" else b"abc"
    data = MAGIC + record(1, struct.pack("<II", 0, 0)) + chunk(b"", compression, size=2**31, packed=packed)
    data += struct.pack("<BQ", 5, 2**31) + bytes(60_000)
    tracemalloc.start()
    health, messages = read(scratch, data)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert messages == [] and not health.is_complete and peak < 20e6


def test_megabytes_of_zeros_in_a_chunk_take_no_time(scratch):
    zeros = bytes(64 * 2**20)
    packed = zstandard.compress(zeros)
    data = MAGIC + record(1, struct.pack("<II", 0, 0)) + chunk(zeros, b"zstd", crc=zlib.crc32(zeros), packed=packed)
    began = time.perf_counter()
    health, _ = read(scratch, data + record(15, bytes(4)))
    assert time.perf_counter() - began < 5 and not health.is_complete


@pytest.mark.parametrize("has_statistics", [True, False])
def test_unknown_records_are_skipped_and_doubted_without_statistics(has_statistics, scratch):
    file = io.BytesIO()
    writer = Writer(file, use_chunking=False, use_statistics=has_statistics)
    writer.start()
    file.write(record(0x90, b"private"))
    channel = writer.register_channel("/a", "json", 0)
    writer.add_message(channel, 5, b"{}", 1)
    writer.finish()
    health, messages = read(scratch, file.getvalue())
    assert [m[3] for m in messages] == [5]
    assert health.is_complete == has_statistics and bool(health.problems) != has_statistics
