"""Writing MCAP: chunked, compressed, indexed, with checksums and statistics, and the same bytes for the same messages."""

import functools
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self

import foxglove_schemas_protobuf.Event_pb2 as event
import foxglove_schemas_protobuf.FrameTransform_pb2 as frame_transform
import foxglove_schemas_protobuf.GeoJSON_pb2 as geojson
import foxglove_schemas_protobuf.Grid_pb2 as grid
import foxglove_schemas_protobuf.LocationFix_pb2 as location_fix
import foxglove_schemas_protobuf.LocationFixes_pb2 as location_fixes
import foxglove_schemas_protobuf.PointCloud_pb2 as point_cloud
import foxglove_schemas_protobuf.SceneUpdate_pb2 as scene_update
import foxglove_schemas_protobuf.VoxelGrid_pb2 as voxel_grid
from google.protobuf import descriptor_pb2

from pipeline.logs.index import Index
from pipeline.logs.recorder import Packing, Recorder
from schemas.channels import DESCRIPTOR_PATH, Channel

LIBRARY = "cadence"
"""The writer's name in the header; no version, so that the bytes depend on the content only (versions: Metadata record)."""

_FOXGLOVE = {
    f"foxglove.{name}": getattr(module, name)
    for name, module in {
        "Event": event,
        "FrameTransform": frame_transform,
        "GeoJSON": geojson,
        "Grid": grid,
        "LocationFix": location_fix,
        "LocationFixes": location_fixes,
        "PointCloud": point_cloud,
        "SceneUpdate": scene_update,
        "VoxelGrid": voxel_grid,
    }.items()
}


class LogWriter:
    """An MCAP file under construction; a context manager that writes the summary when all went well.

    Channels are added when first written to. Messages should come in the order of their times: chunks then do not overlap.
    """

    def __init__(self, path: Path, packing: Packing | None = None, profile: str = "", library: str = LIBRARY) -> None:
        self._path = path
        self._packing = packing or Packing()
        self._header = (profile, library)
        self._channel_ids: dict[Channel, int] = {}
        self._schema_ids: dict[str, int] = {}
        self._sequences: dict[int, int] = {}
        self._file: BinaryIO | None = None
        self._recorder: Recorder | None = None

    def __enter__(self) -> Self:
        """Create the file."""
        self._file = self._path.open("wb")
        self._recorder = Recorder(self._file, self._packing, Index())
        self._recorder.start(*self._header)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Finish the file, or leave the part that was written (its folder is temporary) where something failed."""
        assert self._file is not None
        try:
            if error is None:
                self._open.finish()
        finally:
            self._file.close()

    @property
    def _open(self) -> Recorder:
        assert self._recorder is not None, "use `with LogWriter(...)`"
        return self._recorder

    def write(self, channel: Channel, time_ns: int, data: bytes) -> None:
        """Append one protobuf message with log time and publish time `time_ns`."""
        number = self._channel_ids.get(channel)
        if number is None:
            number = self._open.add_channel(channel.topic, "protobuf", self._schema_id(channel.message))
            self._channel_ids[channel] = number
        sequence = self._sequences.get(number, 0)
        self._sequences[number] = sequence + 1
        self._open.add_message(number, sequence, time_ns, time_ns, data)

    def metadata(self, name: str, content: dict[str, str]) -> None:
        """Append a Metadata record."""
        self._open.add_metadata(name, content)

    def _schema_id(self, name: str) -> int:
        if name not in self._schema_ids:
            self._schema_ids[name] = self._open.add_schema(name, "protobuf", schema_bytes(name))
        return self._schema_ids[name]


def foxglove_class(name: str) -> Any:
    """The published protobuf class, for example of "foxglove.Grid"; `KeyError` for one that we do not write."""
    return _FOXGLOVE[name]


@functools.cache
def schema_bytes(name: str) -> bytes:
    """A serialised FileDescriptorSet with the message `name` and all that it depends on, dependencies first."""
    if name.startswith("cadence."):
        return _pruned(descriptor_pb2.FileDescriptorSet.FromString(DESCRIPTOR_PATH.read_bytes()), name)
    found = descriptor_pb2.FileDescriptorSet()
    seen: set[str] = set()

    def add(file: Any) -> None:
        if file.name not in seen:
            seen.add(file.name)
            for dependency in file.dependencies:
                add(dependency)
            file.CopyToProto(found.file.add())

    add(foxglove_class(name).DESCRIPTOR.file)
    data: bytes = found.SerializeToString(deterministic=True)
    return data


def _pruned(found: descriptor_pb2.FileDescriptorSet, name: str) -> bytes:
    """A FileDescriptorSet with those messages of its last file alone that `name` is made of: summaries are not compressed."""
    ours = found.file[-1]
    messages = {f".{ours.package}.{message.name}": message for message in ours.message_type}
    needed, waiting = set[str](), [f".{name}"]
    while waiting:
        one = waiting.pop()
        if one in messages and one not in needed:
            needed.add(one)
            waiting += [field.type_name for field in messages[one].field]
    for index, kind in reversed(list(enumerate(messages))):
        if kind not in needed:
            del ours.message_type[index]
    data: bytes = found.SerializeToString(deterministic=True)
    return data
