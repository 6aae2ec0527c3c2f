"""Positions that were not measured as they stand: repeated while the target went on, or rounded."""

from pathlib import Path

import numpy as np
import pytest
from fixtures.small_logs import Row, detection, fix, time_ns
from test_extract import fails, run

from cadence.errors import InputError

NUM = 120


def way(seed: int = 0) -> np.ndarray:
    """A target that goes on at 8 m/s, with noise of 2 m [N, 2]."""
    noise = np.random.default_rng(seed).normal(0.0, 2.0, (NUM, 2))
    return np.column_stack([8.0 * np.arange(NUM), 3.0 * np.sin(np.arange(NUM) / 9.0)]) + noise


def seen(place_m: np.ndarray, is_geodetic: bool = False, agent: str | None = "a") -> list[Row]:
    if is_geodetic:
        degrees = np.array([48.1, 11.6]) + place_m[:, ::-1] / np.array([111_200.0, 74_300.0])
        return [fix(float(i), *place, topic="/contacts/a") for i, place in enumerate(degrees.tolist())]
    more = {} if agent is None else {"agent_id": agent}
    return [detection(float(i), *place, **more) for i, place in enumerate(place_m.tolist())]


@pytest.mark.parametrize(("is_geodetic", "agent"), [(True, "a"), (False, "a"), (False, None)])
def test_a_position_that_is_repeated_while_the_target_goes_on_is_none(
    tmp_path: Path, is_geodetic: bool, agent: str | None
) -> None:
    place_m = way()
    place_m[41:80] = place_m[40]
    found = run(tmp_path, seen(place_m, is_geodetic, agent))
    assert len(found.detections) == NUM - 39
    (told,) = found.summary["suspicions"]
    assert told["kind"] == "place" and told["seen"].startswith(f"39 of {NUM} positions repeat the one before to the last digit")
    assert len(run(tmp_path, seen(place_m, is_geodetic, agent), trusted=["place"]).detections) == NUM


def standing() -> np.ndarray:
    """It stops, says so exactly, and goes on from there."""
    place_m = way()
    place_m[41:80] = place_m[40]
    place_m[80:] -= place_m[80] - place_m[40] - [8.0, 0.0]
    return place_m


def now_and_then() -> np.ndarray:
    place_m = way()
    place_m[1:30:2] = place_m[0:30:2]
    return place_m


def teleporting() -> np.ndarray:
    """It is somewhere else afterwards: another target, or carried there."""
    place_m = way()
    place_m[41:80] = place_m[40]
    place_m[80:] += 50_000.0
    return place_m


@pytest.mark.parametrize(
    "place_m",
    [
        standing(),
        np.repeat(way()[::30], 30, axis=0),
        teleporting(),
        way(),
        np.rint(0.2 * way()),
        now_and_then(),
    ],
    ids=["stands", "each thirty times", "elsewhere", "measured", "in whole metres", "now and then"],
)
def test_what_repeats_itself_in_another_way_is_left_as_it_is(tmp_path: Path, place_m: np.ndarray) -> None:
    found = run(tmp_path, seen(place_m))
    assert not [told for told in found.summary["suspicions"] if "to the last digit" in told["seen"]]


@pytest.mark.parametrize(("is_geodetic", "agent"), [(True, "a"), (False, "a"), (False, None)])
@pytest.mark.parametrize("length", [(5,), (1, 2, 4, 3)])
def test_positions_that_are_published_more_often_than_measured(
    tmp_path: Path, length: tuple[int, ...], is_geodetic: bool, agent: str | None
) -> None:
    """As by a list of all aircraft that were heard lately: a position stays in it until there is another one."""
    shown = np.repeat(np.arange(NUM), np.resize(length, NUM))[:NUM]
    place_m = way()[np.maximum.accumulate(np.concatenate([[0], np.flatnonzero(np.diff(shown)) + 1])[shown])]
    found = run(tmp_path, seen(place_m, is_geodetic, agent))
    assert len(found.detections) == len(np.unique(shown))
    (told,) = found.summary["suspicions"]
    assert told["kind"] == "place" and "published more often than measured" in told["seen"]
    assert found.detections["time_ns"].to_pylist() == [time_ns(float(row)) for row in np.unique(shown, return_index=True)[1]]


def test_a_target_that_stops_between_positions_told_twice_stays(tmp_path: Path) -> None:
    place_m = np.repeat(way()[: NUM // 2], 2, axis=0)
    place_m[90:] -= place_m[90] - place_m[60] - [8.0, 0.0]
    place_m[60:90] = place_m[60]
    assert len(run(tmp_path, seen(place_m)).detections) == 45 + 30


def test_a_target_that_stood_before_a_silence_is_believed(tmp_path: Path) -> None:
    place_m = way()
    place_m[30:41] = place_m[30]
    rows = [each for number, each in enumerate(seen(place_m)) if not 41 <= number < 80]
    assert run(tmp_path, rows).summary["suspicions"] == []


@pytest.mark.parametrize(("decimals", "sigma_m"), [(2, 321.3), (3, 32.13)])
def test_rounded_degrees_are_as_exact_as_their_decimals(tmp_path: Path, decimals: int, sigma_m: float) -> None:
    rows = [fix(float(i), round(48.1 + 2e-4 * i, decimals), round(11.6 + 3e-4 * i, decimals)) for i in range(300)]
    found = run(tmp_path, rows)
    (told,) = [each for each in found.summary["suspicions"] if "decimals" in each["seen"]]
    assert told["done"] == f"a standard deviation of {sigma_m:.3g} m is taken"
    assert np.sqrt(np.median(found.detections["cov_yy_m2"].to_numpy())) == pytest.approx(sigma_m, rel=0.01)
    stated = run(tmp_path, rows, detections=[{"topic": "/contacts/{agent}", "sigma_m": 50.0}])
    assert not [each for each in stated.summary["suspicions"] if "decimals" in each["seen"]]


@pytest.mark.parametrize("step_deg", [1e-4, 0.0])
def test_fine_degrees_and_a_target_that_stands_are_not_rounded(tmp_path: Path, step_deg: float) -> None:
    rows = [fix(float(i), round(48.1 + step_deg * i, 4), round(11.6 + step_deg * i, 4)) for i in range(100)]
    assert not [each for each in run(tmp_path, rows).summary["suspicions"] if "decimal" in each["seen"]]


@pytest.mark.parametrize("agent", ["a", None])
@pytest.mark.parametrize("unit_m", [0.001, 0.01])
def test_a_coordinate_that_runs_over_its_field_is_named(tmp_path: Path, unit_m: float, agent: str | None) -> None:
    place_m = way() * unit_m / 0.01
    counts = np.round((place_m + np.array([250.0 * unit_m / 0.01, 0.0])) / unit_m).astype(np.int64)
    wrapped_m = ((counts + 2**15) % 2**16 - 2**15) * unit_m
    told = [each for each in run(tmp_path, seen(wrapped_m, agent=agent)).summary["suspicions"] if "16 bits" in each["seen"]]
    assert [each["seen"].split(",")[0] for each in told] == [f"x jumps 2 times by {2**16 * unit_m:g} m"]
    wide = run(tmp_path, seen(counts * unit_m, agent=agent)).summary["suspicions"]
    assert not [each for each in wide if "16 bits" in each["seen"]]


@pytest.mark.parametrize("text", ["48,1", "48°06'00\"N", "unknown"])
def test_text_that_is_no_number_is_called_so(tmp_path: Path, text: str) -> None:
    rows = [fix(float(i), text, "11,6") for i in range(5)]
    fails(tmp_path, rows, InputError, "every position is text that is no number")
    assert run(tmp_path, [fix(float(i), "48.1", "11.6") for i in range(5)]).summary["num_detections"] == 5
