"""Message paths → columns: the fields of many CDR messages at once, as `message_path` finds them in one decoded message.

Only paths of plain fields to numbers, texts and stamps are taken, and of alternatives those that do not depend on what a
message says; for all others, and for messages that are not sound, there is the way by decoded messages.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys.store import Typestore

from pipeline.arrays import Column
from pipeline.extract.stamps import stamp_ns
from pipeline.logs.cdr_fields import CdrFields
from pipeline.logs.channels import Batch, Channel
from pipeline.logs.decode import UndecodableChannel, cdr_types
from pipeline.mapping.message_path import Field, MessagePath

_Entry = tuple[Any, Any]

_INTEGERS: Final = frozenset(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))
_FLOATS: Final = frozenset({"float32", "float64"})
_MATRIX_SIZES: Final = (4, 6, 9, 36)
CONDITION: Final = "where"
"""Names of fields that conditions look at begin with this."""
_BASES: Final[Mapping[str, frozenset[str]]] = {
    "frame_id": frozenset({"string"}),
    "agent": _INTEGERS | {"string"},
    "sensor": _INTEGERS | {"string"},
}
"""What a field may be; those of conditions anything plain, all others are numbers."""


class FieldColumns:
    """Reads fields, each by the first of its alternative paths that the messages of `channel` have.

    `paths` are those of every field that is read, by name; `names` of those that are there.
    Raises `UndecodableChannel` where they cannot be read without decoding whole messages.
    """

    def __init__(self, channel: Channel, paths: Mapping[str, Sequence[MessagePath]]) -> None:
        if channel.message_encoding != "cdr":
            raise UndecodableChannel(f"{channel.topic}: is not CDR but {channel.message_encoding!r}")
        self.store, self.type_name = cdr_types(channel)
        self._readers: dict[str, tuple[tuple[str, ...], Callable[..., Column]]] = {}
        for name, alternatives in paths.items():
            found = [(path, entry) for path in alternatives if (entry := self._entry(path)) is not None]
            if len(found) > 1 and name in ("time", "frame_id"):
                raise UndecodableChannel(f"{channel.topic}: which {name} counts depends on the message")
            if found:
                self._readers[name] = self._reader(name, *found[0])
        self._fields = CdrFields(channel, [text for texts, _ in self._readers.values() for text in texts], is_whole=True)

    @property
    def names(self) -> frozenset[str]:
        """The fields that the messages have."""
        return frozenset(self._readers)

    def read(self, batch: Batch) -> dict[str, Column] | None:
        """The fields' columns [N], of covariances [N, 4, 6, 9 or 36]; None where a message is not sound.

        Numbers are float64 (integers stay), texts objects, times nanoseconds with 0 where a stamp is unset.
        """
        is_sound, columns = self._fields.columns(batch)
        if not is_sound.all():
            return None
        return {name: convert(*(columns[text] for text in texts)) for name, (texts, convert) in self._readers.items()}

    def _entry(self, path: MessagePath) -> _Entry | None:
        """Kind and detail of the field that a path leads to; None where messages have none."""
        entry: _Entry = (Nodetype.NAME, self.type_name)
        for step in path.steps:
            if not isinstance(step, Field) or entry[0] != Nodetype.NAME:
                raise UndecodableChannel(f"path {path.text!r} is not one of plain fields")
            kind, fields = self.store.types[entry[1]], _fields(self.store, entry[1])
            if step.name not in fields:
                if hasattr(kind, step.name) or hasattr(kind, step.name + "_"):  # a constant, or a name like a keyword
                    raise UndecodableChannel(f"path {path.text!r} does not lead to a field")
                return None
            entry = fields[step.name]
        return entry

    def _reader(self, name: str, path: MessagePath, entry: _Entry) -> tuple[tuple[str, ...], Callable[..., Column]]:
        """The paths to read for a field, and what makes its column of theirs."""
        text = ".".join(step.name for step in path.steps if isinstance(step, Field))
        kind, detail = entry
        if kind == Nodetype.NAME and name == "time":
            bases = {part: inner[1][0] for part, inner in _fields(self.store, detail).items() if inner[0] == Nodetype.BASE}
            if bases.get("sec") in ("int32", "uint32") and bases.get("nanosec") in ("int32", "uint32"):
                return (f"{text}.sec", f"{text}.nanosec"), _stamps
        elif kind == Nodetype.ARRAY and name == "covariance":
            if detail[0][0] == Nodetype.BASE and detail[0][1][0] in _FLOATS and detail[1] in _MATRIX_SIZES:
                return (text,), _numbers
        elif kind == Nodetype.BASE and name.startswith(CONDITION):
            return (text,), np.asarray
        elif kind == Nodetype.BASE and name != "covariance" and detail[0] in _BASES.get(name, _INTEGERS | _FLOATS):
            return (text,), _times if name == "time" else np.asarray if name in _BASES else _numbers
        raise UndecodableChannel(f"path {path.text!r} leads to no plain {name}")


def mapped(values: Iterable[Any], convert: Callable[[Any], Any]) -> list[Any]:
    """What `convert` makes of each of the values, most of which are alike."""
    values = list(values)
    made = {value: convert(value) for value in set(values)}
    return [made[value] for value in values]


def _fields(store: Typestore, name: str) -> dict[str, _Entry]:
    return dict(store.fielddefs[name][1])


def _numbers(column: Column) -> Column:
    with np.errstate(invalid="ignore"):  # signalling NaN
        return column.astype(np.float64)


def _stamps(seconds: Column, nanoseconds: Column) -> Column:
    return seconds.astype(np.int64) * 10**9 + nanoseconds.astype(np.int64)


def _times(column: Column) -> Column:
    return np.array([stamp_ns(value) or 0 for value in column.tolist()], dtype=np.int64)
