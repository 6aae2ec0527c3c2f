"""The doctor: a fault a log, and the sentence, the verdict and the exit code that it must have."""

import io
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from fixtures.recorder import FORMS, NUM_MESSAGES, START_NS, STEP_NS, recording
from fixtures.small_logs import Row, detection, write_log
from mcap.records import ChunkIndex
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, IndexType, Writer

from cadence.errors import InputError, UsageError
from cli import main
from pipeline.inspect.doctor import Diagnosis, diagnose, diagnose_all, exit_code, render
from pipeline.progress import Progress

QUIET = Progress(quiet=True)
Times = Sequence[tuple[float, float, int]]


@pytest.fixture
def examined(tmp_path: Path) -> Callable[[bytes], Diagnosis]:
    def examine(data: bytes) -> Diagnosis:
        path = tmp_path / "log.mcap"
        path.write_bytes(data)
        return diagnose([path], QUIET)

    return examine


def recorded(times: Times, options: dict[str, object] | None = None) -> bytes:
    """A log of one topic with messages at (log time, publish time, sequence), in seconds."""
    file = io.BytesIO()
    writer = Writer(file, **options or {})
    writer.start()
    channel = writer.register_channel("/a", "json", 0)
    for log_s, publish_s, sequence in times:
        writer.add_message(channel, START_NS + round(log_s * 1e9), b"{}", START_NS + round(publish_s * 1e9), sequence)
    writer.finish()
    return file.getvalue()


def steady(count: int = 50, step_s: float = 1.0) -> list[tuple[float, float, int]]:
    return [(i * step_s, i * step_s - 0.01, i) for i in range(count)]


def test_a_sound_log_and_what_of_it_would_be_used(tmp_path: Path) -> None:
    rows = [detection(10.0 * i, i, 2 * i, agent_id=f"A{i % 2}") for i in range(20)]
    rows.append(detection(300.0, float("nan"), 0.0, agent_id="A0"))
    rows += [Row("/odd", "odd/Thing", 1.0, b"\x00\x01", "smoke", "smoke", b"?")]
    found = diagnose([write_log(tmp_path / "log.mcap", rows)], QUIET)
    assert (found.verdict, found.num_messages, found.num_messages_expected) == ("sound", 22, 22)
    assert not (found.problems or found.container or found.clocks or found.no_use)
    assert (found.use["num_detections"], found.use["num_agents"]) == (20, 2)
    (reason,) = found.undecodable
    assert "/odd" in reason and "smoke" in reason
    text = render(found)
    assert "SOUND" in text and "20 detections of 2 agents from /detections" in text and "1 position is NaN" in text
    assert "with its schema" in text and exit_code([found]) == 0


def test_a_log_without_detections_is_sound_but_not_used(examined: Callable[[bytes], Diagnosis]) -> None:
    found = examined(recording())
    assert found.verdict == "sound" and not found.use and "nothing looks like detections" in found.no_use
    assert "would use:\n  nothing: nothing looks like" in render(found)


def test_a_broken_chunk_is_a_partial_log(examined: Callable[[bytes], Diagnosis]) -> None:
    whole = recording()
    broken = [record for record in StreamReader(io.BytesIO(whole)).records if isinstance(record, ChunkIndex)][4]
    damaged = bytearray(whole)
    damaged[broken.chunk_start_offset + broken.chunk_length - 20] ^= 0xFF
    found = examined(bytes(damaged))
    assert found.verdict == "partial" and found.num_messages_expected == NUM_MESSAGES > found.num_messages
    assert found.lost_spans_ns == ((broken.message_start_time, broken.message_end_time),)
    assert "another copy" in found.advice[0] and f"{found.num_messages} of {NUM_MESSAGES} messages" in render(found)
    assert exit_code([found]) == 7


@pytest.mark.parametrize("form", FORMS)
def test_half_a_log_is_partial_whatever_its_form(form: str, examined: Callable[[bytes], Diagnosis]) -> None:
    whole = recording(num_messages=600, **FORMS[form])
    found = examined(whole[: len(whole) // 2])
    assert found.verdict == "partial" and 0 < found.num_messages < 600 and found.problems


def test_a_lost_footer_is_a_fault_without_loss(examined: Callable[[bytes], Diagnosis]) -> None:
    found = examined(recording()[:-20])
    assert found.verdict == "faulty" and found.num_messages == NUM_MESSAGES and exit_code([found]) == 0
    assert "ALL MESSAGES CAN BE READ" in render(found)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "is empty"),
        (b"#ROSBAG V2.0\n" + bytes(100), "ROS 1 bag"),
        (recording()[:30], "inside a record"),
    ],
)
def test_what_holds_no_message_is_unusable(data: bytes, words: str, examined: Callable[[bytes], Diagnosis]) -> None:
    found = examined(data)
    assert found.verdict == "unusable" and words in " ".join(found.problems)
    assert "UNUSABLE" in render(found) and exit_code([found]) == 3


def test_a_sound_log_without_a_message_is_not_unusable(examined: Callable[[bytes], Diagnosis]) -> None:
    found = examined(recording(num_messages=0))
    assert found.verdict == "sound" and not found.problems and found.num_messages == 0 and found.no_use
    assert "SOUND" in render(found) and "no message was recorded" in render(found) and exit_code([found]) == 0
    assert examined(recording(num_messages=0)[:-60]).verdict in ("faulty", "unusable")


def test_a_missing_log_does_not_stop_the_others(tmp_path: Path) -> None:
    log = write_log(tmp_path / "log.mcap", [detection(1.0, 2.0, 3.0)])
    gone, found = diagnose_all([str(tmp_path / "gone.mcap"), str(log)], QUIET)
    assert (gone.verdict, found.verdict) == ("unusable", "sound") and "not found" in gone.problems[0]


def test_joined_recordings_are_named_with_what_to_do(examined: Callable[[bytes], Diagnosis]) -> None:
    found = examined(recording() * 2)
    assert found.verdict == "faulty" and "holds 2 recordings" in found.problems[0]
    assert [advice for advice in found.advice if "file of its own" in advice] and not any("end it" in it for it in found.advice)


def test_an_unusable_log_counts_more_than_a_partial_one(examined: Callable[[bytes], Diagnosis]) -> None:
    whole = recording()
    partial, unusable, sound = examined(whole[: len(whole) // 2]), examined(b""), examined(whole)
    assert exit_code([sound, partial]) == 7 and exit_code([partial, unusable, sound]) == 3


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (FORMS["zstd without summary"], "no index at the end"),
        ({"use_statistics": False}, "no statistics"),
        ({"index_types": IndexType.NONE}, "not indexed"),
        ({"index_types": IndexType.CHUNK}, "have no message index"),
        (FORMS["unchunked"], "not in chunks"),
        ({"compression": CompressionType.NONE, "enable_crcs": False}, "no checksum"),
        ({"order": [*range(60, 120), *range(60)]}, "begin before an earlier one ends"),
    ],
)
def test_what_the_container_lacks(options: dict[str, object], words: str, examined: Callable[[bytes], Diagnosis]) -> None:
    found = examined(recording(**options))
    assert found.verdict == "sound" and found.num_messages == NUM_MESSAGES
    assert any(words in remark for remark in found.container) and any("recorder" in advice for advice in found.advice)


@pytest.mark.parametrize("form", ["zstd", "lz4", "plain"])
def test_a_log_with_everything_lacks_nothing(form: str, examined: Callable[[bytes], Diagnosis]) -> None:
    found = examined(recording(**FORMS[form]))
    assert found.container == found.clocks == found.gaps == found.problems == ()


def test_long_silence_is_named(examined: Callable[[bytes], Diagnosis]) -> None:
    times = steady() + [(log + 3600.0, publish + 3600.0, number + 50) for log, publish, number in steady()]
    (gap,) = examined(recorded(times)).gaps
    assert "(3551 s)" in gap and "2001-09-09T01:47:29" in gap
    assert not examined(recorded(steady(step_s=300.0))).gaps  # a slow log is not silent


def test_bursts_at_a_steady_beat_are_no_gaps_and_a_missed_beat_is(examined: Callable[[bytes], Diagnosis]) -> None:
    beats = [(60.0 * beat + 0.001 * i, 60.0 * beat, 20 * beat + i) for beat in range(30) for i in range(20)]
    assert not examined(recorded(beats)).gaps
    (gap,) = examined(recorded([message for message in beats if not 600 < message[1] < 1000])).gaps
    assert "(420 s)" in gap


def test_many_gaps_make_few_sentences(examined: Callable[[bytes], Diagnosis]) -> None:
    times = [(i + 1000.0 * (i // 10), i, i) for i in range(100)]
    gaps = examined(recorded(times)).gaps
    assert len(gaps) == 6 and gaps[-1].startswith("4 shorter")


def test_what_was_lost_is_not_a_gap(examined: Callable[[bytes], Diagnosis]) -> None:
    times = [(20.0 * i, 20.0 * i, i) for i in range(400)]
    whole = recorded(times, {"chunk_size": 4096, "compression": CompressionType.NONE})
    chunks = [record for record in StreamReader(io.BytesIO(whole)).records if isinstance(record, ChunkIndex)]
    assert len(chunks) > 2 and chunks[1].message_end_time - chunks[1].message_start_time > 100 * 20 * 10**9
    damaged = bytearray(whole)
    damaged[chunks[1].chunk_start_offset + 200] ^= 0xFF
    found = examined(bytes(damaged))
    assert found.verdict == "partial" and found.gaps == ()


def test_a_clock_that_was_set_back_is_named(examined: Callable[[bytes], Diagnosis]) -> None:
    # After 25 messages log and publish times begin again 10.5 s earlier: by log time the two stretches are interleaved.
    times = [(i - 10.5 * (i >= 25), i - 10.5 * (i >= 25), i) for i in range(50)]
    (remark,) = examined(recorded(times)).clocks
    assert "/a: sequence numbers go backwards" in remark and "set back" in remark


def test_numbers_that_begin_again_are_no_clock(examined: Callable[[bytes], Diagnosis]) -> None:
    assert not examined(recorded([(i, i, i % 25) for i in range(50)])).clocks
    assert not examined(recorded([(i, 0.0 if i else -(START_NS / 1e9), 0) for i in range(50)])).clocks


def test_a_jump_between_log_and_publish_time_is_named(examined: Callable[[bytes], Diagnosis]) -> None:
    times = [(i + 100.0 * (i >= 25), float(i), i) for i in range(50)]
    (remark,) = examined(recorded(times)).clocks
    assert "jumps against publish time 1 time, first by +100 s" in remark


def test_a_clock_is_watched_over_chunks(examined: Callable[[bytes], Diagnosis]) -> None:
    times = [(i + 100.0 * (i >= 25), float(i), i) for i in range(50)]
    assert len(examined(recorded(times, {"chunk_size": 1})).clocks) == 1


def test_parts_of_one_recording_are_one_log(tmp_path: Path) -> None:
    for part in range(2):
        (tmp_path / f"run_{part}.mcap").write_bytes(recording())
    (tmp_path / "metadata.yaml").write_text("  relative_file_paths:\n    - run_0.mcap\n    - run_1.mcap\n    - run_2.mcap\n")
    (found,) = diagnose_all([str(tmp_path)], QUIET)
    assert found.verdict == "partial" and found.num_messages == 2 * NUM_MESSAGES
    assert "run_2.mcap" in found.problems[0]


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = recording()
    (tmp_path / "a.mcap").write_bytes(whole)
    (tmp_path / "b.mcap").write_bytes(whole[: len(whole) // 2])
    assert main(["doctor", "--quiet", "--json", str(tmp_path)]) == 7
    sound, partial = json.loads(capsys.readouterr().out)
    assert (sound["verdict"], partial["verdict"]) == ("sound", "partial")
    assert sound["start_ns"] == START_NS and sound["end_ns"] == START_NS + (NUM_MESSAGES - 1) * STEP_NS
    assert main(["doctor", "-q", str(tmp_path / "a.mcap")]) == 0
    assert "a.mcap: SOUND" in capsys.readouterr().out


def test_wrong_calls_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="local files"):
        diagnose_all(["s3://bucket/log.mcap"], QUIET)
    with pytest.raises(InputError, match="holds no MCAP"):
        diagnose_all([str(tmp_path)], QUIET)
