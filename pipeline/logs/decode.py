"""Message bytes to fields, by the schema that the log itself carries.

Decoded messages are plain trees: dataclasses (CDR, ROS 1), protobuf messages or dicts (JSON, flatbuffer), lists or numpy
arrays for repeated fields. `field` reads both kinds.
"""

import functools
import itertools
import json
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Final

from mcap.records import Schema
from mcap_protobuf.decoder import DecoderFactory as ProtobufDecoderFactory
from mcap_ros2.decoder import DecoderFactory as Ros2DecoderFactory
from rosbags.interfaces.typing import Typesdict
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from cadence.errors import InputError
from pipeline.logs.flatbuffer import flatbuffer_decoder
from pipeline.logs.reader import Channel

Decoder = Callable[[bytes], Any]

_IDENTIFIER: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
_TEXT = r'"(?:[^"\\]|\\.)*"'
_COMMENT_OR_TEXT: Final = re.compile(rf"{_TEXT}|/\*.*?\*/|//[^\n]*", re.DOTALL)
_ANNOTATION: Final = re.compile(rf'@\w+\s*\((?:[^()"]|{_TEXT})*\)')
_PLAIN_CDR: Final = (b"\x00\x00", b"\x00\x01")
_MAX_REASON = 160
_MAX_STORES: Final = 64
_STAMPS: Final = {
    "builtin_interfaces/msg/Time": "int32 sec\nuint32 nanosec\n",
    "builtin_interfaces/msg/Duration": "int32 sec\nuint32 nanosec\n",
}


class UndecodableChannel(InputError):
    """No message of the channel can be decoded: unknown encoding, or a schema that is absent or cannot be read."""


class UndecodableMessage(InputError):
    """The bytes of one message do not fit the schema of its channel."""


def decoder_for(channel: Channel) -> Decoder:
    """A function from the bytes of a message of `channel` to its fields.

    Raises `UndecodableChannel` where there is none; the function raises `UndecodableMessage` on bytes that do not fit.
    """
    encoding = channel.message_encoding
    with _named(channel, UndecodableChannel, "cannot be decoded"):
        if encoding == "json":
            decode: Decoder = json.loads
        elif not channel.schema_data:
            raise ValueError(f"encoding {encoding!r} needs a schema, and the log has none for it")
        elif encoding == "protobuf":
            decode = _protobuf_decoder(channel)
        elif encoding == "cdr":
            decode = _cdr_decoder(channel)
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
    """By rosbags, twice as fast as mcap_ros2; that one reads some schemas which rosbags refuses."""
    try:
        return _rosbags_cdr_decoder(channel)
    except Exception:  # the other one says what is wrong where it cannot either
        decode = _mcap_ros2_decoder(channel)

    def decode_plain(data: bytes) -> Any:
        # mcap_ros2 would read other encapsulations as if they were plain CDR: better no position than a wrong one.
        if data[:2] not in _PLAIN_CDR:
            raise ValueError(f"CDR encapsulation {data[:2].hex()} is not known")
        return decode(data)

    return decode_plain


def cdr_types(channel: Channel) -> tuple[Typestore, str]:
    """The types that the schema of a CDR channel defines, and the name of the messages' own.

    Raises `UndecodableChannel` where the schema cannot be read.
    """
    with _named(channel, UndecodableChannel, "cannot be decoded"):
        return _cdr_types(channel.schema_name, channel.schema_encoding, channel.schema_data)


def _rosbags_cdr_decoder(channel: Channel) -> Decoder:
    store, name = _cdr_types(channel.schema_name, channel.schema_encoding, channel.schema_data)
    return lambda data: store.deserialize_cdr(data, name)


@functools.lru_cache(maxsize=_MAX_STORES)
def _cdr_types(schema_name: str, schema_encoding: str, schema_data: bytes) -> tuple[Typestore, str]:
    """A schema takes longer to read than a thousand messages, and is asked for more than once."""
    text = schema_data.decode("utf-8")
    if schema_encoding == "ros2idl":
        types = get_types_from_idl(_plain_idl(text))
    elif schema_encoding == "ros2msg":
        types = get_types_from_msg(text, schema_name)
    else:
        raise ValueError(f"schema encoding {schema_encoding!r} is not known for CDR")
    store = _store(types, Stores.EMPTY)
    return store, _type_name(store, schema_name)


def _ros1_decoder(channel: Channel) -> Decoder:
    store = _store(get_types_from_msg(channel.schema_data.decode("utf-8"), channel.schema_name), Stores.EMPTY)
    name = _type_name(store, channel.schema_name)
    return lambda data: store.deserialize_ros1(data, name)


def _mcap_ros2_decoder(channel: Channel) -> Decoder:
    decode: Decoder | None = Ros2DecoderFactory().decoder_for("cdr", _schema(channel))
    if decode is None:
        raise ValueError(f"schema encoding {channel.schema_encoding!r} is not known for CDR")
    return decode


def _store(types: Typesdict, base: Stores) -> Typestore:
    """A type store of these types alone: definitions of the same name may differ from channel to channel."""
    for name, (constants, fields) in types.items():
        for word in (name, *(item[0] for item in constants), *(item[0] for item in fields)):
            # Registering types runs generated code: nothing but identifiers from a log may get into it.
            if not _IDENTIFIER.fullmatch(word):
                raise ValueError(f"{word!r} is not a name")
    store = get_typestore(base)
    store.register(types)
    for name, text in _STAMPS.items():
        if name not in store.fielddefs:
            store.register(get_types_from_msg(text, name))
    return store


def _type_name(store: Typestore, schema_name: str) -> str:
    """The name of the type in the store: "pkg/msg/Type" for "pkg/msg/Type", "pkg/Type" and "pkg::msg::Type"."""
    parts = schema_name.replace("::", "/").split("/")
    for name in ("/".join(parts), f"{parts[0]}/msg/{parts[-1]}"):
        if name in store.fielddefs:
            store.get_msgdef(name)  # now, so that a type that cannot be compiled makes the channel undecodable
            return name
    raise ValueError(f"the schema does not define {schema_name}")


def _plain_idl(text: str) -> str:
    """IDL of several files in one schema, with the definitions alone.

    Between the files stand === and IDL: name, in them #include. Comments and annotations with arguments (@verbatim, which
    holds comments, and @default, @range, @unit) say nothing about the bytes and cost the parser most of its time.
    """
    is_definition = (not line.startswith(("IDL: ", "#")) and set(line) != {"="} for line in text.splitlines())
    definitions = "\n".join(itertools.compress(text.splitlines(), is_definition))
    uncommented = _COMMENT_OR_TEXT.sub(lambda found: found[0] if found[0].startswith('"') else " ", definitions)
    return _ANNOTATION.sub(" ", uncommented)
