"""What the usual libraries offer for the ends that our writers serve: messages written, a log re-written, scenes filled in."""

from collections.abc import Iterator
from pathlib import Path

from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap import records
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from pipeline.export.scene import Entity
from pipeline.logs.recorder import Packing
from pipeline.logs.writer import schema_bytes
from schemas.channels import Channel

Message = tuple[Channel, int, bytes]


def write_with_library(path: Path, messages: list[Message]) -> None:
    """The same messages, chunk size and checksums through the library's writer."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=Packing().chunk_bytes, compression=CompressionType.ZSTD, enable_data_crcs=True)
        writer.start("", "library")
        ids: dict[Channel, int] = {}
        for number, (channel, time_ns, data) in enumerate(messages):
            if channel not in ids:
                schema = writer.register_schema(channel.message, "protobuf", schema_bytes(channel.message))
                ids[channel] = writer.register_channel(channel.topic, "protobuf", schema)
            writer.add_message(ids[channel], time_ns, data, time_ns, number)
        writer.finish()


def rewrite(source: Path, side: Path, target: Path) -> None:
    """What `mcap` offers for the same end: read every record of both files and write it again, by time."""
    with source.open("rb") as source_file, side.open("rb") as side_file, target.open("wb") as target_file:
        writer = Writer(target_file, compression=CompressionType.ZSTD)
        writer.start("", "library")
        added = rewritten(side_file, writer)
        waiting = next(added, None)
        for time_ns in rewritten(source_file, writer):
            while waiting is not None and waiting <= time_ns:
                waiting = next(added, None)
        for _ in added:
            pass
        writer.finish()


def rewritten(file: object, writer: Writer) -> Iterator[int]:
    """Copy record by record; the log time of each message before it is copied."""
    schemas, ids = {0: 0}, {}
    for record in StreamReader(file).records:
        match record:
            case records.Schema():
                if record.id not in schemas:
                    schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
            case records.Channel():
                if record.id not in ids:
                    schema = schemas[record.schema_id]
                    ids[record.id] = writer.register_channel(record.topic, record.message_encoding, schema, record.metadata)
            case records.Message():
                yield record.log_time
                writer.add_message(ids[record.channel_id], record.log_time, record.data, record.publish_time, record.sequence)
            case records.Attachment():
                writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, record.data)
            case records.Metadata():
                writer.add_metadata(record.name, record.metadata)


def encode_point_by_point(time_ns: int, found: list[Entity]) -> bytes:
    """As one would write it by the book."""
    data: bytes = point_by_point(time_ns, found).SerializeToString()
    return data


def point_by_point(time_ns: int, found: list[Entity], frame_id: str = "map") -> SceneUpdate:
    """The message of `encode_scene`, built with the published classes."""
    update = SceneUpdate()
    update.deletions.add(type=SceneEntityDeletion.ALL).timestamp.FromNanoseconds(time_ns)
    for entity in found:
        out = update.entities.add(frame_id=frame_id, id=entity.id)
        out.timestamp.FromNanoseconds(time_ns)
        for spheres in entity.spheres:
            for center in spheres.center_m:
                sphere = out.spheres.add()
                sphere.pose.position.x, sphere.pose.position.y, sphere.pose.position.z = center
                sphere.pose.orientation.w = 1.0
                sphere.size.x = sphere.size.y = sphere.size.z = spheres.diameter_m
                sphere.color.r, sphere.color.g, sphere.color.b, sphere.color.a = spheres.color
        for lines in entity.lines:
            for points, color in zip(lines.point_m, lines.color, strict=True):
                line = out.lines.add(type=int(lines.type), thickness=lines.thickness_px, scale_invariant=True)
                line.pose.orientation.w = 1.0
                for x, y, z in points:
                    line.points.add(x=x, y=y, z=z)
                line.color.r, line.color.g, line.color.b, line.color.a = color
        for label in entity.labels:
            text = out.texts.add(billboard=True, font_size=14.0, scale_invariant=True, text=label.text)
            text.pose.position.x, text.pose.position.y, text.pose.position.z = label.position_m
            text.pose.orientation.w = 1.0
            text.color.r, text.color.g, text.color.b, text.color.a = label.color
    return update
