"""Kalman filter, Rauch-Tung-Striebel smoother and joint backward sampling, one motion model a row.

Rows are pairs of a window and a motion model. Nodes are the union of grid steps and detection times, in time order; a
node without a detection only predicts. All in float64: exact detections beside a diffuse start need the digits.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from cadence.bank.components import MotionModels, transition

_JITTER = 1e-12


@dataclass(frozen=True, eq=False)
class Nodes:
    """Times and detections of P rows in time order.

    time_s        [P, M] non-decreasing
    position_m    [P, M, 2] detection, anything where there is none
    covariance_m2 [P, M, 2, 2]
    is_observed   [P, M] bool
    """

    time_s: Tensor
    position_m: Tensor
    covariance_m2: Tensor
    is_observed: Tensor

    def __getitem__(self, rows: Tensor) -> "Nodes":
        """A selection of rows; repeats are allowed."""
        return Nodes(self.time_s[rows], self.position_m[rows], self.covariance_m2[rows], self.is_observed[rows])


@dataclass(frozen=True, eq=False)
class Filtered:
    """Filter output: moments after each node's update [P, M, S(, S)], transitions into it, and the log likelihood [P]."""

    mean: Tensor
    covariance: Tensor
    matrix: Tensor
    noise: Tensor
    log_likelihood: Tensor


@dataclass(frozen=True, eq=False)
class Backward:
    """The backward kernel x[m] = gain x[m + 1] + offset + root n, which smooths (n = 0 in the mean) and samples.

    gain [P, M - 1, S, S], offset [P, M - 1, S], root [P, M - 1, S, S] lower triangular; the last node's law is in
    `mean` [P, S] and `last_root` [P, S, S].
    """

    gain: Tensor
    offset: Tensor
    root: Tensor
    mean: Tensor
    last_root: Tensor


def filter_forward(models: MotionModels, nodes: Nodes, position_sigma_m: Tensor) -> Filtered:
    """Kalman filter over the nodes.

    Args:
        models: [P] motion models in seconds and metres.
        nodes: [P, M] nodes; the first need not hold a detection.
        position_sigma_m: [P] standard deviation of the diffuse start around the row's first detection.

    Returns:
        Moments, transitions (identity into the first node) and the log likelihood of each row's detections.
    """
    first = nodes.is_observed.to(torch.int64).argmax(dim=1)
    begin_m = nodes.position_m[torch.arange(len(first)), first]
    return filter_from(models, nodes, *diffuse_start(models, begin_m, position_sigma_m))


def filter_from(models: MotionModels, nodes: Nodes, mean: Tensor, covariance: Tensor) -> Filtered:
    """`filter_forward` from given moments [P, S(, S)] at the first node, before its detection is seen."""
    num_rows, num_nodes = nodes.time_s.shape
    duration = torch.diff(nodes.time_s, dim=1, prepend=nodes.time_s[:, :1])
    matrix, noise = transition(models, duration)
    log_likelihood = torch.zeros(num_rows, dtype=torch.float64)
    means, covariances = [], []
    is_any = nodes.is_observed.any(0).tolist()
    for m in range(num_nodes):
        if m:
            step = matrix[:, m]
            mean = (step @ mean[..., None])[..., 0]
            covariance = step @ covariance @ step.mT + noise[:, m]
        observed = nodes.is_observed[:, m]
        if is_any[m]:
            mean, covariance, gained = _update(mean, covariance, nodes.position_m[:, m], nodes.covariance_m2[:, m], observed)
            log_likelihood = log_likelihood + gained
        means.append(mean)
        covariances.append(covariance)
    return Filtered(torch.stack(means, 1), torch.stack(covariances, 1), matrix, noise, log_likelihood)


def diffuse_start(models: MotionModels, position_m: Tensor, sigma_m: Tensor) -> tuple[Tensor, Tensor]:
    """A diffuse position [P] about [P, 2], or a diffuse centre and the stationary law about it: moments [P, S(, S)]."""
    size = models.num_states
    mean = position_m.repeat(1, size // 2)
    mean[:, 2:4] = 0.0
    covariance = torch.zeros(len(mean), size, size, dtype=torch.float64)
    for axis in (0, 1):
        covariance[:, axis, axis] = sigma_m**2 + torch.where(models.has_home, models.home_range, 0.0) ** 2
        covariance[:, axis + 2, axis + 2] = models.initial_speed**2
        if size > 4:
            about = torch.where(models.has_home, sigma_m**2, 0.0)
            covariance[:, axis + 4, axis + 4] = covariance[:, axis, axis + 4] = covariance[:, axis + 4, axis] = about
    return mean, covariance


def _update(
    mean: Tensor, covariance: Tensor, position_m: Tensor, noise_m2: Tensor, observed: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    innovation_cov = covariance[:, :2, :2] + noise_m2
    a, b, d = innovation_cov[:, 0, 0], innovation_cov[:, 0, 1], innovation_cov[:, 1, 1]
    determinant = a * d - b * b
    inverse = torch.stack([d, -b, -b, a], -1).view(-1, 2, 2) / determinant[:, None, None]
    cross = covariance[:, :, :2]
    gain = cross @ inverse * observed[:, None, None]
    innovation = position_m - mean[:, :2]
    updated_mean = mean + (gain @ innovation[..., None])[..., 0]
    updated = covariance - gain @ cross.mT
    updated = 0.5 * (updated + updated.mT)
    distance = (innovation[:, None] @ inverse @ innovation[..., None])[:, 0, 0]
    gained = -0.5 * (distance + torch.log(determinant)) - math.log(2.0 * math.pi)
    return updated_mean, updated, torch.where(observed, gained, torch.zeros_like(gained))


def backward_kernel(filtered: Filtered) -> Backward:
    """Gains, offsets and noise roots of the backward pass, all nodes at once (they do not depend on the samples)."""
    covariance, mean = filtered.covariance[:, :-1], filtered.mean[:, :-1]
    matrix, noise = filtered.matrix[:, 1:], filtered.noise[:, 1:]
    predicted = matrix @ covariance @ matrix.mT + noise
    predicted = predicted + _jitter(predicted)
    gain = torch.linalg.solve(predicted, matrix @ covariance).mT
    offset = mean - (gain @ (matrix @ mean[..., None]))[..., 0]
    # Joseph's form stays positive semi-definite where covariance - gain predicted gain' would cancel.
    keep = torch.eye(matrix.shape[-1], dtype=torch.float64) - gain @ matrix
    conditional = keep @ covariance @ keep.mT + gain @ noise @ gain.mT
    root = torch.linalg.cholesky(conditional + _jitter(conditional))
    last = filtered.covariance[:, -1]
    return Backward(gain, offset, root, filtered.mean[:, -1], torch.linalg.cholesky(last + _jitter(last)))


def _jitter(covariance: Tensor) -> Tensor:
    scale = covariance.diagonal(dim1=-2, dim2=-1)
    return torch.diag_embed(_JITTER * (scale + scale.amax(-1, keepdim=True)) + 1e-18)


def smooth(filtered: Filtered, backward: Backward) -> tuple[Tensor, Tensor]:
    """Smoothed moments of every node: mean [P, M, S] and covariance [P, M, S, S]."""
    mean, covariance = filtered.mean[:, -1], filtered.covariance[:, -1]
    means, covariances = [mean], [covariance]
    for m in range(backward.gain.shape[1] - 1, -1, -1):
        gain, root = backward.gain[:, m], backward.root[:, m]
        mean = (gain @ mean[..., None])[..., 0] + backward.offset[:, m]
        covariance = gain @ covariance @ gain.mT + root @ root.mT
        means.append(mean)
        covariances.append(covariance)
    return torch.stack(means[::-1], 1), torch.stack(covariances[::-1], 1)


def draw(backward: Backward, rows: Tensor, normal: Tensor) -> Tensor:
    """Joint samples of the states at every node.

    Args:
        backward: kernels of P rows.
        rows: [N] the row of each sample.
        normal: [N, M, S] standard normal numbers.

    Returns:
        States (x, y, vx, vy, where models have a home its centre) [N, M, S].
    """
    state = backward.mean[rows] + (backward.last_root[rows] @ normal[:, -1, :, None])[..., 0]
    states = [state]
    # the noise of all nodes in one product: only the recursion itself is sequential
    kick = (backward.root[rows] @ normal[:, :-1, :, None])[..., 0] + backward.offset[rows]
    # node by node in memory, as it is read: nearly twice as fast
    gain, kicks = backward.gain.transpose(0, 1).contiguous(), kick.transpose(0, 1).contiguous()
    for m in range(len(gain) - 1, -1, -1):
        state = torch.bmm(gain[m][rows], state[..., None])[..., 0] + kicks[m]
        states.append(state)
    return torch.stack(states[::-1], 1)
