"""What tables of scores.md are made of: lines of cells, numbers with their intervals."""

import math
from collections.abc import Iterable, Sequence
from typing import Protocol, TypeVar

from pipeline.lengths import three_digits

Item = TypeVar("Item")


class Number(Protocol):
    """A value with its interval; NaN where there is none."""

    @property
    def value(self) -> float:
        """What is told."""

    @property
    def low(self) -> float:
        """Where its interval begins."""

    @property
    def high(self) -> float:
        """Where it ends."""


def ordered(values: Iterable[Item]) -> list[Item]:
    """Each once, in the order of its first."""
    return list(dict.fromkeys(values))


def line(cells: Sequence[str]) -> str:
    """A line of a table."""
    return "| " + " | ".join(cells) + " |"


def value(row: Number | None) -> str:
    """Three digits, or a dash."""
    return "–" if row is None or math.isnan(row.value) else three_digits(row.value)


def with_interval(row: Number | None) -> str:
    """The value, and its interval where it has one."""
    if row is None or math.isnan(row.low):
        return value(row)
    return f"{three_digits(row.value)} [{three_digits(row.low)}, {three_digits(row.high)}]"
