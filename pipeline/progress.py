"""Progress bars and notes on stderr; stdout is left to results."""

import sys
from dataclasses import dataclass
from typing import Any

from tqdm import tqdm


@dataclass(frozen=True)
class Progress:
    """Where long work tells how far it is. `quiet` silences bars and notes, never errors."""

    quiet: bool = False

    def bar(self, total: int | None, label: str, unit: str = "it", scale: bool = False) -> "tqdm[Any]":
        """A bar to `update(n)` and `close()` (or use as a context manager); `scale` prints k, M, G for bytes."""
        return tqdm(
            total=total, desc=label, unit=unit, unit_scale=scale, disable=self.quiet, file=sys.stderr, leave=False,
            dynamic_ncols=True, mininterval=0.2,
        )  # fmt: skip

    def note(self, text: str) -> None:
        """One line for the person who watches."""
        if not self.quiet:
            tqdm.write(text, file=sys.stderr)

    def warn(self, text: str) -> None:
        """What must be seen also where `quiet` was asked for: a failure that did not stop the rest."""
        tqdm.write(text, file=sys.stderr)
