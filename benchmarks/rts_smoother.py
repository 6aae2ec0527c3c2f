"""Rauch-Tung-Striebel smoothing of what a Kalman filter leaves behind, scans without a detection included.

Stone Soup's own smoother (1.9.1, `findings/rivals.sh`) takes a prediction that it has smoothed for what the filter predicted,
so that nothing that is learned after a missed scan reaches the states before it.
"""

from collections.abc import Sequence

import numpy as np

from cadence.arrays import Float64s


def rts_smoothed(
    mean: Float64s, covariance: Float64s, transition: Sequence[Float64s], noise: Sequence[Float64s]
) -> tuple[Float64s, Float64s]:
    """Smoothed means [N, S] and covariances [N, S, S] of filtered ones (Särkkä 2013, theorem 8.2).

    Transition matrices and process noise [N - 1, S, S] lead from each state to the next. Covariances are updated in Joseph's
    form, which rounding leaves positive definite.
    """
    mean, covariance = mean.copy(), covariance.copy()
    for index in range(len(mean) - 2, -1, -1):
        step, added = transition[index], noise[index]
        gain = np.linalg.solve(step @ covariance[index] @ step.T + added, step @ covariance[index]).T
        kept = np.eye(len(step)) - gain @ step
        mean[index] += gain @ (mean[index + 1] - step @ mean[index])
        covariance[index] = kept @ covariance[index] @ kept.T + gain @ (added + covariance[index + 1]) @ gain.T
    return mean, covariance
