"""Columns of positions, as every step of the stage takes and gives them, and the names in them as numbers."""

import itertools
from array import array
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, ClassVar, Final, Self

import numpy as np

from cadence.arrays import Bools, Float32s, Float64s, Int64s, Objects

_NAMES: Final = {"agents": "agent", "sensors": "sensor", "topics": "topic", "frames": "frame_id"}
"""The columns of names, by how they are called as numbers."""
_FEW: Final = 2**15
"""Names of which the numbers fit 16 bits, which are sorted five times as fast."""


@dataclass(frozen=True, eq=False)
class Positions:
    """Columns of N rows. NaN and None stand for what a message does not state.

    first, second  x_m and y_m, or latitude_deg and longitude_deg where is_geodetic
    covariance_m2  [N, 3] xx, xy, yy
    height_covariance_m2  [N, 3] xz, yz, zz: what a tilted sensor frame turns into those
    message        number of the message that holds the row, among those of its reader; unique in a role
    is_ned         whether x is north, y east and z down in the frame that the positions end in
    is_stated      whether the user configured the source (else it was suggested)
    """

    PLACES: ClassVar[int] = 1
    """Rows that stand for one thing that was seen."""

    time_ns: Int64s
    log_time_ns: Int64s
    sequence: Int64s
    message: Int64s
    first: Float64s
    second: Float64s
    z_m: Float64s
    covariance_m2: Float64s
    height_covariance_m2: Float64s
    score: Float32s
    agent: Objects
    sensor: Objects
    topic: Objects
    frame_id: Objects
    is_geodetic: Bools
    is_ned: Bools
    is_stated: Bools

    def __len__(self) -> int:
        return len(self.time_ns)

    def __getitem__(self, rows: Any) -> Self:
        """The rows of a mask, of indices or of a slice."""
        if isinstance(rows, np.ndarray) and rows.dtype == np.bool_ and rows.all():
            return self
        found = type(self)(*(getattr(self, item.name)[rows] for item in fields(self)))
        return found._knowing({name: known.take(rows) for name, known in self._known.items()})

    @cached_property
    def agents(self) -> "Names":
        """The agents by number."""
        return Names.of(self.agent)

    @cached_property
    def sensors(self) -> "Names":
        """The sensors by number."""
        return Names.of(self.sensor)

    @cached_property
    def topics(self) -> "Names":
        """The topics by number."""
        return Names.of(self.topic)

    @cached_property
    def frames(self) -> "Names":
        """The names of frames by number."""
        return Names.of(self.frame_id)

    def changed(self, **columns: Any) -> Self:
        """The rows with other columns."""
        kept = {name: known for name, known in self._known.items() if _NAMES[name] not in columns}
        return replace(self, **columns)._knowing(kept)

    @classmethod
    def concatenate(cls, parts: Sequence["Positions"]) -> Self:
        """All rows of `parts`, in order."""
        found = cls(*(np.concatenate([getattr(part, item.name) for part in parts]) for item in fields(cls)))
        return found._knowing({name: Names.joined([getattr(part, name) for part in parts]) for name in _NAMES})

    @property
    def _known(self) -> dict[str, "Names"]:
        """The names that were numbered already, which takes longer than to keep their numbers up."""
        return {name: self.__dict__[name] for name in _NAMES if name in self.__dict__}

    def _knowing(self, names: Mapping[str, "Names"]) -> Self:
        self.__dict__.update(names)
        return self


@dataclass(frozen=True, eq=False)
class Names:
    """A column of names as numbers: number [N] is the place of each in `names`, by their first rows; -1 for None."""

    number: Int64s
    names: tuple[str, ...]

    @staticmethod
    def of(column: Iterable[str | None]) -> "Names":
        """The names of a column."""
        column = column.tolist() if isinstance(column, np.ndarray) else list(column)
        names = tuple(name for name in dict.fromkeys(column) if name is not None)
        place: dict[str | None, int] = {name: number for number, name in enumerate(names)} | {None: -1}
        return Names(np.fromiter(map(place.__getitem__, column), np.int64, len(column)), names)

    @staticmethod
    def joined(parts: Sequence["Names"]) -> "Names":
        """The names of columns, one after the other."""
        place = {name: number for number, name in enumerate(dict.fromkeys(name for part in parts for name in part.names))}
        numbers = [np.array([*map(place.__getitem__, part.names), -1], np.int64)[part.number] for part in parts]
        return Names(np.concatenate(numbers), tuple(place))

    def take(self, rows: Any) -> "Names":
        """The names of some rows: a mask, indices or a slice."""
        number = self.number[rows]
        first = np.full(len(self.names) + 1, len(number))  # the last one is of rows without a name
        first[number[::-1]] = np.arange(len(number))[::-1]
        order = np.argsort(first[:-1], kind="stable")[: np.count_nonzero(first[:-1] < len(number))]
        place = np.full(len(self.names) + 1, -1)
        place[order] = np.arange(len(order))
        return Names(place[number], tuple(self.names[old] for old in order.tolist()))

    def rows(self) -> list[Int64s]:
        """The row numbers of each name, ascending."""
        order = np.argsort(self.number.astype(np.int16) if len(self.names) < _FEW else self.number, kind="stable")
        ends = np.cumsum(np.bincount(self.number + 1, minlength=len(self.names) + 1))
        return [order[first:last] for first, last in itertools.pairwise(ends.tolist())]


class Rows:
    """Growing columns of one reader (`Positions` once complete)."""

    def __init__(self) -> None:
        self.integers = array("q")  # time, log time, sequence, message
        self.floats = array("d")  # first, second, z, score, covariance
        self.agents: list[str | None] = []
        self.sensors: list[str | None] = []
        self.frame_ids: list[str] = []

    def finish(self, topic: str = "", is_geodetic: bool = False, is_ned: bool = False, is_stated: bool = False) -> Positions:
        """The columns as arrays."""
        integers = np.array(self.integers, dtype=np.int64).reshape(-1, 4)
        floats = np.array(self.floats, dtype=np.float64).reshape(-1, 10)
        num_rows = len(integers)
        found = Positions(
            integers[:, 0], integers[:, 1], integers[:, 2], integers[:, 3],
            floats[:, 0], floats[:, 1], floats[:, 2], floats[:, 4:7], floats[:, 7:], floats[:, 3].astype(np.float32),
            np.array(self.agents, dtype=object), np.array(self.sensors, dtype=object),
            np.full(num_rows, topic, dtype=object), np.array(self.frame_ids, dtype=object),
            np.full(num_rows, is_geodetic), np.full(num_rows, is_ned), np.full(num_rows, is_stated),
        )  # fmt: skip
        names = {"agents": Names.of(self.agents), "frames": Names.of(self.frame_ids), "topics": Names.of(found.topic)}
        return found._knowing(names)
