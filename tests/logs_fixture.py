"""Small mission logs, written message by message, for tests that need a whole log with a known content."""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from mcap.writer import CompressionType, Writer

SECOND_NS = 1_000_000_000
START_NS = 1_700_000_000 * SECOND_NS

POSE_IN_FRAME = {
    "title": "foxglove.PoseInFrame",
    "type": "object",
    "properties": {
        "timestamp": {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}},
        "frame_id": {"type": "string"},
        "pose": {
            "type": "object",
            "properties": {
                "position": {"type": "object", "properties": {axis: {"type": "number"} for axis in "xyz"}},
                "orientation": {"type": "object", "properties": {axis: {"type": "number"} for axis in "xyzw"}},
            },
        },
    },
}


@dataclass(frozen=True)
class Fix:
    """One message: where a target was seen, `time_s` after the start of the log."""

    time_s: float
    x_m: float
    y_m: float
    topic: str = "/detections/target"


def straight_line(num_fixes: int = 12, step_s: float = 4.0, topic: str = "/detections/target") -> list[Fix]:
    """A target that goes north-east at a steady speed, seen every `step_s`."""
    return [Fix(i * step_s, 3.0 * i * step_s, 2.0 * i * step_s, topic) for i in range(num_fixes)]


def write_log(
    path: Path, fixes: Iterable[Fix], other_topics: Sequence[str] = (), compression: CompressionType = CompressionType.ZSTD
) -> Path:
    """Write `fixes` as foxglove.PoseInFrame (JSON) in the order given; `other_topics` carry a text that is no position."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=4096, compression=compression)  # several chunks also in small logs
        writer.start(profile="", library="test")
        pose = writer.register_schema("foxglove.PoseInFrame", "jsonschema", json.dumps(POSE_IN_FRAME).encode())
        text = writer.register_schema("Note", "jsonschema", b'{"type":"object","properties":{"text":{"type":"string"}}}')
        channels: dict[str, int] = {}
        for topic in other_topics:
            channel = writer.register_channel(topic, "json", text)
            for i in range(10):
                time_ns = START_NS + i * SECOND_NS
                writer.add_message(channel, log_time=time_ns, publish_time=time_ns, sequence=i, data=b'{"text":"nothing here"}')
        for sequence, fix in enumerate(fixes):
            if fix.topic not in channels:
                channels[fix.topic] = writer.register_channel(fix.topic, "json", pose)
            time_ns = START_NS + round(fix.time_s * SECOND_NS)
            writer.add_message(
                channels[fix.topic], log_time=time_ns, publish_time=time_ns, sequence=sequence, data=_pose(fix, time_ns)
            )
        writer.finish()
    return path


def _pose(fix: Fix, time_ns: int) -> bytes:
    message = {
        "timestamp": {"sec": time_ns // SECOND_NS, "nsec": time_ns % SECOND_NS},
        "frame_id": "map",
        "pose": {"position": {"x": fix.x_m, "y": fix.y_m, "z": 0.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}},
    }
    return json.dumps(message).encode()  # NaN and Infinity as Python writes them: what broken recorders do
