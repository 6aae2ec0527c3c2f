import numpy as np
import pytest

from cadence.worlds.cells import CellGround
from cadence.worlds.draws import Draws
from cadence.worlds.pursuit import HELICOPTER, PARTY, Pursuit, is_working

MOUNTAIN = np.array([[1600.0, 1800.0]])
NO_MOUNTAIN = np.zeros((0, 2))
ROUNDING = 0.5 * np.sqrt(2.0) + 1e-9


def _pursuit(kinds=(PARTY,), episodes=(0,), mountains=NO_MOUNTAIN, **ground):
    return Pursuit(CellGround(2428, mountains, **ground), kinds, Draws(7, np.array(episodes)))


def _run(pursuit, first, count):
    """Tracks [count, B, M, 2] with nothing detected."""
    running = np.ones(len(pursuit.position), dtype=bool)
    tracks = []
    for step in range(first, first + count):
        pursuit.advance(step, running)
        tracks.append(pursuit.position.copy())
    return np.array(tracks)


def _see_twice(place, target, way, steps=10):
    """A party at `place` when the target has come `way` to `target` in `steps` since its last detection."""
    pursuit = _pursuit()
    pursuit.notice(1, np.array([True]), np.array([target]) - way)
    pursuit.position[:] = place
    pursuit.notice(1 + steps, np.array([True]), np.array([target], dtype=float))
    return pursuit, 2 + steps


def test_first_detection_sends_everybody_there():
    pursuit = _pursuit((PARTY, PARTY, HELICOPTER))
    target = np.array([1000.0, 900.0])
    before = np.hypot(*(pursuit.position[0] - target).T)
    pursuit.notice(0, np.array([True]), target[None])
    after = np.hypot(*(_run(pursuit, 1, 5)[-1, 0] - target).T)
    assert (before[:2] - after[:2] > 5 * 5.9).all()
    assert after[2] < max(10.0, before[2] - 5 * 125.0 + 1.0)


def test_mover_ahead_goes_to_the_foot_of_the_perpendicular_and_meets_the_target():
    # The target comes along y = 500 in the direction of +x; the party is 130 above the line, 900 ahead.
    pursuit, step = _see_twice([1900.0, 630.0], [1000.0, 500.0], [75.0, 0.0])
    track = _run(pursuit, step, 60)[:, 0, 0]
    assert np.hypot(*(track - [1900.0, 500.0]).T).min() <= 10.0
    assert np.abs(track[:15, 0] - 1900.0).max() <= 1.0
    assert (np.diff(track[25:, 0]) < -5.9).all() and np.abs(track[25:, 1] - 500.0).max() <= 10.0


def test_mover_that_comes_late_follows():
    # The same, but only 100 ahead: the target has passed the foot long before.
    pursuit, step = _see_twice([1100.0, 630.0], [1000.0, 500.0], [75.0, 0.0])
    track = _run(pursuit, step, 60)[:, 0, 0]
    assert np.hypot(*(track - [1100.0, 500.0]).T).min() <= 10.0
    assert (np.diff(track[25:, 0]) > 5.9).all() and np.abs(track[25:, 1] - 500.0).max() <= 10.0


@pytest.mark.parametrize("way", [(0.0, 75.0), (0.0, -75.0), (-75.0, 0.0), (53.0, -53.0)])
def test_mover_behind_goes_to_the_last_place_and_follows(way):
    way = np.array(way)
    target = np.array([1200.0, 1200.0])
    pursuit, step = _see_twice(target - 4 * way, target, way)
    track = _run(pursuit, step, 120)[:, 0, 0]
    reached = int(np.argmin(np.hypot(*(track - target).T)))
    assert np.hypot(*(track[reached] - target)) <= 10.0
    along = (track[reached + 5 :] - target) @ way / np.hypot(*way)
    assert len(along) > 20 and (np.diff(along) > 5.0).all()


def test_foot_off_the_map_is_replaced_by_the_nearest_point_of_it():
    # The line runs off the west edge; the foot of the perpendicular lies beyond it.
    pursuit, step = _see_twice([10.0, 900.0], [60.0, 500.0], [-53.0, 53.0])
    foot = np.array([-165.0, 725.0])
    track = _run(pursuit, step, 60)[:, 0, 0]
    assert np.hypot(*(track - [1.0, foot[1]]).T).min() <= 10.0


def test_spiral_visits_the_corners_of_growing_squares():
    pursuit = _pursuit(detours_before_spiral=False)
    pursuit.position[:] = [1200.0, 1200.0]
    pursuit.notice(0, np.array([True]), np.array([[1200.0, 1200.0]]))
    track = _run(pursuit, 1, 90)[:, 0, 0]
    for corner in ([1244, 1200], [1244, 1244], [1156, 1244], [1156, 1156], [1288, 1156]):
        assert np.hypot(*(track - corner).T).min() <= 10.0


def test_after_arrival_on_land_the_mover_goes_away_and_comes_back_for_the_spiral():
    pursuit = _pursuit((HELICOPTER,))
    pursuit.position[:] = [1200.0, 1200.0]
    pursuit.notice(0, np.array([True]), np.array([[1200.0, 1200.0]]))
    track = _run(pursuit, 1, 199)[:, 0, 0]
    distance, moved = np.hypot(*(track[1:] - 1200.0).T), np.hypot(*np.diff(track, axis=0).T)
    away = int(np.argmax((moved <= 30.0 + ROUNDING) & (distance > 200.0)))
    assert moved[:away].max() > 126.0 and distance[away] > 200.0
    back = away + int(np.argmax(distance[away:] < 80.0))
    assert distance[back] < 80.0
    assert moved[away + 1 : back].max() <= 30.0 + ROUNDING  # the way back belongs to the spiral


def test_nobody_is_faster_than_his_kind_or_leaves_the_map():
    pursuit = _pursuit((HELICOPTER, PARTY, PARTY), range(20), MOUNTAIN)
    rng = np.random.default_rng(1)
    target, running = rng.uniform(300, 2100, (20, 2)), np.ones(20, dtype=bool)
    before = pursuit.position.copy()
    for step in range(1, 400):
        target = np.clip(target + rng.normal(0.0, 5.0, (20, 2)), 0, 2427)
        pursuit.notice(step - 1, rng.random(20) < 0.1, np.rint(target))
        pursuit.advance(step, running)
        moved = np.hypot(*np.moveaxis(pursuit.position - before, -1, 0))
        assert (moved <= np.array([127.0, 6.5, 6.5]) + ROUNDING).all()
        assert (pursuit.position >= 0).all() and (pursuit.position <= 2427).all()
        assert (pursuit.position == np.rint(pursuit.position)).all()
        assert np.hypot(*np.moveaxis(pursuit.position[:, 1:] - MOUNTAIN[0], -1, 0)).min() > 140.0 - 8.0
        if not is_working(HELICOPTER, step):
            assert (moved[:, 0] == 0).all()
        before = pursuit.position.copy()
    assert not is_working(HELICOPTER, 200) and is_working(HELICOPTER, 240) and is_working(PARTY, 200)


def test_batch_neighbours_and_repetition_change_nothing():
    def tracks(episodes):
        pursuit = _pursuit((HELICOPTER, PARTY), episodes, MOUNTAIN)
        way = []
        for step in range(1, 260):
            seen = np.array([(step + episode) % 37 < 2 for episode in episodes])
            target = np.array([[800.0 + 3 * step, 700.0 + 40 * episode + step] for episode in episodes])
            pursuit.notice(step - 1, seen, target)
            pursuit.advance(step, np.ones(len(episodes), dtype=bool))
            way.append(pursuit.position.copy())
        return np.array(way)

    together = tracks([4, 8, 15])
    assert (tracks([8])[:, 0] == together[:, 1]).all()
    assert (tracks([4, 8, 15]) == together).all()
    assert (together[:, 0] != together[:, 1]).any()


def test_finished_episodes_stand_still():
    pursuit = _pursuit((PARTY,), (0, 1))
    before = pursuit.position.copy()
    pursuit.advance(1, np.array([True, False]))
    moved = (pursuit.position != before).any(axis=(1, 2))
    assert moved.tolist() == [True, False]


def test_mountains_of_a_wrong_shape_are_refused():
    with pytest.raises(ValueError, match="expected \\[K, 2\\]"):
        CellGround(2428, np.zeros(2))
