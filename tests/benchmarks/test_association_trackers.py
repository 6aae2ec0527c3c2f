"""The rival trackers' smoothing against the direct solution of the same linear Gaussian problem, with missed scans."""

import numpy as np
import pytest

from benchmarks.association_logs import Log
from benchmarks.association_trackers import Settings, tracked
from benchmarks.rts_smoother import rts_smoothed
from cadence.arrays import Float64s

DIFFUSION, SIGMA_M, SPEED_MPS = 0.02, 3.0, 4.0
SCAN_S = [0.0, 10.0, 20.0, 50.0, 60.0, 90.0, 100.0, 130.0]
IS_MISSED = [False, False, True, False, True, True, False, False]
SEEN_M = [0.0, 32.0, np.nan, 170.0, np.nan, np.nan, 230.0, 250.0]


def transition(interval_s: float) -> Float64s:
    return np.array([[1.0, interval_s], [0.0, 1.0]])


def noise(interval_s: float) -> Float64s:
    return DIFFUSION * np.array([[interval_s**3 / 3.0, interval_s**2 / 2.0], [interval_s**2 / 2.0, interval_s]])


def direct() -> tuple[Float64s, Float64s]:
    """Mean [N, 2] and covariances [N, 2, 2] of position and speed at all scans, by one solution of all normal equations."""
    num = len(SCAN_S)
    precision, right = np.zeros((2 * num, 2 * num)), np.zeros(2 * num)
    precision[1, 1] = SPEED_MPS**-2
    for scan in range(num - 1):
        interval_s = SCAN_S[scan + 1] - SCAN_S[scan]
        difference = np.zeros((2, 2 * num))
        difference[:, 2 * scan : 2 * scan + 4] = np.hstack([-transition(interval_s), np.eye(2)])
        precision += difference.T @ np.linalg.inv(noise(interval_s)) @ difference
    for scan in np.flatnonzero(~np.array(IS_MISSED)):
        precision[2 * scan, 2 * scan] += SIGMA_M**-2
        right[2 * scan] += SEEN_M[scan] / SIGMA_M**2
    covariance = np.linalg.inv(precision)
    blocks = [covariance[2 * scan : 2 * scan + 2, 2 * scan : 2 * scan + 2] for scan in range(num)]
    return (covariance @ right).reshape(num, 2), np.array(blocks)


def filtered() -> tuple[Float64s, Float64s]:
    """The same by a Kalman filter: moments given the detections so far."""
    mean, covariance = np.array([SEEN_M[0], 0.0]), np.diag([SIGMA_M**2, SPEED_MPS**2])
    means, covariances = [mean], [covariance]
    for scan in range(1, len(SCAN_S)):
        interval_s = SCAN_S[scan] - SCAN_S[scan - 1]
        step = transition(interval_s)
        mean, covariance = step @ mean, step @ covariance @ step.T + noise(interval_s)
        if not IS_MISSED[scan]:
            gain = covariance[:, 0] / (covariance[0, 0] + SIGMA_M**2)
            mean, covariance = mean + gain * (SEEN_M[scan] - mean[0]), covariance - np.outer(gain, covariance[0])
        means.append(mean)
        covariances.append(covariance)
    return np.array(means), np.array(covariances)


def test_smoother_gives_the_direct_solution_across_missed_scans() -> None:
    intervals = np.diff(SCAN_S)
    mean, covariance = filtered()
    smoothed = rts_smoothed(mean, covariance, [transition(s) for s in intervals], [noise(s) for s in intervals])
    expected = direct()
    assert smoothed[0] == pytest.approx(expected[0], rel=1e-9)
    assert smoothed[1] == pytest.approx(expected[1], rel=1e-9)
    assert abs(mean[5, 0] - expected[0][5, 0]) > 10.0 * SIGMA_M  # nobody can have left the smoother out


@pytest.mark.parametrize("kind", ["GNN", "JPDA"])
def test_tracks_are_smoothed_by_all_detections(kind: str) -> None:
    """One target along x, seen without doubt: what the rival says at every scan is the direct solution."""
    pytest.importorskip("stonesoup")
    seen = ~np.array(IS_MISSED)
    place = np.stack([np.array(SEEN_M)[seen], np.zeros(seen.sum())], axis=1)
    times, grid = np.array(SCAN_S)[seen], np.array(SCAN_S)
    truth = np.zeros((1, len(grid), 2))
    log = Log(times, place, SIGMA_M, np.zeros(len(times), int), grid, truth, 1, 100.0, SPEED_MPS)
    settings = Settings(DIFFUSION, 0.0, 8.0, 3600.0, 1e-30, 0.999)
    estimate = tracked(kind, settings, log)
    expected, covariance = direct()
    assert estimate.position_m[0, :, 0] == pytest.approx(expected[:, 0], rel=1e-6)
    assert estimate.position_m[0, :, 1] == pytest.approx(np.zeros(len(grid)), abs=1e-9)
    spread = estimate.sample_m[:, 0, :, 0].std(axis=0)
    assert spread == pytest.approx(np.sqrt(covariance[:, 0, 0]), rel=0.35)
    assert estimate.label.tolist() == [0] * len(times)
