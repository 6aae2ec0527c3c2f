"""Where the data end: an end mark is believed where nothing in the file contradicts it; the counts of the file are compared."""

import io
import struct
from pathlib import Path

import pytest
from fixtures.recorder import FORMS, NUM_MESSAGES, START_NS, content, of_kind, places, recording, reference
from hypothesis import given
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.records import ChunkIndex
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from pipeline.logs.health import Health
from pipeline.logs.reader import open_log, reopen

WHOLE = {form: recording(**options) for form, options in FORMS.items()}
MESSAGES = {form: reference(data) for form, data in WHOLE.items()}
CHUNKED = ("zstd", "lz4", "plain", "zstd without index")
WITH_STATISTICS = (*CHUNKED, "unchunked")
SECTOR = 512


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("ends") / "log.mcap"


def read(scratch: Path, data: bytes) -> tuple[Health, list[tuple]]:
    scratch.write_bytes(data)
    log = open_log(scratch)
    found = content(log)
    assert content(reopen([scratch], log.health)) == found
    return log.health, found


def data_of(whole: bytes) -> list:
    """The records of the data section behind the header."""
    found = places(whole)
    return found[1 : [place.opcode for place in found].index(Opcode.DATA_END)]


def end_mark(whole: bytes) -> bytes:
    (place,) = of_kind(whole, Opcode.DATA_END)
    return whole[place.begin : place.end]


def chunk_group(whole: bytes, number: int) -> tuple[int, int]:
    """The bytes of a chunk and of the message indexes behind it."""
    starts = [place.begin for place in of_kind(whole, Opcode.CHUNK)]
    following = next(
        place.begin for place in places(whole) if place.begin > starts[number] and place.opcode != Opcode.MESSAGE_INDEX
    )
    return starts[number], following


@pytest.mark.parametrize("form", FORMS)
def test_an_end_mark_among_the_data_hides_nothing(form: str, scratch: Path) -> None:
    """Inserted before every record: all messages are read, and the health says where the data seem to end."""
    whole = WHOLE[form]
    for place in data_of(whole)[::3]:
        health, found = read(scratch, whole[: place.begin] + end_mark(whole) + whole[place.begin :])
        assert found == MESSAGES[form] and not health.is_complete
        assert f"byte {place.begin}" in health.problems[0].lower() and "end mark" in health.problems[0]
        assert health.num_messages_expected in (None, NUM_MESSAGES)
        assert health.num_messages_expected is not None or form not in WITH_STATISTICS


@pytest.mark.parametrize("form", CHUNKED)
@pytest.mark.parametrize("has_checksums", [True, False])
def test_a_chunk_that_was_cut_out_is_missed(form: str, has_checksums: bool, scratch: Path) -> None:
    """The statistics still count its messages, and its index says when they were."""
    whole = recording(**FORMS[form] | {"enable_crcs": has_checksums})
    records = StreamReader(io.BytesIO(whole)).records
    index = [record for record in records if isinstance(record, ChunkIndex)][3:4]
    begin, end = chunk_group(whole, 3)
    health, found = read(scratch, whole[:begin] + whole[end:])
    assert [message for message in reference(whole) if message in found] == found and len(found) < NUM_MESSAGES
    assert health.num_messages_expected == NUM_MESSAGES and not health.is_complete
    assert f"should hold {NUM_MESSAGES} messages; {len(found)} can be read" in " ".join(health.problems)
    if index:
        assert health.lost_spans_ns == ((index[0].message_start_time, index[0].message_end_time),)


@pytest.mark.parametrize("form", FORMS)
def test_bytes_between_records_move_the_end_and_cost_nothing(form: str, scratch: Path) -> None:
    """A private record that somebody put in: the index is found behind the data, and agrees with them."""
    whole = WHOLE[form]
    private = struct.pack("<BQ", 0x90, 20) + bytes(20)
    place = [place for place in data_of(whole) if place.opcode in (Opcode.CHUNK, Opcode.MESSAGE)][2].begin
    health, found = read(scratch, whole[:place] + private + whole[place:])
    assert found == MESSAGES[form]
    if form in CHUNKED and "enable_data_crcs" not in FORMS[form]:
        assert health.is_complete and health.num_messages_expected == NUM_MESSAGES
        words = "The data end 29 bytes behind the place that the file states; so many messages as it counts were found."
        assert health.problems == (words,)


def test_the_number_of_messages_is_never_taken_from_those_that_were_found(scratch: Path) -> None:
    health, found = read(scratch, WHOLE["zstd without summary"])
    assert health.is_complete and len(found) == NUM_MESSAGES and health.num_messages_expected is None
    damaged = bytearray(WHOLE["zstd without summary"])
    damaged[damaged.index(b"zstd", 2000) + 20] ^= 0xFF
    health, found = read(scratch, bytes(damaged))
    assert not health.is_complete and health.num_messages_expected is None


@pytest.mark.parametrize("form", WITH_STATISTICS)
@given(bits=st.data())
def test_a_damaged_index_costs_no_message(form: str, bits: st.DataObject, scratch: Path) -> None:
    whole = WHOLE[form]
    begin = 8 * of_kind(whole, Opcode.DATA_END)[0].end
    damaged = bytearray(whole)
    for bit in bits.draw(st.lists(st.integers(begin, 8 * len(whole) - 1), min_size=1, max_size=3, unique=True)):
        damaged[bit // 8] ^= 1 << bit % 8
    health, found = read(scratch, bytes(damaged))
    assert found == MESSAGES[form] and health.problems
    assert health.num_messages_expected in (None, NUM_MESSAGES) or not health.is_complete


@pytest.mark.parametrize("form", FORMS)
@given(data=st.data())
def test_exchanged_copied_and_lost_sectors_never_lose_silently(form: str, data: st.DataObject, scratch: Path) -> None:
    whole = WHOLE[form]
    sectors = [whole[begin : begin + SECTOR] for begin in range(0, len(whole), SECTOR)]
    first, second = data.draw(st.lists(st.integers(1, len(sectors) - 1), min_size=2, max_size=2, unique=True))
    kind = data.draw(st.sampled_from(["exchanged", "copied", "zeroed", "lost"]))
    if kind == "exchanged":
        sectors[first], sectors[second] = sectors[second], sectors[first]
    elif kind == "copied":
        sectors[first] = sectors[second]
    else:
        sectors[first] = bytes(SECTOR) if kind == "zeroed" else b""
    health, found = read(scratch, b"".join(sectors))
    assert found == MESSAGES[form] or not health.is_complete
    if form in WITH_STATISTICS and health.num_messages_expected is not None:
        assert health.num_messages_expected == NUM_MESSAGES


@pytest.mark.parametrize("form", WITH_STATISTICS)
@given(data=st.data())
def test_records_put_in_taken_out_and_moved_never_lose_silently(form: str, data: st.DataObject, scratch: Path) -> None:
    """Whole records, so that everything in the file looks sound by itself."""
    whole = WHOLE[form]
    records = [whole[place.begin : place.end] for place in places(whole)]
    numbers = st.integers(1, len(records) - 4)
    for _ in range(data.draw(st.integers(1, 3))):
        source, target = data.draw(numbers), data.draw(numbers)
        kind = data.draw(st.sampled_from(["copied", "moved", "taken"]))
        record = records[source] if kind == "copied" else records.pop(source)
        if kind != "taken":
            records.insert(target, record)
    health, found = read(scratch, whole[:8] + b"".join(records) + whole[-8:])
    assert sorted(found) == sorted(MESSAGES[form]) or not health.is_complete


def test_the_end_of_the_file_in_its_midst(scratch: Path) -> None:
    """End mark, summary and footer stand before the last chunks, as where blocks of a disk were written in another order."""
    whole = WHOLE["zstd"]
    end = of_kind(whole, Opcode.DATA_END)[0].begin
    begin = of_kind(whole, Opcode.CHUNK)[2].begin
    health, found = read(scratch, whole[:begin] + whole[end:] + whole[begin:end])
    assert found == MESSAGES["zstd"] and not health.is_complete
    assert "end mark of the data, but records of the data follow" in health.problems[0]


def test_a_changed_time_outside_checksums_is_noticed_by_the_statistics(scratch: Path) -> None:
    whole = recording(use_chunking=False)
    health, _ = read(scratch, whole)
    assert health.is_complete and not health.has_checksums and not health.problems
    place = of_kind(whole, Opcode.MESSAGE)[0].begin + 9 + 6
    damaged = bytearray(whole)
    assert struct.unpack_from("<Q", damaged, place) == (START_NS,)
    damaged[place + 7] ^= 1  # two years later
    health, _ = read(scratch, bytes(damaged))
    assert not health.is_complete and "log time differs" in health.problems[0]


def test_statistics_that_count_more_attachments_than_there_are(scratch: Path) -> None:
    file = io.BytesIO()
    writer = Writer(file, compression=CompressionType.NONE)
    writer.start()
    channel = writer.register_channel("/a", "json", 0)
    writer.add_attachment(1, 2, "picture", "image/png", b"png")
    writer.add_message(channel, 1, b"{}", 1)
    writer.finish()
    whole = file.getvalue()
    (attachment,) = of_kind(whole, Opcode.ATTACHMENT)
    damaged = bytearray(whole)
    damaged[attachment.begin] = 0x90
    health, found = read(scratch, bytes(damaged))
    assert len(found) == 1 and health.is_complete
    assert health.problems == ("The statistics of the file count 1 attachments; 0 were found.",)
