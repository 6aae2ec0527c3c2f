"""Ranges and bearings as positions: unbiased, as far off as their covariance says, and known not to be where they bend."""

import numpy as np
import pytest

from cadence.measurement.polar import cartesian, is_nearly_normal

NUM = 40_000


def draws(
    range_m: float, bearing: float, elevation: float, sigmas: tuple[float, float, float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The true place, positions made of noisy measurements of it, and their covariances."""
    rng = np.random.default_rng(5)
    true = np.array([range_m, bearing, elevation])
    noisy = true + rng.standard_normal((NUM, 3)) * sigmas
    place = range_m * np.array([np.cos(elevation) * np.cos(bearing), np.cos(elevation) * np.sin(bearing), np.sin(elevation)])
    return place, *cartesian(*noisy.T, *(np.full(NUM, sigma) for sigma in sigmas))


@pytest.mark.parametrize("sigmas", [(10.0, np.radians(1.0), np.radians(1.0)), (5.0, np.radians(8.0), np.radians(4.0))])
def test_positions_are_unbiased_and_their_covariance_is_true(sigmas: tuple[float, float, float]) -> None:
    place, position, covariance = draws(2000.0, 0.7, 0.3, sigmas)
    error = position - place
    spread = np.sqrt(np.trace(np.cov(error.T)))
    assert np.linalg.norm(error.mean(axis=0)) < 4.0 * spread / np.sqrt(NUM)
    squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)
    assert squared.mean() == pytest.approx(3.0, abs=0.1)  # of three axes; 4.5 standard errors at NUM draws


def test_without_correction_a_wide_beam_is_too_near() -> None:
    place, position, _ = draws(2000.0, 0.0, 0.0, (5.0, np.radians(8.0), 0.0))
    plain = 2000.0 * np.exp(-0.5 * np.radians(8.0) ** 2)
    assert plain < 1982.0 and position[:, 0].mean() == pytest.approx(place[0], abs=0.5)


def test_small_noise_is_that_of_the_first_order() -> None:
    """Along the line of sight the range's, across it distance times angle; nothing of the height where none is measured."""
    one = np.ones(1)
    position, covariance = cartesian(1000.0 * one, 0.5 * np.pi * one, 0.0 * one, 3.0 * one, 0.01 * one, 0.0 * one)
    np.testing.assert_allclose(position[0], [0.0, 1000.0, 0.0], atol=0.06)
    np.testing.assert_allclose(covariance[0], np.diag([100.0, 9.0, 0.0]), atol=0.05)


def test_the_bend_of_a_wide_beam_is_no_normal_position() -> None:
    ranges, sigma = np.array([1e3, 1e4, 2e4]), np.full(3, 10.0)
    assert is_nearly_normal(ranges, sigma, np.radians(np.full(3, 1.0))).tolist() == [True, True, False]
