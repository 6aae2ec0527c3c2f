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
_ROUNDING = 1e-6
"""Steps of a grid differ by this share at most."""


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
        durations_s: [R, T] time to pass at each step.
        weight: [R, C] probability of each model at the last detection.
        mean: [R, C, S] of the state there, given the model (anything finite where the weight is zero).
        covariance: [R, C, S, S] likewise.

    Returns:
        Mean [R, T, 2] and variance an axis [R, T].
    """
    first = weight[..., None] * mean
    second = weight[..., None, None] * (covariance + mean[..., :, None] * mean[..., None, :])
    begin, entry_noise = _entry(switching.models)
    has_home = switching.models.has_home
    means, variances = [], []
    steps = _Steps(switching.models, durations_s)
    for s in range(durations_s.shape[1]):
        duration = durations_s[:, s]
        stay = torch.exp(-switching.rate * duration)[:, None]
        share = (1.0 - stay) * switching.weight
        total = weight.sum(1, keepdim=True)
        whole_first, whole_second = first.sum(1, keepdim=True), second.sum(1, keepdim=True)
        entering = torch.where(has_home[:, None], (begin @ whole_first[..., None])[..., 0], whole_first)
        entering_second = torch.where(has_home[:, None, None], begin @ whole_second @ begin.mT, whole_second)
        entering_second = entering_second + total[..., None, None] * entry_noise
        weight = stay * weight + share * total
        first = stay[..., None] * first + share[..., None] * entering
        second = stay[..., None, None] * second + share[..., None, None] * entering_second
        matrix, noise = steps[s]
        first = (matrix @ first[..., None])[..., 0]
        second = matrix @ second @ matrix.mT + weight[..., None, None] * noise
        total_mean = first.sum(1)[:, :2]
        total_square = second.sum(1)[:, :2, :2].diagonal(dim1=-2, dim2=-1)
        means.append(total_mean)
        variances.append(0.5 * (total_square - total_mean**2).sum(-1).clamp_min(0.0))
    return torch.stack(means, 1), torch.stack(variances, 1)


def _entry(models: MotionModels) -> tuple[Tensor, Tensor]:
    """What becomes of the state when a model with a home takes over [S, S], and the noise of that for every model [C, S, S].

    A target that begins to stay about a place does so where it is: the centre lies about it as the stationary law says.
    """
    size = models.num_states
    matrix = torch.eye(size, dtype=torch.float64)
    noise = torch.zeros(len(models), size, size, dtype=torch.float64)
    if size > 4:
        home = models.has_home
        for axis in (0, 1):
            matrix[axis + 4, axis + 4] = 0.0
            matrix[axis + 4, axis] = 1.0
            noise[home, axis + 4, axis + 4] = models.home_range[home] ** 2
    return matrix, noise


def continue_samples(
    switching: SwitchingModels, durations_s: Tensor, model: Tensor, state: Tensor, uniform: Tensor, normal: Tensor
) -> Tensor:
    """Joint samples of the positions while models change.

    Args:
        switching: C models.
        durations_s: [R, T].
        model: [R, K] index of each hypothesis' model at the last detection.
        state: [R, K, S] its state there.
        uniform: [R, K, T, 2] uniform numbers: whether the model changes, and to which.
        normal: [R, K, T, S] standard normal numbers.

    Returns:
        Positions [R, K, T, 2].
    """
    cumulative = switching.weight.cumsum(0).clamp(max=1.0)
    choice = torch.searchsorted(cumulative, uniform[..., 1].contiguous()).clamp(max=len(cumulative) - 1)
    rows = torch.arange(len(durations_s))[:, None]
    steps = _Steps(switching.models, durations_s)
    roots = steps.roots()
    positions = []
    for s in range(durations_s.shape[1]):
        duration = durations_s[:, s]
        changes = uniform[:, :, s, 0] > torch.exp(-switching.rate * duration)[:, None]
        model = torch.where(changes, choice[:, :, s], model)
        if switching.models.num_states > 4:
            # a centre begins about the target (`_entry`); the noise of motion leaves the numbers of a constant centre unused
            begins = (changes & switching.models.has_home[model])[..., None]
            centre = state[..., :2] + switching.models.home_range[model][..., None] * normal[:, :, s, 4:6]
            state = torch.cat([state[..., :4], torch.where(begins, centre, state[..., 4:6])], -1)
        matrix, _ = steps[s]
        root = steps.chosen(s, *roots, 0.0)  # no time, no noise: before the last detection the state is left as it is
        state = (matrix[rows, model] @ state[..., None])[..., 0] + (root[rows, model] @ normal[:, :, s, :, None])[..., 0]
        positions.append(state[..., :2])
    return torch.stack(positions, 2)


class _Steps:
    """Transition and noise of every model over each row's durations: nothing, a whole step, or the rest of the first one."""

    def __init__(self, models: MotionModels, durations_s: Tensor) -> None:
        self.durations_s = durations_s
        whole_s = durations_s.amax()
        self.is_whole = durations_s >= (1.0 - _ROUNDING) * whole_s
        is_part = (durations_s > 0) & ~self.is_whole
        part_s = torch.where(is_part, durations_s, 0.0).amax(1)
        self.whole = tuple(value[:, 0] for value in transition(models, whole_s.expand(len(models), 1)))
        self.part = tuple(value.transpose(0, 1) for value in transition(models, part_s.expand(len(models), -1)))

    def __getitem__(self, step: int) -> tuple[Tensor, Tensor]:
        """Matrices and noise [R, C, S, S] at one step."""
        (matrix, noise), (part_matrix, part_noise) = self.whole, self.part
        eye = torch.eye(matrix.shape[-1], dtype=torch.float64)
        return self.chosen(step, matrix, part_matrix, eye), self.chosen(step, noise, part_noise, 0.0)

    def roots(self) -> tuple[Tensor, Tensor]:
        """Cholesky factors of the noise of a whole step [C, S, S], and of the rest of the first one [R, C, S, S]."""
        # where all of the time lies before the last detection a whole step is none, and has no noise
        return _root(self.whole[1]) * bool(self.durations_s.amax() > 0), _root(self.part[1])

    def chosen(self, step: int, whole: Tensor, part: Tensor, nothing: Tensor | float) -> Tensor:
        """What holds at a step [R, C, S, S], of what holds for a whole one, for the rest of the first one, and before it."""
        is_whole = self.is_whole[:, step]
        if bool(is_whole.all()):
            return whole.expand_as(part)
        goes_on = (self.durations_s[:, step] > 0)[:, None, None, None]
        return torch.where(is_whole[:, None, None, None], whole, torch.where(goes_on, part, nothing))


def _root(noise: Tensor) -> Tensor:
    scale = noise.diagonal(dim1=-2, dim2=-1)
    root: Tensor = torch.linalg.cholesky(noise + torch.diag_embed(_JITTER * (scale + scale.amax(-1, keepdim=True)) + 1e-18))
    return root
