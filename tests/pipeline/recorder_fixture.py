"""Small logs in every form that recorders give them, written by the reference writer."""

import io
import random

from mcap.reader import NonSeekingReader
from mcap.writer import CompressionType, IndexType, Writer

from pipeline.logs.reader import MissionLog, RawMessage

START_NS = 10**18
STEP_NS = 10**8
NUM_MESSAGES = 120
TOPICS = ("/a", "/b", "/c")

FORMS = {
    "zstd": {},
    "lz4": {"compression": CompressionType.LZ4},
    "plain": {"compression": CompressionType.NONE},
    "unchunked": {"use_chunking": False, "enable_data_crcs": True},
    "zstd without summary": {"has_summary": False},
    "plain without summary": {"compression": CompressionType.NONE, "has_summary": False},
    "zstd without index": {"index_types": IndexType.NONE, "enable_data_crcs": True},
}


def recording(
    num_messages: int = NUM_MESSAGES,
    has_summary: bool = True,
    order: list[int] | None = None,
    chunk_size: int = 1500,
    **options,
) -> bytes:
    """A log of three JSON topics with a message each 0.1 s; `order` gives the order in which the messages are written."""
    if not has_summary:
        options |= {"use_statistics": False, "index_types": IndexType.NONE}
        options |= {"use_summary_offsets": False, "repeat_channels": False, "repeat_schemas": False}
    file = io.BytesIO()
    writer = Writer(file, chunk_size=chunk_size, **options)
    writer.start("", "recorder")
    schema = writer.register_schema("Item", "jsonschema", b'{"type": "object"}')
    channels = [writer.register_channel(topic, "json", schema) for topic in TOPICS]
    writer.add_metadata("mission", {"name": "test"})
    noise = random.Random(1)
    bodies = [b'{"x": %d, "noise": "%x"}' % (i, noise.getrandbits(200)) for i in range(num_messages)]
    for i in order or range(num_messages):
        time = START_NS + i * STEP_NS
        writer.add_message(channels[i % 3], time, bodies[i], time + 5, i)
    writer.finish()
    return file.getvalue()


def content(log: MissionLog, topics=None):
    """All that a message carries, in the order of the log."""
    return [carried(message) for message in log.messages(topics)]


def carried(m: RawMessage):
    """All that one message carries."""
    return m.channel.topic, m.channel.schema_name, m.channel.schema_data, m.log_time_ns, m.publish_time_ns, m.sequence, m.data


def reference(data: bytes, topics=None):
    """The same as `content` by the reader of the `mcap` package."""
    reader = NonSeekingReader(io.BytesIO(data), validate_crcs=True)
    return [
        (c.topic, s.name if s else "", s.data if s else b"", m.log_time, m.publish_time, m.sequence, m.data)
        for s, c, m in reader.iter_messages(topics)
    ]
