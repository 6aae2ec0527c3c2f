import io
import random
import tarfile

import pytest
from fixtures.recorder import FORMS, NUM_MESSAGES, START_NS, STEP_NS, content, recording, reference
from mcap.reader import make_reader
from mcap.writer import Writer

from cadence.errors import InputError
from pipeline.logs.file_walk import FileWalk
from pipeline.logs.reader import open_log, utc

REAL = [
    "flights/cubs2_cub_stabilize.mcap",
    "flights/calfire_adsb_known.mcap",
    "maritime/solent_ais_known.mcap",
    "maritime/solent_ais_unknown.mcap",
    "formats/mcap-explorer_demo.mcap",
    "formats/rosbag2_cdr_test_0.mcap",
    "formats/rosbag2_talker.mcap",
    "formats/rosbag2_wbag_0.mcap",
    "formats/rosbag2parquet_array_msgs_0.mcap",
    "prison_reference/high/p_high_0000.mcap",
]


@pytest.mark.parametrize("name", REAL)
def test_real_log_reads_as_by_the_reference_reader(name, shared_data):
    path = shared_data / name
    log = open_log(path)
    statistics = make_reader(io.BytesIO(path.read_bytes())).get_summary().statistics
    assert log.health.is_complete and not log.health.problems
    assert log.health.num_messages == log.health.num_messages_expected == statistics.message_count
    assert (log.start_ns, log.end_ns) == (statistics.message_start_time, statistics.message_end_time)
    assert {c.id: c.message_count for c in log.channels if c.message_count} == {
        number: count for number, count in statistics.channel_message_counts.items() if count
    }
    assert content(log) == reference(path.read_bytes())


def test_conformance_logs_all_read_as_by_the_reference_reader(shared_data, write_log):
    num_logs = 0
    with tarfile.open(shared_data / "formats" / "conformance.tar.gz") as archive:
        for member in archive:
            data = archive.extractfile(member).read() if member.isfile() else b""
            if member.name.endswith(".mcap"):
                log = open_log(write_log(data))
                assert log.health.is_complete and not log.health.problems, member.name
                assert content(log) == reference(data), member.name
                num_logs += 1
    assert num_logs == 208


@pytest.mark.parametrize("form", FORMS)
def test_every_form_of_recording_reads_alike(form, write_log):
    data = recording(**FORMS[form])
    log = open_log(write_log(data))
    assert log.health.is_complete and not log.health.problems and log.health.has_checksums
    assert log.health.num_messages == NUM_MESSAGES
    assert (log.start_ns, log.end_ns) == (START_NS, START_NS + (NUM_MESSAGES - 1) * STEP_NS)
    assert [c.topic for c in log.channels] == ["/a", "/b", "/c"] and log.library.startswith("recorder")
    assert content(log) == reference(data)
    assert content(log, {"/b"}) == reference(data, ["/b"])
    assert content(log, {"/nothing"}) == []
    assert log.metadata() == (("mission", {"name": "test"}),)


@pytest.mark.parametrize("form", ["zstd", "plain", "unchunked", "zstd without summary"])
@pytest.mark.parametrize("disorder", [3, 40, NUM_MESSAGES])
def test_messages_come_in_log_time_order_however_they_were_written(form, disorder, write_log):
    shuffle = random.Random(disorder)
    order = sorted(range(NUM_MESSAGES), key=lambda i: i + shuffle.uniform(0, disorder))
    log = open_log(write_log(recording(order=order, **FORMS[form])))
    times = [message.log_time_ns for message in log.messages()]
    assert times == [START_NS + i * STEP_NS for i in range(NUM_MESSAGES)]
    assert sorted(content(log)) == sorted(content(open_log(write_log(recording(**FORMS[form]), "other.mcap"))))


def test_messages_at_one_time_keep_the_order_of_the_file(tmp_path):
    path = tmp_path / "log.mcap"
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=200)
        writer.start()
        channels = [writer.register_channel(topic, "json", 0) for topic in ("/a", "/b")]
        for i in range(40):
            writer.add_message(channels[i % 2], 7, b"%d" % i, 7, i)
        writer.finish()
    assert [message.sequence for message in open_log(path).messages()] == list(range(40))


def test_messages_of_all_sizes_outside_chunks_are_read_many_at_once(write_log, monkeypatch):
    """Small and large ones, definitions, metadata and times that cannot be used between them; the checksum is continued."""
    sizes = random.Random(1)
    file = io.BytesIO()
    writer = Writer(file, use_chunking=False, enable_data_crcs=True)
    writer.start()
    ids = [writer.register_channel("/first", "json", 0)]
    for i in range(4000):
        if i % 1300 == 700:
            ids.append(writer.register_channel(f"/later/{i}", "json", 0))
            writer.add_metadata("place", {"i": str(i)})
        size = 2**21 if i == 2000 else 30_000 if i % 50 == 9 else sizes.randrange(300)
        writer.add_message(ids[i % len(ids)], 2**63 if i == 3000 else i // 3, bytes(size), i, i)
    writer.finish()
    one_by_one = []
    head = FileWalk.head
    monkeypatch.setattr(FileWalk, "head", lambda self: one_by_one.append(self.position) or head(self))
    log = open_log(write_log(file.getvalue()))
    assert content(log) == [message for message in reference(file.getvalue()) if message[3] < 2**63]
    assert log.health.problems[0] == "1 message has a log time after the year 2262 and cannot be used."
    assert len(one_by_one) < 100 and len(log.metadata()) == 3
    damaged = bytearray(file.getvalue())
    damaged[len(damaged) // 2] ^= 1
    assert "checksum over all data" in " ".join(open_log(write_log(bytes(damaged))).health.problems)


@pytest.mark.parametrize("topics", [None, {"/a"}, set()])
@pytest.mark.parametrize("form", FORMS)
def test_progress_adds_up_to_the_size_of_the_file(form, topics, write_log):
    steps: list[int] = []
    path = write_log(recording(**FORMS[form]))
    log = open_log(path, steps.append)
    assert sum(steps) == log.size_bytes == path.stat().st_size and min(steps) >= 0
    steps.clear()
    list(log.messages(topics, steps.append))
    assert sum(steps) == log.size_bytes and min(steps) >= 0


def test_log_without_messages_opens(write_log):
    log = open_log(write_log(recording(num_messages=0)))
    assert (log.start_ns, log.end_ns, log.health.num_messages, log.health.is_complete) == (0, 0, 0, True)
    assert list(log.messages()) == []


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "empty"),
        (b"not a log at all, but long enough", "not an MCAP"),
        (b"\x89MCA", "not an MCAP"),
        (b"#ROSBAG V2.0\n" + bytes(100), "ROS 1 bag"),
        (b"SQLite format 3\x00" + bytes(100), "rosbags-convert"),
        (b"\x1f\x8b" + bytes(100), "gzip"),
    ],
)
def test_what_is_no_mcap_is_refused_in_one_line(data, words, write_log):
    with pytest.raises(InputError, match=words) as error:
        open_log(write_log(data))
    assert "log.mcap" in str(error.value) and "\n" not in str(error.value)


def test_absent_file_and_folder_are_refused(tmp_path):
    with pytest.raises(InputError, match="not found"):
        open_log(tmp_path / "gone.mcap")
    with pytest.raises(InputError, match="folder"):
        open_log(tmp_path)


def test_magic_alone_opens_as_a_damaged_log(write_log):
    log = open_log(write_log(b"\x89MCAP0\r\n"))
    assert not log.health.is_complete and log.health.num_messages == 0 and log.health.problems


@pytest.mark.parametrize("form", ["zstd", "unchunked"])
def test_file_that_changes_while_it_is_read_is_an_input_error(form, write_log):
    data = recording(**FORMS[form])
    path = write_log(data)
    log = open_log(path)
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match="changed"):
        list(log.messages())
    path.unlink()
    with pytest.raises(InputError, match="any more"):
        list(log.messages())


def test_times_are_written_in_utc():
    assert utc(1_600_000_000_123_000_000) == "2020-09-13T12:26:40.123Z"
    assert utc(2**63 - 1).startswith("2262")
