"""Message bytes to fields, by the schema that the log itself carries.

Decoded messages are plain trees: dataclasses (CDR, ROS 1), protobuf messages or dicts (JSON, flatbuffer), lists or numpy
arrays for repeated fields. `field` reads both kinds.
"""

import functools
import json
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, Final, Literal

from mcap.records import Schema
from mcap_protobuf.decoder import DecoderFactory as ProtobufDecoderFactory
from mcap_ros2.decoder import DecoderFactory as Ros2DecoderFactory
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from cadence.errors import InputError
from pipeline.logs.compression import ZSTD_MAGIC, unpack_message
from pipeline.logs.flatbuffer import flatbuffer_decoder
from pipeline.logs.reader import Channel
from pipeline.logs.ros_types import TypeTooLarge, ros1_types, ros2_types

Decoder = Callable[[bytes], Any]

_PLAIN_CDR: Final = (b"\x00\x00", b"\x00\x01")
_CHAR_FIELD: Final = re.compile(r"^([ \t]*)char\b", re.MULTILINE)
_MAX_REASON = 160
_MAX_STORES: Final = 64


_STANDARD: Final[Mapping[str, tuple[Stores, Literal[1, 2], str]]] = {
    "cdr": (Stores.ROS2_HUMBLE, 2, "ros2msg"),
    "ros1": (Stores.ROS1_NOETIC, 1, "ros1msg"),
}
"""Whose types stand in for definitions that a log lacks, by the encoding of its messages."""


class UndecodableChannel(InputError):
    """No message of the channel can be decoded: unknown encoding, or a schema that is absent or cannot be read."""


class UndecodableMessage(InputError):
    """The bytes of one message do not fit the schema of its channel."""


def decoder_for(channel: Channel) -> Decoder:
    """A function from the bytes of a message of `channel` to its fields.

    Raises `UndecodableChannel` where there is none; the function raises `UndecodableMessage` on bytes that do not fit.
    """
    encoding, channel = channel.message_encoding, with_definition(channel)
    with _named(channel, UndecodableChannel, "cannot be decoded"):
        if encoding == "json":
            decode: Decoder = json.loads
        elif not channel.schema_data:
            raise ValueError(
                f"encoding {encoding!r} needs a schema, and the log has none for it; record it with its definition"
            )
        elif encoding == "protobuf":
            decode = _protobuf_decoder(channel)
        elif encoding == "cdr":
            decode = _unpacking(_cdr_decoder(channel))
        elif encoding == "ros1":
            decode = _ros1_decoder(channel)
        elif encoding == "flatbuffer":
            decode = flatbuffer_decoder(channel.schema_data, channel.schema_name)
        else:
            raise ValueError(f"message encoding {encoding!r} is not known")

    def checked(data: bytes) -> Any:
        try:
            return decode(data)
        except Exception as error:  # see `_named`
            reason = _reason(error)
            raise UndecodableMessage(f"{channel.topic}: a message does not fit its schema ({reason}); it is skipped") from error

    return checked


def with_definition(channel: Channel) -> Channel:
    """The channel with the standard definition of its type, where a ROS recorder found none; others as they are."""
    if channel.schema_data or channel.message_encoding not in _STANDARD:
        return channel
    store, version, schema_encoding = _STANDARD[channel.message_encoding]
    parts = channel.schema_name.replace("::", "/").split("/")
    name = f"{parts[0]}/msg/{parts[-1]}"
    text = _standard_definition(store, name, version)
    return replace(channel, schema_name=name, schema_encoding=schema_encoding, schema_data=text.encode()) if text else channel


@functools.lru_cache(maxsize=_MAX_STORES)
def _standard_definition(store: Stores, type_name: str, ros_version: Literal[1, 2]) -> str:
    """The definition that a distribution has of a type; empty where it has none."""
    types = get_typestore(store)
    return types.generate_msgdef(type_name, ros_version=ros_version)[0] if type_name in types.fielddefs else ""


def field(message: Any, path: str) -> Any:
    """The value at the dotted `path` ("pose.position.x") of a decoded message, by attribute or by key.

    Raises `KeyError` naming the part that is missing. A field named like a Python keyword is found by its plain name.
    """
    for part in path.split("."):
        if isinstance(message, dict):
            if part not in message:
                raise KeyError(part)
            message = message[part]
        elif hasattr(message, part):
            message = getattr(message, part)
        elif hasattr(message, part + "_"):
            message = getattr(message, part + "_")
        else:
            raise KeyError(part)
    return message


@contextmanager
def _named(channel: Channel, kind: type[InputError], what: str) -> Iterator[None]:
    """Foreign schema parsers, code generators and decoders raise whatever they like on bytes that are not theirs."""
    try:
        yield
    except Exception as error:
        name = channel.schema_name or "no schema"
        raise kind(f"{channel.topic}: {what} ({name}, {channel.message_encoding}): {_reason(error)}") from error


def _reason(error: BaseException) -> str:
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= _MAX_REASON else text[: _MAX_REASON - 1] + "…"


def _schema(channel: Channel) -> Schema:
    return Schema(id=1, data=channel.schema_data, encoding=channel.schema_encoding, name=channel.schema_name)


def _protobuf_decoder(channel: Channel) -> Decoder:
    decode: Decoder | None = ProtobufDecoderFactory().decoder_for("protobuf", _schema(channel))
    if decode is None:
        raise ValueError(f"its schema is in {channel.schema_encoding!r}, not protobuf")
    return decode


def _cdr_decoder(channel: Channel) -> Decoder:
    """By rosbags, twice as fast as mcap_ros2; that one reads some definitions in ros2msg which rosbags refuses."""
    try:
        return _rosbags_cdr_decoder(channel)
    except TypeTooLarge:
        raise
    except Exception:  # the other one says what is wrong where it cannot either
        if channel.schema_encoding != "ros2msg":
            raise
        decode = _mcap_ros2_decoder(channel)

    def decode_plain(data: bytes) -> Any:
        # mcap_ros2 would read other encapsulations as if they were plain CDR: better no position than a wrong one.
        if data[:2] not in _PLAIN_CDR:
            raise ValueError(f"CDR encapsulation {data[:2].hex()} is not known")
        return decode(data)

    return decode_plain


def _unpacking(decode: Decoder) -> Decoder:
    """A decoder that also takes messages which rosbag2 has compressed one by one: no CDR begins as their frames do."""
    return lambda data: decode(unpack_message(data) if data.startswith(ZSTD_MAGIC) else data)


def cdr_types(channel: Channel) -> tuple[Typestore, str]:
    """The types that the schema of a CDR channel defines, and the name of the messages' own.

    Raises `UndecodableChannel` where the schema cannot be read.
    """
    channel = with_definition(channel)
    with _named(channel, UndecodableChannel, "cannot be decoded"):
        return ros2_types(channel.schema_name, channel.schema_encoding, channel.schema_data)


def _rosbags_cdr_decoder(channel: Channel) -> Decoder:
    store, name = ros2_types(channel.schema_name, channel.schema_encoding, channel.schema_data)
    return lambda data: store.deserialize_cdr(data, name)


def _ros1_decoder(channel: Channel) -> Decoder:
    store, name = ros1_types(channel.schema_name, channel.schema_data)
    return lambda data: store.deserialize_ros1(data, name)


def _mcap_ros2_decoder(channel: Channel) -> Decoder:
    text = _CHAR_FIELD.sub(r"\1uint8", channel.schema_data.decode("utf-8"))  # a char would be signed
    decode: Decoder | None = Ros2DecoderFactory().decoder_for("cdr", replace(_schema(channel), data=text.encode()))
    if decode is None:
        raise ValueError("no decoder for it")
    return decode
