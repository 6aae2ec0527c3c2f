import os
import signal
import struct
import subprocess
import sys
import time
import zlib
from collections import Counter

import pytest
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader, make_reader
from mcap.writer import CompressionType, IndexType, Writer

from cadence.errors import DeviceError, InputError
from pipeline.logs import append
from pipeline.logs.append import write_combined
from pipeline.logs.index import FOOTER_BYTES
from pipeline.logs.reader import open_log
from pipeline.logs.recorder import Packing
from pipeline.logs.records import HEAD, MAGIC, walk
from pipeline.logs.summary import read_summary
from pipeline.logs.writer import LogWriter
from pipeline.progress import Progress
from schemas.channels import AGENTS, SCENE

QUIET = Progress(quiet=True)


def side_log(path, num_messages=30, packing=None):
    with LogWriter(path, packing) as writer:
        for index in range(num_messages):
            writer.write((SCENE, AGENTS)[index % 2], 70 + index, bytes([index]) * 50)
        writer.metadata("cadence", {"a": "b"})
    return path


def source_log(path, *, first_id=1, **options):
    """Three channels of two schemas, one without; attachment and metadata in between; log times fall and rise."""
    with path.open("wb") as file:
        writer = Writer(file, **{"chunk_size": 64, **options})
        writer.start("ros2", "somebody")
        schemas = [writer.register_schema(name, "ros2msg", b"int32 x") for name in ("a/B", "a/C")]
        ids = [writer.register_channel(f"/topic{i}", "cdr", schema, {"qos": "1"}) for i, schema in enumerate(schemas)]
        ids.append(writer.register_channel("/without", "json", 0))
        for index in range(20):
            writer.add_message(
                ids[index % 2], log_time=100 - index, data=bytes([index]), publish_time=index, sequence=index + 7
            )
        writer.add_attachment(1, 2, "picture", "image/png", b"png")
        writer.add_message(ids[2], log_time=50, data=b"{}", publish_time=50, sequence=0)
        writer.add_metadata("mission", {"ship": "Erna"})
        writer.finish()
    return path


def content(path):
    """Profile, messages by time, attachments and metadata, read by the library with checksums on."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        rows = [
            (c.topic, c.message_encoding, c.metadata, s and (s.name, s.encoding, s.data), message)
            for s, c, m in reader.iter_messages()
            for message in [(m.log_time, m.publish_time, m.sequence, m.data)]
        ]
        attachments = [(a.create_time, a.log_time, a.name, a.media_type, a.data) for a in reader.iter_attachments()]
        metadata = [(record.name, record.metadata) for record in reader.iter_metadata()]
        return reader.get_header().profile, rows, attachments, metadata


def data_end(data):
    """Where the DataEnd record stands."""
    return next(begin - HEAD.size for opcode, begin, _ in walk(data[len(MAGIC) :]) if opcode == Opcode.DATA_END) + len(MAGIC)


def combine(folder, source, side=None):
    side = side or side_log(folder / "side.mcap")
    write_combined(source, side, folder / "target.mcap", Packing(), QUIET)
    return folder / "target.mcap"


def assert_combined(target, source, side, twin=None):
    """What must hold of every combined file; `twin` holds the same as `source` and has all indexes."""
    data, before = target.read_bytes(), source.read_bytes()
    assert data.startswith(before[: data_end(before)]), "the source's data are there, byte for byte"
    (checksum,) = struct.unpack_from("<I", data, data_end(data) + HEAD.size)
    assert checksum in (0, zlib.crc32(data[: data_end(data)]))
    combined, parts = content(target), (content(twin or source), content(side))
    assert combined[0] == parts[0][0]
    for index in (1, 2, 3):
        assert sorted(combined[index], key=repr) == sorted(parts[0][index] + parts[1][index], key=repr)
    times = [row[-1][0] for row in combined[1]]
    assert times == sorted(times)
    with target.open("rb") as file:  # without the index
        assert sum(1 for _ in NonSeekingReader(file, validate_crcs=True).iter_messages()) == len(times)
    log = open_log(target)
    assert log.health.is_complete, log.health.problems
    rows = sorted((m.channel.topic, m.log_time_ns, m.sequence, m.data) for m in log.messages())
    assert rows == sorted((row[0], row[-1][0], row[-1][2], row[-1][3]) for row in combined[1])
    assert not list(target.parent.glob(".*")), "no draft is left"


def statistics(path):
    with path.open("rb") as file:
        summary, fault = read_summary(file, 0, path.stat().st_size)
    assert not fault
    return summary.statistics


SOURCES = {
    "zstd": {},
    "lz4": {"compression": CompressionType.LZ4},
    "none": {"compression": CompressionType.NONE},
    "one chunk": {"chunk_size": 10**6},
    "checksum over all data": {"enable_data_crcs": True},
    "no checksums": {"enable_crcs": False},
    "no chunks": {"use_chunking": False},
    "no statistics": {"use_statistics": False},
    "no repeated definitions": {"repeat_channels": False, "repeat_schemas": False},
    "no indexes": {"index_types": IndexType.NONE},
    "no index of messages": {"index_types": IndexType.ALL & ~IndexType.MESSAGE},
    "no index of chunks": {"index_types": IndexType.ALL & ~IndexType.CHUNK},
    "no offsets": {"use_summary_offsets": False},
    "no summary": {
        "repeat_channels": False,
        "repeat_schemas": False,
        "use_statistics": False,
        "use_summary_offsets": False,
        "index_types": IndexType.NONE,
    },
}


@pytest.mark.parametrize("options", SOURCES.values(), ids=SOURCES)
def test_combined_file_holds_all_of_both(tmp_path, options):
    source, side = source_log(tmp_path / "source.mcap", **options), side_log(tmp_path / "side.mcap")
    assert_combined(combine(tmp_path, source, side), source, side, source_log(tmp_path / "twin.mcap"))


@pytest.mark.parametrize(
    "options", [{}, SOURCES["no summary"] | {"index_types": IndexType.MESSAGE}], ids=["with summary", "without"]
)
def test_index_is_that_of_both(tmp_path, options):
    source, side = source_log(tmp_path / "source.mcap", **options), side_log(tmp_path / "side.mcap")
    found = statistics(combine(tmp_path, source, side))
    assert found.message_count == 21 + 30
    assert (found.schema_count, found.channel_count) == (2 + 2, 3 + 2)
    assert (found.attachment_count, found.metadata_count) == (1, 2)
    assert (found.message_start_time, found.message_end_time) == (50, 100)
    assert found.channel_message_counts == {1: 10, 2: 10, 3: 1, 4: 15, 5: 15}
    with (tmp_path / "target.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert sorted(summary.channels) == [1, 2, 3, 4, 5]
    assert [summary.channels[number].topic for number in (4, 5)] == [SCENE.topic, AGENTS.topic]
    assert [summary.channels[number].schema_id for number in (1, 2, 3, 4, 5)] == [1, 2, 0, 3, 4]
    assert len(summary.chunk_indexes) == found.chunk_count
    assert [index.name for index in summary.attachment_indexes] == ["picture"]


def test_rebuilt_index_equals_the_recorders(tmp_path):
    """Without its summary a source gives the same combined file, but for what only the recorder's own summary can hold."""
    side = side_log(tmp_path / "side.mcap")
    whole = source_log(tmp_path / "source.mcap")
    expected = combine(tmp_path, whole, side).read_bytes()
    data = whole.read_bytes()
    end = data_end(data) + HEAD.size + 4
    whole.write_bytes(data[:end] + data[-FOOTER_BYTES:][:9] + bytes(20) + MAGIC)
    assert combine(tmp_path, whole, side).read_bytes() == expected


def test_damaged_summary_is_built_anew(tmp_path):
    side = side_log(tmp_path / "side.mcap")
    source = source_log(tmp_path / "source.mcap")
    expected = combine(tmp_path, source, side).read_bytes()
    data = bytearray(source.read_bytes())
    for position in range(data_end(data) + HEAD.size + 4, len(data) - 1, 31):
        changed = data.copy()
        changed[position] ^= 0x10
        source.write_bytes(changed)
        assert combine(tmp_path, source, side).read_bytes() == expected, position
    source.write_bytes(data[:-40])  # cut off behind the end mark of the data: nothing is lost
    assert combine(tmp_path, source, side).read_bytes() == expected


def test_summary_that_leaves_out_a_chunk_is_not_believed(tmp_path):
    side = side_log(tmp_path / "side.mcap")
    source = source_log(tmp_path / "source.mcap", use_summary_offsets=False, enable_crcs=False)
    data = source.read_bytes()
    begin = data_end(data) + HEAD.size + 4
    kept, left_out = bytearray(data[:begin]), 0
    for opcode, first, last in walk(data[begin:-FOOTER_BYTES]):
        if opcode == Opcode.CHUNK_INDEX and not left_out:
            left_out += 1
        else:
            kept += data[begin + first - HEAD.size : begin + last]
    source.write_bytes(kept + data[-FOOTER_BYTES:])
    assert left_out == 1
    assert len(content(source)[1]) < 21, "a reader that trusts the index misses messages of the source alone"
    assert len(content(combine(tmp_path, source, side))[1]) == 21 + 30


def test_unknown_records_are_kept(tmp_path):
    source, side = source_log(tmp_path / "source.mcap"), side_log(tmp_path / "side.mcap")
    data = source.read_bytes()
    end = data_end(data)
    private = HEAD.pack(0x90, 5) + b"hello"
    tail = HEAD.pack(Opcode.DATA_END, 4) + bytes(4) + HEAD.pack(Opcode.FOOTER, 20) + bytes(20) + MAGIC
    source.write_bytes(data[:end] + private + tail)
    target = combine(tmp_path, source, side)
    assert private in target.read_bytes()
    assert len(content(target)[1]) == 21 + 30


def test_combined_file_can_be_a_source(tmp_path):
    """Our topics then are there twice, apart; the older ones stay as they were."""
    source, side = source_log(tmp_path / "source.mcap"), side_log(tmp_path / "side.mcap")
    first = combine(tmp_path, source, side).rename(tmp_path / "first.mcap")
    target = combine(tmp_path, first, side)
    assert_combined(target, first, side)
    counts = Counter(channel.topic for channel in open_log(target).channels)
    assert counts[SCENE.topic] == counts[AGENTS.topic] == 2


@pytest.mark.parametrize("packing", [Packing("none"), Packing("lz4"), Packing("zstd", 200, 9)])
def test_packing_is_that_of_the_caller(tmp_path, packing):
    source, side = source_log(tmp_path / "source.mcap"), side_log(tmp_path / "side.mcap", packing=Packing("zstd", 100))
    target = tmp_path / "target.mcap"
    write_combined(source, side, target, packing, QUIET)
    assert_combined(target, source, side)
    with target.open("rb") as file:
        ours = [chunk for chunk in make_reader(file).get_summary().chunk_indexes if 4 in chunk.message_index_offsets]
    assert {chunk.compression for chunk in ours} == {"" if packing.compression == "none" else packing.compression}
    assert (len(ours) > 1) == (packing.chunk_bytes == 200)


@pytest.mark.parametrize("largest", [65533, 65534, 65535])
def test_ids_that_are_used_up_give_one_line(tmp_path, largest):
    source, side = (
        source_log(tmp_path / "source.mcap", chunk_size=10**6, compression=CompressionType.NONE),
        tmp_path / "side.mcap",
    )
    side_log(side)
    data = source.read_bytes()
    old = HEAD.pack(Opcode.CHANNEL, 0)[:1]
    changed = bytearray(data[: data_end(data)])
    for opcode, begin, _ in list(walk(bytes(changed[len(MAGIC) :]))):
        if opcode == Opcode.CHUNK:
            inner = changed.index(old + struct.pack("<Q", 2 + 2 + 4 + 8 + 4 + 4 + 4), len(MAGIC) + begin) + HEAD.size
            assert changed[inner : inner + 2] == b"\x03\x00"
            struct.pack_into("<H", changed, inner, largest)
            body = bytes(changed[len(MAGIC) + begin :])
            at = body.index(struct.pack("<BQH", Opcode.MESSAGE, 24, 3)) + HEAD.size + len(MAGIC) + begin
            struct.pack_into("<H", changed, at, largest)
            struct.pack_into("<I", changed, len(MAGIC) + begin + 24, 0)  # the checksum of the chunk: none
    tail = HEAD.pack(Opcode.DATA_END, 4) + bytes(4) + HEAD.pack(Opcode.FOOTER, 20) + bytes(20) + MAGIC
    source.write_bytes(bytes(changed) + tail)
    if largest == 65533:
        assert {channel.id for channel in open_log(combine(tmp_path, source, side)).channels} >= {65534, 65535}
        return
    with pytest.raises(InputError, match="65535; none is left") as caught:
        combine(tmp_path, source, side)
    assert "\n" not in str(caught.value)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["side.mcap", "source.mcap"]


@pytest.mark.parametrize("keep", [0, 5, 60, 200, 500])
def test_damaged_source_is_refused(tmp_path, keep):
    source = source_log(tmp_path / "source.mcap")
    source.write_bytes(source.read_bytes()[:keep])
    with pytest.raises(InputError, match=r"source\.mcap: is damaged"):
        combine(tmp_path, source)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["side.mcap", "source.mcap"]


def test_flipped_byte_is_noticed_where_chunks_are_unpacked(tmp_path):
    source = source_log(tmp_path / "source.mcap", compression=CompressionType.NONE, **SOURCES["no summary"])
    data = bytearray(source.read_bytes())
    data[data.index(b"int32 x") + 3] ^= 1
    source.write_bytes(data)
    with pytest.raises(InputError, match="damaged"):
        combine(tmp_path, source)
    assert not (tmp_path / "target.mcap").exists()


@pytest.mark.parametrize("part", [b"int32 x", b"Erna"], ids=["in a chunk", "outside"])
def test_flipped_byte_does_not_become_less_visible(tmp_path, part):
    """Chunks are not unpacked; their checksums, and that over all data, go on to be wrong."""
    source = source_log(tmp_path / "source.mcap", compression=CompressionType.NONE, enable_data_crcs=True)
    data = bytearray(source.read_bytes())
    data[data.index(part) + 3] ^= 1
    source.write_bytes(data)
    target = combine(tmp_path, source).read_bytes()
    (checksum,) = struct.unpack_from("<I", target, data_end(target) + HEAD.size)
    assert checksum not in (0, zlib.crc32(target[: data_end(target)]))
    with (tmp_path / "target.mcap").open("rb") as file, pytest.raises(ValueError, match=r"(?i)crc"):
        list(NonSeekingReader(file, validate_crcs=True).iter_messages())


def test_message_without_its_channel_is_refused(tmp_path):
    source = source_log(tmp_path / "source.mcap", use_chunking=False)
    data = bytearray(source.read_bytes())
    data[data.index(b"\x04", data.index(b"ros2msg"))] = 0x7F  # the opcode of the first Channel record: one that readers skip
    source.write_bytes(data)
    with pytest.raises(InputError, match=r"without a definition \(id 1\)"):
        combine(tmp_path, source)


def test_message_that_is_gone_is_noticed(tmp_path):
    source = source_log(tmp_path / "source.mcap", use_chunking=False)
    data = bytearray(source.read_bytes())
    data[data.index(HEAD.pack(Opcode.MESSAGE, 23))] = 0x7F
    source.write_bytes(data)
    with pytest.raises(InputError, match="should hold 21 messages, and 20 are there"):
        combine(tmp_path, source)


def test_damaged_side_file_is_refused(tmp_path):
    side = side_log(tmp_path / "side.mcap")
    side.write_bytes(side.read_bytes()[:900])
    with pytest.raises(InputError, match=r"side\.mcap: is damaged"):
        combine(tmp_path, source_log(tmp_path / "source.mcap"), side)


def test_failure_in_the_middle_leaves_nothing(tmp_path, monkeypatch):
    source, side = source_log(tmp_path / "source.mcap"), side_log(tmp_path / "side.mcap")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(append.Recorder, "finish", full)
    with pytest.raises(DeviceError, match="No space"):
        combine(tmp_path, source, side)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["side.mcap", "source.mcap"]


def test_killed_process_leaves_no_file_that_looks_finished(tmp_path):
    source, side = source_log(tmp_path / "source.mcap"), side_log(tmp_path / "side.mcap")
    program = (
        "import sys, time; from pathlib import Path; from pipeline.logs import append\n"
        "from pipeline.logs.recorder import Packing\n"
        "from pipeline.progress import Progress\n"
        "append.Recorder.finish = lambda self: (self._file.flush(), print('now', flush=True), time.sleep(60))\n"
        "append.write_combined(*map(Path, sys.argv[1:]), Packing(), Progress(quiet=True))\n"
    )
    command = [sys.executable, "-c", program, source, side, tmp_path / "target.mcap"]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as child:
        assert child.stdout.readline() == b"now\n"
        os.kill(child.pid, signal.SIGKILL)
    left = [path.name for path in tmp_path.iterdir() if not path.name.startswith(".target.mcap.")]
    assert sorted(left) == ["side.mcap", "source.mcap"], "a hidden draft at most"


def test_target_of_an_earlier_run_stays_until_the_new_one_is_complete(tmp_path):
    source, side = source_log(tmp_path / "source.mcap"), side_log(tmp_path / "side.mcap")
    before = combine(tmp_path, source, side).read_bytes()
    source.write_bytes(source.read_bytes()[:300])
    with pytest.raises(InputError):
        combine(tmp_path, source, side)
    assert (tmp_path / "target.mcap").read_bytes() == before


def test_same_files_same_bytes(tmp_path):
    source, side = source_log(tmp_path / "source.mcap"), side_log(tmp_path / "side.mcap")
    first = combine(tmp_path, source, side).read_bytes()
    time.sleep(0.01)
    assert combine(tmp_path, source, side).read_bytes() == first


@pytest.mark.parametrize(
    "name",
    ["mcap-explorer_demo", "rosbag2_cdr_test_0", "rosbag2_talker", "rosbag2_wbag_0", "rosbag2parquet_array_msgs_0"],
)
def test_recorded_logs(shared_data, tmp_path, name):
    assert_combined(
        combine(tmp_path, shared_data / "formats" / f"{name}.mcap"),
        shared_data / "formats" / f"{name}.mcap",
        tmp_path / "side.mcap",
    )


@pytest.mark.parametrize("kind", ["two recordings", "end mark among the data", "bytes behind the end"])
def test_more_than_one_recording_is_not_combined(kind, tmp_path):
    """The combined file would hold what stands before the first end mark only."""
    path = source_log(tmp_path / "log.mcap")
    data = path.read_bytes()
    records = list(walk(data[len(MAGIC) : -len(MAGIC)]))
    chunk = next(begin for opcode, begin, _ in records if opcode == Opcode.CHUNK) + len(MAGIC) - HEAD.size
    mark = next((begin, end) for opcode, begin, end in records if opcode == Opcode.DATA_END)
    end_mark = data[len(MAGIC) + mark[0] - HEAD.size : len(MAGIC) + mark[1]]
    damaged = {
        "two recordings": data + data,
        "end mark among the data": data[:chunk] + end_mark + data[chunk:],
        "bytes behind the end": data + bytes(20),
    }
    path.write_bytes(damaged[kind])
    with pytest.raises(InputError, match="behind"):
        write_combined(path, side_log(tmp_path / "side.mcap"), tmp_path / "combined.mcap", Packing(), QUIET)
    assert not (tmp_path / "combined.mcap").exists()
