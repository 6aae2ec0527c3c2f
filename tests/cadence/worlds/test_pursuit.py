from dataclasses import dataclass, field

import numpy as np
import pytest

from cadence.worlds.draws import Draws
from cadence.worlds.pursuit import AIRPLANE, VESSEL, Pursuit, is_working


@dataclass
class Square:
    """A square sea with a round island that nobody enters; ways are straight."""

    island: float = 0.0
    size: np.ndarray = field(default_factory=lambda: np.array([2400.0, 2400.0]))

    def is_outside(self, point):
        return ((point < 1.0) | (point > self.size - 1.0)).any(axis=-1)

    def is_closed(self, point):
        return np.hypot(*np.moveaxis(point - 1600.0, -1, 0)) < self.island

    def ends_spiral(self, point):
        return self.is_outside(point) | self.is_closed(point)

    def ends_line(self, point, ahead, speed):
        return ((point <= speed[:, None]) | (point >= self.size - speed[:, None])).any(axis=-1) | self.is_closed(ahead)

    def settle(self, point, heading, otherwise):
        return np.where(self.is_closed(point)[:, None], otherwise, point)

    def aim(self, position, goal):
        return goal

    def move(self, position, direction, speed):
        moved = np.clip(position + direction * speed[:, None], 0.0, self.size)
        return np.where(self.is_closed(moved)[:, None], position, moved)


def _pursuit(kinds=(VESSEL,), episodes=(0,), island=0.0):
    return Pursuit(Square(island), kinds, Draws(7, np.array(episodes)))


def _run(pursuit, first, count):
    """Tracks [count, B, M, 2] with nothing detected."""
    running = np.ones(len(pursuit.position), dtype=bool)
    tracks = []
    for step in range(first, first + count):
        pursuit.advance(step, running)
        tracks.append(pursuit.position.copy())
    return np.array(tracks)


def _see_twice(place, target, way, steps=10):
    """A vessel at `place` when the target has come `way` to `target` in `steps` since its last detection."""
    pursuit = _pursuit()
    pursuit.notice(1, np.array([True]), np.array([target]) - way)
    pursuit.position[:] = place
    pursuit.notice(1 + steps, np.array([True]), np.array([target], dtype=float))
    return pursuit, 2 + steps


def test_first_detection_sends_everybody_there():
    pursuit = _pursuit((VESSEL, VESSEL, AIRPLANE))
    target = np.array([1000.0, 900.0])
    before = np.hypot(*(pursuit.position[0] - target).T)
    pursuit.notice(0, np.array([True]), target[None])
    distance = np.hypot(*np.moveaxis(_run(pursuit, 1, 5)[:, 0] - target, -1, 0))
    np.testing.assert_allclose(before[:2] - distance[-1, :2], 5 * 6.5)
    assert before[2] < 5 * 127.0 and distance[:, 2].min() <= 10.0


def test_mover_ahead_goes_to_the_foot_of_the_perpendicular_and_meets_the_target():
    # The target comes along y = 500 in the direction of +x; the vessel is 130 above the line, 900 ahead.
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
    pursuit = _pursuit()
    pursuit.position[:] = [1200.0, 1200.0]
    pursuit.notice(0, np.array([True]), np.array([[1200.0, 1200.0]]))
    track = _run(pursuit, 1, 90)[:, 0, 0]
    for corner in ([1244, 1200], [1244, 1244], [1156, 1244], [1156, 1156], [1288, 1156]):
        assert np.hypot(*(track - corner).T).min() <= 10.0


def test_spiral_that_has_no_room_becomes_a_random_point():
    pursuit = _pursuit()
    pursuit.position[:] = [2380.0, 1200.0]  # the first corner would lie off the map
    pursuit.notice(0, np.array([True]), np.array([[2380.0, 1200.0]]))
    track = _run(pursuit, 1, 60)[:, 0, 0]
    assert np.hypot(*(track[-1] - [2380.0, 1200.0])) > 300.0


def test_line_ends_at_land():
    # The vessel is behind the target and follows it into the island, where it gives up.
    target, way = np.array([1300.0, 1600.0]), np.array([75.0, 0.0])
    pursuit = _pursuit(island=150.0)
    pursuit.notice(1, np.array([True]), (target - way)[None])
    pursuit.position[:] = target - 2 * way
    pursuit.notice(11, np.array([True]), target[None])
    track = _run(pursuit, 12, 150)[:, 0, 0]
    moved = np.hypot(*np.diff(track, axis=0).T)
    assert np.hypot(*(track - 1600.0).T).min() < 160.0
    assert (moved == 0).sum() < 20


def test_nobody_is_faster_than_his_kind_or_leaves_the_map():
    pursuit = _pursuit((AIRPLANE, VESSEL, VESSEL), range(20), 150.0)
    rng = np.random.default_rng(1)
    target, running = rng.uniform(300, 2100, (20, 2)), np.ones(20, dtype=bool)
    before = pursuit.position.copy()
    for step in range(1, 400):
        target = np.clip(target + rng.normal(0.0, 5.0, (20, 2)), 0, 2400)
        pursuit.notice(step - 1, rng.random(20) < 0.1, target)
        pursuit.advance(step, running)
        moved = np.hypot(*np.moveaxis(pursuit.position - before, -1, 0))
        assert (moved <= np.array([127.0, 6.5, 6.5]) + 1e-9).all()
        assert (pursuit.position >= 0).all() and (pursuit.position <= 2400).all()
        assert np.hypot(*np.moveaxis(pursuit.position - 1600.0, -1, 0)).min() >= 150.0
        if not is_working(AIRPLANE, step):
            assert (moved[:, 0] == 0).all()
        before = pursuit.position.copy()
    assert not is_working(AIRPLANE, 200) and is_working(AIRPLANE, 240) and is_working(VESSEL, 200)


def test_batch_neighbours_and_repetition_change_nothing():
    def tracks(episodes):
        pursuit = _pursuit((AIRPLANE, VESSEL), episodes, 150.0)
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
    pursuit = _pursuit((VESSEL,), (0, 1))
    before = pursuit.position.copy()
    pursuit.advance(1, np.array([True, False]))
    moved = (pursuit.position != before).any(axis=(1, 2))
    assert moved.tolist() == [True, False]
