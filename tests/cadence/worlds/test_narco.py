import itertools

import numpy as np
import pytest
import shapely

from cadence.worlds.narco import (
    HIDEOUTS,
    RENDEZVOUS,
    SPEED,
    START,
    UNIT_M,
    NarcoConfig,
    land_of,
    simulate_narco,
    simulate_narco_batch,
)
from cadence.worlds.ocean import CELL, COLUMNS, ROWS, SIZE, eastern_pacific

SETS = ("low", "high")


@pytest.fixture(scope="module")
def recorded():
    return {name: simulate_narco_batch(NarcoConfig(name), 0, np.arange(120)) for name in SETS}


@pytest.fixture(scope="module")
def ocean():
    return eastern_pacific()


def test_all_sites_are_on_water(ocean):
    assert not ocean.is_closed(np.vstack([START[None], RENDEZVOUS, HIDEOUTS])).any()
    np.testing.assert_allclose(SIZE, [7884.467, 3538.368], atol=5e-4)


def test_land_is_where_america_is(ocean):
    def at(longitude, latitude):
        return bool(ocean.is_land[int(longitude + 145), int(latitude + 12)])

    mexico, lima, caribbean, bogota = (-98.5, 18.5), (-75.5, -11.5), (-75.5, 15.5), (-74.5, 4.5)
    assert all(at(*place) for place in (mexico, lima, caribbean, bogota))
    assert not any(at(*place) for place in ((-140.5, 0.5), (-100.5, 10.5), (-85.5, -5.5), (-105.5, 15.5)))


def test_waves_are_of_the_open_pacific_and_change_slowly(ocean):
    water = ocean.wave[:, ~ocean.is_land]
    assert 1.7 < water.mean() < 2.3 and water.min() > 0.3 and water.max() < 8.0
    assert (ocean.wave[:, ocean.is_land] == 0).all()
    assert np.corrcoef(water[0], water[1])[0, 1] > 0.8
    assert np.corrcoef(water[0], water[12])[0, 1] < 0.6
    point = np.array([[3000.0, 1500.0]])
    assert ocean.coverage(point, 179) == ocean.coverage(point, 0) != ocean.coverage(point, 180)


def test_way_is_the_cheapest_of_its_neighbours_and_stays_on_water(ocean):
    way = ocean.way(START, HIDEOUTS[0], 1.0)
    dense = np.concatenate([np.linspace(a, b, 40) for a, b in itertools.pairwise(way)])
    assert not ocean.is_closed(dense).any()
    assert (way[0] == START).all() and (way[-1] == HIDEOUTS[0]).all()
    steps = np.abs(np.diff(ocean.cell_of(way), axis=0)).max(axis=1)
    assert set(steps[:-1]) == {1} and steps[-1] == 0
    straight = np.hypot(*(HIDEOUTS[0] - START))
    assert straight < np.hypot(*np.diff(way, axis=0).T).sum() < 1.5 * straight


@pytest.mark.parametrize("name", SETS)
def test_mean_rates_are_those_of_the_paper(recorded, name):
    # 120 episodes: the standard error is about 2 points; over thousands of episodes the means are 13.7 and 31.4 %.
    want = {"low": 0.138, "high": 0.315}[name]
    assert abs(recorded[name].rates().mean() - want) < 0.05


@pytest.mark.parametrize("name", SETS)
def test_episodes_begin_at_the_start_and_end_at_a_hideout_or_a_vessel(recorded, name):
    episodes = recorded[name]
    first, last = episodes.offset[:-1], episodes.offset[1:] - 1
    place = episodes.position_m / UNIT_M
    assert (place[first] == START.astype(np.float32)).all()
    arrived = np.hypot(*np.moveaxis(place[last][:, None] - HIDEOUTS, -1, 0)).min(axis=1) <= 50.0 + 1e-3
    gap = np.hypot(*np.moveaxis(episodes.tracker_m[:, -2:] / UNIT_M - place[:, None], -1, 0)).min(axis=1)
    caught = gap[last] <= 100.0 + 1e-3
    assert (arrived | caught).all() and arrived.any() and caught.any()
    # Nobody is within 100 of a vessel and goes on.
    inner = np.ones(len(gap), dtype=bool)
    inner[first] = inner[last] = False
    assert (gap[inner] > 100.0 - 1e-3).all()
    met = [np.hypot(*(place[a : b + 1, None] - RENDEZVOUS).T).min() <= 50.0 + 1e-3 for a, b in zip(first, last, strict=True)]
    assert all(np.array(met)[arrived])
    assert np.isnan(episodes.known_goal_m).all()


@pytest.mark.parametrize("name", SETS)
def test_nobody_is_too_fast_or_on_land(recorded, name, ocean):
    episodes = recorded[name]
    num_airplanes = {"low": 2, "high": 3}[name]
    tracker = episodes.tracker_m.astype(np.float64) / UNIT_M
    assert tracker.shape[1] == num_airplanes + 2
    inner = np.setdiff1d(np.arange(1, len(tracker)), episodes.offset)
    moved = np.hypot(*np.moveaxis(tracker[inner] - tracker[inner - 1], -1, 0))
    assert (moved <= np.array([127.0] * num_airplanes + [6.5] * 2) + 2e-3).all()
    way = np.hypot(*(episodes.position_m[inner] - episodes.position_m[inner - 1]).astype(np.float64).T) / UNIT_M
    assert way.max() <= SPEED + 2e-3 and np.median(way) > 7.4
    # float32 puts points on a border a hair to either side of it: look a little inside and outside
    wet = [~ocean.is_closed(tracker + shift) for shift in ([0.01, 0.01], [-0.01, -0.01], [0.01, -0.01], [-0.01, 0.01])]
    assert np.any(wet, axis=0).all()
    step = np.arange(len(tracker)) - np.repeat(episodes.offset[:-1], episodes.length)
    resting = step[inner] % 240 >= 200
    assert resting.any() and (moved[resting, :num_airplanes] == 0).all()


def test_batch_neighbours_and_repetition_change_nothing(recorded):
    together = recorded["low"]
    alone = simulate_narco_batch(NarcoConfig("low"), 0, np.array([17, 5]))
    for row, index in enumerate((17, 5)):
        one, other = alone.select([row]), together.select([index])
        np.testing.assert_array_equal(one.position_m, other.position_m)
        np.testing.assert_array_equal(one.is_detected, other.is_detected)
        np.testing.assert_array_equal(one.tracker_m, other.tracker_m)
    moved = simulate_narco_batch(NarcoConfig("low"), 1, np.array([17]))
    assert not np.array_equal(moved.tracker_m[0], alone.tracker_m[0])


def test_few_ways_each_to_the_nearer_hideout(recorded):
    episodes = recorded["low"]
    last = episodes.position_m[episodes.offset[1:] - 1]
    assert len(np.unique(last.round(), axis=0)) > 10  # captures end anywhere
    begin, end = episodes.offset[:-1], episodes.offset[1:]
    whole = [place for place in episodes.position_m[end - 1] if np.hypot(*(place / UNIT_M - HIDEOUTS).T).min() <= 50.0]
    assert len(np.unique(np.round(whole), axis=0)) <= 16
    # 100 steps out nobody has met, and everybody is on one of the ways to the four rendezvous, which may begin alike.
    assert 2 <= len(np.unique(episodes.position_m[begin[end - begin > 100] + 100].round(), axis=0)) <= 4


def test_every_hideout_is_reached(recorded):
    arrivals = np.concatenate([recorded[name].position_m[recorded[name].offset[1:] - 1] for name in SETS]) / UNIT_M
    nearest = np.hypot(*np.moveaxis(arrivals[:, None] - HIDEOUTS, -1, 0))
    taken = np.bincount(nearest.argmin(axis=1)[nearest.min(axis=1) <= 50.0], minlength=4)
    assert taken.min() > 5


def test_an_episode_is_the_recording_with_everything_in_it(recorded):
    index = int(np.argmax(recorded["high"].rates()))
    episode, row = simulate_narco(NarcoConfig("high"), 0, index), recorded["high"].select([index])
    np.testing.assert_allclose(episode.truth_m[0], row.position_m, atol=0.5)
    np.testing.assert_array_equal(episode.is_detected()[0], row.is_detected)
    np.testing.assert_allclose(np.moveaxis(episode.sensors_m, 0, 1), row.tracker_m, atol=0.5)
    assert episode.sensor_ids == ("airplane_1", "airplane_2", "airplane_3", "vessel_1", "vessel_2")
    seen = episode.detections
    np.testing.assert_array_equal(seen.position_m, episode.truth_m[0, seen.step])
    np.testing.assert_array_equal(episode.is_active[:, 199:202].sum(axis=1), [1, 1, 1, 3, 3])
    assert (np.diff(episode.mode[0]) >= 0).all()
    assert (episode.time_s[1:] - episode.time_s[:-1] == 60.0).all()


def test_sensors_see_by_the_factor():
    rates = [simulate_narco_batch(NarcoConfig("low", factor), 3, np.arange(6)).rates().mean() for factor in (0.0, 120.0)]
    assert rates[0] == 0.0 and rates[1] > 0.3


def test_land_is_given_as_polygons(ocean):
    terrain = land_of(ocean)
    land = terrain.land()
    column, row = np.meshgrid(np.arange(COLUMNS), np.arange(ROWS), indexing="ij")
    middles = shapely.points((np.stack([column, row], axis=-1) + 0.5).reshape(-1, 2) * CELL * UNIT_M)
    inside = np.zeros(len(middles), dtype=bool)
    inside[land.query(middles, predicate="within")[0]] = True
    np.testing.assert_array_equal(inside, ocean.is_land.ravel())


@pytest.mark.parametrize("wrong", [dict(set="medium"), dict(factor=-1.0), dict(factor=float("nan"))])
def test_impossible_settings_are_refused(wrong):
    with pytest.raises(ValueError, match="must"):
        NarcoConfig(**wrong)
