"""After the last detection: exact moments against all ways of switching, and samples against the moments."""

import itertools
import math

import pytest
import torch
from torch import Tensor

from cadence.bank.components import MotionModels, concatenate, constant_velocity, ornstein_uhlenbeck, transition
from cadence.bank.switching import SwitchingModels, continue_moments, continue_samples, durations_after

MODELS = concatenate(
    constant_velocity([0.02]), ornstein_uhlenbeck([2.0], [0.8], [0.0]), ornstein_uhlenbeck([50.0], [0.7], [0.5])
)
PRIOR = torch.tensor([0.5, 0.3, 0.2], dtype=torch.float64)
WEIGHT = torch.tensor([[0.1, 0.2, 0.7], [1.0, 0.0, 0.0]], dtype=torch.float64)
DURATIONS = torch.tensor([[0.4, 1.0, 1.0, 1.0], [0.0, 0.7, 1.0, 1.0]], dtype=torch.float64)


def states(num_models: int = 3) -> tuple[Tensor, Tensor]:
    g = torch.Generator().manual_seed(0)
    mean = torch.randn(2, num_models, 4, generator=g, dtype=torch.float64)
    root = 0.4 * torch.randn(2, num_models, 4, 4, generator=g, dtype=torch.float64)
    return mean, root @ root.mT + 0.01 * torch.eye(4, dtype=torch.float64)


def every_way(switching: SwitchingModels, durations: Tensor, weight: Tensor, mean: Tensor, covariance: Tensor) -> Tensor:
    """Probability, mean and variance an axis at the end, summed over all sequences of models (one row)."""
    num_models = len(weight)
    total = torch.zeros(4, dtype=torch.float64)  # probability, x, y, square
    for first in range(num_models):
        for path in itertools.product(range(num_models), repeat=len(durations)):
            probability, m, c, before = weight[first], mean[first], covariance[first], first
            for model, duration in zip(path, durations, strict=True):
                stay = math.exp(-switching.rate * float(duration))
                probability = probability * ((1.0 - stay) * switching.weight[model] + stay * (model == before))
                f, q = transition(switching.models[torch.tensor([model])], duration[None])
                m, c, before = f[0] @ m, f[0] @ c @ f[0].mT + q[0], model
            square = (m[:2] ** 2).sum() + c[0, 0] + c[1, 1]
            total += probability * torch.stack([torch.ones(()).double(), m[0], m[1], square])
    return total


@pytest.mark.parametrize("rate", [0.05, 0.8])
def test_moments_are_exact(rate: float) -> None:
    switching = SwitchingModels(MODELS, PRIOR, rate)
    mean, covariance = states()
    durations = DURATIONS[:, :3]
    got_mean, got_variance = continue_moments(switching, durations, WEIGHT, mean, covariance)
    for row in range(2):
        one, x, y, square = every_way(switching, durations[row], WEIGHT[row], mean[row], covariance[row]).tolist()
        assert one == pytest.approx(1.0)
        assert got_mean[row, -1].tolist() == pytest.approx([x, y])
        assert float(got_variance[row, -1]) == pytest.approx(0.5 * (square - x**2 - y**2))


@pytest.mark.parametrize("rate", [0.05, 0.8])
def test_samples_have_these_moments(rate: float) -> None:
    switching, num, num_steps = SwitchingModels(MODELS, PRIOR, rate), 8000, DURATIONS.shape[1]
    mean, covariance = states()
    want_mean, want_variance = continue_moments(switching, DURATIONS, WEIGHT, mean, covariance)
    g = torch.Generator().manual_seed(1)
    model = torch.multinomial(WEIGHT, num, replacement=True, generator=g)
    root = torch.linalg.cholesky(covariance)
    rows = torch.arange(2)[:, None]
    normal = torch.randn(2, num, 4, 1, generator=g, dtype=torch.float64)
    state = mean[rows, model] + (root[rows, model] @ normal)[..., 0]
    uniform = torch.rand(2, num, num_steps, 2, generator=g, dtype=torch.float64)
    kick = torch.randn(2, num, num_steps, 4, generator=g, dtype=torch.float64)
    sample = continue_samples(switching, DURATIONS, model, state, uniform, kick)
    error = (sample.mean(1) - want_mean) / sample.std(1).div(math.sqrt(num))
    assert float(error.abs().max()) < 4.5
    square = 0.5 * ((sample - want_mean[:, None]) ** 2).sum(-1)
    error = (square.mean(1) - want_variance) / square.std(1).div(math.sqrt(num))
    assert float(error.abs().max()) < 4.5


def predicted(models: MotionModels, durations: Tensor, mean: Tensor, covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Moments [C, 4], [C, 4, 4] after all of the durations without any change."""
    f, q = transition(models, durations.sum().expand(len(models)))
    return (f @ mean[..., None])[..., 0], f @ covariance @ f.mT + q


def test_no_rate_is_no_switching() -> None:
    mean, covariance = states()
    got_mean, got_variance = continue_moments(SwitchingModels(MODELS, PRIOR, 1e-12), DURATIONS, WEIGHT, mean, covariance)
    for row in range(2):
        m, c = predicted(MODELS, DURATIONS[row], mean[row], covariance[row])
        mixed = WEIGHT[row] @ m[:, :2]
        variance = WEIGHT[row] @ (0.5 * (c[:, 0, 0] + c[:, 1, 1] + ((m[:, :2] - mixed) ** 2).sum(-1)))
        torch.testing.assert_close(got_mean[row, -1], mixed, rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(got_variance[row, -1], variance, rtol=1e-9, atol=1e-9)


def test_one_model_cannot_change() -> None:
    only = MODELS[torch.tensor([1])]
    mean, covariance = states(1)
    one = torch.ones(1, dtype=torch.float64)
    got_mean, got_variance = continue_moments(SwitchingModels(only, one, 0.8), DURATIONS, one.expand(2, 1), mean, covariance)
    for row in range(2):
        m, c = predicted(only, DURATIONS[row], mean[row], covariance[row])
        torch.testing.assert_close(got_mean[row, -1], m[0, :2])
        torch.testing.assert_close(got_variance[row, -1], 0.5 * (c[0, 0, 0] + c[0, 1, 1]))


def test_the_weights_that_take_over_forget_the_start() -> None:
    """At a high rate nothing is left of the weights at the last detection."""
    mean, covariance = states()
    mean, covariance = mean[:, :1].expand(-1, 3, -1), covariance[:, :1].expand(-1, 3, -1, -1)
    fast = SwitchingModels(MODELS, PRIOR, 1e3)
    durations = DURATIONS + 0.1
    one, other = (continue_moments(fast, durations, weight, mean, covariance) for weight in (WEIGHT, WEIGHT.flip(1)))
    torch.testing.assert_close(one, other)


def test_no_time_leaves_every_state_in_place() -> None:
    state = torch.randn(2, 5, 4, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    durations = torch.zeros(2, 3, dtype=torch.float64)
    kick, uniform = torch.ones(2, 5, 3, 4, dtype=torch.float64), torch.full((2, 5, 3, 2), 0.99, dtype=torch.float64)
    sample = continue_samples(
        SwitchingModels(MODELS, PRIOR, 0.5), durations, torch.zeros(2, 5, dtype=torch.int64), state, uniform, kick
    )
    assert torch.equal(sample, state[:, :, None, :2].expand(-1, -1, 3, -1))


def test_durations_after_the_last_detection() -> None:
    time_s = torch.tensor([-2.0, -1.0, 0.0, 1.0], dtype=torch.float64)
    last_s = torch.tensor([-1.5, -1.0, 0.0, 5.0, -9.0], dtype=torch.float64)
    want = [[0.0, 0.5, 1.0, 1.0], [0.0, 0.0, 1.0, 1.0], [0.0, 0.0, 0.0, 1.0], [0.0] * 4, [1.0] * 4]
    assert durations_after(time_s, last_s).tolist() == want
