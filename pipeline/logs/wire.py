"""The two pieces of the protobuf wire format that large messages are put together from.

Source: https://protobuf.dev/programming-guides/encoding/ — a tag is (field number << 3) | wire type.
"""

DOUBLE, BYTES = 1, 2
"""Wire types: eight bytes; a length and as many bytes (strings, messages, packed numbers)."""

_SHORT = tuple(bytes([value]) for value in range(128))


def varint(value: int) -> bytes:
    """An unsigned number in groups of seven bits, lowest first."""
    if value <= 0x7F:
        return _SHORT[value]
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def field(number: int, payload: bytes) -> bytes:
    """Tag, length and content of a string, message or packed field."""
    return varint(number << 3 | BYTES) + varint(len(payload)) + payload
