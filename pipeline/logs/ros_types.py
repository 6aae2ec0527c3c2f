"""Types of ROS 1 and ROS 2, by the definitions that a log carries, as a store of rosbags."""

import functools
import re
from typing import Any, Final

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import Typesdict
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from pipeline.logs.idl import types_from_idl

_IDENTIFIER: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
_CDR_OCTETS: Final = {"byte": "uint8", "char": "uint8", "wchar": "uint16"}
"""Types of ROS 2 that are unsigned integers on the wire. (In ROS 1 a byte is signed, and a char is not.)"""
_MAX_MEMBERS: Final = 100_000
_MAX_STORES: Final = 64
_STAMPS: Final = {
    "builtin_interfaces/msg/Time": "int32 sec\nuint32 nanosec\n",
    "builtin_interfaces/msg/Duration": "int32 sec\nuint32 nanosec\n",
}


class TypeTooLarge(ValueError):
    """A type that holds itself, or has more members than any message that people record."""


@functools.lru_cache(maxsize=_MAX_STORES)
def ros2_types(schema_name: str, schema_encoding: str, schema_data: bytes) -> tuple[Typestore, str]:
    """The types of a schema for CDR, and the name of its own: read once, which takes longer than a thousand messages."""
    text = schema_data.decode("utf-8")
    if schema_encoding == "ros2idl":
        types = types_from_idl(text)
    elif schema_encoding == "ros2msg":
        types = get_types_from_msg(text, schema_name)
    else:
        raise ValueError(f"schema encoding {schema_encoding!r} is not known for CDR")
    return _store(_with_octets(types), schema_name)


def ros1_types(schema_name: str, schema_data: bytes) -> tuple[Typestore, str]:
    """The types of a schema of ROS 1, and the name of its own."""
    return _store(get_types_from_msg(schema_data.decode("utf-8"), schema_name), schema_name)


def _with_octets(types: Typesdict) -> Typesdict:
    """The types with integers for what is an octet or a wide character; rosbags takes a byte for signed."""

    def plain(described: Any) -> Any:
        kind, detail = described
        if kind == Nodetype.BASE:
            return kind, (_CDR_OCTETS.get(detail[0], detail[0]), detail[1])
        return described if kind == Nodetype.NAME else (kind, (plain(detail[0]), detail[1]))

    return {
        name: (constants, [(member, plain(described)) for member, described in members])
        for name, (constants, members) in types.items()
    }


def _store(types: Typesdict, schema_name: str) -> tuple[Typestore, str]:
    """A type store of these types alone, since definitions of one name differ from channel to channel; the name in it."""
    for name, (constants, fields) in types.items():
        for word in (name, *(item[0] for item in constants), *(item[0] for item in fields)):
            # Registering types runs generated code: nothing but identifiers from a log may get into it.
            if not _IDENTIFIER.fullmatch(word):
                raise ValueError(f"{word!r} is not a name")
    store = get_typestore(Stores.EMPTY)
    store.register(types)
    for name, text in _STAMPS.items():
        if name not in store.fielddefs:
            store.register(get_types_from_msg(text, name))
    return store, _type_name(store, schema_name)


def _type_name(store: Typestore, schema_name: str) -> str:
    """The name of the type in the store: "pkg/msg/Type" for "pkg/msg/Type", "pkg/Type" and "pkg::msg::Type"."""
    parts = schema_name.replace("::", "/").split("/")
    for name in ("/".join(parts), f"{parts[0]}/msg/{parts[-1]}"):
        if name in store.fielddefs:
            if _num_members(store, name, {}) > _MAX_MEMBERS:
                raise TypeTooLarge(f"its type has more than {_MAX_MEMBERS} members")
            store.get_msgdef(name)  # now, so that a type that cannot be compiled makes the channel undecodable
            return name
    raise ValueError(f"the schema does not define {schema_name}")


def _num_members(store: Typestore, name: str, known: dict[str, int]) -> int:
    """How many members a message of the type has, one item in each list that may be empty. `known` keeps answers."""
    if name in known:
        if known[name] < 0:
            raise TypeTooLarge(f"its type {name} holds itself")
        return known[name]
    if name not in store.fielddefs:
        raise ValueError(f"the schema does not define {name}")
    known[name] = -1
    known[name] = sum(_num_in(store, described, known) for _, described in store.fielddefs[name][1])
    return known[name]


def _num_in(store: Typestore, described: Any, known: dict[str, int]) -> int:
    kind, detail = described
    if kind == Nodetype.NAME:
        return _num_members(store, detail, known)
    if kind == Nodetype.BASE or detail[0][0] == Nodetype.BASE:
        return 1
    num_inner = _num_members(store, detail[0][1], known)
    return num_inner * int(detail[1]) if kind == Nodetype.ARRAY else num_inner
