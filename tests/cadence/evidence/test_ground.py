"""The ground of a mission: what it is made of, and that silence neither takes from nor gives to what lies beyond it."""

import math

import numpy as np
import pytest
import shapely
import torch

from cadence.evidence.footprints import DetectionCurve
from cadence.evidence.ground import WIDTH, Ground, without_beyond
from cadence.evidence.silence import Looks, Silence, ground_of
from cadence.types import Tracks

CURVE = DetectionCurve(np.array([0.0, 10.0, 20.0]), np.array([0.8, 0.8, 0.0]))


def looks(time_s, places_m, curve=CURVE, **more) -> Looks:
    num = len(time_s)
    given = {"range_m": np.ones(num), "heading_rad": np.zeros(num)} | more
    return Looks(np.asarray(time_s, float), np.asarray(places_m, float).reshape(num, 2), curve=curve, **given)


def test_beyond_counts_as_the_mean_of_those_on_the_ground():
    ground = shapely.box(0.0, 0.0, 10.0, 10.0)
    place = np.array([[5.0, 5.0], [6.0, 5.0], [50.0, 5.0], [math.nan, math.nan]])
    found = without_beyond(np.log([0.2, 1.0, 1.0, 1.0]), place, ground)
    assert np.exp(found).tolist() == pytest.approx([0.2, 1.0, 0.6, 1.0])
    nobody = without_beyond(np.log([0.2, 0.5]), place[2:], ground)
    assert nobody.tolist() == pytest.approx([0.0, math.log(0.5)])


def test_the_ground_grows_with_time_and_is_never_small():
    generator = np.random.default_rng(5)
    place_m = generator.normal(size=(900, 2)) * np.linspace(1.0, 40.0, 900)[:, None]
    ground = Ground(np.arange(900.0), place_m, 0.0)
    assert ground.until(-1.0) is None
    areas = []
    for at in (3.0, 255.0, 256.0, 511.5, 899.0, 5000.0):
        found = ground.until(at)
        expected = shapely.convex_hull(shapely.multipoints(place_m[: min(int(at) + 1, 900)]))
        assert found is not None and found.symmetric_difference(expected).area < 1e-9 * expected.area
        areas.append(found.area)
    assert areas == sorted(areas) and areas[-1] > areas[0]
    alone = Ground(np.zeros(1), np.zeros((1, 2)), 30.0).until(0.0)
    assert alone is not None and alone.area == pytest.approx(math.pi * 900.0, rel=0.02)


def test_the_ground_lies_between_sensors_and_sightings():
    some = [looks([0.0, 8.0], [[0, 0], [100, 0]]), looks([4.0], [[0, 100]], range_m=np.full(1, 0.5)), looks([], [])]
    ground = ground_of(some, np.array([6.0]), np.array([[100.0, 100.0]]))
    assert ground is not None and ground.time_s.tolist() == [0.0, 4.0, 6.0, 8.0]
    assert ground.least_radius_m == WIDTH * 10.0  # half as sure as at best up to 10 m
    late, early = ground.until(8.0), ground.until(7.0)
    assert late is not None and early is not None
    assert shapely.contains_xy(late, 95.0, 50.0) and late.area > early.area
    assert ground_of([], np.zeros(0), np.zeros((0, 2))) is None


@pytest.mark.parametrize("exponent", [0.3, 1.0])
def test_hypotheses_that_stray_beyond_gain_nothing(exponent):
    """Half of the hypotheses stay between sensors, of which one sees some of them; half have left, where nothing looks."""
    generator = np.random.default_rng(1)
    num = 400
    start = np.where(np.arange(num)[:, None] % 2 == 0, generator.uniform(-50, 50, (num, 2)), [500.0, 0.0])
    tracks = Tracks(
        torch.from_numpy(start)[None, :, None, None].expand(1, num, 1, 3, 2), torch.tensor([[0.0, 10.0, 20.0]]).double()
    )
    watch = (looks([5.0, 6.0, 15.0], [[-80, -80], [80, 80], [0, 0]]), looks([5.0, 6.0], [[-80, 80], [80, -80]]))
    ground = ground_of(watch, np.zeros(0), np.zeros((0, 2)))
    gone = np.arange(num) % 2 == 1
    share, spread = [], []
    for given in (None, ground):
        said = Silence(watch, exponent, ground=given).log_likelihood(tracks)[0, :, 0].numpy()
        weight = np.exp(said) / np.exp(said).sum()
        share.append(weight[gone].sum())
        spread.append(np.ptp(said[~gone]))
    assert share[0] > 0.5 + 0.01 * exponent and share[1] == pytest.approx(0.5, abs=1e-3)
    assert spread[0] == pytest.approx(spread[1]) and spread[1] > 0.5 * exponent
