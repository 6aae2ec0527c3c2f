"""Returns that stand, by what one motion of the radar makes of their range rates."""

import numpy as np
import pytest

from cadence.measurement.doppler import are_static


def scene(velocity: tuple[float, float], sign: float = -1.0, num_static: int = 30) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Walls all around, and five cars that come nearer at 12 m/s beside what the radar's own motion makes."""
    rng = np.random.default_rng(4)
    bearing = rng.uniform(-1.2, 1.2, num_static + 5)
    ways = np.column_stack([np.cos(bearing), np.sin(bearing)])
    rates = sign * ways @ np.array(velocity) + 0.05 * rng.standard_normal(len(ways))
    rates[num_static:] -= 12.0
    return ways, rates, np.arange(len(ways)) < num_static


@pytest.mark.parametrize("velocity", [(0.0, 0.0), (15.0, 0.0), (6.0, -3.0)])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_walls_stand_however_the_radar_moves(velocity: tuple[float, float], sign: float) -> None:
    ways, rates, stands = scene(velocity, sign)
    np.testing.assert_array_equal(are_static(ways, rates, 0.3), stands)


def test_a_radar_that_reports_targets_alone_keeps_all() -> None:
    ways, rates, _ = scene((15.0, 0.0), num_static=3)
    assert not are_static(ways, rates, 0.3).any()
    assert not are_static(ways[:4], np.zeros(4), 0.3).any()
    assert not are_static(ways, np.full(len(rates), np.nan), 0.3).any()


def test_all_in_one_direction_tell_a_motion_along_it() -> None:
    ways = np.tile([1.0, 0.0], (12, 1))
    assert are_static(ways, np.zeros(12), 0.3).all() and not are_static(ways, np.linspace(-9.0, 9.0, 12), 0.3).any()


def test_one_ship_of_many_returns_is_no_surroundings() -> None:
    bearing = 0.7 + np.linspace(-0.2, 0.2, 20)
    ways = np.column_stack([np.cos(bearing), np.sin(bearing)])
    assert not are_static(ways, ways @ np.array([-6.0, 2.0]), 0.3).any()
