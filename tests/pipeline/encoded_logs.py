"""A small log in each encoding that is read, with real message definitions, each in another kind of container."""

import io
from pathlib import Path

import flatbuffers
import foxglove_schemas_flatbuffer
import numpy as np
from foxglove_schemas_flatbuffer import LocationFix, Time
from mcap.writer import CompressionType, Writer
from ros_messages import Builder, store_with
from rosbags.typesys import Stores

from pipeline.logs.forms import Report, detection_form, pose_form

START_NS = 1_700_000_000 * 10**9
STEP_NS = 250_000_000
TOPICS = ("/truth/T0", "/detections/T0")
CONTAINERS = {
    "cdr": {"compression": CompressionType.ZSTD},
    "ros1": {"compression": CompressionType.LZ4},
    "protobuf": {"compression": CompressionType.NONE},
    "json": {"use_chunking": False, "enable_data_crcs": True},
    "flatbuffer": {"compression": CompressionType.ZSTD, "enable_data_crcs": True},
}


def encoded_log(encoding: str, num_messages: int = 90) -> bytes:
    """A log of `num_messages` positions on two topics."""
    file = io.BytesIO()
    writer = Writer(file, chunk_size=2000, **CONTAINERS[encoding])
    writer.start("", "recorder")
    writer.add_metadata("mission", {"name": encoding})
    make = {"ros1": _ros1, "flatbuffer": _flatbuffer}.get(encoding)
    forms = None if make else [pose_form(encoding, False), detection_form(encoding, False)]
    channels = [form.register(writer, topic) for form, topic in zip(forms or (), TOPICS, strict=bool(forms))]
    for number in range(num_messages):
        time_ns, x, y = START_NS + number * STEP_NS, 3.0 * number, 100.0 - number
        if make:
            schema, data = make(time_ns, x, y)
            if not channels:
                channels = [writer.register_channel(topic, encoding, writer.register_schema(*schema)) for topic in TOPICS]
        else:
            report = Report(time_ns, "map", x, y, (4.0, 1.0, 9.0), "T0", "radar")
            data = forms[number % 2].encode(report)
        writer.add_message(channels[number % 2], time_ns, data, time_ns + 5, number)
    writer.finish()
    return file.getvalue()


_NOETIC = Builder(store_with(base=Stores.ROS1_NOETIC))


def _ros1(time_ns: int, x: float, y: float) -> tuple[tuple[str, str, bytes], bytes]:
    store, name = _NOETIC.store, "geometry_msgs/msg/PointStamped"
    message = _NOETIC(name, header=_NOETIC.header("map", time_ns), point=_NOETIC.point(x, y))
    definition = store.generate_msgdef(name, ros_version=1)[0]
    return ("geometry_msgs/PointStamped", "ros1msg", definition.encode()), bytes(store.serialize_ros1(message, name))


def _flatbuffer(time_ns: int, x: float, y: float) -> tuple[tuple[str, str, bytes], bytes]:
    schema = Path(foxglove_schemas_flatbuffer.__file__).parent / "LocationFix.bfbs"
    builder = flatbuffers.Builder()
    frame = builder.CreateString("gps")
    covariance = builder.CreateNumpyVector(np.array([4.0, 1, 0, 1, 9, 0, 0, 0, 16]))
    LocationFix.Start(builder)
    LocationFix.AddTimestamp(builder, Time.CreateTime(builder, *divmod(time_ns, 10**9)))
    LocationFix.AddFrameId(builder, frame)
    LocationFix.AddLatitude(builder, 50.0 + y * 1e-5)
    LocationFix.AddLongitude(builder, -1.0 + x * 1e-5)
    LocationFix.AddPositionCovariance(builder, covariance)
    LocationFix.AddPositionCovarianceType(builder, 3)
    builder.Finish(LocationFix.End(builder))
    return ("foxglove.LocationFix", "flatbuffer", schema.read_bytes()), bytes(builder.Output())
