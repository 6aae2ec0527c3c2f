import pytest
from google.protobuf import descriptor_pb2, descriptor_pool
from mcap.reader import make_reader
from mcap.writer import Writer

from cadence.errors import InputError
from pipeline.logs.append import write_combined
from pipeline.logs.recorder import Packing
from pipeline.logs.writer import LogWriter, foxglove_class, schema_bytes
from pipeline.progress import Progress
from schemas.channels import AGENTS, SCENE, TRANSFORM, message_class

QUIET = Progress(quiet=True)


def write(path, compression="zstd", num_messages=100):
    with LogWriter(path, Packing(compression)) as writer:
        for index in range(num_messages):
            writer.write((SCENE, AGENTS)[index % 2], 10 + index, bytes([index]) * 50)
        writer.metadata("cadence", {"a": "b"})


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_file_is_indexed_and_checked(tmp_path, compression):
    write(tmp_path / "a.mcap", compression)
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        found = [(c.topic, m.log_time, m.publish_time, m.sequence, m.data) for _, c, m in reader.iter_messages()]
        assert reader.get_header().library == "cadence"
        assert [record.name for record in reader.iter_metadata()] == ["cadence"]
    expected = [((SCENE, AGENTS)[i % 2].topic, 10 + i, 10 + i, i // 2, bytes([i]) * 50) for i in range(100)]
    assert found == expected
    assert summary.statistics.message_count == 100
    assert summary.statistics.channel_message_counts == {1: 50, 2: 50}
    assert (summary.statistics.message_start_time, summary.statistics.message_end_time) == (10, 109)
    assert [chunk.compression for chunk in summary.chunk_indexes] == [compression if compression != "none" else ""]


def test_same_messages_same_bytes(tmp_path):
    write(tmp_path / "a.mcap")
    write(tmp_path / "b.mcap")
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_error_inside_is_not_hidden_and_the_file_is_closed(tmp_path):
    with pytest.raises(ZeroDivisionError), LogWriter(tmp_path / "a.mcap") as writer:
        writer.write(AGENTS, 1, b"")
        1 / 0  # noqa: B018
    with pytest.raises(InputError), (tmp_path / "a.mcap").open("rb"):
        write_combined(tmp_path / "a.mcap", tmp_path / "a.mcap", tmp_path / "b.mcap", Packing(), QUIET)


@pytest.mark.parametrize(
    "name", ["foxglove.SceneUpdate", "foxglove.Grid", "foxglove.LocationFix", "foxglove.GeoJSON", "cadence.Agents"]
)
def test_schema_stands_alone(name):
    """A reader that has only the file can build the message, each file after those it imports."""
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(schema_bytes(name)).file:
        pool.Add(file)
    kind = message_class(name) if name.startswith("cadence.") else foxglove_class(name)
    assert len(pool.FindMessageTypeByName(name).fields) == len(kind.DESCRIPTOR.fields)


def source_log(path, *, chunking=True):
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=64, use_chunking=chunking)
        writer.start("ros2", "somebody")
        schema_id = writer.register_schema("a/B", "ros2msg", b"int32 x")
        first = writer.register_channel("/with", "cdr", schema_id, {"qos": "1"})
        second = writer.register_channel("/without", "json", 0)
        for index in range(20):
            writer.add_message(first, log_time=100 - index, data=bytes([index]), publish_time=index, sequence=index + 7)
        writer.add_message(second, log_time=50, data=b"{}", publish_time=50, sequence=0)
        writer.add_attachment(1, 2, "picture", "image/png", b"png")
        writer.finish()


def content(path):
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        rows = [
            (c.topic, c.message_encoding, c.metadata, s and (s.name, s.encoding, s.data), message)
            for s, c, m in reader.iter_messages(log_time_order=False)
            for message in [(m.log_time, m.publish_time, m.sequence, m.data)]
        ]
        attachments = [(a.create_time, a.log_time, a.name, a.media_type, a.data) for a in reader.iter_attachments()]
        return reader.get_header().profile, rows, attachments


@pytest.mark.parametrize("chunking", [True, False])
def test_combined_keeps_every_record_of_the_source(tmp_path, chunking):
    source, side, target = (tmp_path / f"{name}.mcap" for name in ("source", "side", "target"))
    source_log(source, chunking=chunking)
    write(side)
    write_combined(source, side, target, Packing(), QUIET)
    profile, rows, attachments = content(target)
    assert profile == "ros2"
    assert attachments == content(source)[2]
    assert [row for row in rows if not row[0].startswith("/cadence/")] == content(source)[1]
    assert [row for row in rows if row[0].startswith("/cadence/")] == content(side)[1]


def test_source_of_the_same_topic_stays_apart(tmp_path):
    side, target = tmp_path / "side.mcap", tmp_path / "target.mcap"
    write(side, num_messages=6)
    write_combined(side, side, target, Packing(), QUIET)
    assert len(content(target)[1]) == 12


@pytest.mark.parametrize("keep", [0, 5, 60, 200])
def test_damaged_source_is_refused(tmp_path, keep):
    source, side = tmp_path / "source.mcap", tmp_path / "side.mcap"
    source_log(source)
    write(side)
    source.write_bytes(source.read_bytes()[:keep])
    with pytest.raises(InputError, match=r"source\.mcap: is damaged"):
        write_combined(source, side, tmp_path / "target.mcap", Packing(), QUIET)


def test_flipped_byte_in_a_chunk_is_refused(tmp_path):
    source, side = tmp_path / "source.mcap", tmp_path / "side.mcap"
    write(source, compression="none")
    write(side)
    data = bytearray(source.read_bytes())
    data[data.index(bytes([7]) * 50) + 3] ^= 1
    source.write_bytes(data)
    with pytest.raises(InputError, match="damaged"):
        write_combined(source, side, tmp_path / "target.mcap", Packing(), QUIET)


def test_message_without_its_channel_is_refused(tmp_path):
    source, side = tmp_path / "source.mcap", tmp_path / "side.mcap"
    source_log(source, chunking=False)
    write(side)
    data = bytearray(source.read_bytes())
    at = data.index(b"\x04", data.index(b"ros2msg"))  # opcode of the first Channel record
    data[at] = 0x7F  # an opcode that readers skip
    source.write_bytes(data)
    with pytest.raises(InputError, match="damaged"):
        write_combined(source, side, tmp_path / "target.mcap", Packing(), QUIET)


def test_transform_is_written_with_a_published_schema():
    assert foxglove_class(TRANSFORM.message).DESCRIPTOR.full_name == TRANSFORM.message
