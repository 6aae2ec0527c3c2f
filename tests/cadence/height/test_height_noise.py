"""The noise of heights: found where it is, none where there is none, and never less than rounding leaves."""

import numpy as np
import pytest

from cadence.height.bank import HeightTrack
from cadence.height.noise import height_noise, rounding_m


def flight(seed, sigma_m, step_m=0.0, num=240):
    """Level, a climb of 5 m/s, level, every second."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(num, dtype=np.float64)
    height = 1000.0 + 5.0 * np.clip(time_s - num / 3, 0.0, num / 3) + rng.normal(0, sigma_m, num)
    height = np.round(height / step_m) * step_m if step_m else height
    return HeightTrack(time_s, height, np.full(num, np.nan))


@pytest.mark.parametrize("sigma_m", [1.0, 4.0, 25.0])
def test_noise_is_found(sigma_m):
    for seed in range(3):
        found = height_noise([flight(seed, sigma_m)])
        assert found.interval_m[0] < sigma_m * 1.05
        assert found.interval_m[1] > sigma_m * 0.95
        assert found.sigma_m == pytest.approx(sigma_m, rel=0.25)
        assert found.is_sure
        assert found.rounded_to_m == 0.0


def test_rounding_is_found_and_is_the_least_noise():
    found = height_noise([flight(0, 0.0, 7.62)])
    assert found.rounded_to_m == pytest.approx(7.62)
    assert found.sigma_m == pytest.approx(7.62 / 12**0.5, rel=0.5)
    assert found.sigma_m >= found.rounded_to_m / 12**0.5
    assert rounding_m([flight(0, 2.0)]) == 0.0


def test_a_few_finer_altimeters_do_not_hide_the_step_of_most():
    found = [flight(seed, 0.0, 30.48) for seed in range(9)] + [flight(9, 0.0, 7.62, num=24)]
    assert rounding_m(found) == pytest.approx(30.48)


def test_heights_that_hardly_change_are_not_rounded():
    rng = np.random.default_rng(0)
    height = np.cumsum(rng.normal(0, 4e-4, 500))
    assert rounding_m([HeightTrack(np.arange(500.0), height, np.full(500, np.nan))]) == 0.0


def test_level_heights_without_change_are_exact():
    time_s = np.arange(30.0)
    found = height_noise([HeightTrack(time_s, np.full(30, 12.5), np.full(30, np.nan))])
    assert found.sigma_m == 0.0
    assert not found.is_sure


def test_too_little_to_tell():
    assert height_noise([]) is None
    assert height_noise([HeightTrack(np.array([0.0, 1.0, 2.0]), np.zeros(3), np.zeros(3))]) is None
