import numpy as np
import pytest

from cadence.worlds.draws import Draws


def test_numbers_do_not_depend_on_the_batch():
    together, alone = Draws(5, [3, 9, 4]), Draws(5, [9])
    steps = range(20)
    got = [together.uniform(np.array([0, 1, 2]), 2, step, np.array([7, 7, 7]))[1] for step in steps]
    want = [alone.uniform(np.array([0]), 2, step, 7)[0] for step in steps]
    assert got == want


def test_every_coordinate_of_the_address_counts():
    base = dict(seed=1, episode=2, stream=3, step=4, index=5)

    def number(**change):
        at = base | change
        return float(Draws(at["seed"], [at["episode"]]).uniform(np.array([0]), at["stream"], at["step"], at["index"])[0])

    values = {number()} | {number(**{name: value + 1}) for name, value in base.items()}
    assert len(values) == 6


def test_numbers_are_uniform_and_neighbours_unrelated():
    draws = Draws(0, np.arange(400))
    numbers = np.array([draws.uniform(np.arange(400), 1, step) for step in range(100)])
    assert abs(numbers.mean() - 0.5) < 4 * np.sqrt(1 / 12 / numbers.size)
    counts = np.histogram(numbers, 20, (0, 1))[0]
    assert (np.square(counts - 2000) / 2000).sum() < 45.0  # chi square, 19 degrees of freedom: 0.1 % beyond 43.8
    for axis in (0, 1):
        one, other = np.delete(numbers, 0, axis), np.delete(numbers, -1, axis)
        assert abs(np.corrcoef(one.ravel(), other.ravel())[0, 1]) < 0.02


def test_points_fill_the_square():
    draws = Draws(2, np.arange(5000))
    points = draws.point(np.arange(5000), 4, 0)
    assert points.shape == (5000, 2)
    assert abs(np.corrcoef(points.T)[0, 1]) < 0.06
    assert points.min() >= 0.0 and points.max() < 1.0


def test_negative_seed_is_refused():
    with pytest.raises(ValueError, match="seed is -1"):
        Draws(-1, [0])
