"""Messages of one or several files in log-time order, from planned blocks, in bounded memory.

Blocks are taken by their first time. What lies before the first time of the next block is given out; the rest waits as
arrays of places. Where many blocks overlap, their bytes are not all held but read again, a stretch of time after another.
"""

import contextlib
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, groupby
from pathlib import Path
from typing import BinaryIO, Final, Literal

import numpy as np

from cadence.arrays import Int64s
from cadence.errors import InputError
from pipeline.logs.channels import Batch, Channel, RawMessage, batches_of, raw_messages
from pipeline.logs.packed import unpacked
from pipeline.logs.plan import Block
from pipeline.logs.records import (
    MAX_TIME_NS,
    DamagedRecord,
    parse_chunk,
    parse_message_index,
    unpack_chunk,
    unpack_cut_chunk,
    walk,
)
from pipeline.logs.rows import Rows, indexed_rows, rows_by_walk, rows_in_torn

BACK_NS: Final = 10**9
"""Recorders that write what comes from several places are out of order by less."""
MAX_HELD_BYTES: Final = 2**27
"""So many bytes of unpacked blocks, and of messages that wait for each other, are held where blocks overlap."""


@dataclass(frozen=True)
class Selection:
    """What is wanted: channels, by the ids that each file uses, and log times from start_ns up to, not including, end_ns."""

    channels: Sequence[Mapping[int, Channel]]
    start_ns: int = 0
    end_ns: int = MAX_TIME_NS + 1


@dataclass(frozen=True)
class Source:
    """One recording of a mission, as it was planned: a file, or a part of one that holds several.

    size_bytes  of its part of the file
    channels    those of the mission by the ids that the recording uses
    """

    path: Path
    size_bytes: int
    blocks: tuple[Block, ...]
    channels: Mapping[int, Channel]
    metadata_spans: tuple[tuple[int, int], ...]


@dataclass(frozen=True, eq=False)
class _Piece:
    """Messages of one block, by time. `key` is the place of the block: number of the source, offset in its file."""

    key: tuple[int, int]
    block: Block
    rows: Rows

    def split(self, bound: tuple[float, int, int]) -> tuple["_Piece", "_Piece | None"]:
        """The rows before and, if any, after the beginning of another block (time, source, offset)."""
        if bound[0] == math.inf:
            place = len(self.rows)
        else:
            side: Literal["left", "right"] = "right" if self.key < bound[1:] else "left"
            place = int(np.searchsorted(self.rows.log_time_ns, np.uint64(bound[0]), side))
        if place == len(self.rows):
            return self, None
        return _Piece(self.key, self.block, self.rows[:place]), _Piece(self.key, self.block, self.rows[place:])


class Timeline:
    """One pass over the selected messages of `sources`."""

    def __init__(
        self,
        sources: Sequence[Source],
        selection: Selection,
        on_bytes: Callable[[int], object] | None,
        on_back: Callable[[], object] | None = None,
    ) -> None:
        self.sources, self.selection, self.on_bytes, self.on_back = sources, selection, on_bytes, on_back
        self.held: dict[tuple[int, int], bytes] = {}  # unpacked blocks, the one used last at the end
        places = [(block.start_ns, number, block.offset, block) for number, part in enumerate(sources) for block in part.blocks]
        self.places = sorted(places, key=lambda place: place[:3])

    def messages(self) -> Iterator[RawMessage]:
        """All messages by log time; those of one time in the order of the sources and of the file.

        `on_back` is called where they were not written by time: where one lies over `BACK_NS` before what was written earlier.
        """
        self._tell_back()
        return chain.from_iterable(self._stretches())

    def written(self) -> tuple[Int64s, Int64s]:
        """Channel [N] and log time [N] of the messages in the order in which they were written."""
        found = []
        for number, block, loaded in self._blocks():
            if loaded is not None:
                rows = loaded[1][np.argsort(loaded[1].begin, kind="stable")]
                ids = {own: channel.id for own, channel in self.sources[number].channels.items()}
                channel = np.fromiter(map(ids.__getitem__, rows.channel_id.tolist()), np.int64, len(rows))
                found.append(((number, block.offset), channel, rows.log_time_ns.astype(np.int64)))
        found.sort(key=lambda part: part[0])
        none = np.zeros(0, np.int64)
        return np.concatenate([none, *(part[1] for part in found)]), np.concatenate([none, *(part[2] for part in found)])

    def _tell_back(self) -> None:
        """Whether blocks overlap, as the files have them."""
        blocks = [block for number, part in enumerate(self.sources) for block in part.blocks if self._is_wanted(number, block)]
        if self.on_back is not None and any(
            later.start_ns < earlier.end_ns - BACK_NS for earlier, later in itertools.pairwise(blocks)
        ):
            self.on_back()

    def _stretches(self) -> Iterator[Iterable[RawMessage]]:
        waiting: list[_Piece] = []
        bounds = [*(place[:3] for place in self.places[1:]), (math.inf, 0, 0)]
        for (number, block, loaded), bound in zip(self._blocks(), bounds, strict=False):
            if loaded is not None:
                self._hold((number, block.offset), loaded[0])
                waiting.append(_Piece((number, block.offset), block, loaded[1]))
            if waiting:
                pairs = [piece.split(bound) for piece in waiting]
                yield from self._in_order([ready for ready, _ in pairs if len(ready.rows)])
                waiting = [rest for _, rest in pairs if rest is not None]
                self.held = {piece.key: self.held[piece.key] for piece in waiting if piece.key in self.held}
            self._advance(block)
        self._finish()

    def batches(self) -> Iterator[Batch]:
        """The messages of each block and channel at a time, the blocks by their first log time."""
        for number, block, loaded in self._blocks():
            if loaded is not None:
                yield from batches_of(self.sources[number].channels, *loaded)
            self._advance(block)
        self._finish()

    def _blocks(self) -> Iterator[tuple[int, Block, tuple[bytes, Rows] | None]]:
        """Number of the source, block, and what `_load` gives where anything in it is wanted.

        No thread reads ahead: for every chunk it would wait several times for the interpreter, which costs what it saves.
        """
        for number, places in groupby(self.places, key=lambda place: place[1]):
            with reading(self.sources[number].path) as file:
                for _, _, _, block in places:
                    yield number, block, self._load(file, number, block) if self._is_wanted(number, block) else None

    def _is_wanted(self, number: int, block: Block) -> bool:
        is_in_time = block.start_ns < self.selection.end_ns and block.end_ns >= self.selection.start_ns
        return is_in_time and not block.num_messages.keys().isdisjoint(self.selection.channels[number])

    def _advance(self, block: Block) -> None:
        if self.on_bytes is not None:
            self.on_bytes(block.length)

    def _finish(self) -> None:
        if self.on_bytes is not None:
            total = sum(part.size_bytes - sum(block.length for block in part.blocks) for part in self.sources)
            self.on_bytes(total)

    def _load(self, file: BinaryIO, number: int, block: Block) -> tuple[bytes, Rows]:
        """The bytes of a block of a source, and its selected messages by time."""
        wanted = self.selection.channels[number]
        data = _unpacked(file, block)
        index = b"" if block.index_length == 0 else read_span(file, block.offset + block.length, block.index_length)
        if block.kind == "torn" or not index:
            rows = _walked(data, block, index)
            rows = rows[np.isin(rows.channel_id, list(wanted))]
        else:
            rows = indexed_rows(data, index, wanted.keys())
        is_in_time = (rows.log_time_ns >= self.selection.start_ns) & (rows.log_time_ns < np.uint64(self.selection.end_ns))
        rows = rows if is_in_time.all() else rows[is_in_time]
        ordered = rows.by_time()
        if ordered is not rows and self.on_back is not None and _steps_back(rows):
            self.on_back()
        return data, ordered

    def _hold(self, key: tuple[int, int], data: bytes) -> None:
        """Keep the bytes of a block for a while, and forget those that have not been used for the longest time."""
        self.held.pop(key, None)
        self.held[key] = data
        total = sum(map(len, self.held.values()))
        for old in list(self.held)[:-1]:
            if total <= MAX_HELD_BYTES:
                break
            total -= len(self.held.pop(old))

    def _bytes(self, piece: _Piece) -> bytes:
        data = self.held.get(piece.key)
        if data is None:
            with reading(self.sources[piece.key[0]].path) as file:
                data = _unpacked(file, piece.block)
        self._hold(piece.key, data)
        return data

    def _in_order(self, pieces: list[_Piece]) -> Iterator[Iterable[RawMessage]]:
        """The messages of all `pieces` by time, then by place, in stretches."""
        if len(pieces) == 1:
            yield raw_messages(self.sources[pieces[0].key[0]].channels, self._bytes(pieces[0]), pieces[0].rows)
            return
        if not pieces:
            return
        pieces = sorted(pieces, key=lambda piece: piece.key)
        rows = Rows.concatenate([piece.rows for piece in pieces])
        owner = np.repeat(np.arange(len(pieces)), [len(piece.rows) for piece in pieces])
        order = np.argsort(rows.log_time_ns, kind="stable")
        filled = np.cumsum((rows.end - rows.begin)[order])
        cuts = np.flatnonzero(np.diff(filled // MAX_HELD_BYTES)) + 1
        for stretch in np.split(order, cuts):
            yield self._stretch(pieces, rows, owner, stretch)

    def _stretch(self, pieces: list[_Piece], rows: Rows, owner: Int64s, stretch: Int64s) -> list[RawMessage]:
        """The messages rows[stretch], of which `owner` says from which piece they are: every piece is read once."""
        found: list[tuple[int, RawMessage]] = []
        owners = owner[stretch]
        for number in np.unique(owners).tolist():
            places = np.flatnonzero(owners == number)
            channels = self.sources[pieces[number].key[0]].channels
            messages = raw_messages(channels, self._bytes(pieces[number]), rows[stretch[places]])
            found += zip(places.tolist(), messages, strict=True)
        return [message for _, message in sorted(found, key=lambda item: item[0])]


def _steps_back(rows: Rows) -> bool:
    return bool((np.diff(rows.log_time_ns.astype(np.int64)) < -BACK_NS).any())


def read_span(file: BinaryIO, offset: int, length: int) -> bytes:
    """So many bytes of the file; `DamagedRecord` where it has become shorter."""
    file.seek(offset)
    data = file.read(length)
    if len(data) != length:
        raise DamagedRecord("the file has become shorter")
    return data


@contextlib.contextmanager
def reading(path: Path) -> Iterator[BinaryIO]:
    """The file at `path`, which was there before; whatever goes wrong becomes an `InputError`."""
    try:
        file = unpacked(path).open("rb")
    except OSError as error:
        raise InputError(f"{path}: cannot be read any more ({error.strerror}); was it moved?") from error
    try:
        with file:
            yield file
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the disk") from error
    except DamagedRecord as error:
        raise InputError(f"{path}: was changed while it was being read ({error}); run again") from error


def _unpacked(file: BinaryIO, block: Block) -> bytes:
    data = read_span(file, block.offset, block.length)
    if block.kind == "chunk":
        return unpack_chunk(parse_chunk(data))
    return unpack_cut_chunk(data)[1] if block.kind == "cut" else data


def _walked(data: bytes, block: Block, index: bytes) -> Rows:
    """The messages of a block by a walk over its records, of a torn one those that are left."""
    if block.kind == "torn":
        return rows_in_torn(data, [parse_message_index(index[begin:end]) for _, begin, end in walk(index)])[0]
    return rows_by_walk(data, block.kind == "cut")[0]
