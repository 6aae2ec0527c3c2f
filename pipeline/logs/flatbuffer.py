"""Flatbuffer messages to fields, by the binary schema (`.bfbs`) that the log carries; no generated code is needed.

The schema is itself a flatbuffer, of the tables in `reflection.fbs`. Only the fields of those that are needed here are
read, by their ids. Nothing that a file states is believed: every offset is checked against the end of the bytes, and a
message whose tables refer to each other more often than it has bytes is refused (a few hundred bytes could else ask for
gigabytes). Tables and structs become dicts, enumerations integers with a name, vectors of numbers arrays; unions are left
out.
"""

import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

_BOOL, _STRING, _VECTOR, _TABLE, _UNION, _ARRAY = 2, 13, 14, 15, 16, 17
_SCALARS: Final[Mapping[int, str]] = {  # BaseType → struct format
    1: "<B", _BOOL: "<?", 3: "<b", 4: "<B", 5: "<h", 6: "<H", 7: "<i", 8: "<I", 9: "<q", 10: "<Q", 11: "<f", 12: "<d",
}  # fmt: skip
_IDENTIFIER: Final = b"BFBS"
_MAX_DEPTH = 64

Item = Callable[["Bytes", int], Any]
"""Reads one value at a position."""


class EnumNumber(int):
    """A number of an enumeration; `name` is empty where the schema does not know it."""

    name: str

    def __new__(cls, value: int, name: str) -> "EnumNumber":
        """The number, with its name."""
        number = super().__new__(cls, value)
        number.name = name
        return number


class Bytes:
    """The bytes of one message, read with checks; `ValueError` and `struct.error` where something lies outside them."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self._num_left = len(data) + 64
        self._depth = 0

    def scalar(self, form: str, position: int) -> Any:
        """The number of the struct format `form` at `position`."""
        if position < 0:  # Python would count from the end
            raise ValueError("an offset leads before the first byte")
        return struct.unpack_from(form, self.data, position)[0]

    def follow(self, position: int) -> int:
        """Where the offset at `position` leads to."""
        return position + int(self.scalar("<I", position))

    def string(self, position: int) -> str:
        """The text whose length stands at `position`."""
        start, size = position + 4, int(self.scalar("<I", position))
        if start + size > len(self.data):
            raise ValueError("a text ends behind the last byte")
        self.spend(1 + size // 8)
        return self.data[start : start + size].decode("utf-8")

    def length(self, position: int, item_size: int) -> int:
        """The number of items of `item_size` bytes of the vector at `position`."""
        num = int(self.scalar("<I", position))
        if item_size < 1 or position + 4 + num * item_size > len(self.data):
            raise ValueError("a vector ends behind the last byte")
        return num

    def field(self, table: int, slot: int) -> int | None:
        """Where the field lies whose place in the table's vtable is `slot` bytes after its start; None where it is absent."""
        vtable = table - int(self.scalar("<i", table))
        if slot + 2 > self.scalar("<H", vtable):
            return None
        offset = int(self.scalar("<H", vtable + slot))
        return table + offset if offset else None

    def spend(self, num: int) -> None:
        """Count `num` more values; `ValueError` where there are more than a sound message of this size can hold."""
        self._num_left -= num
        if self._num_left < 0:
            raise ValueError("tables refer to each other without end")

    def enter(self) -> None:
        """Count one more table or struct, inside the one that is being read."""
        self.spend(1)
        self._depth += 1
        if self._depth > _MAX_DEPTH:
            raise ValueError("tables lie in each other too deeply")

    def leave(self) -> None:
        """The table or struct is read."""
        self._depth -= 1


@dataclass(frozen=True)
class _Type:
    base: int = 0
    element: int = 0
    index: int = -1
    fixed_length: int = 0


@dataclass(frozen=True)
class _Field:
    name: str
    type: _Type
    slot: int  # in a table: the place in its vtable; in a struct: the offset
    default: Any


@dataclass(frozen=True)
class _Object:
    name: str
    fields: tuple[_Field, ...]
    is_struct: bool
    num_bytes: int


def flatbuffer_decoder(schema: bytes, root_name: str) -> Callable[[bytes], dict[str, Any]]:
    """A function from a message's bytes to its fields. `ValueError` or `struct.error` where the schema is none."""
    reflection = _Reflection(schema, root_name)

    def decode(data: bytes) -> dict[str, Any]:
        message = Bytes(data)
        found: dict[str, Any] = reflection.table(reflection.root)(message, message.follow(0))
        return found

    return decode


class _Reflection:
    """The objects and enumerations of a binary schema, and readers for them."""

    def __init__(self, schema: bytes, root_name: str) -> None:
        if schema[4:8] != _IDENTIFIER:
            raise ValueError("the schema is no binary flatbuffer schema (.bfbs)")
        data = Bytes(schema)
        table = data.follow(0)
        self._objects = [_object(data, at) for at in _tables(data, table, 4)]
        self._names = [_value_names(data, at) for at in _tables(data, table, 6)]
        by_name = {item.name: number for number, item in enumerate(self._objects)}
        if root_name not in by_name:
            raise ValueError(f"the schema does not define {root_name}")
        self.root = by_name[root_name]
        self._readers: dict[int, Item] = {}

    def table(self, number: int) -> Item:
        """The reader of a table or a struct; made once, when first asked for, because tables may hold themselves."""
        if number not in self._readers:
            item = self._objects[number]
            if item.is_struct:
                self._readers[number] = _struct_reader([(field, self._in_place(field)) for field in item.fields])
            else:
                self._readers[number] = _table_reader([(self._named(field), self._field(field)) for field in item.fields])
        return self._readers[number]

    def _named(self, field: _Field) -> _Field:
        """The field with a name for its default, where that is of an enumeration."""
        if field.type.base not in _SCALARS or field.default is None or not 0 <= field.type.index < len(self._names):
            return field
        return replace(field, default=EnumNumber(field.default, self._names[field.type.index].get(field.default, "")))

    def _later(self, number: int) -> Item:
        if not 0 <= number < len(self._objects):
            raise ValueError("the schema names a table that it does not define")
        return lambda data, position: self.table(number)(data, position)

    def _field(self, field: _Field) -> Item:
        kind = field.type
        if kind.base == _STRING:
            return lambda data, position: data.string(data.follow(position))
        if kind.base == _VECTOR:
            return self._vector(kind)
        if kind.base == _TABLE:
            inner = self._later(kind.index)
            if self._objects[kind.index].is_struct:
                return inner
            return lambda data, position: inner(data, data.follow(position))
        return self._in_place(field)

    def _in_place(self, field: _Field) -> Item:
        """What lies in place, without an offset to follow: numbers, structs, arrays of fixed length."""
        kind = field.type
        if kind.base in _SCALARS:
            return self._scalar(kind.base, kind.index)
        if kind.base == _TABLE:
            return self._later(kind.index)
        if kind.base == _ARRAY:
            size, item = self._item(kind)
            return lambda data, position: _items(data, position, kind.fixed_length, size, item)
        raise ValueError(f"field {field.name} is of a kind that is not known")

    def _scalar(self, base: int, index: int) -> Item:
        form = _SCALARS[base]
        if not 0 <= index < len(self._names):
            return lambda data, position: data.scalar(form, position)
        names = self._names[index]

        def number(data: Bytes, position: int) -> EnumNumber:
            value = data.scalar(form, position)
            return EnumNumber(value, names.get(value, ""))

        return number

    def _item(self, kind: _Type) -> tuple[int, Item]:
        """Size and reader of an item of a vector or an array."""
        if kind.element in _SCALARS:
            return struct.calcsize(_SCALARS[kind.element]), self._scalar(kind.element, kind.index)
        if kind.element == _STRING:
            return 4, lambda data, position: data.string(data.follow(position))
        if kind.element == _TABLE:
            inner = self._later(kind.index)
            if self._objects[kind.index].is_struct:
                return self._objects[kind.index].num_bytes, inner
            return 4, lambda data, position: inner(data, data.follow(position))
        raise ValueError("a vector holds items of a kind that is not known")

    def _vector(self, kind: _Type) -> Item:
        if kind.element in _SCALARS and not 0 <= kind.index < len(self._names):
            dtype = np.dtype(_SCALARS[kind.element])

            def numbers(data: Bytes, position: int) -> Any:
                start = data.follow(position)
                return np.frombuffer(data.data, dtype, data.length(start, dtype.itemsize), start + 4)

            return numbers
        size, item = self._item(kind)

        def items(data: Bytes, position: int) -> list[Any]:
            start = data.follow(position)
            return _items(data, start + 4, data.length(start, size), size, item)

        return items


def _items(data: Bytes, start: int, num: int, size: int, item: Item) -> list[Any]:
    data.spend(num)
    return [item(data, start + place * size) for place in range(num)]


def _struct_reader(readers: Sequence[tuple[_Field, Item]]) -> Item:
    def read_struct(data: Bytes, position: int) -> dict[str, Any]:
        data.enter()
        found = {field.name: read(data, position + field.slot) for field, read in readers}
        data.leave()
        return found

    return read_struct


def _table_reader(readers: Sequence[tuple[_Field, Item]]) -> Item:
    def read_table(data: Bytes, position: int) -> dict[str, Any]:
        data.enter()
        found = {}
        for field, read in readers:
            at = data.field(position, field.slot)
            found[field.name] = field.default if at is None else read(data, at)
        data.leave()
        return found

    return read_table


def _tables(data: Bytes, table: int, slot: int) -> list[int]:
    """The positions of the tables in the vector that is a field of a table; none where it is absent."""
    at = data.field(table, slot)
    if at is None:
        return []
    start = data.follow(at)
    return [data.follow(start + 4 + 4 * place) for place in range(data.length(start, 4))]


def _number(data: Bytes, table: int, slot: int, form: str, default: Any = 0) -> Any:
    at = data.field(table, slot)
    return default if at is None else data.scalar(form, at)


def _name(data: Bytes, table: int) -> str:
    at = data.field(table, 4)
    return "" if at is None else data.string(data.follow(at))


def _type(data: Bytes, table: int, slot: int) -> _Type:
    at = data.field(table, slot)
    if at is None:
        return _Type()
    kind = data.follow(at)
    return _Type(*(_number(data, kind, 4 + 2 * place, form, default) for place, (form, default) in enumerate(_TYPE_FIELDS)))


_TYPE_FIELDS: Final = (("<b", 0), ("<b", 0), ("<i", -1), ("<H", 0))


def _object(data: Bytes, table: int) -> _Object:
    fields = [_field(data, at) for at in _tables(data, table, 6)]
    return _Object(
        _name(data, table),
        tuple(field for field in fields if field.type.base != _UNION),
        bool(_number(data, table, 8, "<?", False)),
        _number(data, table, 12, "<i"),
    )


def _field(data: Bytes, table: int) -> _Field:
    kind = _type(data, table, 6)
    default: Any = None
    if kind.base == _STRING:
        default = ""
    elif kind.base == _VECTOR:
        default = ()
    elif kind.base in _SCALARS and not _number(data, table, 26, "<?", False):  # optional numbers have no default
        is_real = kind.base in (11, 12)
        default = _number(data, table, 14, "<d", 0.0) if is_real else _number(data, table, 12, "<q", 0)
        default = bool(default) if kind.base == _BOOL else default
    return _Field(_name(data, table), kind, _number(data, table, 10, "<H"), default)


def _value_names(data: Bytes, table: int) -> Mapping[int, str]:
    """Number → name of an enumeration."""
    return {_number(data, at, 6, "<q"): _name(data, at) for at in _tables(data, table, 6)}
