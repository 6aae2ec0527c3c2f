"""Fields of CDR messages by columns: equal to those of messages decoded one by one."""

import io

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from pipeline.logs.cdr_fields import CdrFields
from pipeline.logs.decode import UndecodableChannel, UndecodableMessage, decoder_for, field
from pipeline.logs.reader import open_log

DEFINITION = """uint8 kind
string frame
uint8[] blob
float64[] values
int16 small
Inner inner
bool is_set
float32[3] three
int64 last
Inner[] list
int8 behind
================================================================================
MSG: test/Inner
uint16 a
float64 x
string name
uint64[2] pair
"""
PATHS = ("kind", "frame", "small", "inner.a", "inner.x", "inner.name", "inner.pair", "is_set", "three", "last")


def write(path, name: str, text: str, payloads, encoding: str = "cdr"):
    file = io.BytesIO()
    writer = Writer(file)
    writer.start()
    channel = writer.register_channel("/a", encoding, writer.register_schema(name, "ros2msg", text.encode()))
    for i, payload in enumerate(payloads):
        writer.add_message(channel, i, payload, i)
    writer.finish()
    path.write_bytes(file.getvalue())
    return open_log(path)


def own_types():
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(DEFINITION, "test/msg/Own"))
    return store


STORE = own_types()


def message(kind, frame, blob, values, x, name, num_items):
    inner = STORE.types["test/msg/Inner"](7, x, name, np.array([1, 2**63], np.uint64))
    own = STORE.types["test/msg/Own"](
        kind, frame, np.frombuffer(blob, np.uint8), np.array(values, np.float64), -3, inner, True,
        np.array([1, 2, 3], np.float32), -(2**40), [inner] * num_items, 5,
    )  # fmt: skip
    return bytes(STORE.serialize_cdr(own, "test/msg/Own"))


MESSAGES = st.builds(
    message, st.integers(0, 255), st.text(max_size=9), st.binary(max_size=9), st.lists(st.floats(-1, 1), max_size=3),
    st.floats(allow_nan=False), st.text("ab", max_size=5), st.integers(0, 2),
)  # fmt: skip


@pytest.fixture(scope="module")
def scratch(tmp_path_factory):
    return tmp_path_factory.mktemp("cdr") / "log.mcap"


def assert_same(log, paths, topic="/a"):
    (channel,) = [channel for channel in log.channels if channel.topic == topic]
    reader, decode = CdrFields(channel, paths), decoder_for(channel)
    for batch in log.batches({topic}):
        is_sound, columns = reader.columns(batch)
        assert is_sound.all() and columns.keys() == set(paths)
        decoded = [decode(data) for data in batch.payloads()]
        for path in paths:
            wanted = [field(one, path) for one in decoded]
            assert np.array_equal(columns[path], np.array(wanted, columns[path].dtype)), path


@given(payloads=st.lists(MESSAGES, min_size=1, max_size=5))
def test_columns_are_those_of_whole_messages(payloads, scratch):
    log = write(scratch, "test/msg/Own", DEFINITION, payloads)
    assert_same(log, PATHS)
    assert_same(log, ["last"])


@given(payload=MESSAGES, data=st.data())
def test_damaged_messages_are_told_or_read_as_by_the_decoder(payload, data, scratch):
    """Cut anywhere, or a bit flipped anywhere: never an error, and where both can read a message they agree."""
    damaged = bytearray(payload)
    bit = data.draw(st.integers(0, 8 * len(damaged) - 1))
    damaged[bit // 8] ^= 1 << bit % 8
    cut = payload[: data.draw(st.integers(0, len(payload) - 1))]
    log = write(scratch, "test/msg/Own", DEFINITION, [payload, bytes(damaged), cut, b"", payload])
    (batch,) = log.batches()
    is_sound, columns = CdrFields(log.channels[0], PATHS).columns(batch)
    decode = decoder_for(log.channels[0])
    assert is_sound[[0, 4]].all() and not is_sound[3]
    for number, one in enumerate(batch.payloads()):
        try:
            whole = decode(one)
        except UndecodableMessage:
            continue
        if is_sound[number]:
            for path in ("kind", "small", "inner.x", "last"):
                assert columns[path][number] == field(whole, path) or np.isnan(columns[path][number])


def test_messages_cut_inside_the_wanted_part_are_not_sound(scratch):
    payload = message(1, "map", b"123", [0.5], 2.0, "n", 0)
    log = write(scratch, "test/msg/Own", DEFINITION, [payload[:size] for size in range(len(payload) + 1)])
    (batch,) = log.batches()
    is_sound, columns = CdrFields(log.channels[0], ["inner.x"]).columns(batch)
    first = int(np.argmax(is_sound))
    assert is_sound[first:].all() and not is_sound[:first].any() and 40 < first < len(payload)
    assert (columns["inner.x"][first:] == 2.0).all()


@pytest.mark.parametrize("path", ["list", "behind", "inner", "nothing", "blob"])
def test_what_cannot_be_reached_is_refused(path, scratch):
    log = write(scratch, "test/msg/Own", DEFINITION, [message(1, "", b"", [], 0.0, "", 1)])
    with pytest.raises(UndecodableChannel, match="/a"):
        CdrFields(log.channels[0], [path])


def test_other_encodings_are_refused(scratch):
    with pytest.raises(UndecodableChannel, match="json"):
        CdrFields(write(scratch, "test/msg/Own", "{}", [b"{}"], "json").channels[0], ["a"])
    with pytest.raises(UndecodableChannel, match="cannot be decoded"):
        CdrFields(write(scratch, "test/msg/Own", "what is this?", [b"{}"]).channels[0], ["a"])


def test_real_flight(shared_data):
    log = open_log(shared_data / "flights" / "cubs2_cub_stabilize.mcap")
    paths = ["header.stamp.sec", "header.stamp.nanosec", "header.frame_id", "pose.position.x", "pose.orientation.w"]
    assert_same(log, paths, "/cub1/pose")
