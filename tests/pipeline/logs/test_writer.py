import pytest
from google.protobuf import descriptor_pb2, descriptor_pool
from mcap.reader import NonSeekingReader, make_reader
from mcap.writer import Writer

from pipeline.logs.reader import open_log
from pipeline.logs.recorder import Packing
from pipeline.logs.writer import LogWriter, foxglove_class, schema_bytes
from schemas.channels import AGENTS, SCENE, TRANSFORM, message_class


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


def test_error_inside_is_not_hidden_and_the_file_does_not_look_finished(tmp_path):
    with pytest.raises(ZeroDivisionError), LogWriter(tmp_path / "a.mcap") as writer:
        writer.write(AGENTS, 1, b"")
        1 / 0  # noqa: B018
    assert not open_log(tmp_path / "a.mcap").health.is_complete


@pytest.mark.parametrize("chunk_bytes", [1, 300, 10**6])
def test_chunks_end_where_they_are_full(tmp_path, chunk_bytes):
    with LogWriter(tmp_path / "a.mcap", Packing("none", chunk_bytes)) as writer:
        for index in range(50):
            writer.write(AGENTS, index, bytes(20))
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert [message.log_time for _, _, message in reader.iter_messages()] == list(range(50))
        chunks = reader.get_summary().chunk_indexes
    assert all(chunk.uncompressed_size >= chunk_bytes for chunk in chunks[:-1])
    assert len(chunks) == {1: 50, 10**6: 1}.get(chunk_bytes, len(chunks))
    assert all(chunk.message_start_time <= chunk.message_end_time < (i + 1) * 50 for i, chunk in enumerate(chunks))


def test_messages_out_of_order_are_indexed_with_their_true_span(tmp_path):
    with LogWriter(tmp_path / "a.mcap") as writer:
        for time_ns in (30, 10, 20):
            writer.write(AGENTS, time_ns, b"x")
    log = open_log(tmp_path / "a.mcap")
    assert (log.start_ns, log.end_ns, log.health.is_complete) == (10, 30, True)
    assert [message.log_time_ns for message in log.messages()] == [10, 20, 30]


def test_same_content_as_the_library_writes(tmp_path):
    """Header, definitions, messages and statistics, read back by the library, equal those of its own writer."""
    write(tmp_path / "ours.mcap")
    with (tmp_path / "theirs.mcap").open("wb") as file:
        writer = Writer(file, enable_data_crcs=True)
        writer.start("", "cadence")
        ids = {}
        for index in range(100):
            channel = (SCENE, AGENTS)[index % 2]
            if channel not in ids:
                schema = writer.register_schema(channel.message, "protobuf", schema_bytes(channel.message))
                ids[channel] = writer.register_channel(channel.topic, "protobuf", schema)
            writer.add_message(ids[channel], 10 + index, bytes([index]) * 50, 10 + index, index // 2)
        writer.add_metadata("cadence", {"a": "b"})
        writer.finish()

    def content(path):
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            summary = reader.get_summary()
            return (
                reader.get_header(),
                list(reader.iter_messages()),
                list(reader.iter_metadata()),
                (summary.statistics, summary.schemas, summary.channels),
            )

    assert content(tmp_path / "ours.mcap") == content(tmp_path / "theirs.mcap")


def test_checksum_over_all_data_is_right(tmp_path):
    write(tmp_path / "a.mcap")
    with (tmp_path / "a.mcap").open("rb") as file:
        assert sum(1 for _ in NonSeekingReader(file, validate_crcs=True).iter_messages()) == 100


def test_empty_log_is_a_log(tmp_path):
    with LogWriter(tmp_path / "a.mcap"):
        pass
    log = open_log(tmp_path / "a.mcap")
    assert (log.channels, log.health.is_complete, log.health.num_messages) == ((), True, 0)


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


def test_transform_is_written_with_a_published_schema():
    assert foxglove_class(TRANSFORM.message).DESCRIPTOR.full_name == TRANSFORM.message
