"""The time grid of a mission: how far apart its steps are, and at which origins windows are drawn.

The grid is planned by what can be answered. The step follows from the gaps between detections; windows that would see nothing
are not drawn; and where there would be too many the step is longer. What follows from that is said (`Grid.remarks`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa

from cadence.arrays import Bools, Float64s, Int64s
from cadence.errors import ConfigError, InputError
from pipeline.tracks import agent_tracks

if TYPE_CHECKING:
    from torch import Tensor

_NICE = np.array([1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0])
_STEPS_PER_GAP = 16.0
_MOST_WINDOWS = 1_000_000
"""What nobody can have meant, even where the step is stated."""

_MOST_ABSENCES, _LEAST_IN_A_PASS, _ABSENCE_OVER_PASS = 3, 8, 20.0


@dataclass(frozen=True)
class GridConfig:
    """The time grid of the windows.

    step_s         seconds between steps; by default a sixteenth of the gap in which a random moment of the mission lies, more
                   where there would be over max_windows
    history_steps  steps up to and including the origin
    horizon_steps  steps after it
    stride_steps   steps from one origin to the next
    context_steps  detections from this many steps before the origin on are used; by default from the first step on
    max_windows    where step_s is not stated the step is as long as it takes for no more windows than these
    """

    step_s: float | None = None
    history_steps: int = 64
    horizon_steps: int = 32
    stride_steps: int = 16
    context_steps: int | None = None
    max_windows: int = 2000

    def __post_init__(self) -> None:
        if self.step_s is not None and not 0 < self.step_s < math.inf:
            raise ValueError(f"step_s must be positive, got {self.step_s}")
        if min(self.history_steps, self.stride_steps) < 1 or self.horizon_steps < 0:
            raise ValueError("history_steps and stride_steps must be at least 1, horizon_steps at least 0")
        if self.context_steps is not None and self.context_steps < self.history_steps:
            raise ValueError(f"context_steps is {self.context_steps}, less than history_steps {self.history_steps}")
        if self.max_windows < 1:
            raise ValueError(f"max_windows must be at least 1, got {self.max_windows}")

    @property
    def used_steps(self) -> int:
        """How many steps before the origin detections are used."""
        return self.context_steps or self.history_steps


@dataclass(frozen=True, eq=False)
class Grid:
    """Resolved grid: `origins_ns` [B] and the steps around each; detections reach back `context_steps` (None: the history).

    remarks  what a user should know of how it was planned, a sentence each
    """

    step_ns: int
    history_steps: int
    horizon_steps: int
    origins_ns: Int64s
    context_steps: int | None = None
    remarks: tuple[str, ...] = ()

    @property
    def context_ns(self) -> int:
        """How far before the origin detections are used."""
        return (self.context_steps or self.history_steps) * self.step_ns

    @property
    def step_s(self) -> float:
        """Seconds between two steps."""
        return self.step_ns * 1e-9

    @property
    def num_steps(self) -> int:
        """Number of steps T of a window."""
        return self.history_steps + self.horizon_steps

    @property
    def origin_index(self) -> int:
        """Index of the step at the origin, the last of the history."""
        return self.history_steps - 1

    @property
    def time_s(self) -> "Tensor":
        """Step times relative to the origin [T], float64."""
        import torch  # only now: settings of the grid are read before it is known whether anything is to be drawn

        return (torch.arange(self.num_steps, dtype=torch.float64) - self.origin_index) * self.step_s


def plan_grid(detections: pa.Table, config: GridConfig) -> Grid:
    """The grid for a DETECTIONS table: the step from the gaps unless configured, origins wherever a window sees a detection."""
    if detections.num_rows == 0:
        raise InputError("detections: the table is empty; nothing was detected, so there is nothing to infer from")
    times = [track.time_ns for _, track in agent_tracks(detections, 0.0)]
    seen_ns = np.sort(np.concatenate(times))
    wanted_s = config.step_s if config.step_s is not None else suggest_step_s(times)
    origins = _Origins.of(seen_ns, wanted_s, config)
    num_wanted = origins.num_windows
    while config.step_s is None and origins.num_windows > config.max_windows:
        longer_s = _nice_above(origins.step_ns * 1e-9 * max(origins.num_windows / config.max_windows, 1.01))
        origins = _Origins.of(seen_ns, longer_s, config)
    if origins.num_windows > _MOST_WINDOWS:
        raise ConfigError(
            f"infer.grid: {origins.num_windows} windows with steps of {wanted_s:g} s; choose a larger step_s or stride_steps"
        )
    remarks = origins.remarks(seen_ns, config)
    if num_wanted > origins.num_windows:
        remarks.append(
            f"steps are {origins.step_ns * 1e-9:g} s long, not the {wanted_s:g} s that the gaps between detections ask for, as "
            f"these would take {num_wanted} windows; infer.grid.max_windows = {config.max_windows} allows more or fewer, "
            "step_s sets the step"
        )
    return Grid(
        origins.step_ns, config.history_steps, config.horizon_steps, origins.time_ns, config.context_steps, tuple(remarks)
    )


def suggest_step_s(times_ns: Sequence[Int64s]) -> float:
    """A sixteenth of the gap in which a random moment lies (time-weighted median), rounded to a plain number.

    Long absences (an agent that leaves for hours, the time between two passes) are left out: they are not gaps within a track.
    """
    gaps = np.concatenate([np.diff(times)[~absences(times)] for times in times_ns]).astype(np.float64) * 1e-9
    gaps = np.sort(gaps[gaps > 0])
    if len(gaps) == 0:
        return 1.0
    gaps = gaps[gaps <= 20.0 * _weighted_median(gaps)]
    return _nice(_weighted_median(gaps) / _STEPS_PER_GAP)


def absences(time_ns: Int64s) -> Bools:
    """Which gaps [N - 1] between an agent's detections [N], by time, lie between passes of a sensor, not within a track.

    A few gaps, each twenty times as long as the longest pass that they leave, where a pass has detections enough to follow.
    """
    gap_ns = np.diff(time_ns)
    order = np.argsort(-gap_ns, kind="stable")
    for num in range(min(_MOST_ABSENCES, len(gap_ns)), 0, -1):
        is_absence = np.zeros(len(gap_ns), dtype=bool)
        is_absence[order[:num]] = True
        passes = np.split(time_ns, np.flatnonzero(is_absence) + 1)
        longest_ns = max(np.ptp(each) for each in passes)
        if gap_ns[order[num - 1]] > _ABSENCE_OVER_PASS * longest_ns and max(map(len, passes)) >= _LEAST_IN_A_PASS:
            return is_absence
    return np.zeros(len(gap_ns), dtype=bool)


@dataclass(frozen=True, eq=False)
class _Origins:
    """Origins a stride apart behind the first detection, in runs (first and last number, [R] each) that see detections.

    The last one of all, at or behind the last detection, is always among them.
    """

    start_ns: int
    step_ns: int
    stride_ns: int
    num_all: int
    first: Int64s
    last: Int64s

    @staticmethod
    def of(seen_ns: Int64s, step_s: float, config: GridConfig) -> "_Origins":
        """The origins for a step."""
        step_ns = max(1, round(step_s * 1e9))
        start_ns, stride_ns = int(seen_ns[0]), config.stride_steps * step_ns
        num_all = max(1, -(-(int(seen_ns[-1]) - start_ns) // stride_ns))
        after_ns = seen_ns - start_ns
        first = np.maximum(-(-after_ns // stride_ns), 1)
        last = np.minimum((after_ns + config.used_steps * step_ns - 1) // stride_ns, num_all)
        is_any = first <= last
        first, last = np.append(first[is_any], num_all), np.append(last[is_any], num_all)
        is_new = np.append(True, first[1:] > last[:-1] + 1)
        return _Origins(start_ns, step_ns, stride_ns, num_all, first[is_new], last[np.append(is_new[1:], True)])

    @property
    def num_windows(self) -> int:
        """How many origins see something."""
        return int((self.last - self.first + 1).sum())

    @property
    def time_ns(self) -> Int64s:
        """All of them [B]."""
        number = np.concatenate([np.arange(first, last + 1) for first, last in zip(self.first, self.last, strict=True)])
        return np.asarray(self.start_ns + self.stride_ns * number)

    def remarks(self, seen_ns: Int64s, config: GridConfig) -> list[str]:
        """What is not answered."""
        found = []
        apart_ns = np.diff(self.time_ns)
        apart_ns = apart_ns[apart_ns > self.stride_ns]
        in_none_s = (apart_ns - (config.history_steps + config.horizon_steps) * self.step_ns) * 1e-9
        if (in_none_s > 0).any():
            gap_s, span_s = float(np.diff(seen_ns).max()) * 1e-9, float(np.ptp(seen_ns)) * 1e-9
            found.append(
                f"{_plain(in_none_s[in_none_s > 0].sum())} of the {_plain(span_s)} s from the first detection to the last "
                f"lie in no window, as nothing was detected for up to {_plain(gap_s)} s; "
                f"{f'infer.grid.step_s = {_nice(gap_s / _STEPS_PER_GAP):g}' if config.step_s is None else 'a longer step'} "
                "spans that time"
            )
        if config.stride_steps > config.horizon_steps > 0:
            found.append(
                f"infer.grid.stride_steps = {config.stride_steps} is more than horizon_steps = {config.horizon_steps}: "
                f"{config.stride_steps - config.horizon_steps} of every {config.stride_steps} steps are in no window's future"
            )
        return found


def _plain(seconds: float) -> str:
    return f"{seconds:,.0f}" if seconds >= 10.0 else f"{seconds:.2g}"


def _nice(value: float) -> float:
    """The plain number nearest to a value, in ratio."""
    exponent = math.floor(math.log10(value))
    mantissa = value / 10.0**exponent
    return float(_NICE[np.argmin(np.abs(np.log(_NICE / mantissa)))] * 10.0**exponent)


def _nice_above(value: float) -> float:
    """The next plain number that is no less than a value."""
    exponent = math.floor(math.log10(value))
    return float(_NICE[np.searchsorted(_NICE, value / 10.0**exponent)] * 10.0**exponent)


def _weighted_median(gaps: Float64s) -> float:
    """Of sorted gaps: the one in which half of their time has passed."""
    return float(gaps[np.searchsorted(np.cumsum(gaps), 0.5 * gaps.sum())])
