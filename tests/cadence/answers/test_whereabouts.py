"""Areas that hold what they say, and grids that sum to one."""

import numpy as np
import pytest
import shapely

from cadence.answers.whereabouts import Grid, whereabouts

EQUAL = np.full(200, 1 / 200)


def two_ways(rng, num):
    side = np.where(rng.random(num) < 0.6, -5000.0, 5000.0)
    return np.stack([side + 50.0 * rng.normal(size=num), 400.0 * rng.normal(size=num)], axis=1)


def thin(rng, num):
    along = 8000.0 * rng.normal(size=num)
    return np.stack([along, 0.7 * along + 30.0 * rng.normal(size=num)], axis=1)


@pytest.mark.parametrize(
    "law", [lambda rng, num: 300.0 * rng.normal(size=(num, 2)), two_ways, thin], ids=["round", "two", "thin"]
)
def test_areas_hold_what_they_say(law):
    rng = np.random.default_rng(3)
    held = []
    for _ in range(25):
        found = whereabouts(law(rng, 200), EQUAL, num_cells=128)
        fresh = law(rng, 400)
        held.append([shapely.contains_xy(area.shape, *fresh.T).mean() for area in found.areas])
    np.testing.assert_allclose(np.mean(held, axis=0), [0.5, 0.9, 0.95], atol=0.035)


def test_two_ways_are_two_areas_and_the_middle_is_on_one():
    rng = np.random.default_rng(0)
    found = whereabouts(two_ways(rng, 200), EQUAL)
    area = found.areas[1]
    assert len(shapely.get_parts(area.shape)) >= 2 and not area.shape.contains(shapely.Point(0, 0))
    assert abs(abs(found.centre_m[0]) - 5000) < 200
    # the exact one is 2 pi sigma_x sigma_y ln(10) for each way
    assert 0.5 < area.area_m2 / (2 * 2 * np.pi * 50 * 400 * np.log(10)) < 2.5


def test_the_grid_sums_to_one_and_lies_where_the_stories_are():
    rng = np.random.default_rng(1)
    points = 300.0 * rng.normal(size=(200, 2)) + np.array([1e6, -2e6])
    grid = whereabouts(points, EQUAL).grid
    x, y = grid.centres_m
    assert grid.probability.sum() == pytest.approx(1.0) and grid.probability.min() >= 0
    mean = np.array([grid.probability.sum(0) @ x, grid.probability.sum(1) @ y])
    np.testing.assert_allclose(mean, points.mean(0), atol=10.0)


def test_weights_move_the_areas():
    points = np.concatenate([np.random.default_rng(0).normal(size=(100, 2)), np.full((100, 2), 500.0)])
    points[100:] += np.random.default_rng(1).normal(size=(100, 2))
    weight = np.repeat([0.0099, 0.0001], 100)
    area = whereabouts(points, weight).areas[1]
    assert area.shape.bounds[2] < 100 and area.low_m2 <= area.area_m2 <= area.high_m2


def test_an_exact_detection_is_a_small_area():
    found = whereabouts(np.full((50, 2), 7.0), np.full(50, 1 / 50), floor_m=2.0)
    assert 1 < found.areas[1].area_m2 < 200 and found.spread_m == 0 and found.centre_m == (7.0, 7.0)


def test_one_story_and_absent_ones():
    points = np.full((4, 2), np.nan)
    points[2] = (3.0, 4.0)
    found = whereabouts(points, np.full(4, 0.25))
    assert found.presence.value == 0.25 and found.centre_m == (3.0, 4.0)
    assert found.areas[0].shape.contains(shapely.Point(3, 4))
    with pytest.raises(ValueError, match="no story"):
        whereabouts(np.full((4, 2), np.nan), np.full(4, 0.25))


def test_grids_are_checked():
    with pytest.raises(ValueError, match=r"Grid\.probability"):
        Grid(0.0, 0.0, 0.0, np.ones((2, 2)))
