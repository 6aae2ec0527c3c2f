"""A byte is a byte, by whichever way it is read: fields by columns, whole messages, and the second decoder."""

import io
import struct
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.writer import Writer

from pipeline.logs.cdr_fields import CdrFields
from pipeline.logs.decode import decoder_for, field
from pipeline.logs.reader import Channel, open_log

NUMBERS = (1, 127, 128, 200, 255)


@pytest.mark.parametrize("base", ["byte", "char", "uint8"])
def test_ros2_octets_are_unsigned(base: str, write_log: Callable[[bytes], Path]) -> None:
    text = f"float64 x\n  {base} id\n{base}[2] pair\n{base}[] list\n{base} LAST=255"
    bodies = [struct.pack("<d3BxI2B", 0.5, number, number, 1, 2, number, 2) for number in NUMBERS]
    file = io.BytesIO()
    writer = Writer(file)
    writer.start("ros2")
    channel = writer.register_channel("/a", "cdr", writer.register_schema("p/msg/M", "ros2msg", text.encode()))
    for i, body in enumerate(bodies):
        writer.add_message(channel, i, b"\0\1\0\0" + body, i)
    writer.finish()
    log = open_log(write_log(file.getvalue()))
    (batch,) = log.batches()
    is_sound, columns = CdrFields(log.channels[0], ("id", "pair")).columns(batch)
    assert is_sound.all() and columns["id"].tolist() == list(NUMBERS)
    assert columns["pair"].tolist() == [[number, 1] for number in NUMBERS]
    for number, message in zip(NUMBERS, map(decoder_for(log.channels[0]), batch.payloads()), strict=True):
        found = (message.id, list(message.pair), list(message.list))
        assert found == (number, [number, 1], [number, 2])


@pytest.mark.parametrize("base", ["byte", "char", "uint8"])
@pytest.mark.parametrize("num_signs", [80, 16])
def test_ros2_octets_in_lists_are_unsigned(base: str, num_signs: int) -> None:
    """With a short separator the definition is read by the second decoder."""
    text = f"p/Plot[] plots\n{'=' * num_signs}\nMSG: p/Plot\nfloat64 x\n{base} id"
    decode = decoder_for(Channel(1, "/a", "cdr", "p/msg/M", "ros2msg", text.encode(), 1, {}))
    for number in NUMBERS:
        (plot,) = field(decode(b"\0\1\0\0" + struct.pack("<I4xdB", 1, 0.5, number)), "plots")
        assert plot.id == number


@pytest.mark.parametrize(("base", "is_signed"), [("byte", True), ("int8", True), ("char", False), ("uint8", False)])
def test_ros1_octets_are_those_of_its_definition(base: str, is_signed: bool) -> None:
    decode = decoder_for(Channel(1, "/a", "ros1", "p/M", "ros1msg", f"{base} id\n{base}[] list".encode(), 1, {}))
    for number in NUMBERS:
        message = decode(struct.pack("<BIB", number, 1, number))
        wanted = number - 256 if is_signed and number > 127 else number
        assert (message.id, list(message.list)) == (wanted, [wanted])
