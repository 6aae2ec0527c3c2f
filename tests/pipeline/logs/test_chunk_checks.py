"""Chunks that stand in a file twice, and chunks in the place of others."""

import io
from pathlib import Path

import pytest
from fixtures.recorder import NUM_MESSAGES, content, of_kind, recording, reference
from mcap.opcode import Opcode
from mcap.records import ChunkIndex
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, IndexType, Writer

from pipeline.logs.reader import MissionLog, open_log

FORMS = {
    "zstd": {},
    "plain, no checksums": {"compression": CompressionType.NONE, "enable_crcs": False},
    "no index": {"index_types": IndexType.NONE},
    "no summary": {"has_summary": False},
}


def groups(data: bytes) -> list[tuple[int, int]]:
    """The bytes of each chunk with the message indexes behind it."""
    starts = [place.begin for place in of_kind(data, Opcode.CHUNK)]
    return list(zip(starts, [*starts[1:], of_kind(data, Opcode.DATA_END)[0].begin], strict=True))


@pytest.fixture
def opened(tmp_path: Path):
    def opened(data: bytes) -> MissionLog:
        path = tmp_path / "log.mcap"
        path.write_bytes(data)
        return open_log(path)

    return opened


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("behind", [2, 5])
def test_a_chunk_that_stands_twice_is_taken_once(form: str, behind: int, opened) -> None:
    whole = recording(**FORMS[form])
    begin, end = groups(whole)[2]
    place = groups(whole)[behind][1]
    log = opened(whole[:place] + whole[begin:end] + whole[place:])
    assert content(log) == reference(whole)
    assert log.health.is_complete == (form != "no summary")
    assert any(f"chunk of byte {begin} stands there once more" in problem for problem in log.health.problems)


def test_a_chunk_over_another_of_its_size_is_missed_and_not_taken_twice(opened) -> None:
    """Everything in the file but the times in its index would agree."""
    whole = recording(compression=CompressionType.NONE)
    sizes = [end - begin for begin, end in groups(whole)]
    first = next(i for i in range(2, len(sizes)) if sizes[i] in sizes[i + 1 :])
    second = sizes.index(sizes[first], first + 1)
    (begin, end), (place, place_end) = groups(whole)[first], groups(whole)[second]
    log = opened(whole[:place] + whole[begin:end] + whole[place_end:])
    index = [record for record in StreamReader(io.BytesIO(whole)).records if isinstance(record, ChunkIndex)][second]
    span = (index.message_start_time, index.message_end_time)
    assert content(log) == [message for message in reference(whole) if not span[0] <= message[3] <= span[1]]
    assert log.health.lost_spans_ns == (span,) and log.health.num_messages_expected == NUM_MESSAGES


@pytest.mark.parametrize("form", FORMS)
def test_chunks_that_a_recorder_wrote_alike_are_two(form: str, opened) -> None:
    """A recorder without clock writes one message like another; index or statistics count them."""
    options = dict(FORMS[form])
    if not options.pop("has_summary", True):
        options |= {"use_statistics": False, "index_types": IndexType.NONE}
    file = io.BytesIO()
    writer = Writer(file, chunk_size=1, **options)
    writer.start()
    channel = writer.register_channel("/a", "json", 0)
    for _ in range(4):
        writer.add_message(channel, 0, b"{}", 0)
    writer.finish()
    log = opened(file.getvalue())
    assert len(of_kind(file.getvalue(), Opcode.CHUNK)) > 3
    if form in ("zstd", "plain, no checksums"):
        assert len(content(log)) == 4 and not log.health.problems
    else:
        assert log.health.problems and not log.health.is_complete
        assert len(content(log)) == (4 if form == "no index" else 2)
