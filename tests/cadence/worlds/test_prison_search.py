"""The prison's trackers: plans after detections, spirals, the mountain, and the recorded trackers step by step."""

import numpy as np

from cadence.worlds.draws import Draws
from cadence.worlds.prison_map import MOUNTAIN, SIDE, prison_map
from cadence.worlds.prison_search import Search, leaves_map, move
from cadence.worlds.pursuit import HELICOPTER, PARTY

RUNS = np.array([True])


def search(*kinds, at):
    made = Search(kinds, Draws(0, [0]))
    made.position[0] = at
    return made


def seen(made, step, place):
    made.notice(step, RUNS, np.array([place], dtype=float))


def go(made, first, stop):
    """Positions [T, M, 2] after each of the steps."""
    track = []
    for step in range(first, stop):
        made.advance(step, RUNS)
        track.append(made.position[0].copy())
    return np.array(track)


def test_everybody_starts_somewhere_and_goes_to_a_random_place():
    made = Search((HELICOPTER, PARTY, PARTY), Draws(3, np.arange(400)))
    start = made.position.copy()
    assert start.min() >= 0 and start.max() < SIDE and np.abs(start.mean(axis=(0, 1)) - SIDE / 2).max() < 80
    goal = made._place[:, 0]
    assert not leaves_map(goal).any() and (np.hypot(*(goal - MOUNTAIN).T) > 161).all()
    made.advance(0, np.ones(400, dtype=bool))
    assert np.hypot(*np.moveaxis(made.position - start, -1, 0))[:, 1:].max() <= 7.6


def test_the_first_detection_is_where_everybody_goes():
    made = search(PARTY, HELICOPTER, at=[[500.0, 500.0], [2000.0, 500.0]])
    seen(made, 5, (500.0, 900.0))
    track = go(made, 5, 15)
    assert (track[:, 0, 0] == 500).all() and track[-1, 0, 1] == 560  # halves go to the even cell
    np.testing.assert_allclose(track[:, 1].min(axis=0), [500, 500], atol=400)


def test_a_target_that_passes_by_is_cut_off_at_the_foot_of_the_perpendicular():
    # It runs to the north-east; the party stands ahead of it beside its line and is there first: it goes there to meet it.
    made = search(PARTY, at=[[800.0, 700.0]])
    seen(made, 0, (100.0, 100.0))
    seen(made, 10, (150.0, 150.0))
    np.testing.assert_allclose(made._place[0, 0], [750, 750])
    np.testing.assert_allclose(made._place[0, 1], [-np.sqrt(0.5)] * 2)
    track = go(made, 10, 25)
    assert (track[9:12] == [750, 750]).all(axis=-1).any() or np.hypot(*(track[:, 0] - 750).T).min() < 11
    assert (np.diff(track[12:, 0], axis=0) < 0).all()


def test_a_mover_behind_the_target_follows_it():
    made = search(PARTY, at=[[50.0, 50.0]])
    seen(made, 0, (400.0, 400.0))
    seen(made, 10, (450.0, 450.0))
    np.testing.assert_allclose(made._place[0, 0], [450, 450])
    np.testing.assert_allclose(made._place[0, 1], [np.sqrt(0.5)] * 2)


def test_helicopters_slow_down_near_the_target():
    made = search(HELICOPTER, at=[[1000.0, 1000.0]])
    seen(made, 0, (400.0, 400.0))
    seen(made, 1, (405.0, 405.0))
    strides = np.hypot(*np.diff(go(made, 1, 40)[:, 0], axis=0).T)
    assert strides[0] > 100 and ((strides > 7) & (strides < 9)).sum() > 20


def test_after_a_place_comes_a_journey_and_then_the_spiral_around_it():
    made = search(HELICOPTER, at=[[900.0, 900.0]])
    seen(made, 0, (900.0, 905.0))
    go(made, 0, 1)
    assert made._end[0] == 15 and (made._leg[0, :15] == [0] + [1] * 14).all()
    np.testing.assert_allclose(made._place[0, 1:4] - made._place[0, 1], [[0, 0], [0, 44], [-88, 44]])


def test_near_the_mountain_the_spiral_begins_at_once():
    made = search(PARTY, at=[[1600.0, 1635.0]])
    seen(made, 0, (1600.0, 1636.0))
    go(made, 0, 1)
    assert made._leg[0, 0] == 1 and made._end[0] == 14


def test_helicopters_on_the_ground_stay_and_hear_nothing():
    made = search(HELICOPTER, PARTY, at=[[500.0, 500.0], [500.0, 500.0]])
    go(made, 195, 199)
    track = go(made, 199, 239)
    assert (track[:, 0] == track[0, 0]).all() and (np.diff(track[:, 1], axis=0) != 0).any()
    before = made._place[0].copy()
    seen(made, 210, (900.0, 900.0))
    np.testing.assert_array_equal(made._place[0], before)
    np.testing.assert_allclose(made._place[1, 0], [900, 900])


def test_nobody_enters_the_mountain_and_nobody_leaves_the_map():
    rng = np.random.default_rng(0)
    angle = rng.uniform(0, 2 * np.pi, 300)
    here = np.rint(np.array(MOUNTAIN) + 175 * np.stack([np.cos(angle), np.sin(angle)], axis=-1))
    direction = (np.array(MOUNTAIN) - here) / np.hypot(*(np.array(MOUNTAIN) - here).T)[:, None]
    closest = np.full(300, np.inf)
    for _ in range(60):
        here = move(here, direction, np.full(300, 6.5))
        closest = np.minimum(closest, np.hypot(*(here - MOUNTAIN).T))
        assert not prison_map().is_mountain[tuple(here.astype(int).T)].any()
    assert closest.min() > 130
    np.testing.assert_array_equal(move(np.array([[3.0, 2425.0]]), np.array([[-0.6, 0.8]]), np.array([127.0])), [[0, SIDE - 1]])


def test_what_is_drawn_depends_on_the_episode_alone():
    several, single = Search((HELICOPTER, PARTY), Draws(1, [4, 7, 9])), Search((HELICOPTER, PARTY), Draws(1, [7]))
    for step in range(150):
        several.notice(step, np.array([step % 7 == 0, step == 60, False]), np.full((3, 2), 700.0 + step))
        single.notice(step, np.array([step == 60]), np.full((1, 2), 700.0 + step))
        several.advance(step, np.ones(3, dtype=bool))
        single.advance(step, RUNS)
    np.testing.assert_array_equal(several.position[1], single.position[0])


def test_recorded_trackers_are_followed_cell_by_cell(shared_data):
    """Put where the recorded ones were, told what was detected; only legs that hold nothing random can agree."""
    recorded = np.load(shared_data / "prison_reference" / "low_extra.npz")
    offset, num = recorded["episode_offset"][:13], 12
    length = np.diff(offset)
    rows = np.minimum(offset[:-1] + np.arange(length.max())[:, None], offset[1:] - 1)
    target, is_detected = recorded["xy"].astype(float)[rows], recorded["detected"][rows]
    place = np.concatenate([recorded["heli_xy"], recorded["party_xy"]], axis=1).astype(float)[rows]
    made = Search((HELICOPTER,) + (PARTY,) * 5, Draws(0, np.arange(num)))
    num_right = num_steps = 0
    for step in range(length.max() - 1):
        is_running = step + 1 < length
        made.position[:] = place[step]
        made.notice(step, is_detected[step] & is_running, target[step])
        # Plans of two legs come from a detection; near the mountain they hold random places.
        is_known = (made._end - made._head >= 1) & (made._leg[:, 1] == 2) & (made._end == 2)
        is_known &= np.hypot(*(made._place[:, 0] - MOUNTAIN).T) > 400
        made.advance(step, is_running)
        is_known &= np.repeat(is_running, 6)
        agrees = (made.position == place[step + 1]).all(axis=-1).ravel()
        num_steps += int(is_known.sum())
        num_right += int((agrees & is_known).sum())
    assert num_steps > 5000 and num_right > 0.995 * num_steps
