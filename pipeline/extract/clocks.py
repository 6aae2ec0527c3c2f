"""Whether the stamps of one source can be meant: compared with the times at which its messages were logged, by differences.

Stamps may lie anywhere and run at another pace (a recording that is played again, a simulation), and messages may be late by
minutes. What cannot be meant is a clock that stands while the target moves, is read in a wrong unit, or jumps.
"""

import itertools
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from cadence.arrays import Bools, Float64s, Int64s, Objects
from pipeline.counted import counted
from pipeline.extract.positions import Names

AHEAD_S: Final = 2.0
"""A message cannot be logged before the moment it tells of, and the clocks of one vehicle agree better than this."""
LATE_S: Final = 10.0
"""What a source may steadily lag behind by its own work. More, and always the same, is another clock."""
MIN_ROWS: Final = 3
_JUMP_S: Final = 5.0
_LATENESS: Final = 0.1
"""Of an offset: one that varies by more is lateness (a satellite, a radio link), not a clock."""
_LATE_CLOCK_S: Final = 60.0
"""Some messages that are late by more than this, and all by the same, are of another clock: what queues comes one by one."""
_STANDING: Final = 0.3
"""Of the time that a source was logged: stamps that stand for longer are no stamps. The messages of one scan share a stamp for
good reasons, but follow each other in a small part of the time between two scans."""
_STANDING_STEPS: Final = 3.0
"""Of the usual steps of the stamps: for longer a clock that works does not stand."""
_SLOW: Final = 100
"""Within a second log times go on by so many times the step of a stamp that as good as stands: its nanoseconds hold micro- or
milliseconds."""
_UNITS: Final = (3, 6, 9)
_UNIT_TOLERANCE: Final = 0.01
_PACES: Final = (0.1, 10.0)
"""Simulations and players run slower or faster than the log. Beyond this the log was not written while things happened, and
its times say nothing of the stamps."""
_LATE_PACES: Final = (0.8, 1.25)
_MAX_SEGMENTS: Final = 10
_SEGMENTED: Final = 0.8
_COPIED: Final = 0.5
_ABSURD_S: Final = 30 * 86400.0
_FIRST_LOG_NS: Final = 631_152_000 * 10**9
"""1990: nobody recorded logs before. A stamp of then counts from some start, not from 1970."""


@dataclass(frozen=True, eq=False)
class Stamps:
    """What one source says of time, in the order in which it was logged.

    time_ns, log_time_ns [N]; place [N, D] is what moves; who [N] tells whose it is (empty: all of one)
    """

    time_ns: Int64s
    log_time_ns: Int64s
    place: Float64s
    who: Objects = field(default_factory=lambda: np.zeros(0, dtype=object))

    def __len__(self) -> int:
        return len(self.time_ns)

    def __getitem__(self, rows: Int64s) -> "Stamps":
        return Stamps(self.time_ns[rows], self.log_time_ns[rows], self.place[rows])

    @property
    def ahead_s(self) -> Float64s:
        """How far stamps are ahead of log times [N]; in floats, as the difference may be larger than any int64."""
        return (self.time_ns.astype(np.float64) - self.log_time_ns.astype(np.float64)) * 1e-9


@dataclass(frozen=True)
class Clock:
    """How far a clock is ahead of the log's: `ahead_s` at the log time `at_ns`, and `drift` seconds more each second."""

    at_ns: int = 0
    ahead_s: float = 0.0
    drift: float = 0.0

    def ahead_ns(self, log_time_ns: Int64s) -> Int64s:
        """Nanoseconds by which it is ahead at log times [N]."""
        since_s = (log_time_ns - self.at_ns).astype(np.float64) * 1e-9
        return np.round((self.ahead_s + self.drift * since_s) * 1e9).astype(np.int64)

    @property
    def is_log(self) -> bool:
        """Whether it is the log's own clock, of messages that are late at most."""
        return self.drift == 0 and -LATE_S <= self.ahead_s <= AHEAD_S

    def agrees_with(self, other: "Clock") -> bool:
        """Whether both may be one clock, read from sources of different lateness."""
        at_ns = np.array([self.at_ns, other.at_ns])
        apart_s = np.abs(self.ahead_ns(at_ns) - other.ahead_ns(at_ns)).max() * 1e-9
        return (self.is_log and other.is_log) or bool(apart_s <= AHEAD_S)


@dataclass(frozen=True, eq=False)
class Judgement:
    """What the stamps of a source are worth.

    clock     the clock that they are of; None where they are of none, or it cannot be told
    fault     what cannot be meant; empty where nothing is amiss
    is_good   which of them [N] hold
    is_copy   which of them [N] tell again what was told in an earlier pass of the same recording
    """

    clock: Clock | None
    fault: str
    is_good: Bools
    is_copy: Bools


def judge(stamps: Stamps) -> Judgement:
    """What the stamps of one source are worth."""
    no_row = np.zeros(len(stamps), np.bool_)
    if len(stamps) < MIN_ROWS:
        return Judgement(None, "", ~no_row, no_row)
    if _are_prompt(stamps):
        return Judgement(Clock(), "", ~no_row, no_row)
    is_standing, fault = _standing(stamps)
    unit = _wrong_unit(stamps)
    if is_standing.all() or unit:
        return Judgement(None, unit or fault, no_row, no_row)
    is_telling = ~is_standing & ~_unset(stamps)
    segments = _segments(stamps, is_telling)
    if len(segments) > 1:
        return _judge_jumps(stamps, segments)
    clock = _clock(stamps[np.flatnonzero(is_telling)])
    is_stray = no_row if clock is None else strays(stamps, clock)
    if is_stray.any():
        fault += (
            "; " * bool(fault) + f"{int(is_stray.sum())} of {len(stamps)} stamps are unset or of another clock than the rest"
        )
    return Judgement(clock, fault, ~(is_standing | is_stray), no_row)


def _are_prompt(stamps: Stamps) -> bool:
    """Whether all is as it is in nearly every log: stamps go on, a little behind the log times."""
    ahead_ns = stamps.time_ns - stamps.log_time_ns
    if not (stamps.time_ns.min() >= 0 and ahead_ns.min() >= -LATE_S * 1e9 and ahead_ns.max() <= AHEAD_S * 1e9):
        return False
    step_s, log_s = np.diff(stamps.time_ns) * 1e-9, np.diff(stamps.log_time_ns) * 1e-9
    return not bool((_stays(step_s, log_s) & (log_s > 0)).any())


def strays(stamps: Stamps, clock: Clock) -> Bools:
    """Which stamps [N] cannot be of the clock.

    They are ahead of it, or older than the log by over a month and ten times its length, or all late by the same time.
    """
    ahead_s = stamps.ahead_s - clock.ahead_ns(stamps.log_time_ns) * 1e-9
    length_s = float(np.ptp(stamps.log_time_ns)) * 1e-9
    found = (ahead_s > AHEAD_S + _JUMP_S) | (ahead_s < -max(_ABSURD_S, 10 * length_s))
    late = np.flatnonzero((ahead_s < -_LATE_CLOCK_S) & ~found)
    if len(late) >= MIN_ROWS and np.ptp(ahead_s[late]) <= AHEAD_S:
        found[late] = True
    return np.asarray(found)


def _unset(stamps: Stamps) -> Bools:
    """Which stamps [N] were not filled in, and took the log's time, while the others tell of another epoch."""
    found = stamps.time_ns == stamps.log_time_ns
    is_elsewhere = 2 * found.sum() < len(stamps) and abs(float(np.median(stamps.ahead_s[~found]))) > _ABSURD_S
    return np.asarray(found & is_elsewhere)


def _stays(step_s: Float64s, log_s: Float64s) -> Bools:
    """Which steps of the stamps [N] are none, beside those of the log."""
    return np.asarray((step_s == 0) | ((_SLOW * np.abs(step_s) <= log_s) & (log_s <= 1)))


def _standing(stamps: Stamps) -> tuple[Bools, str]:
    """Which stamps [N] stand still while the log goes on and what they stamp moves, and the fault in words.

    All of them where that is the rule; else those of the stretches in which their clock stood.
    """
    order, is_next = np.arange(len(stamps)), np.ones(len(stamps) - 1, np.bool_)
    if len(stamps.who):
        who = Names.of(stamps.who).number
        order = np.argsort(who, kind="stable")
        is_next = who[order][1:] == who[order][:-1]
    step_s = np.diff(stamps.time_ns[order]).astype(np.float64) * 1e-9
    log_s = np.diff(stamps.log_time_ns[order]).astype(np.float64) * 1e-9 * is_next
    stays = is_next & _stays(step_s, log_s)
    moves = stays & (log_s > 0) & (np.diff(stamps.place[order], axis=0) != 0).any(axis=1)
    found = np.zeros(len(stamps), np.bool_)
    if not moves.any():
        return found, ""
    if log_s[moves].sum() >= _STANDING * log_s.sum():
        found[:] = True
    else:
        run = np.cumsum(~stays)
        lasts_s = np.bincount(run, weights=log_s * stays)
        usual_s = float(np.median(step_s[is_next & (step_s > 0)])) if (is_next & (step_s > 0)).any() else 0.0
        found[order[1:][moves & (lasts_s[run] > max(_STANDING_STEPS * usual_s, AHEAD_S))]] = True
        if not found.any():
            return found, ""
    whole = ", all in whole seconds," if (stamps.time_ns % 10**9 == 0).all() and np.ptp(stamps.time_ns) else ""
    fault = f"{int(moves.sum())} of {len(stamps)} stamps{whole} repeat the one before, while what they stamp moves"
    return found, f"{fault} and the log goes on for {log_s[moves].sum():.3g} s"


def _wrong_unit(stamps: Stamps) -> str:
    """The fault of stamps that run a thousand, a million or 1e9 times as fast or slow as the log; empty where they do not."""
    pace = _pace(stamps)
    if not pace > 0:
        return ""
    power = round(np.log10(pace))
    is_unit = abs(power) in _UNITS and abs(pace / 10.0**power - 1) < _UNIT_TOLERANCE
    # Where the log's dates are impossible, and the stamps' are not, it is the log's unit that is wrong.
    if not is_unit or stamps.log_time_ns[0] < _FIRST_LOG_NS <= stamps.time_ns[0]:
        return ""
    stamps_s, log_s = (float(np.ptp(times.astype(np.float64))) * 1e-9 for times in (stamps.time_ns, stamps.log_time_ns))
    return f"stamps run over {stamps_s:.4g} s while the log runs over {log_s:.4g} s: their unit is not the one they are read in"


def _pace(stamps: Stamps) -> float:
    """Seconds of the stamps for a second of the log: the median over pairs half the rows apart; NaN where it cannot be said."""
    half = len(stamps) // 2
    log_s = (stamps.log_time_ns[half:] - stamps.log_time_ns[: len(stamps) - half]).astype(np.float64)
    time_s = stamps.time_ns[half:].astype(np.float64) - stamps.time_ns[: len(stamps) - half].astype(np.float64)
    is_known = log_s > 0
    return float(np.median(time_s[is_known] / log_s[is_known])) if is_known.any() else float("nan")


def _segments(stamps: Stamps, is_telling: Bools) -> list[Int64s]:
    """Row numbers of the stretches between steps of the offset, without single odd rows; one where jumps are the rule."""
    rows, ahead_s = np.flatnonzero(is_telling), stamps.ahead_s
    parts = np.split(rows, np.flatnonzero(np.abs(np.diff(ahead_s[rows])) > _JUMP_S) + 1)
    joined: list[Int64s] = []
    for part in parts:
        if joined and len(part) >= MIN_ROWS and abs(ahead_s[part[0]] - ahead_s[joined[-1][-1]]) <= _JUMP_S:
            joined[-1] = np.concatenate([joined[-1], part])
        elif len(part) >= MIN_ROWS:
            joined.append(part)
    is_stepped = 1 < len(joined) <= _MAX_SEGMENTS and sum(map(len, joined)) > _SEGMENTED * len(rows)
    return joined if is_stepped else [rows]


def _judge_jumps(stamps: Stamps, segments: list[Int64s]) -> Judgement:
    """The judgement of stamps whose offset from the log takes steps."""
    no_row, is_first = np.zeros(len(stamps), np.bool_), np.zeros(len(stamps), np.bool_)
    borders = [(before[-1], after[0]) for before, after in itertools.pairwise(segments)]
    steps_s = [(float(stamps.time_ns[after]) - float(stamps.time_ns[before])) * 1e-9 for before, after in borders]
    log_s = [float(stamps.log_time_ns[after] - stamps.log_time_ns[before]) * 1e-9 for before, after in borders]
    if all(abs(step) < log for step, log in zip(steps_s, log_s, strict=True)):  # it is the log's clock that was set
        return Judgement(None, "", ~no_row, no_row)
    jumps = ", ".join(f"{step:+.4g}" for step in steps_s[:3]) + " and so on" * (len(steps_s) > 3)
    fault = f"stamps jump {counted(len(borders), 'time')} (by {jumps} s) while the log goes on"
    is_first[: segments[1][0]] = True
    if min(np.isin(stamps.time_ns[part], stamps.time_ns[is_first]).mean() for part in segments[1:]) >= _COPIED:
        fault = f"{fault}, back to stamps that were there before: a recording was played {len(segments)} times"
        return Judgement(_clock(stamps[segments[0]]), fault, ~no_row, ~is_first)
    return Judgement(None, fault, no_row, no_row)


def _are_of_two(ahead_s: Float64s) -> bool:
    """Whether some stamps are of the log's clock, and all others ahead of it by one time: no message is early."""
    is_log, is_ahead = (ahead_s >= -LATE_S) & (ahead_s <= AHEAD_S), ahead_s > AHEAD_S + _JUMP_S
    is_either = bool((is_log | is_ahead).all()) and min(is_log.sum(), is_ahead.sum()) >= MIN_ROWS
    return is_either and bool(np.ptp(ahead_s[is_ahead]) <= AHEAD_S)


def _clock(stamps: Stamps) -> Clock | None:
    """The clock that most of the stamps are of; None where log times and stamps have nothing to do with each other."""
    at_ns, pace, ahead_s = int(np.median(stamps.log_time_ns)), _pace(stamps), stamps.ahead_s
    late_s, usual_s, early_s = np.quantile(ahead_s, (0.05, 0.5, 0.95))
    spread_s = early_s - late_s
    if spread_s <= AHEAD_S:
        return Clock(at_ns, float(usual_s))
    if _are_of_two(ahead_s):
        return Clock(at_ns)
    if not _PACES[0] <= pace <= _PACES[1]:
        return None
    level_s = ahead_s - (pace - 1) * (stamps.log_time_ns - at_ns).astype(np.float64) * 1e-9
    if spread_s > LATE_S and np.ptp(np.quantile(level_s, (0.05, 0.95))) < max(AHEAD_S, _LATENESS * spread_s):
        return Clock(at_ns, float(np.median(level_s)), pace - 1)
    if not _LATE_PACES[0] <= pace <= _LATE_PACES[1]:
        return None
    # Of messages that are late by chance, those that are least late show the clock: the log's, or one that is far from it.
    return Clock(at_ns, float(early_s)) if spread_s < _LATENESS * abs(early_s) or early_s > AHEAD_S else Clock(at_ns)
