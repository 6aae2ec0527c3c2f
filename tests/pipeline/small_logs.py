"""Small logs for tests: rows of (topic, schema name, log time in seconds, message) written as JSON, or as given bytes."""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap.writer import Writer

START_NS = 1_700_000_000_000_000_000


@dataclass(frozen=True)
class Row:
    """One message; bytes are written as they are, with the encoding given."""

    topic: str
    schema: str
    time_s: float
    message: dict[str, Any] | bytes
    encoding: str = "json"
    schema_encoding: str = "jsonschema"
    schema_data: bytes = b"{}"


def time_ns(time_s: float) -> int:
    """Nanoseconds of the test's clock."""
    return START_NS + round(time_s * 1e9)


def stamp(time_s: float) -> dict[str, int]:
    """A JSON stamp."""
    return {"sec": time_ns(time_s) // 10**9, "nsec": time_ns(time_s) % 10**9}


def write_log(path: Path, rows: Iterable[Row]) -> Path:
    """Write an indexed MCAP."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=16_384)
        writer.start()
        channels: dict[tuple[str, str], int] = {}
        for sequence, row in enumerate(rows):
            key = (row.topic, row.schema)
            if key not in channels:
                schema = writer.register_schema(row.schema, row.schema_encoding, row.schema_data) if row.schema else 0
                channels[key] = writer.register_channel(row.topic, row.encoding, schema)
            data = row.message if isinstance(row.message, bytes) else json.dumps(row.message).encode()
            now_ns = time_ns(row.time_s)
            writer.add_message(channels[key], now_ns, data, now_ns, sequence)
        writer.finish()
    return path


def detection(
    time_s: float, x: float, y: float, topic: str = "/detections", sensor: str | None = None, frame: str = "map", **more: Any
) -> Row:
    """A `mission.Detection`."""
    message = {"timestamp": stamp(time_s), "frame_id": frame, "position": {"x": x, "y": y, "z": 0.0}, **more}
    if sensor is not None:
        message["sensor_id"] = sensor
    return Row(topic, "mission.Detection", time_s, message)


def pose(time_s: float, x: float, y: float, topic: str = "/truth/T0", frame: str = "map") -> Row:
    """A `foxglove.PoseInFrame`."""
    position = {"position": {"x": x, "y": y, "z": 0.0}}
    return Row(topic, "foxglove.PoseInFrame", time_s, {"timestamp": stamp(time_s), "frame_id": frame, "pose": position})


def fix(time_s: float, latitude: float, longitude: float, topic: str = "/contacts/A", status: int = 0, **more: Any) -> Row:
    """A `sensor_msgs/NavSatFix`."""
    message = {
        "header": {"stamp": stamp(time_s), "frame_id": "gps"}, "latitude": latitude, "longitude": longitude, "altitude": 5.0,
        "status": {"status": status}, **more,
    }  # fmt: skip
    return Row(topic, "sensor_msgs/NavSatFix", time_s, message)
