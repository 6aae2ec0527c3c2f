"""Definitions of ROS types that are small to write and large to read."""

import time

import pytest

from pipeline.logs.cdr_fields import CdrFields
from pipeline.logs.decode import UndecodableChannel, decoder_for
from pipeline.logs.reader import Channel
from pipeline.logs.ros_types import ros1_types, ros2_types

SEPARATOR = "\n" + "=" * 80 + "\nMSG: "


def doubling(depth: int, leaf: str, member: str = "{inner} a\n{inner} b") -> str:
    """A type of two of the next type, and so on: 2**depth leaves."""
    levels = [f"a/L{i}\n{member.format(inner=f'a/L{i + 1}')}" for i in range(1, depth)]
    return SEPARATOR.join([member.format(inner="a/L1"), *levels, f"a/L{depth}\n{leaf}"])


def channel(text: str, encoding: str = "cdr", schema_encoding: str = "ros2msg") -> Channel:
    return Channel(1, "/a", encoding, "a/msg/L0", schema_encoding, text.encode(), 1, {})


@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (doubling(40, "float64 x"), "more than 100000 members"),
        (doubling(40, "float64[0] nothing"), "more than 100000 members"),  # a message without a byte would do
        (doubling(5, "float64 x", "{inner}[1000] a"), "more than 100000 members"),
        (doubling(3, "a/L1 again"), "holds itself"),
        (doubling(3, "a/L1[] again"), "holds itself"),
    ],
)
def test_types_that_grow_at_each_level_are_refused_at_once(encoding: str, text: str, reason: str) -> None:
    began = time.process_time()
    with pytest.raises(UndecodableChannel, match=reason):
        decoder_for(channel(text, encoding))
    if encoding == "cdr":
        with pytest.raises(UndecodableChannel, match=reason):
            CdrFields(channel(text), ["a.a.x"], is_whole=True)
    assert time.process_time() - began < 5


def test_large_types_that_people_record_are_read() -> None:
    """A fixed list of structures, lists of lists, and many constants and members."""
    for text in (
        doubling(10, "float64 x"),
        doubling(30, "float64 x", "{inner}[] a"),
        "\n".join(f"int32 m{i}" for i in range(2000)),
    ):
        store, name = ros2_types("a/msg/L0", "ros2msg", text.encode())
        assert store.get_msgdef(name) and ros1_types("a/L0", text.encode())
