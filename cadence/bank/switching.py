"""Motion after the last detection: the model may change at any moment.

Between detections the data hold a hypothesis in place; after the last one a target that turned keeps turning for ever
unless models can change. They do so at a constant rate, to a model drawn from the log's prior weights: a Markov jump
linear system, whose first two moments are exact (Costa, Fragoso, Marques, "Discrete-Time Markov Jump Linear Systems", ch. 3).
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from cadence.bank.components import MotionModels, transition

_JITTER = 1e-12


@dataclass(frozen=True, eq=False)
class SwitchingModels:
    """All C models of the bank in seconds and metres, their prior weights [C] and the rate of change (1/s)."""

    models: MotionModels
    weight: Tensor
    rate: float


def durations_after(time_s: Tensor, last_s: Tensor) -> Tensor:
    """How much of the interval that ends at each grid step lies after each row's last detection [R, T]; zero before it."""
    previous = torch.cat([time_s[:1] - (time_s[1] - time_s[0]), time_s[:-1]])
    return (time_s - torch.maximum(previous, last_s[:, None])).clamp_min(0.0)


def continue_moments(
    switching: SwitchingModels, durations_s: Tensor, weight: Tensor, mean: Tensor, covariance: Tensor
) -> tuple[Tensor, Tensor]:
    """Exact mean and axis variance of the position while models change.

    Args:
        switching: C models.
        durations_s: [R, S] time to pass at each step.
        weight: [R, C] probability of each model at the last detection.
        mean: [R, C, 4] of the state there, given the model (anything finite where the weight is zero).
        covariance: [R, C, 4, 4] likewise.

    Returns:
        Mean [R, S, 2] and variance an axis [R, S].
    """
    first = weight[..., None] * mean
    second = weight[..., None, None] * (covariance + mean[..., :, None] * mean[..., None, :])
    means, variances = [], []
    num_rows, num_models = weight.shape
    for s in range(durations_s.shape[1]):
        duration = durations_s[:, s]
        stay = torch.exp(-switching.rate * duration)[:, None]
        weight = stay * weight + (1.0 - stay) * switching.weight * weight.sum(1, keepdim=True)
        first = stay[..., None] * first + ((1.0 - stay) * switching.weight)[..., None] * first.sum(1, keepdim=True)
        second = stay[..., None, None] * second + ((1.0 - stay) * switching.weight)[..., None, None] * second.sum(
            1, keepdim=True
        )
        matrix, noise = _transitions(switching.models, duration, num_rows, num_models)
        first = (matrix @ first[..., None])[..., 0]
        second = matrix @ second @ matrix.mT + weight[..., None, None] * noise
        total_mean = first.sum(1)[:, :2]
        total_square = second.sum(1)[:, :2, :2].diagonal(dim1=-2, dim2=-1)
        means.append(total_mean)
        variances.append(0.5 * (total_square - total_mean**2).sum(-1).clamp_min(0.0))
    return torch.stack(means, 1), torch.stack(variances, 1)


def continue_samples(
    switching: SwitchingModels, durations_s: Tensor, model: Tensor, state: Tensor, uniform: Tensor, normal: Tensor
) -> Tensor:
    """Joint samples of the positions while models change.

    Args:
        switching: C models.
        durations_s: [R, S].
        model: [R, K] index of each hypothesis' model at the last detection.
        state: [R, K, 4] its state there.
        uniform: [R, K, S, 2] uniform numbers: whether the model changes, and to which.
        normal: [R, K, S, 4] standard normal numbers.

    Returns:
        Positions [R, K, S, 2].
    """
    cumulative = switching.weight.cumsum(0).clamp(max=1.0)
    choice = torch.searchsorted(cumulative, uniform[..., 1].contiguous()).clamp(max=len(cumulative) - 1)
    num_rows, num_models = len(durations_s), len(switching.models)
    rows = torch.arange(num_rows)[:, None]
    positions = []
    for s in range(durations_s.shape[1]):
        duration = durations_s[:, s]
        changes = uniform[:, :, s, 0] > torch.exp(-switching.rate * duration)[:, None]
        model = torch.where(changes, choice[:, :, s], model)
        matrix, noise = _transitions(switching.models, duration, num_rows, num_models)
        scale = noise.diagonal(dim1=-2, dim2=-1)
        root = torch.linalg.cholesky(noise + torch.diag_embed(_JITTER * (scale + scale.amax(-1, keepdim=True)) + 1e-18))
        # no time, no noise: steps before the last detection must leave the state as it is
        root = root * (duration > 0)[:, None, None, None]
        state = (matrix[rows, model] @ state[..., None])[..., 0] + (root[rows, model] @ normal[:, :, s, :, None])[..., 0]
        positions.append(state[..., :2])
    return torch.stack(positions, 2)


def _transitions(models: MotionModels, duration: Tensor, num_rows: int, num_models: int) -> tuple[Tensor, Tensor]:
    """Transition and noise of every model over each row's duration [R, C, 4, 4]; computed once where all rows agree."""
    if bool((duration == duration[0]).all()):
        matrix, noise = transition(models, duration[:1].expand(num_models)[:, None])
        return matrix[:, 0].expand(num_rows, -1, -1, -1), noise[:, 0].expand(num_rows, -1, -1, -1)
    matrix, noise = transition(models, duration.expand(num_models, num_rows))
    return matrix.transpose(0, 1), noise.transpose(0, 1)
