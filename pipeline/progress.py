"""Progress bars (on a terminal alone) and notes on stderr; stdout is left to results."""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from tqdm import tqdm

from pipeline.counted import counted

_MIN_SHARE = 0.01


@dataclass(frozen=True)
class Progress:
    """Where long work tells how far it is. `quiet` silences bars and notes, never errors."""

    quiet: bool = False

    def bar(self, total: int | None, label: str, unit: str = "it", scale: bool = False) -> "tqdm[Any]":
        """A bar to `update(n)` and `close()` (or use as a context manager); `scale` prints k, M, G for bytes."""
        return tqdm(
            total=total, desc=label, unit=unit, unit_scale=scale, disable=self._is_hidden, file=sys.stderr, leave=False,
            dynamic_ncols=True, mininterval=0.2,
        )  # fmt: skip

    def percent(self, label: str) -> "tqdm[Any]":
        """A bar from 0 to 1 for work whose pieces are not alike, so that a rate would say nothing: set `n` and `refresh`."""
        return tqdm(
            total=1.0, desc=label, disable=self._is_hidden, file=sys.stderr, leave=False, dynamic_ncols=True,
            bar_format="{desc}: {percentage:3.0f}%|{bar}| {elapsed}{postfix}",
        )  # fmt: skip

    @property
    def _is_hidden(self) -> bool:
        """Bars are for terminals; in a file each of their states would be read."""
        return self.quiet or not sys.stderr.isatty()

    def doing(self, label: str) -> None:
        """What the work is at, where that is shown and no bar says it."""

    def note(self, text: str) -> None:
        """One line for the person who watches."""
        if not self.quiet:
            tqdm.write(text, file=sys.stderr)

    def warn(self, text: str) -> None:
        """What must be seen also where `quiet` was asked for: a failure that did not stop the rest."""
        tqdm.write(text, file=sys.stderr)

    def part(self, begin: float, end: float) -> "Progress":
        """The progress of work that takes a task from the share `begin` of it to the share `end`."""
        return self


class Doing(str):
    """What a task is at, in a word or two."""

    __slots__ = ()


Told = str | float
"""What a task tells while it runs: a line of text, what it is at (`Doing`), or the share of it that is done."""


@dataclass(frozen=True)
class RelayedProgress(Progress):
    """Progress that is shown elsewhere: every note, and every bar as a share of the task, goes to `tell`."""

    tell: Callable[[Told], object] = float
    begin: float = 0.0
    end: float = 1.0

    def bar(self, total: int | None, label: str, unit: str = "it", scale: bool = False) -> "tqdm[Any]":
        """A bar that is not drawn but told."""
        self.tell(Doing(label))

        def told(done: float, share: float) -> None:
            self.tell(self.begin + share * (self.end - self.begin))
            if unit != "B":  # of bytes the share says enough
                self.tell(Doing(f"{label} {done:.0f} of {counted(total or 0, unit)}"))

        return _ToldBar(total, told)

    def doing(self, label: str) -> None:
        """As above."""
        self.tell(Doing(label))

    def note(self, text: str) -> None:
        """Tell one line."""
        self.tell(text)

    def warn(self, text: str) -> None:
        """Tell one line."""
        self.tell(text)

    def part(self, begin: float, end: float) -> "RelayedProgress":
        """As above."""
        width = self.end - self.begin
        return RelayedProgress(self.quiet, self.tell, self.begin + begin * width, self.begin + end * width)


class _ToldBar(tqdm):  # type: ignore[type-arg]
    """A bar without a picture, which tells its share at each per cent."""

    def __init__(self, total: int | None, tell: Callable[[float, float], object]) -> None:
        super().__init__(total=total, disable=True)
        self._size, self._tell, self._done, self._told = total or 0, tell, 0.0, 0.0

    def update(self, n: float | None = 1) -> bool | None:
        self._done += n or 0
        share = min(self._done / self._size, 1.0) if self._size else 0.0
        if share - self._told >= _MIN_SHARE:
            self._told = share
            self._tell(self._done, share)
        return None
