"""Prison Escape: the map, the fugitive's routes and evasion, whole episodes beside the original's recorded ones."""

import numpy as np
import pytest

from benchmarks.episode_statistics import compare, site_difference
from benchmarks.worlds import KEPT, kept_statistics, of_prison
from cadence.worlds.block_route import BlockPlanner
from cadence.worlds.draws import Draws
from cadence.worlds.perlin import enlarge_twice, fractal, octave
from cadence.worlds.prison import PrisonConfig, simulate_prison, simulate_prison_batch
from cadence.worlds.prison_fugitive import Fugitives, Sight, nearest_forest, stride, turn_from
from cadence.worlds.prison_map import CELL_M, HIDDEN_CAMERAS, KNOWN_SITES, SEEN_CAMERAS, SIDE, UNKNOWN_SITES, prison_map

SITES = np.concatenate([KNOWN_SITES, UNKNOWN_SITES])
LIKE_REFERENCE = PrisonConfig("low", factor=3.5)


@pytest.fixture(scope="module")
def episodes():
    return simulate_prison_batch(LIKE_REFERENCE, 1, np.arange(60))


def test_noise_is_zero_on_the_lattice_and_periodic():
    x = np.arange(12, dtype=np.float32)
    assert (octave(x, x, np.float32(300), 5) == 0).all()
    place = np.linspace(0, 5.9, 40, dtype=np.float32)
    noise = octave(place, place, np.float32(6), 80)
    np.testing.assert_allclose(octave(place + 6, place, np.float32(6), 80), noise, atol=1e-5)
    assert np.abs(noise).max() < 1.5 and noise.std() > 0.1
    assert (octave(place, place, np.float32(6), 81) != noise).any()


def test_octaves_are_summed_by_their_heights():
    x = np.linspace(0.1, 3.0, 20, dtype=np.float32)
    both = fractal(x, x, octaves=2, persistence=2.0, lacunarity=0.5, period=64.0, base=3)
    one, two = octave(x, x, np.float32(64), 3), octave(x * np.float32(0.5), x * np.float32(0.5), np.float32(32), 3)
    np.testing.assert_allclose(both, (one + 2 * two) / 3, atol=1e-6)


def test_enlarging_keeps_planes_and_means():
    np.testing.assert_allclose(enlarge_twice(np.array([[0.0, 4.0]])), [[0.0, 1.0, 3.0, 4.0]] * 2)
    image = np.random.default_rng(0).random((5, 7))
    assert enlarge_twice(image).mean() == pytest.approx(image.mean())


def test_the_map_is_the_originals(shared_data):
    recorded = np.load(shared_data / "prison_reference" / "terrain.npz")["coverage_1e4"].astype(int)
    assert np.abs(np.rint(prison_map().coverage * 1e4).astype(int) - recorded).max() <= 1


def test_sites_and_cameras_stand_on_open_ground():
    ground = prison_map()
    assert ground.coverage.min() == 0.2 and ground.coverage.max() <= 0.8
    assert not ground.is_mountain[tuple(np.concatenate([SITES, HIDDEN_CAMERAS]).T)].any()
    assert (len(SEEN_CAMERAS), len(HIDDEN_CAMERAS)) == (43, 33)
    assert ground.is_mountain.sum() == 194 * 98 + 97 * 195 - 97 * 98
    assert ground.planning.shape == (114, 114) and (ground.planning == -1).sum() > 0


def test_search_confined_by_the_least_cost_finds_the_same_ways():
    price = np.random.default_rng(3).choice([0.2, 0.2, 0.2, 0.5, 0.8, -1.0], (40, 40))
    price[0], price[-1] = 0.2, 0.2
    near, whole = BlockPlanner(price, 1000.0), BlockPlanner(price, 1000.0, slack=1e9)
    rng = np.random.default_rng(4)
    for start in rng.integers(0, 40, 25):
        way = near.plan(int(start), 39 * 40 + 20)
        np.testing.assert_array_equal(way, whole.plan(int(start), 39 * 40 + 20))
        assert np.abs(np.diff(way, axis=0)).max() == 1 and (price[tuple(way.T)] > 0).all()


def test_ways_over_even_ground_are_as_long_as_they_must_be_and_closed_goals_are_refused():
    price = np.full((9, 9), 0.2)
    price[4, :] = -1.0
    planner = BlockPlanner(price, 1000.0)
    assert len(planner.plan(0, 3 * 9 + 7)) == 8
    with pytest.raises(ValueError, match="no way"):
        planner.plan(0, 80)


def test_headings_turn_to_the_nearer_tangent_only_where_they_lead_inwards():
    rng = np.random.default_rng(0)
    here, heading = rng.uniform(-100, 100, (500, 2)), rng.uniform(-np.pi, np.pi, 500)
    turned = turn_from((0.0, 0.0), here, heading)
    outwards = (here / np.hypot(*here.T)[:, None] * np.stack([np.cos(turned), np.sin(turned)], axis=-1)).sum(axis=1)
    led_inwards = (here * np.stack([np.cos(heading), np.sin(heading)], axis=-1)).sum(axis=1) < 0
    np.testing.assert_array_equal(turned != heading, led_inwards)
    np.testing.assert_allclose(outwards[led_inwards], 0, atol=1e-9)
    assert (np.cos(turned - heading)[led_inwards] >= -1e-9).all()


def test_strides_end_on_whole_cells_of_the_map():
    here = np.array([[10.0, 10.0], [11.0, 10.0], [2.0, 3.0]])
    moved = stride(here, np.full(3, 7.5), np.array([0.0, 0.0, np.pi]))
    np.testing.assert_array_equal(moved, [[18, 10], [18, 10], [0, 3]])  # halves go to the even cell; the edge stops


def test_nearest_forest_is_the_nearest_of_all():
    is_dense = np.zeros((SIDE, SIDE), dtype=bool)
    is_dense[tuple(np.random.default_rng(1).integers(0, SIDE, (2, 4000)))] = True
    here = np.array([[5.0, 2420.0], [1200.0, 800.0], [40.0, 41.0]])
    is_dense[1200, 800] = True  # the own cell does not count
    places = np.argwhere(is_dense)
    for point, found in zip(here, nearest_forest(is_dense, here), strict=True):
        square = ((places - point) ** 2).sum(axis=1)
        assert ((found - point) ** 2).sum() == square[square > 0].min()
    assert (nearest_forest(np.zeros_like(is_dense), here) == 1500).all()


def alone(goal, start):
    """The track of one fugitive whom nobody follows."""
    fugitive = Fugitives(np.array([[goal, goal]]), np.array([[5000.0, 5000.0]]), np.zeros((1, 1, 2)), 1, Draws(0, [0]))
    here, track = np.array([start], dtype=float), []
    for step in range(800):
        sight = Sight(step, here, np.array([7.5]), np.zeros((1, 2, 2)), np.zeros((1, 2), dtype=bool))
        here = stride(here, *fugitive.act(np.array([0]), sight))
        track.append(here[0])
        if np.hypot(*(here[0] - goal)) < 50:
            return np.array(track)
    raise AssertionError("never arrived")


def test_who_is_not_followed_walks_in_the_dark_to_its_hideout():
    ground = prison_map()
    track = alone(np.array([909.0, 510.0]), (2200, 2300))
    strides = np.hypot(*np.diff(track, axis=0).T)
    assert strides.max() <= 8.1 and 6.0 < strides.mean() < 8.0
    on_track = ground.coverage[tuple(track.astype(int).T)].mean()
    straight = np.linspace(track[0], track[-1], 300).astype(int)
    assert on_track < 0.9 * ground.coverage[tuple(straight.T)].mean()


def flee(num_parties_seen, sees_helicopter, distance, steps=8):
    """Modes and tracks of a fugitive with a helicopter and a party at a distance for some steps."""
    fugitive = Fugitives(
        np.array([[[400.0, 800.0], [100.0, 2000.0]]]), np.array([[2300.0, 430.0]]), np.zeros((1, 1, 2)), 1, Draws(0, [0])
    )
    here = np.array([[1400.0, 1200.0]])
    modes = []
    for step in range(steps):
        tracker = np.stack([here[0] + [distance, 0.0], here[0] - [0.0, distance]])[None]
        seen = np.array([[sees_helicopter, num_parties_seen > 0]])
        here = stride(here, *fugitive.act(np.array([0]), Sight(step, here, np.array([7.5]), tracker, seen)))
        modes.append(int(fugitive.mode[0]))
    return modes


def test_it_hides_from_a_near_pursuer_after_seven_steps_and_gives_up_after_fifty_of_both():
    assert flee(0, True, 20.0) == [0] * 6 + [1] * 2
    assert flee(1, False, 15.0) == [0] * 6 + [1] * 2
    assert flee(0, True, 150.0) == [0] * 8
    both = flee(1, True, 15.0, steps=60)
    assert both[6] == 1 and both[49] == 1 and set(both[50:]) == {2}


def test_episodes_end_at_a_hideout_and_keep_off_the_mountain(episodes):
    item = of_prison(episodes)
    assert (item.site >= 0).all() and (item.length < 2000).all()
    cell = np.rint(episodes.position_m / CELL_M).astype(int)
    np.testing.assert_allclose(cell * CELL_M, episodes.position_m)
    assert not prison_map().is_mountain[tuple(cell.T)].any()
    start = cell[episodes.offset[:-1]]
    assert start.min() >= 2078 and not episodes.is_detected[episodes.offset[:-1]].any()
    assert episodes.tracker_m.shape[1] == 6 and not np.isnan(episodes.tracker_m).any()
    assert {tuple(goal) for goal in (episodes.known_goal_m / CELL_M).astype(int)} <= {tuple(site) for site in KNOWN_SITES}


def test_trackers_keep_their_speeds_and_helicopters_rest(episodes):
    first = episodes.select([int(np.argmax(episodes.length))])
    strides = np.hypot(*np.moveaxis(np.diff(first.tracker_m / CELL_M, axis=0), -1, 0))
    assert strides[:, 1:].max() <= 7.5 and 100 < strides[:, 0].max() <= 128.5
    assert (strides[200 - 1 : 239, 0] == 0).all() and (strides[190:199, 0] > 0).any()


def test_episodes_are_like_the_originals(episodes):
    # Distances of 60 episodes from the 298 recorded; two such samples of one distribution differ by less in 19 of 20 cases.
    ours, reference = of_prison(episodes), kept_statistics(KEPT)["low"]
    found = compare(ours, reference)
    assert found["length"].largest < 0.19 and found["rate"].largest < 0.19
    assert found["gap"].largest < 0.12 and found["stride"].largest < 0.06
    assert site_difference(ours, reference, len(SITES)) < 0.3
    assert abs(ours.share_at(0, len(KNOWN_SITES)) - reference.share_at(0, len(KNOWN_SITES))) < 0.1


def test_an_episode_depends_on_nothing_but_its_index(episodes):
    alone = simulate_prison_batch(LIKE_REFERENCE, 1, np.array([17]))
    among = episodes.select([17])
    for name in ("position_m", "is_detected", "tracker_m", "known_goal_m"):
        np.testing.assert_array_equal(getattr(alone, name), getattr(among, name))


def test_an_episode_with_all_details_is_the_same(episodes):
    whole = simulate_prison(LIKE_REFERENCE, 1, 17)
    among = episodes.select([17])
    np.testing.assert_array_equal(whole.truth_m[0], among.position_m)
    np.testing.assert_array_equal(whole.is_detected()[0], among.is_detected)
    np.testing.assert_array_equal(np.moveaxis(whole.sensors_m[78:], 0, 1), among.tracker_m)
    np.testing.assert_array_equal(whole.detections.position_m, whole.truth_m[0, whole.detections.step])
    assert whole.sensor_ids[0] == "known_camera_00" and whole.sensor_ids[78:80] == ("helicopter_00", "party_00")
    assert len(set(whole.sensor_ids)) == 84 and whole.goals_m[0].shape == (3, 2)


def test_without_range_nobody_detects_anything():
    found = simulate_prison_batch(PrisonConfig(factor=0.0, num_parties=1, num_helicopters=0), 0, np.arange(3))
    assert not found.is_detected.any() and found.tracker_m.shape[1] == 1


def test_recorded_fugitives_are_followed_cell_by_cell(shared_data):
    recorded = np.load(shared_data / "prison_reference" / "low_extra.npz")
    offset, num = recorded["episode_offset"], 12
    xy, sees, speed = recorded["xy"].astype(float), recorded["fugitive_sees"], recorded["speed"].astype(float)
    trackers = np.concatenate([recorded["heli_xy"], recorded["party_xy"]], axis=1).astype(float)
    sites, is_known, camera = (
        recorded["hideout_xy"].astype(float),
        recorded["hideout_known"],
        recorded["camera_xy"].astype(float),
    )
    num_wrong = 0
    for episode in range(num):
        rows = slice(offset[episode], offset[episode + 1])
        fugitive = Fugitives(
            sites[None, episode][:, ~is_known[episode]],
            sites[episode, is_known[episode]],
            camera[episode, None, :45],
            1,
            Draws(0, [0]),
        )
        track, seen, pace, place = xy[rows], sees[rows], speed[rows], trackers[rows]
        for step in range(len(track) - 1):
            sight = Sight(step, track[step, None], pace[step, None], place[step, None], seen[step, None])
            moved = stride(track[step, None], *fugitive.act(np.array([0]), sight))[0]
            is_blocked = prison_map().is_mountain[tuple(moved.astype(int))]
            num_wrong += not np.array_equal(track[step] if is_blocked else moved, track[step + 1])
    assert num_wrong == 0


@pytest.mark.parametrize("settings", [{"set": "mid"}, {"factor": -1.0}, {"factor": float("nan")}, {"num_parties": -1}])
def test_impossible_settings_are_refused(settings):
    with pytest.raises(ValueError):
        PrisonConfig(**settings)
