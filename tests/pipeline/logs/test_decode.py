import dataclasses
import itertools
import json
import math
import random
import struct
from pathlib import Path

import flatbuffers
import foxglove_schemas_flatbuffer
import numpy as np
import pytest
import zstandard
from foxglove_schemas_flatbuffer import (
    CubePrimitive,
    LocationFix,
    Point3,
    Pose,
    PosesInFrame,
    SceneEntity,
    SceneUpdate,
    Time,
)
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from cadence.errors import InputError
from pipeline.logs.decode import UndecodableChannel, UndecodableMessage, decoder_for, field
from pipeline.logs.reader import Channel, open_log

POSE_STAMPED = """std_msgs/Header header
Point position
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: a/Point
float64 x
float64 y
"""
POINT_IDL = """module a {
  module msg {
    struct Point {
      double x;
      double y;
    };
  };
};
"""


def channel(encoding: str, name: str = "", schema_encoding: str = "", data: bytes | str = b"") -> Channel:
    body = data.encode() if isinstance(data, str) else data
    return Channel(1, "/topic", encoding, name, schema_encoding, body, 1, {})


def cdr(body: bytes, little_endian: bool = True) -> bytes:
    return bytes([0, little_endian, 0, 0]) + body


@pytest.mark.parametrize(
    "name",
    ["flights/cubs2_cub_stabilize.mcap", "formats/rosbag2_cdr_test_0.mcap", "formats/rosbag2parquet_array_msgs_0.mcap"],
)
def test_cdr_of_real_logs_decodes_as_by_the_reference_decoder(name, shared_data):
    log = open_log(shared_data / name)
    decoders = {c.id: (decoder_for(c), oracle(c)) for c in log.channels}
    for message in itertools.islice(log.messages(), 300):
        mine, theirs = (decode(message.data) for decode in decoders[message.channel.id])
        assert_same(mine, theirs)


def oracle(c: Channel):
    return DecoderFactory().decoder_for("cdr", Schema(1, c.schema_data, c.schema_encoding, c.schema_name))


def assert_same(mine, theirs) -> None:
    for name in getattr(theirs, "__slots__", ()) or vars(theirs):
        a, b = getattr(mine, name), getattr(theirs, name)
        if hasattr(a, "__dataclass_fields__"):
            assert_same(a, b)
        elif isinstance(a, list) and a and hasattr(a[0], "__dataclass_fields__"):
            for left, right in zip(a, b, strict=True):
                assert_same(left, right)
        elif isinstance(b, bytes):
            assert bytes(a) == b
        else:
            np.testing.assert_array_equal(np.asarray(a), np.asarray(b))


@pytest.mark.parametrize(
    ("name", "topic", "path"),
    [
        ("maritime/solent_ais_known.mcap", "/contacts/", "latitude"),
        ("flights/calfire_adsb_known.mcap", "/truth/", "longitude"),
        ("prison_reference/high/p_high_0000.mcap", "/truth/", "pose.position.x"),
        ("flights/cubs2_cub_stabilize.mcap", "/cub1/pose", "pose.position.x"),
        ("formats/mcap-explorer_demo.mcap", "/odom", "pose.position.x"),
    ],
)
def test_positions_of_real_logs_are_numbers(name, topic, path, shared_data):
    log = open_log(shared_data / name)
    decoders = {c.id: decoder_for(c) for c in log.channels}
    values = [field(decoders[m.channel.id](m.data), path) for m in log.messages() if m.channel.topic.startswith(topic)]
    assert len(values) > 20 and all(math.isfinite(value) for value in values)


def test_every_channel_of_the_real_logs_decodes(shared_data):
    for path in sorted((shared_data / "formats").glob("*.mcap")):
        log = open_log(path)
        decoders = {c.id: decoder_for(c) for c in log.channels}
        for message in log.messages():
            decoders[message.channel.id](message.data)


@pytest.mark.parametrize("little_endian", [True, False])
@pytest.mark.parametrize(
    ("name", "encoding", "text"), [("a/msg/Point", "ros2msg", "float64 x\nfloat64 y\n"), ("a/msg/Point", "ros2idl", POINT_IDL)]
)
def test_cdr_by_msg_and_by_idl_in_both_byte_orders(name, encoding, text, little_endian):
    decode = decoder_for(channel("cdr", name, encoding, text))
    point = decode(cdr(struct.pack("<2d" if little_endian else ">2d", 1.5, -2.0), little_endian))
    assert (field(point, "x"), field(point, "y")) == (1.5, -2.0)


@pytest.mark.parametrize("little_endian", [True, False])
def test_messages_that_are_compressed_one_by_one_are_unpacked(little_endian):
    """As rosbag2 writes them with the compression mode MESSAGE; the schema says nothing about it."""
    decode = decoder_for(channel("cdr", "a/msg/Point", "ros2msg", "float64 x\nfloat64 y\n"))
    plain = cdr(struct.pack("<2d" if little_endian else ">2d", 1.5, -2.0), little_endian)
    unsized = zstandard.ZstdCompressor(write_content_size=False)
    assert decode(zstandard.compress(plain)) == decode(unsized.compress(plain)) == decode(plain)
    for damaged in (zstandard.compress(plain)[:-3], zstandard.compress(bytes(2**26 + 1)), zstandard.compress(b"")):
        with pytest.raises(UndecodableMessage):
            decode(damaged)


def test_idl_of_several_files_decodes():
    separator = "=" * 80
    nested = POINT_IDL.replace("Point", "Pose").replace("double x;\n      double y;", "a::msg::Point position;")
    text = f"{separator}\nIDL: a/msg/Pose\n{nested}{separator}\nIDL: a/msg/Point\n{POINT_IDL}"
    pose = decoder_for(channel("cdr", "a/msg/Pose", "ros2idl", text))(cdr(struct.pack("<2d", 1.5, -2.0)))
    assert field(pose, "position.y") == -2.0


def test_idl_as_rosidl_writes_it():
    text = """// generated from rosidl_adapter/resource/msg.idl.em

#include "a/msg/Other.idl"

module a {
  module msg {
    module P_Constants {
      /**
       * A "quoted; comment } with everything
       */
      const uint8 CAR = 1;
      @verbatim (language="comment", text=" a; b { c }" "\\n" " (more) // \\" */")
      const string NAME = "x // y";
    };
    typedef double double__3[3];
    struct P {
      @verbatim (language="comment", text=
        "See http://example.org/ (and \\"that\\") @default (value=3)" "\\n"
        "/* no comment */")
      double__3 place;  // where

      @default (value=0.5)
      @range (min=0.0, max=1.0)
      float score;
      sequence<uint8, 4> label;
    };
  };
};
"""
    body = struct.pack("<3df", 1.5, 2.5, 3.5, 0.25) + struct.pack("<I", 2) + b"\x07\x08"
    point = decoder_for(channel("cdr", "a/msg/P", "ros2idl", text))(cdr(body))
    assert (point.place.tolist(), point.score, point.label.tolist()) == ([1.5, 2.5, 3.5], 0.25, [7, 8])
    assert (point.CAR, point.NAME) == (1, "x // y")


def test_time_is_known_without_its_definition():
    body = struct.pack("<iI", 12, 34) + struct.pack("<I", 4) + b"map\0" + struct.pack("<2d", 5.0, 6.0)
    message = decoder_for(channel("cdr", "a/msg/Pose", "ros2msg", POSE_STAMPED))(cdr(body))
    assert field(message, "header.stamp.nanosec") == 34 and field(message, "header.frame_id") == "map"
    assert field(message, "position.y") == 6.0


def test_ros1_messages_decode():
    text = "Header header\nfloat64 x\n" + "=" * 80 + "\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
    body = struct.pack("<IIII", 7, 100, 5, 3) + b"map" + struct.pack("<d", 2.5)
    message = decoder_for(channel("ros1", "a/Pose", "ros1msg", text))(body)
    assert (field(message, "header.stamp.sec"), field(message, "header.frame_id"), field(message, "x")) == (100, "map", 2.5)


def test_types_of_one_name_may_differ_between_channels():
    first = decoder_for(channel("cdr", "a/msg/P", "ros2msg", "float64 x\n"))
    second = decoder_for(channel("cdr", "a/msg/P", "ros2msg", "int32 x\n"))
    assert (first(cdr(struct.pack("<d", 1.5))).x, second(cdr(struct.pack("<i", 3))).x) == (1.5, 3)


def test_field_reads_attributes_keys_and_python_keywords():
    message = decoder_for(channel("cdr", "a/msg/P", "ros2msg", "int32 class\nint32 id\n"))(cdr(struct.pack("<2i", 4, 5)))
    assert (field(message, "class"), field({"a": {"b": [message]}}, "a.b")[0].id) == (4, 5)
    for broken in ("nothing", "id.more", "a"):
        with pytest.raises(KeyError):
            field(message, broken)
    with pytest.raises(KeyError):
        field({"a": 1}, "b")


def test_json_decodes_to_dicts():
    assert decoder_for(channel("json"))(b'{"a": [1, {"b": null}]}') == {"a": [1, {"b": None}]}


@pytest.mark.parametrize(
    "broken",
    [
        channel("cbor", "T", "jsonschema", b"{}"),
        channel("", "", "", b""),
        channel("cdr"),
        channel("cdr", "a/msg/P", "ros2msg", b"\xff\xfe"),
        channel("cdr", "a/msg/P", "ros2msg", "this is no definition"),
        channel("cdr", "a/srv/S_Event", "ros2msg", "int32 a\n---\nint32 b\n"),
        channel("cdr", "a/msg/P", "ros2idl", "module {"),
        channel("cdr", "a/msg/P", "jsonschema", "{}"),
        channel("protobuf", "a.P", "protobuf", b"garbage"),
        channel("protobuf", "a.P", "protobuf", FileDescriptorSet().SerializeToString() or b"\n\x00"),
        channel("protobuf", "a.P", "ros2msg", b"int32 x\n"),
        channel("ros1", "a/P", "ros1msg", b"nonsense nonsense nonsense"),
    ],
    ids=lambda broken: f"{broken.message_encoding}-{broken.schema_encoding}",
)
def test_channel_without_a_decoder_says_why_in_one_line(broken):
    with pytest.raises(UndecodableChannel) as error:
        decoder_for(broken)
    assert isinstance(error.value, InputError) and "\n" not in str(error.value) and "/topic" in str(error.value)
    assert len(str(error.value)) < 300


@pytest.mark.parametrize(
    ("kind", "data"),
    [
        (channel("json"), b"{"),
        (channel("json"), b"\xff"),
        (channel("json"), b"[" * 200_000),
        (channel("cdr", "a/msg/P", "ros2msg", "float64 x\n"), b""),
        (channel("cdr", "a/msg/P", "ros2msg", "float64 x\n"), cdr(b"1234")),
        (channel("cdr", "a/msg/P", "ros2msg", "float64 x\n"), cdr(bytes(64))),
        (channel("cdr", "a/msg/P", "ros2msg", "b/Missing field\n"), cdr(bytes(64))),
        (channel("cdr", "a/msg/P", "ros2msg", "float64[] x\n"), cdr(b"\xff\xff\xff\xff")),
        (channel("cdr", "a/msg/P", "ros2msg", "string x\n"), cdr(b"\x05\0\0\0\xff\xff\xff\xff\0")),
        (channel("cdr", "a/msg/P", "ros2msg", "float64 x\n"), b"\x00\x07\x00\x00" + bytes(8)),
    ],
)
def test_bytes_that_do_not_fit_are_an_undecodable_message(kind, data):
    with pytest.raises(UndecodableMessage, match="/topic") as error:
        decoder_for(kind)(data)
    assert "\n" not in str(error.value)


def test_protobuf_bytes_that_do_not_fit_are_an_undecodable_message(shared_data):
    log = open_log(shared_data / "maritime" / "solent_ais_known.mcap")
    with pytest.raises(UndecodableMessage):
        decoder_for(log.channels[0])(b"\xff\xff\xff\xff")


@pytest.mark.parametrize(("encoding", "store"), [("cdr", Stores.ROS2_JAZZY), ("ros1", Stores.ROS1_NOETIC)])
@pytest.mark.parametrize("name", ["sensor_msgs/msg/NavSatFix", "sensor_msgs/NavSatFix", "sensor_msgs::msg::NavSatFix"])
def test_a_standard_type_whose_definition_the_recorder_did_not_find(encoding, store, name):
    types = get_typestore(store)
    header = dict(stamp=types.types["builtin_interfaces/msg/Time"](sec=1, nanosec=2), frame_id="gps")
    header |= {"seq": 0} if encoding == "ros1" else {}
    fix = types.types["sensor_msgs/msg/NavSatFix"](
        header=types.types["std_msgs/msg/Header"](**header),
        status=types.types["sensor_msgs/msg/NavSatStatus"](status=0, service=1), latitude=50.5, longitude=-1.25, altitude=7.0,
        position_covariance=np.zeros(9), position_covariance_type=0,
    )  # fmt: skip
    data = types.serialize_cdr(fix, fix.__msgtype__) if encoding == "cdr" else types.serialize_ros1(fix, fix.__msgtype__)
    decoded = decoder_for(channel(encoding, name, "ros2msg"))(bytes(data))
    assert (decoded.latitude, decoded.longitude, decoded.header.frame_id) == (50.5, -1.25, "gps")


@pytest.mark.parametrize("name", ["own_msgs/msg/Thing", "NavSatFix", ""])
def test_other_types_need_a_definition(name):
    with pytest.raises(UndecodableChannel, match="the log has none for it; record it with its definition"):
        decoder_for(channel("cdr", name, "ros2msg"))


def test_schema_cannot_smuggle_in_code(tmp_path):
    """Registering a type runs generated code; text from a log must stay text in it."""
    mark = tmp_path / "executed"
    call = f"__import__('pathlib').Path({str(mark)!r}).touch()"
    texts = [
        f"string X='+str({call})+'\nint32 y\n",
        f'string X="""+str({call})+"""\nint32 y\n',
        f"int32 X={call}\nint32 y\n",
        f"float64[{call}] y\n",
        f"int32 y\n{'=' * 80}\nMSG: a/B:\n  {call}\nint32 z\n",
        f"int32 y {call}\n",
    ]
    names = ["a/msg/P", f"a/msg/P(object):\n  {call}\nclass C", f'a/msg/P"+{call}+"']
    for text, name in itertools.product(texts, names):
        try:
            decoder_for(channel("cdr", name, "ros2msg", text))(cdr(bytes(4)))
        except InputError:
            continue
    assert not mark.exists()


def test_decoding_agrees_with_a_message_built_field_by_field():
    store = get_typestore(Stores.EMPTY)
    text = "float64[] values\nstring[] names\nuint8[4] fixed\nbool flag\n"
    store.register(get_types_from_msg(text, "a/msg/M"))
    built = store.types["a/msg/M"](np.array([1.0, 2.5]), ["p", "quer"], np.array([1, 2, 3, 4], np.uint8), True)
    message = decoder_for(channel("cdr", "a/msg/M", "ros2msg", text))(bytes(store.serialize_cdr(built, "a/msg/M")))
    assert message.values.tolist() == [1.0, 2.5] and message.names == ["p", "quer"]
    assert message.fixed.tolist() == [1, 2, 3, 4] and message.flag is True
    assert json.dumps(message.names)


def flat_channel(name: str) -> Channel:
    schema = Path(foxglove_schemas_flatbuffer.__file__).parent / f"{name}.bfbs"
    return channel("flatbuffer", f"foxglove.{name}", "flatbuffer", schema.read_bytes())


def flat_poses(num_poses: int = 2) -> bytes:
    builder = flatbuffers.Builder()
    frame = builder.CreateString("map")
    poses = []
    for i in range(num_poses):
        Point3.Start(builder)
        Point3.AddX(builder, 1.5 + i)
        Point3.AddY(builder, -2.5)
        position = Point3.End(builder)
        Pose.Start(builder)
        Pose.AddPosition(builder, position)
        poses.append(Pose.End(builder))
    PosesInFrame.StartPosesVector(builder, num_poses)
    for pose in reversed(poses):
        builder.PrependUOffsetTRelative(pose)
    vector = builder.EndVector()
    PosesInFrame.Start(builder)
    PosesInFrame.AddTimestamp(builder, Time.CreateTime(builder, 100, 7))
    PosesInFrame.AddFrameId(builder, frame)
    PosesInFrame.AddPoses(builder, vector)
    builder.Finish(PosesInFrame.End(builder))
    return bytes(builder.Output())


def flat_fix() -> bytes:
    builder = flatbuffers.Builder()
    frame = builder.CreateString("gps")
    LocationFix.StartPositionCovarianceVector(builder, 9)
    for value in reversed([4.0, 1, 0, 1, 9, 0, 0, 0, 16]):
        builder.PrependFloat64(value)
    covariance = builder.EndVector()
    LocationFix.Start(builder)
    LocationFix.AddTimestamp(builder, Time.CreateTime(builder, 100, 7))
    LocationFix.AddFrameId(builder, frame)
    LocationFix.AddLatitude(builder, 50.5)
    LocationFix.AddLongitude(builder, -1.25)
    LocationFix.AddPositionCovariance(builder, covariance)
    LocationFix.AddPositionCovarianceType(builder, 3)
    builder.Finish(LocationFix.End(builder))
    return bytes(builder.Output())


def test_flatbuffer_messages_decode_by_the_schema_in_the_log():
    poses = decoder_for(flat_channel("PosesInFrame"))(flat_poses())
    assert (poses["timestamp"], poses["frame_id"]) == ({"sec": 100, "nsec": 7}, "map")
    assert [pose["position"] for pose in poses["poses"]] == [{"x": 1.5, "y": -2.5, "z": 0.0}, {"x": 2.5, "y": -2.5, "z": 0.0}]
    assert poses["poses"][0]["orientation"] is None
    fix = decoder_for(flat_channel("LocationFix"))(flat_fix())
    assert (fix["latitude"], fix["longitude"], fix["altitude"], fix["heading"]) == (50.5, -1.25, 0.0, None)
    assert fix["position_covariance"].tolist() == [4.0, 1, 0, 1, 9, 0, 0, 0, 16]
    assert fix["position_covariance_type"] == 3 and fix["position_covariance_type"].name == "KNOWN"
    empty = decoder_for(flat_channel("PosesInFrame"))(flat_poses(0))
    assert list(empty["poses"]) == []


def test_every_foxglove_flatbuffer_schema_is_understood():
    schemas = sorted(Path(foxglove_schemas_flatbuffer.__file__).parent.glob("*.bfbs"))
    assert len(schemas) > 40
    for schema in schemas:
        decoder_for(flat_channel(schema.stem))


@pytest.mark.parametrize(
    "broken",
    [
        channel("flatbuffer", "foxglove.LocationFix", "flatbuffer", b"\x10\0\0\0BFBS"),
        channel("flatbuffer", "foxglove.LocationFix", "flatbuffer", b"\x10\0\0\0ABCD" + bytes(64)),
        channel("flatbuffer", "foxglove.Other", "flatbuffer", flat_channel("LocationFix").schema_data),
    ],
)
def test_wrong_flatbuffer_schemas(broken):
    with pytest.raises(UndecodableChannel, match="/topic"):
        decoder_for(broken)


@pytest.mark.parametrize(("name", "data"), [("PosesInFrame", flat_poses()), ("LocationFix", flat_fix())])
def test_damaged_flatbuffers_are_undecodable_or_something_else(name, data):
    """Cut at every byte, and every byte changed: never a crash, and what is cut is noticed."""
    decode = decoder_for(flat_channel(name))
    noise = random.Random(2)
    num_noticed = 0
    for i in range(len(data)):
        if i < len(data) - 1:  # the last byte only ends a text
            with pytest.raises(UndecodableMessage):
                decode(data[:i])
        changed = data[:i] + bytes([data[i] ^ noise.randrange(1, 256)]) + data[i + 1 :]
        try:
            decode(changed)
        except UndecodableMessage:
            num_noticed += 1
    assert num_noticed > len(data) / 10


def test_damaged_flatbuffer_schemas_neither_crash_nor_hang():
    whole = flat_channel("LocationFix")
    noise = random.Random(3)
    for _ in range(400):
        schema = bytearray(whole.schema_data)
        for _ in range(noise.randrange(1, 4)):
            schema[noise.randrange(len(schema))] = noise.randrange(256)
        try:
            decoder_for(dataclasses.replace(whole, schema_data=bytes(schema)))(flat_fix())
        except InputError as error:
            assert "\n" not in str(error)


def test_flatbuffer_whose_tables_all_share_one_vector_is_refused():
    """Ten thousand entities that share one list of a thousand cubes: 44 kB that would ask for ten million tables."""
    builder = flatbuffers.Builder()
    CubePrimitive.Start(builder)
    cube = CubePrimitive.End(builder)
    SceneEntity.StartCubesVector(builder, 1000)
    for _ in range(1000):
        builder.PrependUOffsetTRelative(cube)
    cubes = builder.EndVector()
    SceneEntity.Start(builder)
    SceneEntity.AddCubes(builder, cubes)
    entity = SceneEntity.End(builder)
    SceneUpdate.StartEntitiesVector(builder, 10_000)
    for _ in range(10_000):
        builder.PrependUOffsetTRelative(entity)
    entities = builder.EndVector()
    SceneUpdate.Start(builder)
    SceneUpdate.AddEntities(builder, entities)
    builder.Finish(SceneUpdate.End(builder))
    with pytest.raises(UndecodableMessage, match="without end"):
        decoder_for(flat_channel("SceneUpdate"))(bytes(builder.Output()))
