"""The noise of detections by their likelihood: known noise is found, and what is no noise is not taken for any."""

import numpy as np
import pytest

from cadence.measurement.courses import velocities
from cadence.measurement.noise import MeasurementNoise, Track, covariances_m2, measurement_noise
from cadence.measurement.processes import all_processes, transitions

SECONDS = np.arange(300.0)
STRAIGHT = np.column_stack([5.0 * SECONDS, 0.0 * SECONDS])
CIRCLE = 200.0 * np.column_stack([np.cos(SECONDS / 20.0), np.sin(SECONDS / 20.0)])


def noise(sigma_m: float, seed: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).normal(0.0, sigma_m, (len(SECONDS), 2))


def found_of(time_s: np.ndarray, position_m: np.ndarray) -> MeasurementNoise:
    found = measurement_noise([Track(time_s, position_m)])
    assert found is not None
    return found


@pytest.mark.parametrize("way", [STRAIGHT, CIRCLE, 0.0 * STRAIGHT])
@pytest.mark.parametrize("sigma_m", [2.0, 20.0])
def test_white_noise(way: np.ndarray, sigma_m: float) -> None:
    found = found_of(SECONDS, way + noise(sigma_m))
    low_m, high_m = found.sigma_interval_m
    assert found.is_sure and low_m <= sigma_m <= high_m and found.sigma_m == pytest.approx(sigma_m, rel=0.12)
    assert found.timing_interval_s[0] == 0.0


def test_white_noise_at_irregular_times() -> None:
    time_s = np.sort(np.random.default_rng(5).uniform(0.0, 300.0, 300))
    found = found_of(time_s, np.column_stack([5.0 * time_s, 0.0 * time_s]) + noise(3.0))
    assert found.is_sure and found.sigma_m == pytest.approx(3.0, rel=0.2)


@pytest.mark.parametrize(
    "position_m",
    [
        STRAIGHT,
        CIRCLE,
        np.column_stack([5.0 * SECONDS, 20.0 * np.sin(SECONDS / 2.0)]),  # turns sharply
    ],
)
def test_ways_without_noise(position_m: np.ndarray) -> None:
    assert not found_of(SECONDS, position_m).is_sure


def test_a_walk_at_random_is_hardly_told_from_a_noisy_one() -> None:
    """Steps of 3 m an axis: what is taken for noise stays below half of one."""
    assert found_of(SECONDS, np.cumsum(noise(3.0), axis=0)).sigma_m < 1.7


def test_whole_seconds_are_noise_along_the_course() -> None:
    """A circle at 50 m/s that is seen at any time, of which whole seconds remain."""
    rng = np.random.default_rng(4)
    angle = 0.05 * (SECONDS + rng.uniform(-0.5, 0.5, len(SECONDS)))
    position_m = 1000.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    found = found_of(SECONDS, position_m)
    low_s, high_s = found.timing_interval_s
    assert low_s <= 1.0 / np.sqrt(12.0) <= high_s and found.sigma_interval_m[1] < 2.0
    assert found.along_m == pytest.approx(50.0 / np.sqrt(12.0), rel=0.15)
    largest = np.linalg.eigh(covariances_m2(Track(SECONDS, position_m), found)[100])[1][:, 1]
    course = np.array([-np.sin(angle[100]), np.cos(angle[100])])
    assert abs(float(largest @ course)) > 0.99


def test_turns_that_are_seen_too_rarely() -> None:
    """An aircraft on circles of two minutes, reported every three on average: far beside any smooth way, and no noise."""
    time_s = np.cumsum(np.random.default_rng(2).uniform(60.0, 300.0, 120))
    circles = 1500.0 * np.column_stack([np.cos(time_s / 19.0), np.sin(time_s / 19.0)])
    found = measurement_noise([Track(time_s, circles)])
    assert found is None or not found.is_sure


@pytest.mark.parametrize("num", [0, 1, 3, 20])
def test_too_few_detections(num: int) -> None:
    assert measurement_noise([Track(SECONDS[:num], (STRAIGHT + noise(2.0))[:num])]) is None


def test_short_bursts_of_many_targets_are_enough_together() -> None:
    tracks = [Track(SECONDS[:8], (CIRCLE + noise(4.0, seed))[:8]) for seed in range(30)]
    found = measurement_noise(tracks)
    assert found is not None and found.sigma_interval_m[0] <= 4.0 <= found.sigma_interval_m[1]
    assert measurement_noise(tracks[:3]) is None


def test_units_do_not_matter() -> None:
    one, other = found_of(SECONDS, CIRCLE + noise(4.0)), found_of(SECONDS, 1e3 * (CIRCLE + noise(4.0)))
    assert other.sigma_m == pytest.approx(1e3 * one.sigma_m, rel=1e-6)


def test_velocities_leave_out_the_detection_itself() -> None:
    time_s = np.array([0.0, 1.0, 2.0, 3.0, 100.0, 200.0, 201.0, 202.0])
    position_m = np.column_stack([3.0 * time_s, np.zeros(8)])
    position_m[1, 1] = 9.0
    velocity, base_s = velocities(time_s, position_m, 1.0)
    assert np.allclose(velocity[1], [3.0, 0.0])
    assert base_s.tolist() == [1.0, 3.0, 3.0, 1.0, 0.0, 1.0, 2.0, 1.0] and velocity[4].tolist() == [0.0, 0.0]


def test_what_stands_alone_is_uncertain_all_round() -> None:
    lone = MeasurementNoise(1.0, (0.9, 1.1), 0.2, (0.1, 0.3), 10.0, 1.0, 20)
    assert np.allclose(covariances_m2(Track(np.zeros(1), np.zeros((1, 2))), lone)[0], 3.0 * np.eye(2))


def test_two_steps_are_one_step_of_twice_the_time() -> None:
    """Chapman and Kolmogorov, for every process."""
    assert len(all_processes()) == 5 * 14
    one, two = transitions(np.array(0.7)), transitions(np.array(1.4))
    zero, unit = np.zeros_like(one.xx), np.ones_like(one.xx)

    def matrices(step):
        way = np.array([[unit, step.x_of_v, step.x_of_a], [zero, step.v_of_v, step.v_of_a], [zero, zero, step.a_of_a]])
        return way.transpose(2, 0, 1), np.array(
            [[step.xx, step.xv, step.xa], [step.xv, step.vv, step.va], [step.xa, step.va, step.aa]]
        ).transpose(2, 0, 1)

    (way, spread), (way_two, spread_two) = matrices(one), matrices(two)
    assert np.allclose(way @ way, way_two)
    assert np.allclose(way @ spread @ way.swapaxes(1, 2) + spread, spread_two, rtol=1e-6)
