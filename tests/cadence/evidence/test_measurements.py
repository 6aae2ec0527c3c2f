"""Bearings, elevations, ranges and range rates: by hand, robust, of whom, contradiction, two modes on a grid, refusals."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from test_weighing import ORIGIN, Walk, mean_and_deviation, windows

from cadence.evidence.estimator import CONTRADICTED, WithEvidence
from cadence.evidence.measurements import KINDS, Measurements, sigma_name
from cadence.evidence.settings import WeighingConfig
from cadence.types import Tracks

SIGMA = {"bearing_rad": 0.1, "elevation_rad": 0.1, "range_m": 1.0, "range_rate_mps": 0.5}


def measured(time_s, observer_m=(0.0, 0.0), agents=None, velocity_mps=(0.0, 0.0), height_m=math.nan, **values) -> Measurements:
    num = len(time_s)
    columns = {kind: np.broadcast_to(np.asarray(values.get(kind, np.nan), float), (num,)) for kind in KINDS}
    sigmas = {sigma_name(kind): np.full(num, float(values.get(sigma_name(kind), SIGMA[kind]))) for kind in KINDS}
    place, moves = (np.broadcast_to(np.asarray(pair, float), (num, 2)) for pair in (observer_m, velocity_mps))
    named = tuple(agents or [None] * num)
    return Measurements(np.asarray(time_s, float), place, moves, np.full(num, height_m), **columns, **sigmas, agent_ids=named)


def tracks(*paths_m, time_s=(0.0, 10.0, 20.0), names=(), height_m=None) -> Tracks:
    """Hypotheses of one agent."""
    position = torch.tensor(paths_m, dtype=torch.float64)[None, :, None]
    height = None if height_m is None else torch.tensor(height_m, dtype=torch.float64)[None, :, None]
    return Tracks(position, torch.tensor([time_s], dtype=torch.float64), names, height)


def said(measurements: Measurements, *paths_m, **more) -> list[float]:
    return measurements.log_likelihood(tracks(*paths_m, **more))[0, :, 0].tolist()


def robust(deviation: float, level: float) -> float:
    level *= 0.01 / 0.99
    return math.log((math.exp(-0.5 * deviation**2) + level) / (1 + level))


PATH = [[30, 0], [30, 40], [30, 80]]


def test_by_hand_between_steps():
    # at 5 s the track is at (30, 20), at 10 s at (30, 40), 50 m from the observer, and recedes at 4 m/s * 4 / 5
    turn = 0.1 / math.sqrt(2 * math.pi)
    assert said(measured([5.0], bearing_rad=math.atan2(20, 30) + 0.15 - 2 * math.pi), PATH)[0] == pytest.approx(
        robust(1.5, turn)
    )
    assert said(measured([10.0], range_m=51.0), PATH)[0] == pytest.approx(robust(1.0, 0.01))
    assert said(measured([10.0], range_rate_mps=3.7), PATH)[0] == pytest.approx(robust(1.0, 0.01))
    # an observer that goes along with it sees it recede by nothing
    assert said(measured([10.0], velocity_mps=(0, 4), range_rate_mps=0.0), PATH) == [0.0]
    assert said(measured([10.0], velocity_mps=(np.nan, 4), range_rate_mps=9.0), PATH) == [0.0]
    both = measured([5.0, 10.0, 20.0], observer_m=[[0, 0], [0, 0], [30, 40]], range_m=[np.nan, 51.0, 40.0])
    assert said(both, PATH)[0] == pytest.approx(robust(1.0, 0.01))
    # before and after the track nothing is said
    late = measured([-1.0, 20.0, 20.5], range_m=[7.0, math.hypot(30, 80), 7.0])
    assert said(late, PATH) == [0.0] and late.touches(torch.tensor([[0.0, 10.0, 20.0]]).double()).tolist() == [
        [False, True, True]
    ]


def test_heights_make_elevations_and_slant_ranges():
    high = [[50.0, 50.0, 50.0]]
    seen = measured([10.0], height_m=0.0, range_m=math.hypot(50, 50), elevation_rad=math.pi / 4)
    assert said(seen, PATH, height_m=high) == pytest.approx([0.0])
    low = measured([10.0], height_m=0.0, elevation_rad=math.pi / 4 + 0.2)
    assert said(low, PATH, height_m=high)[0] == pytest.approx(robust(2.0, 0.1 * math.sqrt(2 / math.pi)))
    # without heights of tracks the elevation projects the range, and says nothing else
    assert said(seen, PATH) == pytest.approx([0.0]) and said(low, PATH) == [0.0]
    assert said(measured([10.0], range_m=50.0), PATH) == [0.0]


def test_one_wild_value_never_rules_out_the_truth():
    times = np.linspace(0.0, 20.0, 11)
    bearing = np.arctan2(4.0 * times, 30.0)
    bearing[3] += 2.0
    good, bad = said(measured(times, bearing_rad=bearing, bearing_sigma_rad=0.02), PATH, [[-30, 0], [-30, 40], [-30, 80]])
    assert -12 < good < -8 and bad < 8 * good


def test_of_whom_a_row_speaks():
    position = torch.tensor([PATH, PATH], dtype=torch.float64).movedim(0, 0)[None, None]
    three = measured([10.0] * 3, agents=["T1", None, "T9"], range_m=51.0)
    one = robust(1.0, 0.01)
    time_s = torch.tensor([[0.0, 10.0, 20.0]]).double()
    assert three.log_likelihood(Tracks(position, time_s, ("T0", "T1")))[0, 0].tolist() == pytest.approx([0.0, one])
    assert three.log_likelihood(Tracks(position, time_s))[0, 0].tolist() == [0.0, 0.0]
    # who is alone has what nobody is named for as well
    assert said(three, PATH, names=("T1",)) == pytest.approx([2 * one]) and said(three, PATH) == pytest.approx([one])
    gone = [[math.nan] * 2] * 3
    assert said(three, gone, PATH) == pytest.approx([0.0, one])
    assert not three.contradicts(tracks(gone), torch.zeros(1, 1, 1)).any()


def test_some_of_the_rows():
    whole = measured([0.0, 5.0, 10.0], agents=["a", "b", None], range_m=[1.0, 2.0, 3.0])
    for rows in (slice(1, None), np.array([False, True, True]), np.array([1, 2])):
        part = whole[rows]
        assert len(part) == 2 and part.agent_ids == ("b", None) and part.range_m.tolist() == [2.0, 3.0]


def test_what_no_track_reaches_is_told_and_set_aside():
    times = np.linspace(960.0, 1000.0, 9)
    nobody = measured(times, observer_m=(0, -1000), range_m=2000.0, agents=["T0"] * 9)
    assert WithEvidence(Walk()).sample(windows(nobody), 30).status == ((CONTRADICTED,),)
    # a sharp bearing that none of thirty tracks fits is no contradiction: it lies among them
    sharp = measured(times, observer_m=(0, -1000), bearing_rad=math.pi / 2, bearing_sigma_rad=1e-5, agents=["T0"] * 9)
    assert WithEvidence(Walk()).sample(windows(sharp), 30).status != ((CONTRADICTED,),)
    behind = dataclasses.replace(sharp, bearing_rad=-sharp.bearing_rad)
    assert WithEvidence(Walk()).sample(windows(behind), 30).status == ((CONTRADICTED,),)


def test_columns_without_an_angle_warn_of_nothing():
    ranges = measured([0.0, 10.0], range_m=100.0, bearing_sigma_rad=math.nan, elevation_sigma_rad=math.nan)
    paths = tracks([(100.0, 0.0)] * 3, [(90.0, 0.0)] * 3)
    with np.errstate(all="raise"):
        assert ranges.contradicts(paths, ranges.log_likelihood(paths)).tolist() == [[False]]


def test_two_ranges_with_two_modes_agrees_with_a_grid():
    """A ring about an observer and the same range from another: two places, weighed as the prior says."""
    at_m = np.array([[-3.0, 1.0], [3.0, 1.0]])
    seen = measured([990.0, 990.0], observer_m=at_m, range_m=[3.5, 3.2], range_sigma_m=0.4, agents=["T0"] * 2)
    x, y = np.meshgrid(np.linspace(-12, 12, 481), np.linspace(-12, 12, 481), indexing="ij")
    place = np.stack([x, y], axis=-1)[..., None, :]
    weight = np.exp(-(x**2 + y**2) / 8.0 + seen.fits(place, place).sum(axis=-1))  # the walk has variance 4 an axis at step 3
    weight /= weight.sum()
    found = WithEvidence(Walk(), WeighingConfig(most_draws=1)).sample(windows(seen), 40_000)
    mean, deviation = mean_and_deviation(found, ORIGIN - 1)
    exact = float((weight * x).sum())
    assert mean == pytest.approx(exact, abs=0.05) and deviation == pytest.approx(
        math.sqrt((weight * x**2).sum() - exact**2), abs=0.05
    )
    upper = float(found.weight[0] @ (found.position_m[0, :, 0, ORIGIN - 1, 1] > 1.0).double())
    assert 0.1 < upper < 0.5 and upper == pytest.approx(float(weight[y > 1.0].sum()), abs=0.03)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"range_m": np.full(2, -1.0)}, "negative"),
        ({"bearing_rad": np.full(2, 90.0)}, "degrees"),
        ({"elevation_rad": np.full(2, 2.0)}, "degrees"),
        ({"bearing_rad": np.zeros(2), "bearing_sigma_rad": np.zeros(2)}, "bearing_sigma_rad must be above zero"),
        ({"range_m": np.ones(2), "range_sigma_m": np.full(2, np.nan)}, "range_sigma_m"),
        ({"time_s": np.array([1.0, 0.0])}, "not fall"),
        ({"observer_m": np.full((2, 2), np.nan)}, "finite"),
        ({"observer_m": np.zeros((3, 2))}, "shape"),
        ({"agent_ids": ()}, "0 agents for 2 rows"),
        ({"outlier_share": 0.0}, "outlier_share"),
    ],
)
def test_what_cannot_have_been_measured_is_refused(change, words):
    with pytest.raises(ValueError, match=words):
        dataclasses.replace(measured([0.0, 1.0]), **change)
