"""Stamps against log times: clocks that cannot be meant, and the many that can."""

import numpy as np
import pytest

from cadence.arrays import Float64s
from pipeline.extract.clocks import Clock, Judgement, Stamps, judge

START_S = 1_720_000_000.0
NUM = 120
LOG_S = np.arange(NUM, dtype=np.float64)


def stamps(
    ahead_s: Float64s | float = 0.0, log_s: Float64s = LOG_S, who: list[str] | None = None, moves: bool = True
) -> Stamps:
    """Stamps `ahead_s` of the log times `log_s` after the start."""
    log_ns = round(START_S * 1e9) + np.round(log_s * 1e9).astype(np.int64)
    place = np.column_stack([3.0 * np.arange(len(log_s)) * moves, np.zeros(len(log_s))])
    ahead_ns = np.round(np.broadcast_to(ahead_s, log_s.shape) * 1e9).astype(np.int64)
    return Stamps(log_ns + ahead_ns, log_ns, place)


def stamped(time_s: Float64s, log_s: Float64s = LOG_S, **more: bool) -> Stamps:
    """Stamps at `time_s` since 1970."""
    return stamps(time_s - START_S - log_s, log_s, **more)


def num_good(found: Judgement) -> int:
    return int(found.is_good.sum())


RNG = np.random.default_rng(3)
QUEUE_S = np.where((LOG_S >= 40) & (LOG_S < 70), LOG_S - 70, 0.0)  # an outage of half a minute, sent at its end
SOUND = {
    "stamps of the log": stamps(),
    "a little late, by chance": stamps(-RNG.exponential(0.2, NUM)),
    "late by minutes, by chance": stamps(-RNG.exponential(900.0, NUM) - 600.0),
    "late by half a minute, by chance": stamps(-RNG.exponential(20.0, NUM)),
    "held up for half a minute": stamps(QUEUE_S, np.sort(LOG_S - QUEUE_S)),
    "a recording of last month": stamps(-30 * 86400.0),
    "a simulation that began at zero": stamps(-START_S - 5.0),
    "a simulation at half speed": stamped(0.5 * LOG_S + 10),
    "a player at three times the speed": stamps(-86400.0 + 2 * LOG_S),
    "a converter that wrote an hour in a second": stamps(-1e6 + 3600 * LOG_S, LOG_S / 120),
    "a converter that wrote all at one moment": stamps(-1e6 + 60 * LOG_S, 0 * LOG_S),
    "a converter that wrote at its own pace": stamps(-1e6 + 500 * LOG_S, np.sort(RNG.gamma(0.1, 9.0, NUM))),
    "a log in microseconds": Stamps(stamps().time_ns, stamps().time_ns // 1000, stamps().place),
    "whole seconds, once a second": stamped(np.floor(START_S + LOG_S)),
    "a target that stands": stamped(np.floor(START_S + LOG_S / 10), LOG_S / 10, moves=False),
    "three plots of a scan": stamped(START_S + LOG_S // 3 * 4.0, LOG_S // 3 * 4.0 + 0.01 * (LOG_S % 3)),
    "one clock set, the recorder's": stamps(np.where(LOG_S < 30, 5e6, 0.0), LOG_S - np.where(LOG_S < 30, 5e6, 0.0)),
    "two rows": stamps(-300.0, LOG_S[:2]),
    "many ships with whole seconds": Stamps(
        *(stamped(np.floor(START_S + LOG_S / 10), LOG_S / 10).__dict__[name] for name in ("time_ns", "log_time_ns", "place")),
        np.arange(NUM) % 30,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", SOUND)
def test_clocks_that_can_be_meant(name: str) -> None:
    found = judge(SOUND[name])
    assert (found.fault, num_good(found), found.is_copy.any()) == ("", len(SOUND[name]), False)


BOOT_S = 90.0 + LOG_S
LOOPS_S = START_S - 86400 + LOG_S % 40
BROKEN = {
    "microseconds since boot": (stamped(1e6 * BOOT_S), "unit", 0),
    "milliseconds since boot": (stamped(1e3 * BOOT_S), "unit", 0),
    "frozen": (stamped(0 * LOG_S + START_S), "119 of 120 stamps repeat", 0),
    "frozen at zero": (stamped(0 * LOG_S), "repeat the one before", 0),
    "whole seconds of ten a second": (stamped(np.floor(START_S + LOG_S / 10), LOG_S / 10), "all in whole seconds", 0),
    "whole seconds of two a second": (stamped(np.floor(START_S + LOG_S / 2), LOG_S / 2), "all in whole seconds", 0),
    "frozen for a while": (stamps(np.where((LOG_S > 50) & (LOG_S < 80), 50 - LOG_S, 0.0)), "repeat the one before", NUM - 29),
    "set after a while": (stamps(np.where(LOG_S < 30, -3e8, 0.0)), "jump 1 time", 0),
    "set back after a while": (stamps(np.where(LOG_S < 90, 0.0, -3600.0)), "jump 1 time", 0),
    "first ones unset": (stamped(np.where(LOG_S < 2, START_S + LOG_S, 50.0 + LOG_S)), "2 of 120 stamps are unset", NUM - 2),
    "one of the future": (stamps(np.where(LOG_S == 7, 1e9, 0.0)), "1 of 120 stamps", NUM - 1),
    "every other an hour late": (stamps(np.where(LOG_S % 2 == 0, -3600.0, 0.0)), "60 of 120 stamps", 60),
    "every other by the time of satellites": (stamps(np.where(LOG_S % 2 == 0, 37.0, 0.0)), "60 of 120 stamps", 60),
    "every third an hour early": (stamps(np.where(LOG_S % 3 == 0, 3600.0, 0.0)), "40 of 120 stamps", 80),
    "every other an hour early": (stamps(np.where(LOG_S % 2 == 0, 3600.0, 0.0)), "60 of 120 stamps", 60),
}


@pytest.mark.parametrize("name", BROKEN)
def test_clocks_that_cannot_be_meant(name: str) -> None:
    source, words, good = BROKEN[name]
    found = judge(source)
    assert words in found.fault and num_good(found) == good


def test_a_recording_that_is_played_again_counts_once() -> None:
    found = judge(stamped(LOOPS_S))
    assert "jump 2 times (by -39, -39 s)" in found.fault and "played 3 times" in found.fault
    assert found.is_copy.tolist() == [False] * 40 + [True] * 80 and num_good(found) == NUM
    restarted = judge(stamped(LOOPS_S + 0.37 * (LOG_S // 40)))  # a simulation that is reset tells something new each time
    assert "jump 2 times" in restarted.fault and not restarted.is_copy.any() and num_good(restarted) == 0


@pytest.mark.parametrize(
    ("name", "ahead_s", "drift"),
    [
        ("stamps of the log", 0.0, 0.0),
        ("late by half a minute, by chance", 0.0, 0.0),
        ("a recording of last month", -30 * 86400.0, 0.0),
        ("a simulation at half speed", 10 - START_S - 0.5 * 60, -0.5),
        ("a player at three times the speed", 2 * 60 - 86400.0, 2.0),
    ],
)
def test_which_clock_it_is(name: str, ahead_s: float, drift: float) -> None:
    clock = judge(SOUND[name]).clock
    assert clock is not None and clock.ahead_s == pytest.approx(ahead_s, abs=2.0) and clock.drift == pytest.approx(drift)
    assert clock.is_log == (ahead_s == 0)


def test_clocks_that_agree() -> None:
    assert Clock(0, -9.0).agrees_with(Clock(5, 1.0))  # lateness of the log's own clock
    assert Clock(0, -7200.0).agrees_with(Clock(10**12, -7201.0)) and not Clock(0, -7200.0).agrees_with(Clock())
    half = Clock(0, -50.0, -0.5)
    assert half.agrees_with(Clock(100 * 10**9, -100.0, -0.5)) and not half.agrees_with(Clock(100 * 10**9, -50.0, -0.5))
