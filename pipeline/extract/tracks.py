"""What bears one name, as a track: can one target have moved so?

A jump that needs an acceleration and a speed of which nothing shows before and after is another target's.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cadence.arrays import Bools, Float64s, Int64s

_MAX_ACCELERATION_MPS2: Final = 10.0
"""One g: more than ships, people, cars and airliners do. Whatever does more is fast before and after, too."""
_MAX_RATIO: Final = 3.0
"""Of the speed over a jump to the speeds around it."""
_MIN_JUMP_M: Final = 100.0
_MIN_JUMP_MPS: Final = 100.0
"""A receiver that finds its fix again may jump by tens of metres from one second to the next."""
_MIN_REUSE_M: Final = 20.0
_REUSE_RATIO: Final = 10.0
"""Names that a tracker counts are given out anew, those of receivers are not: a shorter jump is enough, if it is fast."""
_SIGMAS: Final = 4.0
_SCATTERS: Final = 10.0
_STEPS: Final = 3.0
"""Two sensors may put one target apart by what they state, by several times what they scatter, and by what it moves between
some looks."""
_MAX_BIAS_M: Final = 50.0
"""How far apart sensors that state no accuracy may put one target."""
_MAX_GAPS: Final = 3.0
"""Of the usual step of a track: over a longer gap nobody knows where it was."""
_MIN_ROWS: Final = 3
_MAX_LAG: Final = 8
_MAX_LATE_RATIO: Final = 10.0
"""Of a step that leads far away to where it leads back: chance does so in one of a hundred."""


@dataclass(frozen=True, eq=False)
class Track:
    """Detections of one name by time: time_s [N], place [N] (x + iy in metres), variance_m2 [N] (0: none stated)."""

    time_s: Float64s
    place: NDArray[np.complex128]
    variance_m2: Float64s

    def __len__(self) -> int:
        return len(self.time_s)

    def __getitem__(self, rows: Any) -> "Track":
        return Track(self.time_s[rows], self.place[rows], self.variance_m2[rows])

    def scatter_m(self) -> float:
        """How far places lie from the line between their neighbours, as a rule."""
        if len(self) < _MIN_ROWS:
            return 0.0
        before_s, whole_s = self.time_s[1:-1] - self.time_s[:-2], self.time_s[2:] - self.time_s[:-2]
        share = np.divide(before_s, whole_s, out=np.full(len(before_s), 0.5), where=whole_s > 0)
        between = self.place[:-2] + share * (self.place[2:] - self.place[:-2])
        return float(np.median(np.abs(self.place[1:-1] - between)))

    def step_m(self) -> float:
        """How far it moves between two looks, as a rule; 0 where it stands."""
        steps_m = np.abs(np.diff(self.place))
        return float(np.median(steps_m[steps_m > 0])) if (steps_m > 0).any() else 0.0


@dataclass(frozen=True)
class Jump:
    """The largest step of a track that nothing makes: how far, in what time, and how many times the speed around it."""

    length_m: float
    time_s: float
    ratio: float


def apart_m(parts: Sequence[Track]) -> float:
    """How far from each other sources put what they call by one name; 0 where it may be one target."""
    reference = max(parts, key=len)
    found = [_apart_m(reference, part) for part in parts if part is not reference]
    return max(found, default=0.0)


def _apart_m(reference: Track, other: Track) -> float:
    """The median distance at moments at which both are known, where it is more than one target explains; else 0."""
    if len(reference) < _MIN_ROWS or len(other) < _MIN_ROWS:
        return 0.0
    after = np.clip(np.searchsorted(reference.time_s, other.time_s), 1, len(reference) - 1)
    gap_s = reference.time_s[after] - reference.time_s[after - 1]
    is_known = (other.time_s >= reference.time_s[0]) & (other.time_s <= reference.time_s[-1])
    is_known &= gap_s <= _MAX_GAPS * np.median(np.diff(reference.time_s))
    if is_known.sum() < _MIN_ROWS:
        return 0.0
    share = np.divide(other.time_s - reference.time_s[after - 1], gap_s, out=np.zeros(len(other)), where=gap_s > 0)
    between = reference.place[after - 1] + share * (reference.place[after] - reference.place[after - 1])
    distance_m = float(np.median(np.abs(other.place - between)[is_known]))
    sigma_m = float(np.sqrt(np.median(reference.variance_m2) + np.median(other.variance_m2)))
    scatter_m = reference.scatter_m() + other.scatter_m()
    least_m = 0.0 if np.median(reference.variance_m2) > 0 and np.median(other.variance_m2) > 0 else _MAX_BIAS_M
    allowed_m = max(least_m, _SIGMAS * sigma_m, _SCATTERS * scatter_m, _STEPS * max(reference.step_m(), other.step_m()))
    return distance_m if distance_m > allowed_m else 0.0


def odd_share(track: Track, tolerance_s: float, of_interest: float = 0.0) -> float:
    """Of its steps the share that no target makes: being at two places, or leaving and coming back at once.

    A share that cannot be above `of_interest` is not looked at more closely, and 0.
    """
    if len(track) < _MIN_ROWS:
        return 0.0
    step_s, step_m = np.diff(track.time_s), np.abs(np.diff(track.place))
    is_double, least = (step_s <= tolerance_s) & (step_m > 0), of_interest * len(step_s)
    is_return = _begin_returns(track, step_m, 2)
    lags = range(3, _MAX_LAG + 1) if (step_m > _MIN_JUMP_M).sum() > least else ()
    if is_return.sum() + is_double.sum() <= least and not lags:
        return 0.0
    sigma_m = np.sqrt(track.variance_m2[1:] + track.variance_m2[:-1])
    is_odd = _are_forced(track, sigma_m, is_return, 2, tolerance_s)
    for lag in lags:
        is_odd |= _are_forced(track, sigma_m, _begin_returns(track, step_m, lag), lag, tolerance_s)
    moments = track[np.diff(track.time_s, prepend=-np.inf) > tolerance_s]
    allowed_m = max(_STEPS * moments.step_m(), _SCATTERS * moments.scatter_m())
    is_double &= step_m > np.maximum(_SIGMAS * sigma_m, allowed_m)
    return float(is_odd.sum() + is_double.sum()) / len(step_s)


def _begin_returns(track: Track, step_m: Float64s, lag: int) -> Bools:
    """Which steps [N - 1] lead away from where the track is again, `lag` rows later; after more than two only far ones."""
    found = np.zeros(len(step_m), np.bool_)
    if len(step_m) < lag:
        return found
    leg_m = np.minimum(step_m[: len(step_m) - lag + 1], step_m[lag - 1 :])
    back_m = np.abs(track.place[lag:] - track.place[:-lag])
    is_near = leg_m > (_MAX_RATIO if lag == 2 else _MAX_LATE_RATIO) * back_m
    found[: len(leg_m)] = is_near if lag == 2 else is_near & (leg_m > _MIN_JUMP_M)
    return found


def _are_forced(track: Track, sigma_m: Float64s, is_return: Bools, lag: int, tolerance_s: float) -> Bools:
    """Which of the steps [N - 1] that begin a return nothing makes that moves as it does around it, nor those that end it."""
    begin = np.flatnonzero(is_return)
    found = np.zeros(len(is_return), np.bool_)
    if not len(begin):
        return found
    back_m, back_s = np.abs(track.place[begin + lag] - track.place[begin]), track.time_s[begin + lag] - track.time_s[begin]
    speed_mps = np.divide(back_m, back_s, out=np.zeros(len(begin)), where=back_s > 0)
    is_forced = np.ones(len(begin), np.bool_)
    for step in (begin, begin + lag - 1):
        way_m, way_s = np.abs(track.place[step + 1] - track.place[step]), track.time_s[step + 1] - track.time_s[step]
        is_forced &= (way_s > tolerance_s) & (4 * (way_m - speed_mps * way_s) > _MAX_ACCELERATION_MPS2 * way_s**2)
        is_forced &= way_m > _SIGMAS * sigma_m[step]
    found[begin[is_forced]] = True
    return found


def pieces_of(track: Track, tolerance_s: float, is_counted: bool = False) -> tuple[Int64s, Jump | None]:
    """The number [N] of the target that each row of a track is of, from 0, and the jump between two that is longest.

    After a jump comes what was there before another one, if it can, else a new target. `is_counted`: its name is a number
    that a tracker gave out.
    """
    is_moment = np.diff(track.time_s, prepend=-np.inf) > tolerance_s
    moments = track[is_moment]
    if not _is_far(np.abs(np.diff(moments.place)), np.diff(moments.time_s), is_counted).any():
        return np.zeros(len(track), np.int64), None
    motion = _Motion(moments, is_counted)
    jumps = motion.jumps()
    if not jumps.any():
        return np.zeros(len(track), np.int64), None
    piece, ends = np.zeros(len(motion.track), np.int64), list[int]()
    borders = [0, *(np.flatnonzero(jumps) + 1).tolist(), len(piece)]
    for first, last in itertools.pairwise(borders):
        able = [number for number, end in enumerate(ends) if end < first - 1 and not motion.is_jump(end, first)]
        number = max(able, key=lambda number: ends[number], default=len(ends))
        ends[number : number + 1] = [last - 1]
        piece[first:last] = number
    return piece[np.cumsum(is_moment) - 1], motion.longest(jumps)


class _Motion:
    """How a track moves from moment to moment: steps [N - 1], and the speeds around them."""

    def __init__(self, track: Track, is_counted: bool) -> None:
        self.track, self.is_counted = track, is_counted
        self.step_s, self.step_m = np.diff(track.time_s), np.abs(np.diff(track.place))
        self.speed_mps = self.step_m / self.step_s
        self.usual_mps = float(np.quantile(self.speed_mps, 0.75)) if len(self.speed_mps) else 0.0
        self.scatter_m = track.scatter_m()
        padded = np.concatenate([[0.0], self.speed_mps, [0.0]])
        self.around_mps = np.maximum(np.maximum(padded[:-2], padded[2:]), self.usual_mps)

    def jumps(self) -> Bools:
        """Which steps [N - 1] nothing makes."""
        if len(self.step_s) < _MIN_ROWS:
            return np.zeros(len(self.step_s), np.bool_)
        variance_m2 = self.track.variance_m2[1:] + self.track.variance_m2[:-1]
        return self._are_jumps(self.step_m, self.step_s, self.around_mps, variance_m2)

    def is_jump(self, before: int, after: int) -> bool:
        """Whether nothing gets from row `before` to row `after`, between which there are others."""
        around = [self.usual_mps, *self.speed_mps[max(before - 1, 0) : before], *self.speed_mps[after : after + 1]]
        step_m = abs(self.track.place[after] - self.track.place[before])
        step_s = self.track.time_s[after] - self.track.time_s[before]
        variance_m2 = self.track.variance_m2[after] + self.track.variance_m2[before]
        values = (np.array([value]) for value in (step_m, step_s, max(around), variance_m2))
        return bool(self._are_jumps(*values)[0])

    def longest(self, jumps: Bools) -> Jump:
        """The longest of them."""
        step = int(np.argmax(self.step_m * jumps))
        around_mps = max(float(self.around_mps[step]), 1e-3)
        return Jump(float(self.step_m[step]), float(self.step_s[step]), float(self.speed_mps[step]) / around_mps)

    def _are_jumps(self, step_m: Float64s, step_s: Float64s, around_mps: Float64s, variance_m2: Float64s) -> Bools:
        noise_m = _SIGMAS * np.sqrt(variance_m2) + _SCATTERS * self.scatter_m
        # To leave the speed around, and to come back to it at the other end.
        acceleration_mps2 = 4 * (step_m - around_mps * step_s - noise_m) / step_s**2
        is_fast = (acceleration_mps2 > _MAX_ACCELERATION_MPS2) & (step_m > _MAX_RATIO * around_mps * step_s)
        is_leap = is_fast & (step_m > _REUSE_RATIO * around_mps * step_s) & self.is_counted
        return (is_fast & _is_far(step_m, step_s, False)) | (is_leap & _is_far(step_m, step_s, True))


def _is_far(step_m: Float64s, step_s: Float64s, is_counted: bool) -> Bools:
    return np.asarray((step_m > (_MIN_REUSE_M if is_counted else _MIN_JUMP_M)) | (step_m > _MIN_JUMP_MPS * step_s))
