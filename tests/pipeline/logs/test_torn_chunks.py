"""Chunks without compression and checksum, of which a page was lost: what is left of them is read, and nothing else."""

from pathlib import Path

import pytest
from fixtures.recorder import content, of_kind, recording, reference
from hypothesis import given
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.writer import CompressionType, IndexType

from pipeline.logs.reader import open_log, reopen

PLAIN = {"num_messages": 600, "chunk_size": 20_000, "compression": CompressionType.NONE, "enable_crcs": False}
FORMS = {
    "indexed": recording(**PLAIN),
    "without message index": recording(index_types=IndexType.NONE, **PLAIN),
    "without summary": recording(has_summary=False, **PLAIN),
}
MESSAGES = {form: reference(data) for form, data in FORMS.items()}
PAGE = 4096


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("torn") / "log.mcap"


def overlapping(form: str, begin: int, end: int) -> int:
    """How many messages have bytes in this stretch of the file."""
    whole = FORMS[form]
    places = [(whole.index(message[-1]), len(message[-1])) for message in MESSAGES[form]]
    return sum(place - 31 < end and place + length > begin for place, length in places)


@pytest.mark.parametrize("page", [b"\0" * PAGE, b"\xff" * PAGE])
@pytest.mark.parametrize("number", range(2, 9))
def test_a_lost_page_costs_its_messages_and_the_one_before(page: bytes, number: int, scratch: Path) -> None:
    whole, wanted = FORMS["indexed"], MESSAGES["indexed"]
    begin = number * PAGE
    scratch.write_bytes(whole[:begin] + page + whole[begin + PAGE :])
    log = open_log(scratch)
    found = content(log)
    assert [message for message in wanted if message in found] == found
    num_hit = overlapping("indexed", begin, begin + PAGE)
    assert 0 < num_hit < 60 and len(found) >= len(wanted) - num_hit - 2  # two where the page takes part of two chunks
    assert not log.health.is_complete and log.health.num_messages_expected == len(wanted)
    assert any("were saved" in problem for problem in log.health.problems)
    assert content(reopen([scratch], log.health)) == found
    assert content(log, ["/b"]) == [message for message in found if message[0] == "/b"]
    assert sorted(m.sequence for batch in log.batches() for m in batch.messages()) == [message[5] for message in found]


@pytest.mark.parametrize("form", ["without message index", "without summary"])
def test_without_an_index_the_beginning_is_saved(form: str, scratch: Path) -> None:
    whole, wanted = FORMS[form], MESSAGES[form]
    chunk = of_kind(whole, Opcode.CHUNK)[1]
    middle = (chunk.begin + chunk.end) // 2
    scratch.write_bytes(whole[:middle] + bytes(PAGE) + whole[middle + PAGE :])
    log = open_log(scratch)
    found = content(log)
    assert [message for message in wanted if message in found] == found and not log.health.is_complete
    in_front = [message for message in wanted if chunk.begin < whole.index(message[-1]) < middle - len(message[-1])]
    assert len(in_front) > 50 and set(in_front[:-1]) <= set(found)
    behind = [message for message in wanted if middle <= whole.index(message[-1]) + len(message[-1]) <= chunk.end]
    assert len(behind) > 50 and not set(behind[1:]) & set(found)


@pytest.mark.parametrize("form", FORMS)
@given(data=st.data())
def test_what_is_lost_is_told(form: str, data: st.DataObject, scratch: Path) -> None:
    """Zeros, noise and bytes that were taken away, anywhere in the file."""
    whole = FORMS[form]
    begin = data.draw(st.integers(8, len(whole) - 1))
    length = data.draw(st.integers(1, 3000))
    middle = data.draw(st.sampled_from([bytes(length), b"\x05\0" * (length // 2), b"", bytes(length + 3)]))
    scratch.write_bytes(whole[:begin] + middle + whole[begin + length :])
    log = open_log(scratch)
    found = content(log)
    assert len(found) == log.health.num_messages
    assert len(found) >= len(MESSAGES[form]) or not log.health.is_complete
