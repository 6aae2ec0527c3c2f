"""Silence of sensors: by hand, against a grid, against one sensor after the other, own-prior check, areas, and who was seen."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from scipy.signal import fftconvolve
from test_weighing import ORIGIN, Walk, mean_and_deviation, windows

from cadence.constraints.obstacles import Obstacles
from cadence.evidence.estimator import CONTRADICTED, WithEvidence
from cadence.evidence.footprints import DetectionCurve, Polygon, Sector
from cadence.evidence.settings import WeighingConfig
from cadence.evidence.silence import Looks, Silence
from cadence.types import Tracks

CURVE = DetectionCurve(np.array([0.0, 1.0, 3.0]), np.array([0.9, 0.9, 0.0]))


def looks(time_s, places_m, curve=CURVE, **more) -> Looks:
    num = len(time_s)
    place = np.broadcast_to(np.asarray(places_m, dtype=np.float64), (num, 2)).copy()
    given = {"range_m": np.ones(num), "heading_rad": np.zeros(num)} | more
    return Looks(np.asarray(time_s, dtype=np.float64), place, curve=curve, **given)


def tracks(*paths_m, time_s=(0.0, 10.0, 20.0), names=()) -> Tracks:
    """Hypotheses of one agent."""
    position = torch.tensor(paths_m, dtype=torch.float64)[None, :, None]
    return Tracks(position, torch.tensor([time_s], dtype=torch.float64), names)


def test_by_hand_between_steps_beyond_reach_and_after_the_track():
    # at 5 s the first track is at (1, 0): P = .9; at 15 s at (2, 0) from the sensor: P = .45; the look at 30 s is after it
    found = Silence((looks([5.0, 15.0, 30.0], [1.0, 0.0]),)).log_likelihood(
        tracks([[0, 0], [2, 0], [4, 0]], [[0, 50], [2, 50], [4, 50]], [[1, 0], [math.nan] * 2, [math.nan] * 2])
    )
    # 5 s: distance 0, P = .9; 15 s: distance 2, P = .45
    assert found[0, :, 0].tolist() == pytest.approx([math.log(0.1) + math.log(0.55), 0.0, 0.0])
    half = Silence((looks([5.0], [1.0, 0.0]),), exponent=0.5).log_likelihood(tracks([[0, 0], [2, 0], [4, 0]]))
    assert half[0, 0, 0] == pytest.approx(0.5 * math.log(0.1))
    sure = DetectionCurve(np.array([0.0, 5.0]), np.array([1.0, 1.0]))
    assert float(Silence((looks([5.0], [1.0, 0.0], sure),)).log_likelihood(tracks([[0, 0], [2, 0], [4, 0]]))) == pytest.approx(
        math.log(0.02)
    )


def test_who_was_seen_is_no_silence_and_who_is_absent_adds_nothing():
    path = [[0, 0], [2, 0], [4, 0]]
    seen = (frozenset({"T0"}), frozenset(), frozenset({None}))
    silence = Silence((looks([0.0, 5.0, 10.0], [1.0, 0.0], seen=seen),))
    position = torch.tensor(path, dtype=torch.float64).expand(1, 1, 3, 3, 2).clone()
    position[:, :, 2] = torch.nan
    found = silence.log_likelihood(Tracks(position, torch.tensor([[0.0, 10.0, 20.0]]).double(), ("T0", "T1", "T2")))
    one = math.log(0.1)
    assert found[0, 0].tolist() == pytest.approx([one, 2 * one, 0.0])


def test_areas_turn_with_the_sensor_or_stay_on_the_ground():
    north = np.full(1, np.pi / 2)
    path = [[0, 2], [0, 2], [0, 2]], [[2, 0], [2, 0], [2, 0]]
    ahead = Polygon(np.array([[1.0, -0.5], [2.5, -0.5], [2.5, 0.5], [1.0, 0.5]]))
    for area in (Sector(0.3), ahead):
        found = Silence((looks([5.0], [0.0, 0.0], heading_rad=north, area=area),)).log_likelihood(tracks(*path))
        assert float(found[0, 0]) == pytest.approx(math.log(0.55)) and float(found[0, 1]) == 0.0
    ground = Polygon(np.array([[1.0, -1.0], [3.0, -1.0], [3.0, 1.0]]), is_on_ground=True)
    found = Silence((looks([5.0], [0.0, 0.0], heading_rad=north, area=ground),)).log_likelihood(tracks(*path))
    assert float(found[0, 0]) == 0.0 and float(found[0, 1]) == pytest.approx(math.log(0.55))


def test_obstacles_hide_what_is_behind_them():
    wall = torch.tensor([[0.5, -1.0], [0.6, -1.0], [0.6, 1.0], [0.5, 1.0]], dtype=torch.float64)
    peak = Obstacles(torch.tensor([[-1.0, 0.0, 0.2]], dtype=torch.float64), ((wall,),))
    silence = Silence((looks([5.0], [0.0, 0.0]),), obstacles=peak)
    found = silence.log_likelihood(tracks(*([[x, 0.0]] * 3 for x in (0.4, 2.0, -2.0, -0.5))))
    assert found[0, :, 0].tolist() == pytest.approx([math.log(0.1), 0.0, 0.0, math.log(0.1)])


def test_leaving_out_what_is_far_changes_nothing():
    generator = np.random.default_rng(3)
    position = torch.from_numpy(generator.normal(size=(2, 30, 2, 9, 2)).cumsum(3) * 3)
    time_s = torch.stack([torch.arange(9.0), 4.0 + torch.arange(9.0)]).double()
    num = 400
    many = Looks(
        np.sort(generator.uniform(0, 14, num)), generator.normal(size=(num, 2)) * 12, generator.uniform(0, 3, num),
        np.zeros(num), CURVE,
    )  # fmt: skip
    found = Silence((many,)).log_likelihood(Tracks(position, time_s))
    expected = torch.zeros_like(found)
    for row in range(2):
        steps = time_s[row].numpy()
        for look in range(num):
            at = many.time_s[look]
            if steps[0] <= at <= steps[-1]:
                path = position[row].numpy()
                left = min(int(at - steps[0]), 7)
                place = path[:, :, left] + (at - steps[left]) * (path[:, :, left + 1] - path[:, :, left])
                away = np.linalg.norm(place - many.position_m[look], axis=-1) / many.range_m[look]
                expected[row] += torch.from_numpy(np.log1p(-np.minimum(CURVE(away), 0.98)))
    torch.testing.assert_close(found, expected)
    assert float(found.min()) < -1


def grid_posterior(sensors_m, seen_nothing_at) -> tuple[float, float]:
    """Mean and deviation of x at the origin of unit random walks from zero (variance 1 at the first step), on a grid of .1."""
    axis = np.arange(-12.0, 12.05, 0.1)
    x, y = np.meshgrid(axis, axis, indexing="ij")
    kernel_axis = axis[np.abs(axis) < 5.01]
    kernel = np.exp(-0.5 * (kernel_axis[:, None] ** 2 + kernel_axis**2))
    kernel /= kernel.sum()
    density = np.exp(-0.5 * (x**2 + y**2))
    for step in range(ORIGIN + 1):
        if step:
            density = np.maximum(fftconvolve(density, kernel, mode="same"), 0.0)
        if step in seen_nothing_at:
            for sensor in sensors_m:
                density = density * (1.0 - np.minimum(CURVE(np.hypot(x - sensor[0], y - sensor[1])), 0.98))
        density /= density.sum()
    mean = float((density * x).sum())
    return mean, float(np.sqrt((density * (x - mean) ** 2).sum()))


@pytest.mark.parametrize("sensors_m", [[(1.0, 0.0)], [(1.5, 0.5), (0.0, 2.0)]])
def test_weighted_hypotheses_agree_with_a_grid(sensors_m):
    steps = (1, 2, 4)
    times = [1000.0 + 10.0 * (step - ORIGIN) for step in steps]
    silence = Silence(tuple(looks(times, sensor) for sensor in sensors_m))
    expected = grid_posterior(sensors_m, steps)
    assert abs(expected[0]) > 0.3
    num = 40_000
    found = WithEvidence(Walk(), WeighingConfig(most_draws=1)).sample(windows(silence), num)
    assert found.num_effective is not None
    error = expected[1] / math.sqrt(float(found.num_effective[0, 0]))
    mean, deviation = mean_and_deviation(found, ORIGIN)
    assert abs(mean - expected[0]) < 3 * error and abs(deviation - expected[1]) < 3 * error
    few = [WithEvidence(Walk()).sample(dataclasses.replace(windows(silence), seeds=torch.tensor([s])), 60) for s in range(200)]
    means = np.array([mean_and_deviation(one, ORIGIN)[0] for one in few])
    assert abs(means.mean() - expected[0]) < 3 * means.std() / math.sqrt(200) + 0.02


def test_own_prior_check():
    """Targets of the sampler's own prior, those that a sensor would have missed: the 90 % region holds 88 to 92 % of them."""
    generator = np.random.default_rng(11)
    times = [1000.0 + 10.0 * (step - ORIGIN) for step in range(ORIGIN + 1)]
    ranks = []
    for row in range(2500):
        sensor = generator.normal(size=2)
        truth = generator.normal(size=(7, 2)).cumsum(0)
        chance = CURVE(np.hypot(*(truth[: ORIGIN + 1] - sensor).T))
        if (generator.random(ORIGIN + 1) < chance).any():
            continue
        batch = dataclasses.replace(windows(Silence((looks(times, sensor),))), seeds=torch.tensor([row]))
        found = WithEvidence(Walk()).sample(batch, 200)
        ranks.append(float(found.weight[0] @ (found.position_m[0, :, 0, 5, 0] < truth[5, 0]).double()))
    assert len(ranks) > 500
    assert 0.88 <= np.mean((np.array(ranks) > 0.05) & (np.array(ranks) < 0.95)) <= 0.92


def test_a_footprint_over_everything_contradicts_and_is_not_believed():
    everywhere = DetectionCurve(np.array([0.0, 1e6]), np.array([0.9, 0.9]))
    times = [1000.0 + 10.0 * (step - ORIGIN) for step in range(ORIGIN + 1)]
    found = WithEvidence(Walk()).sample(windows(Silence((looks(times, [0.0, 0.0], everywhere),))), 30)
    assert found.status == ((CONTRADICTED,),) and set(found.weight[0].tolist()) == {1 / 30}
    off = Silence((looks(times, [0.0, 0.0], everywhere),), exponent=0.0)
    assert WithEvidence(Walk()).sample(windows(off), 30).num_effective is None


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: DetectionCurve(np.array([0.0, 1.0]), np.array([1.2, 0.0])), "between 0 and 1, got 0 to 1.2"),
        (lambda: DetectionCurve(np.array([1.0, 1.0]), np.array([0.2, 0.0])), "must increase"),
        (lambda: DetectionCurve(np.zeros((1, 2)), np.zeros((1, 2))), "pairs"),
        (lambda: Sector(0.0), "more than 0"),
        (lambda: Polygon(np.array([[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]])), "area is zero"),
        (lambda: Polygon(np.zeros((2, 2))), "three corners"),
        (lambda: looks([2.0, 1.0], [0.0, 0.0]), "times must not fall"),
        (lambda: looks([1.0], [0.0, 0.0], range_m=np.ones(3)), "range_m"),
        (lambda: looks([1.0], [0.0, 0.0], seen=(frozenset(), frozenset())), "who was seen"),
        (lambda: Silence((), exponent=1.5), "exponent"),
    ],
)
def test_what_is_no_footprint_is_refused(make, words):
    with pytest.raises(ValueError, match=words):
        make()


def test_a_curve_that_sees_nothing_reaches_nowhere():
    assert DetectionCurve(np.array([0.0, 2.0]), np.array([0.0, 0.0])).reach == 0.0
    assert CURVE.reach == 3.0 and CURVE(np.array([0.5, 2.0, 4.0])).tolist() == pytest.approx([0.9, 0.45, 0.0])


def test_misses_within_a_run_of_detections_contradict_nothing():
    """A sensor that detects in 60 of 100 looks at a place that is known was told to detect so; in 10 of them it was not."""
    curve = DetectionCurve(np.array([0.0, 100.0]), np.array([0.6, 0.6]))
    times = np.linspace(0.0, 20.0, 100)
    paths = tracks([[0, 0], [2, 0], [4, 0]], [[0, 1], [2, 1], [4, 1]], names=("T0",))
    for num_seen, is_odd in ((60, False), (52, False), (10, True)):
        seen = tuple(frozenset({"T0"}) if i < num_seen else frozenset() for i in range(100))
        silence = Silence((looks(times, [1.0, 0.0], curve, seen=seen),))
        value = silence.log_likelihood(paths)
        assert float(value.max()) < -30
        assert silence.contradicts(paths, value).tolist() == [[is_odd]]
    hill = Obstacles(torch.tensor([[1.0, 0.5, 0.05]], dtype=torch.float64))
    hidden = Silence((looks(np.full(100, 10.0), [0.0, 0.0], curve),), obstacles=hill)
    behind = tracks([[0, 0], [2, 1], [4, 0]], names=("T0",))
    assert not bool(hidden.contradicts(behind, torch.full((1, 1, 1), -99.0).double()))
