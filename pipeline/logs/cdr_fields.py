"""Single fields of many CDR messages at once: the schema is walked once, all messages of a batch step by step with it.

Positions, stamps and covariances lie behind strings of varying length at most. Their places are computed as arrays, so that
no message is decoded as a whole. What the walk cannot pass (lists of structures, optional members) is left to `decode`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys.store import Typestore

from cadence.arrays import Bools, Int64s
from pipeline.arrays import Column
from pipeline.logs.channels import Batch, Channel
from pipeline.logs.decode import UndecodableChannel, cdr_types

_LITTLE_ENDIAN: Final = (0, 1)
_HEAD_BYTES: Final = 4
_ALIGNMENT: Final = 4
_DTYPES: Final = {
    "bool": "u1", "byte": "u1", "char": "u1", "octet": "u1", "int8": "i1", "uint8": "u1", "int16": "<i2", "uint16": "<u2",
    "int32": "<i4", "uint32": "<u4", "int64": "<i8", "uint64": "<u8", "float32": "<f4", "float64": "<f8",
}  # fmt: skip
_MAX_DEPTH: Final = 32


@dataclass(frozen=True)
class _Member:
    """One member on the way: a number, `count` numbers, a string (dtype empty) or a list of numbers (count None)."""

    path: str
    dtype: str
    count: int | None = 1


class CdrFields:
    """Reads the fields at dotted `paths` from batches of `channel`: numbers, arrays of numbers of fixed length, strings.

    With `is_whole` messages are walked to their ends, so that only those are read which `decode` accepts as a whole.
    Raises `UndecodableChannel` where that cannot be done without decoding whole messages.
    """

    def __init__(self, channel: Channel, paths: Sequence[str], is_whole: bool = False) -> None:
        if channel.message_encoding != "cdr":
            raise UndecodableChannel(f"{channel.topic}: is not CDR but {channel.message_encoding!r}")
        self.paths = tuple(paths)
        self.is_whole = is_whole
        self.members = _way(channel, set(paths), is_whole)

    def columns(self, batch: Batch) -> tuple[Bools, dict[str, Column]]:
        """Which of the N messages could be read, and the columns [N] or [N, count] by path (strings as objects).

        Messages that are too short, in another byte order, or with strings that are none on the way are not read; their
        cells mean nothing.
        """
        walker = _Walker(batch)
        columns = {}
        for member in self.members:
            if member.path in self.paths:
                columns[member.path] = walker.take(member)
            else:
                walker.skip(member)
        if self.is_whole:
            walker.finish()
        return walker.is_sound, columns


class _Walker:
    """Stands at one member in all messages of a batch. Places that leave their message are no longer sound, and stay."""

    def __init__(self, batch: Batch) -> None:
        self.data, self.end = batch.data, batch.end
        self.origin: Int64s = batch.begin + _HEAD_BYTES  # alignment counts from behind the encapsulation
        self.place: Int64s = self.origin
        self.is_sound = self.origin <= self.end
        head = self._gather("V4", np.where(self.is_sound, batch.begin, 0)).view("u1").reshape(-1, _HEAD_BYTES)
        self.is_sound = self.is_sound & (head[:, 0] == _LITTLE_ENDIAN[0]) & (head[:, 1] == _LITTLE_ENDIAN[1])

    def take(self, member: _Member) -> Column:
        """The member's column; stands behind it afterwards."""
        if not member.dtype:
            return self._texts()
        dtype = np.dtype(member.dtype)
        begin = self._advance(dtype.itemsize, dtype.itemsize * (member.count or 0))
        values = self._gather(f"V{dtype.itemsize * (member.count or 0)}", begin).view(dtype)
        return values if member.count == 1 else values.reshape(-1, member.count or 0)

    def skip(self, member: _Member) -> None:
        """Stand behind the member."""
        if not member.dtype:
            self._texts()
            return
        size = np.dtype(member.dtype).itemsize
        if member.count is not None:
            self._advance(size, size * member.count)
            return
        length = self._length()
        begin = np.where(length > 0, self._aligned(size), self.place)  # an empty list has no padding
        self._move(begin, begin + length * size)

    def finish(self) -> None:
        """Behind the last member there may be padding, but no more."""
        self.is_sound = self.is_sound & (self.end - self.place < _ALIGNMENT)

    def _texts(self) -> Column:
        length = self._length()
        begin = self._move(self.place, self.place + length)
        spans = zip(begin.tolist(), np.where(self.is_sound, begin + length, 0).tolist(), strict=True)
        pieces = [self.data[start:end] for start, end in spans]
        texts = {piece: _text(piece) for piece in set(pieces)}  # most of them are alike
        values = np.array([texts[piece] for piece in pieces], dtype=object)
        self.is_sound = self.is_sound & (values != None)  # noqa: E711 - by element
        return values

    def _length(self) -> Int64s:
        begin = self._advance(4, 4)
        return self._gather("<u4", begin).astype(np.int64)

    def _advance(self, alignment: int, size: int) -> Int64s:
        begin = self._aligned(alignment)
        return self._move(begin, begin + size)

    def _aligned(self, alignment: int) -> Int64s:
        return self.origin + (self.place - self.origin + alignment - 1) // alignment * alignment

    def _move(self, begin: Int64s, end: Int64s) -> Int64s:
        """Go to `end` where that is inside the message; `begin`, or 0 where it is not."""
        self.is_sound = self.is_sound & (end <= self.end)
        self.place = np.where(self.is_sound, end, self.origin)
        return np.where(self.is_sound, begin, 0)

    def _gather(self, dtype: str, begin: Int64s) -> Column:
        """What lies at the places, read through a view of the data with a stride of one byte."""
        kind = np.dtype(dtype)
        num_places = len(self.data) - kind.itemsize + 1
        if num_places <= 0:
            return np.zeros(len(begin), kind)
        view: Column = np.ndarray((num_places,), kind, self.data, strides=(1,))
        return view[np.where(self.is_sound, begin, 0)]


def _text(piece: bytes) -> str | None:
    """A string with its zero at the end; None where it is none."""
    try:
        return piece[:-1].decode() if piece[-1:] == b"\0" else None
    except UnicodeDecodeError:
        return None


def _way(channel: Channel, wanted: set[str], is_whole: bool) -> tuple[_Member, ...]:
    """The members from the beginning of a message to the last that is wanted, or to its end."""
    store, name = cdr_types(channel)
    way: list[_Member] = []
    missing = set(wanted)
    for member in _members(store, name, "", 0):
        if not missing and not is_whole:
            break
        if member is None:
            what = sorted(missing)[0] if missing else "the end"
            raise UndecodableChannel(f"{channel.topic}: {what} lies behind a list of structures")
        if member.path in missing and member.count is None:
            raise UndecodableChannel(f"{channel.topic}: {member.path} is a list of varying length")
        missing.discard(member.path)
        way.append(member)
    if missing:
        raise UndecodableChannel(f"{channel.topic}: {channel.schema_name} has no number or text {sorted(missing)[0]}")
    return tuple(way)


def _members(store: Typestore, name: str, prefix: str, depth: int) -> Iterator[_Member | None]:
    """The members of a type in order, structures resolved; None for one that cannot be passed."""
    for field, (kind, detail) in store.fielddefs[name][1]:
        path = f"{prefix}{field}"
        if kind == Nodetype.NAME and depth < _MAX_DEPTH:
            yield from _members(store, str(detail), f"{path}.", depth + 1)
        elif kind == Nodetype.BASE:
            yield _plain(path, str(detail[0]), 1)
        elif kind in (Nodetype.ARRAY, Nodetype.SEQUENCE) and detail[0][0] == Nodetype.BASE and detail[0][1][0] != "string":
            yield _plain(path, str(detail[0][1][0]), int(detail[1]) if kind == Nodetype.ARRAY else None)
        else:
            yield None


def _plain(path: str, base: str, count: int | None) -> _Member | None:
    if base == "string":
        return _Member(path, "")
    return _Member(path, _DTYPES[base], count) if base in _DTYPES and count != 0 else None
