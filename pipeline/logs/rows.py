"""Where the messages of a block lie, as arrays: found by the message indexes of a chunk, or by a walk over its records.

An index is believed only where it accounts for every byte: its messages must be where it says, with its channels and
times, and between them there may be no other message. Then no record has to be walked one by one.
"""

from collections.abc import Sequence, Set
from dataclasses import dataclass, fields
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt
from mcap.opcode import Opcode

from cadence.arrays import Int64s
from pipeline.logs.records import HEAD, INDEX_ENTRY, MAX_TIME_NS, MESSAGE, MESSAGE_HEAD, DamagedRecord, walk

Index = Sequence[tuple[int, npt.NDArray[np.void]]]
"""Channel ids and entries, as `parse_message_index` gives them."""
Definitions = list[tuple[int, bytes]]
"""Opcode and body of the channels and schemas in a chunk, in its order."""
_MESSAGE: Final = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel_id", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
    ]
)
_INDEX_HEAD_BYTES: Final = 6  # channel id and length of the entries
assert _MESSAGE.itemsize == HEAD.size + MESSAGE_HEAD.size
_OPAQUE: Final = np.dtype((np.void, _MESSAGE.itemsize))
"""The same bytes without fields: numpy gathers these ten times as fast."""


@dataclass(frozen=True, eq=False)
class Rows:
    """N messages of one block; begin and end are those of their data in the block's unpacked bytes.

    Times are uint64 nanoseconds, as the file has them; those after `MAX_TIME_NS` are for `usable` to leave out.
    """

    channel_id: npt.NDArray[np.uint16]
    sequence: npt.NDArray[np.uint32]
    log_time_ns: npt.NDArray[np.uint64]
    publish_time_ns: npt.NDArray[np.uint64]
    begin: Int64s
    end: Int64s

    def __post_init__(self) -> None:
        columns = (self.channel_id, self.sequence, self.log_time_ns, self.publish_time_ns, self.end)
        if self.begin.ndim != 1 or any(column.shape != self.begin.shape for column in columns):
            raise ValueError("the columns of rows must have one length")

    def __len__(self) -> int:
        return len(self.begin)

    def __getitem__(self, rows: Any) -> Self:
        """The rows of a mask, of indices or of a slice."""
        return type(self)(
            self.channel_id[rows], self.sequence[rows], self.log_time_ns[rows], self.publish_time_ns[rows],
            self.begin[rows], self.end[rows],
        )  # fmt: skip

    @classmethod
    def concatenate(cls, parts: Sequence["Rows"]) -> "Rows":
        """All rows of `parts`, in order."""
        return cls(*(np.concatenate([getattr(part, item.name) for part in parts]) for item in fields(cls)))

    def counts(self) -> dict[int, int]:
        """The number of rows by channel id."""
        counts = np.bincount(self.channel_id)
        ids = np.flatnonzero(counts)
        return dict(zip(ids.tolist(), counts[ids].tolist(), strict=True))

    def span_ns(self) -> tuple[int, int]:
        """The first and the last log time; (2**64, -1) without rows."""
        return (int(self.log_time_ns.min()), int(self.log_time_ns.max())) if len(self) else (2**64, -1)

    def usable(self) -> "Rows":
        """The rows whose log times fit into int64."""
        mask = self.log_time_ns <= MAX_TIME_NS
        return self if mask.all() else self[mask]

    def by_time(self) -> "Rows":
        """The rows, which are in the order of the block, by log time and then in that order."""
        is_sorted = (self.log_time_ns[1:] >= self.log_time_ns[:-1]).all()
        return self if is_sorted else self[np.argsort(self.log_time_ns, kind="stable")]


def rows_by_walk(data: bytes, is_cut: bool = False) -> tuple[Rows, Definitions]:
    """Messages and definitions in the unpacked bytes of a block; raises `DamagedRecord` as `walk` does."""
    offsets, definitions = _walked(data, is_cut)
    return rows_at(data, np.array(offsets, dtype=np.int64)), definitions


def leading_rows(data: bytes) -> tuple[Rows, int]:
    """The whole messages that follow each other at the beginning of `data`, and how many bytes they take."""
    offsets, length = [], 0
    for opcode, begin, end in walk(data, is_cut=True):
        if opcode != MESSAGE:
            break
        offsets.append(begin - HEAD.size)
        length = end
    return rows_at(data, np.array(offsets, dtype=np.int64)), length


def rows_by_index(data: bytes, index: Index) -> tuple[Rows, Definitions] | None:
    """The same as `rows_by_walk`, by the message indexes of the chunk; None where they do not agree with its content."""
    begin, ids, times, num_outside = _named(data, index)
    heads = _heads(data, begin)
    if not len(begin) or num_outside or not _are_there(heads, ids, times, len(data)).all():
        return None
    end = begin + HEAD.size + heads["length"].astype(np.int64)
    definitions = _between(data, np.append(0, end), np.append(begin, len(data)))
    return None if definitions is None else (_rows_of(heads, begin, end), definitions)


def rows_in_torn(data: bytes, index: Index) -> tuple[Rows, Definitions]:
    """The messages of a chunk that is broken and that no checksum covers: those which its index names and which are there.

    In front of a damaged place one message more is left out, because its end may be damaged as well. Without an index those
    in front of the first damaged place are found. Definitions are those beside such messages.
    """
    if not index:
        offsets, definitions = _walked(data, is_cut=True)
        return rows_at(data, np.array(offsets[:-1], dtype=np.int64)), definitions
    begin, ids, times, _ = _named(data, index)
    heads = _heads(data, begin)
    end = begin + HEAD.size + np.minimum(heads["length"], len(data)).astype(np.int64)
    following = np.append(begin, len(data))[1:]
    is_there = _are_there(heads, ids, times, len(data)) & (end <= following)
    gaps = [_between(data, begin=end[i : i + 1], end=following[i : i + 1]) for i in range(len(begin))]
    is_followed = np.append(is_there, True)[1:] & np.array([gap is not None for gap in gaps], np.bool_)
    is_sound = is_there & is_followed
    in_front = _between(data, np.zeros(1, np.int64), np.append(begin, len(data))[:1]) if is_sound[:1].all() else None
    definitions = [item for gap, is_beside in zip(gaps, is_sound, strict=True) if is_beside for item in gap or ()]
    return _rows_of(heads[is_sound], begin[is_sound], end[is_sound]), [*(in_front or ()), *definitions]


def indexed_rows(data: bytes, index: bytes, channel_ids: Set[int]) -> Rows:
    """The messages of some channels in a chunk, by the bytes of its message indexes, which were found to agree with it."""
    named = [
        index[begin + _INDEX_HEAD_BYTES : end]
        for _, begin, end in walk(index)
        if int.from_bytes(index[begin : begin + 2], "little") in channel_ids
    ]
    offsets = np.sort(np.frombuffer(b"".join(named), INDEX_ENTRY)["offset"].astype(np.int64))
    if len(offsets) and not 0 <= offsets[0] <= offsets[-1] <= len(data) - _MESSAGE.itemsize:
        raise DamagedRecord("a message index points outside its chunk")
    rows = rows_at(data, offsets)
    if not ((rows.end <= len(data)) & (rows.end >= rows.begin)).all() or not channel_ids >= rows.counts().keys():
        raise DamagedRecord("a message index differs from its chunk")
    return rows


def agrees(rows: Rows, channel_id: int, entries: npt.NDArray[np.void]) -> bool:
    """Whether a message index (`INDEX_ENTRY`) names the messages of its channel in a chunk, in any order."""
    own = rows[rows.channel_id == channel_id]
    found = np.empty(len(own), INDEX_ENTRY)
    found["log_time"], found["offset"] = own.log_time_ns, own.begin - _MESSAGE.itemsize
    return np.array_equal(np.sort(found), np.sort(entries))


def _named(data: bytes, index: Index) -> tuple[Int64s, npt.NDArray[np.int64], npt.NDArray[np.uint64], int]:
    """Where the messages that an index names should begin, in order, their channels and times; and how many lie outside."""
    offsets = np.concatenate([np.empty(0, np.uint64), *(entries["offset"] for _, entries in index)])
    times = np.concatenate([np.empty(0, np.uint64), *(entries["log_time"] for _, entries in index)])
    ids = np.repeat([number for number, _ in index], [len(entries) for _, entries in index]).astype(np.int64)
    last = len(data) - _MESSAGE.itemsize
    inside = np.flatnonzero(offsets <= np.uint64(max(0, last))) if last >= 0 else np.empty(0, np.int64)
    order = inside[np.argsort(offsets[inside], kind="stable")]
    return offsets[order].astype(np.int64), ids[order], times[order], len(offsets) - len(order)


def _are_there(
    heads: npt.NDArray[np.void], ids: npt.NDArray[np.int64], times: npt.NDArray[np.uint64], size: int
) -> npt.NDArray[np.bool_]:
    """Which of the heads are those of the messages of these channels and times in `size` bytes."""
    is_message = (heads["opcode"] == Opcode.MESSAGE) & (heads["length"] >= MESSAGE_HEAD.size) & (heads["length"] <= size)
    are_there: npt.NDArray[np.bool_] = is_message & (heads["log_time"] == times) & (heads["channel_id"] == ids)
    return are_there


def _walked(data: bytes, is_cut: bool) -> tuple[list[int], Definitions]:
    offsets, definitions = [], []
    for opcode, begin, end in walk(data, is_cut):
        if opcode == MESSAGE:
            offsets.append(begin - HEAD.size)
        elif opcode in (Opcode.CHANNEL, Opcode.SCHEMA):
            definitions.append((opcode, data[begin:end]))
    return offsets, definitions


def _between(data: bytes, begin: Int64s, end: Int64s) -> Definitions | None:
    """Definitions in the stretches between messages; None where messages overlap or one is not in the index."""
    if (begin > end).any():
        return None
    definitions = []
    for place in np.flatnonzero(begin < end).tolist():
        try:
            offsets, found = _walked(data[begin[place] : end[place]], is_cut=False)
        except DamagedRecord:
            return None
        if offsets:
            return None
        definitions += found
    return definitions


def rows_at(data: bytes, offsets: Int64s) -> Rows:
    """The messages whose records begin at `offsets`; only their heads are looked at."""
    heads = _heads(data, offsets)
    return _rows_of(heads, offsets, offsets + HEAD.size + heads["length"].astype(np.int64))


def _rows_of(heads: npt.NDArray[np.void], begin: Int64s, end: Int64s) -> Rows:
    ids, sequence, log_time, publish_time = (
        np.ascontiguousarray(heads[name]) for name in ("channel_id", "sequence", "log_time", "publish_time")
    )
    return Rows(ids, sequence, log_time, publish_time, begin + _MESSAGE.itemsize, end)


def _heads(data: bytes, offsets: Int64s) -> npt.NDArray[np.void]:
    """The heads of the messages at these offsets, `_MESSAGE`."""
    everywhere: npt.NDArray[np.void] = np.ndarray((max(0, len(data) - _MESSAGE.itemsize + 1),), _OPAQUE, data, strides=(1,))
    return everywhere[offsets].view(_MESSAGE)
