"""The recordings that a file holds: one, as a rule; two where files were joined byte by byte."""

from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO, Final

from pipeline.logs.chunk_checks import leave_out_shared
from pipeline.logs.plan import Plan
from pipeline.logs.salvage import Scan

_MAX_RECORDINGS: Final = 100
"""Each costs a plan; nobody joins so many, and a hostile file could hold millions of empty ones."""


def scan_log(path: Path, size: int, on_bytes: Callable[[int], object] | None = None) -> tuple[Plan, ...]:
    """Walk the whole file: the plans of its recordings, at least one. OSError is the caller's."""
    progress = _Progress(on_bytes)
    plans: list[Plan] = []
    begin = 0
    with path.open("rb") as file:
        while begin < size and len(plans) < _MAX_RECORDINGS:
            plan, following = _scan(file, begin, size, progress.reach)
            if following > plan.end:
                words = f"{following - plan.end} bytes from byte {plan.end} on, behind the end of the recording, are no records"
                plan.remarks.append(f"{words}.")
            plans.append(plan)
            begin = following
        if len(plans) > 1:
            leave_out_shared(plans, file)
    if begin < size:
        words = f"was left out: it is more than the {_MAX_RECORDINGS}th recording"
        plans[-1].doubts.append(f"Everything from byte {begin} on {words}.")
    progress.reach(size)
    return tuple(plans)


class _Progress:
    """Tells bytes done since the last call, by the position: recordings that turn out to be shorter are gone over twice."""

    def __init__(self, on_bytes: Callable[[int], object] | None) -> None:
        self.on_bytes, self.reached = on_bytes, 0

    def reach(self, position: int) -> None:
        """All bytes up to `position` are done."""
        if self.on_bytes is not None and position > self.reached:
            self.on_bytes(position - self.reached)
            self.reached = position


def _scan(file: BinaryIO, begin: int, end: int, on_position: Callable[[int], object]) -> tuple[Plan, int]:
    """The plan of the recording at `begin`, and where the next one begins, `end` without one.

    What ends before `end` is walked over again as what it is: then its index lies at its end.
    """
    following = end
    while True:
        scan = Scan(file, begin, end)
        scan.run(on_position)
        following = scan.following if scan.following < end else following
        if scan.end == end:
            return scan.plan, following
        end = scan.end
