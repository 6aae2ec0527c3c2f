import numpy as np
import pytest

from cadence.resampling import candidates_at, resample, systematic, threshold


def test_shares_fall_into_candidates_in_order() -> None:
    weight = np.array([0.0, 1.0, 0.0, 3.0, 0.0])
    found = candidates_at(weight, np.array([0.0, 0.24, 0.25, 0.9, np.nextafter(1.0, 0.0)]))
    assert found.tolist() == [1, 1, 3, 3, 3]


@pytest.mark.parametrize("uniform", [0.0, 0.3, 0.999])
def test_systematic_draws_are_even(uniform: float) -> None:
    assert np.bincount(systematic(np.array([3.0, 0.0, 1.0]), 100, uniform), minlength=3).tolist() == [75, 0, 25]
    count = np.bincount(systematic(np.array([0.7, 0.3]), 15, uniform), minlength=2)
    assert count.sum() == 15 and abs(count[0] - 10.5) < 1.0


def test_systematic_draws_are_right_on_average() -> None:
    weight, moments = np.array([0.05, 0.15, 0.8]), (np.arange(1000) + 0.5) / 1000
    count = [np.bincount(systematic(weight, 3, uniform), minlength=3) for uniform in moments]
    np.testing.assert_allclose(np.mean(count, axis=0), 3 * weight, atol=2e-3)


@pytest.mark.parametrize("num", [1, 2, 5, 9])
def test_resampling_keeps_the_heavy_and_is_right_on_average(num):
    weight = np.array([0.3, 0.02, 0.2, 0.0, 0.1, 0.05, 0.15, 0.03, 0.1, 0.05])
    level = threshold(weight[weight > 0], num) if num < 9 else 0.0
    if num < 9:
        np.testing.assert_allclose(np.minimum(weight / level, 1.0).sum(), num)
    mean = np.zeros(len(weight))
    for uniform in (np.arange(500) + 0.5) / 500:
        index, new = resample(weight, num, uniform)
        assert len(np.unique(index)) == len(index) <= num
        np.testing.assert_allclose(new.sum(), 1.0)
        np.testing.assert_allclose(new[weight[index] > level], weight[index][weight[index] > level], rtol=1e-9)
        mean[index] += new / 500
    np.testing.assert_allclose(mean, weight, atol=5e-3)
