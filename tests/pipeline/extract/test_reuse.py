"""Names that several targets bear: split, or taken away; and tracks of one target, however it moves and is seen, that stay."""

from typing import Any

import numpy as np
import pytest
from fixtures.detection_rows import rows, together

from pipeline.extract.names import Naming
from pipeline.extract.positions import Positions
from pipeline.extract.reuse import without_reused_names
from pipeline.extract.tracks import Track, odd_share, pieces_of
from pipeline.suspicions import Suspicions

Floats = np.ndarray[Any, np.dtype[np.float64]]


def named(found: Positions, believed: str = "") -> tuple[list[str | None], list[str]]:
    suspicions = Suspicions()
    kept = without_reused_names(found, 0.001, Naming({believed}, set()), suspicions)
    return kept.agent.tolist(), suspicions.lines()


def car(first_s: float, last_s: float, x: float, y: float, speed_mps: float, name: str = "7", step_s: float = 1.0) -> list[Any]:
    times = np.arange(first_s, last_s + step_s / 2, step_s)
    return [(round(t / step_s), float(t), x + speed_mps * (t - first_s), y, name) for t in times]


def test_a_name_that_is_given_out_again_becomes_two() -> None:
    found = rows(*car(0, 29, 0.0, 0.0, 10.0), *car(33, 62, 400.0, 350.0, -8.0))
    names, (line,) = named(found)
    assert names == ["7"] * 30 + ["7.2"] * 30
    assert '"7" jumps 366.9 m in 4 s, 9.17 times its speed; 1 name became 2 agents (7, 7.2, ...)' in line
    assert named(found, believed="/seen") == (["7"] * 60, [])


@pytest.mark.parametrize(("kind", "num"), [("car_", 4), ("", 4), ("Person-", 4), ("rover", 2), ("boat 1", 2)])
def test_numbers_by_the_order_of_places_change_where_targets_pass(kind: str, num: int) -> None:
    """Two cars meet, and from then on the first in the list is the other one."""
    items = [
        (i, float(i), *place, f"{kind}{k}")
        for i in range(60) for k, place in enumerate(sorted([(3.0 * i, 0.0), (151.0 - 3.0 * i, 40.0)]))
    ]  # fmt: skip
    names, lines = named(rows(*items))
    assert len(set(names)) == num and len(lines) == (num > 2)


def test_three_targets_and_one_that_comes_back() -> None:
    found = rows(*car(0, 9, 0, 0, 9), *car(10, 19, 5e3, 0, 9), *car(20, 29, 180, 0, 9), *car(30, 39, 0, -8e3, 9))
    assert named(found)[0] == ["7"] * 10 + ["7.2"] * 10 + ["7"] * 10 + ["7.3"] * 10


def test_a_radar_at_twenty_hertz() -> None:
    found = rows(*car(0.0, 2.0, 0, 0, 10, step_s=0.05), *car(2.1, 4.0, 60, 20, 9, step_s=0.05))
    assert set(named(found)[0]) == {"7", "7.2"}


def test_two_targets_that_take_turns_are_nobody() -> None:
    items = [(i, i / 2, 5.0 * i, 90.0 * (i % 2), "7") for i in range(40)]
    names, (line,) = named(rows(*items))
    assert names == [None] * 40 and "leave and come back faster than anything moves; 40 detections" in line
    at_once = [(2 * i + k, float(i), 5.0 * i, 90.0 * k, "7") for i in range(20) for k in (0, 1)]  # a message a detection
    assert named(rows(*at_once))[0] == [None] * 40


def test_numbers_of_places_in_a_list_are_nobody() -> None:
    """Of three targets that stand in another order in each message, or of which each message tells one."""
    rng = np.random.default_rng(0)
    mixed = [(i, float(i), 5.0 * i, 300.0 * k, str(name)) for i in range(60) for name, k in enumerate(rng.permutation(3))]
    names, (line,) = named(rows(*mixed))
    assert names == [None] * 180 and '"0", "1", "2" would be at several places at once' in line
    assert named(rows(*[(i, float(i), 5.0 * i, 300.0 * (i % 3), "0") for i in range(60)]))[0] == [None] * 60


@pytest.mark.parametrize("sigma_m", [150.0, 600.0])
def test_one_target_that_is_seen_badly_keeps_its_name(sigma_m: float) -> None:
    place_m = np.random.default_rng(0).normal(0.0, sigma_m, (200, 2))
    assert named(rows(*[(i, float(i), *place, "7") for i, place in enumerate(place_m.tolist())]))[0].count(None) == 0


@pytest.mark.parametrize("y_m", [300.0, 100.0])
def test_sensors_that_count_for_themselves(y_m: float) -> None:
    left, right = rows(*car(0, 29, 0, 0, 10), topic="/left/tracks"), rows(*car(0.2, 29.2, 0, y_m, 10), topic="/right/tracks")
    names, (line,) = named(together(left, right))
    assert set(names) == {"left/tracks/7", "right/tracks/7"}
    assert line.startswith(f'identity of /left/tracks, /right/tracks: sources put "7" up to {y_m:.4g}')
    one_topic = [rows(*car(0, 29, 0, y, 10), sensor=name) for name, y in (("left", 0.0), ("right", y_m))]
    assert set(named(together(*one_topic))[0]) == {"seen left/7", "seen right/7"}


def test_sensors_that_see_one_target_each_in_its_way() -> None:
    for offset_m, sigma_m in ((12.0, float("nan")), (40.0, float("nan")), (25.0, 10.0)):
        left = rows(*car(0, 29, 0, 0, 10), topic="/left/tracks", sigma_m=sigma_m)
        right = rows(*car(0.2, 29.2, 0, offset_m, 10), topic="/right/tracks", sigma_m=sigma_m)
        assert named(together(left, right)) == (["7"] * 60, [])


def _walk(rng: np.random.Generator, time_s: Floats) -> Floats:
    """A target that turns, stops and goes, at up to 15 m/s."""
    fine_s = np.arange(0.0, time_s[-1] + 2, 1.0)
    heading = np.cumsum(rng.normal(0, 0.4, len(fine_s)))
    speed = 15 * np.clip(np.cumsum(rng.normal(0, 0.15, len(fine_s))), 0, 1)
    path = np.cumsum(speed * np.exp(1j * heading))
    return np.interp(time_s, fine_s, path.real) + 1j * np.interp(time_s, fine_s, path.imag)


def _seen(rng: np.random.Generator, style: int) -> tuple[Floats, Floats]:
    """Times and places of one target, seen steadily, in bursts, rarely, on a lattice, at any time, or by a poor sensor."""
    time_s = [
        np.arange(0.0, 100.0, 0.1), np.concatenate([start + np.arange(5.0) for start in range(0, 3000, 300)]),
        np.sort(rng.uniform(0, 40_000, 60)), np.arange(0.0, 6000.0, 60.0), np.sort(rng.uniform(0, 100, 300)),
        np.arange(0.0, 100.0, 1.0),
    ][style]  # fmt: skip
    noise = rng.normal(size=len(time_s)) + 1j * rng.normal(size=len(time_s))
    place = _walk(rng, time_s) + [0.3, 3.0, 20.0, 0.0, 1.0, 30.0][style] * noise
    return time_s, np.round(place / 21) * 21 if style == 3 else place


@pytest.mark.parametrize("style", range(6))
def test_one_target_is_one_name_however_it_is_seen(style: int) -> None:
    for seed in range(60):
        time_s, place = _seen(np.random.default_rng(seed), style)
        track = Track(time_s, place, np.zeros(len(time_s)))
        piece, jump = pieces_of(track, 0.001)
        assert jump is None and not piece.any() and odd_share(track, 0.001) < 0.3, (seed, jump)


def test_faults_of_a_receiver_are_no_other_target() -> None:
    time_s = np.arange(100.0)
    for fault_m in (8e4, 60.0):  # one fix in another country; a step when the fix is found again
        place = 2.0 * time_s + 0j
        place[50 : 51 if fault_m > 100 else None] += 1j * fault_m
        assert pieces_of(Track(time_s, place, np.zeros(100)), 0.001)[1] is None


def test_what_starts_and_stops_at_once_is_one_target() -> None:
    time_s = np.arange(60.0)
    place = 12.0 * np.clip(time_s - 30, 0, 12) + 0j  # as simple simulations move
    assert pieces_of(Track(time_s, place, np.zeros(60)), 0.001)[1] is None


def test_hundreds_of_names_are_told_in_one_line() -> None:
    items = [item for k in range(200) for item in (*car(0, 4, 0, 50.0 * k, 9, f"{k}"), *car(5, 9, 9e3, 50.0 * k, 9, f"{k}"))]
    names, lines = named(rows(*sorted(items, key=lambda item: item[1])))
    assert len(set(names)) == 400 and len(lines) == 1 and "and 199 more names jump; 200 names became 400 agents" in lines[0]
