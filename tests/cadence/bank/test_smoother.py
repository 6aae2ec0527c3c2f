"""Filter, smoother and joint samples against the dense Gaussian, which knows no recursion."""

import pytest
import torch
from fixtures.bank import Dense, dense_posterior, turn_matrix
from torch import Tensor

from cadence.bank.components import MotionModels, concatenate, constant_velocity, home_ranges, ornstein_uhlenbeck
from cadence.bank.smoother import Nodes, backward_kernel, draw, filter_forward, smooth

MODELS = concatenate(
    constant_velocity([0.05]), ornstein_uhlenbeck([4.0], [0.8], [0.0]), ornstein_uhlenbeck([30.0], [0.7], [0.4, -0.1])
)
START_M = 30.0


def random_nodes(seed: int, num_rows: int = 1, num_nodes: int = 12) -> Nodes:
    """Irregular nodes, two at the same time, some without detection (the first among them)."""
    g = torch.Generator().manual_seed(seed)
    time_s = torch.rand(num_rows, num_nodes, generator=g, dtype=torch.float64).mul(2.0).cumsum(1) - 5.0
    time_s[:, 5] = time_s[:, 4]
    observed = torch.rand(num_rows, num_nodes, generator=g) < 0.5
    observed[:, 0], observed[:, 4], observed[:, 5] = False, True, True
    root = torch.eye(2, dtype=torch.float64) + 0.5 * torch.randn(num_rows, num_nodes, 2, 2, generator=g, dtype=torch.float64)
    covariance = 0.05 * (root @ root.mT) + 0.01 * torch.eye(2, dtype=torch.float64)
    position = torch.randn(num_rows, num_nodes, 2, generator=g, dtype=torch.float64).cumsum(1)
    return Nodes(time_s, position, covariance, observed)


def start(num_rows: int) -> Tensor:
    return torch.full((num_rows,), START_M, dtype=torch.float64)


def posterior(model: MotionModels, nodes: Nodes) -> Dense:
    """What the recursions say, with the joint covariance read off the linear map that makes samples."""
    filtered = filter_forward(model, nodes, start(1))
    backward = backward_kernel(filtered)
    mean, _ = smooth(filtered, backward)
    m, size = nodes.time_s.shape[1], model.num_states
    unit = torch.eye(size * m, dtype=torch.float64).view(size * m, m, size)
    rows = torch.zeros(size * m, dtype=torch.int64)
    linear = (draw(backward, rows, unit) - draw(backward, rows, torch.zeros_like(unit))).view(size * m, size * m)
    return Dense(float(filtered.log_likelihood), mean[0], (linear.mT @ linear).view(m, size, m, size))


@pytest.mark.parametrize("seed", range(3))
def test_a_home_whose_centre_is_unknown_is_the_dense_gaussian(seed: int) -> None:
    model, nodes = home_ranges([5.0], [0.7], [2.0]), random_nodes(seed)
    got, want = posterior(model, nodes), dense_posterior(model, nodes, START_M)
    assert got.log_likelihood == pytest.approx(want.log_likelihood, abs=1e-6)
    torch.testing.assert_close(got.mean, want.mean, rtol=0, atol=1e-5)
    torch.testing.assert_close(got.covariance, want.covariance, rtol=0, atol=1e-4)
    assert float(want.covariance[-1, 4, -1, 4]) > 0.5  # the centre is not taken for known


@pytest.mark.parametrize("index", range(len(MODELS)))
@pytest.mark.parametrize("seed", range(4))
def test_likelihood_moments_and_samples_are_those_of_the_dense_gaussian(index: int, seed: int) -> None:
    model, nodes = MODELS[torch.tensor([index])], random_nodes(seed)
    got, want = posterior(model, nodes), dense_posterior(model, nodes, START_M)
    assert got.log_likelihood == pytest.approx(want.log_likelihood, rel=1e-8)
    torch.testing.assert_close(got.mean, want.mean, rtol=0, atol=1e-6)
    # the law of the samples, not an estimate of it: they are a linear map of standard normal numbers
    torch.testing.assert_close(got.covariance, want.covariance, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("index", range(len(MODELS)))
def test_smoothed_covariance_is_that_of_the_samples(index: int) -> None:
    model, nodes = MODELS[torch.tensor([index])], random_nodes(9)
    filtered = filter_forward(model, nodes, start(1))
    _, covariance = smooth(filtered, backward_kernel(filtered))
    joint = posterior(model, nodes).covariance
    own = torch.stack([joint[m, :, m] for m in range(len(joint))])
    torch.testing.assert_close(covariance[0], own, rtol=1e-9, atol=1e-12)


def test_empirical_moments_of_samples() -> None:
    model, nodes, num = MODELS[torch.tensor([1])], random_nodes(3), 800
    filtered = filter_forward(model, nodes, start(1))
    backward = backward_kernel(filtered)
    normal = torch.randn(num, nodes.time_s.shape[1], 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    sample = draw(backward, torch.zeros(num, dtype=torch.int64), normal).flatten(1)
    want = dense_posterior(model, nodes, START_M)
    covariance = want.covariance.reshape(len(sample[0]), -1)
    variance = covariance.diagonal()
    error = (sample.mean(0) - want.mean.flatten()) / (variance / num).sqrt()
    assert float(error.abs().max()) < 5.0
    spread = ((variance[:, None] * variance + covariance**2) / num).sqrt()
    assert float(((torch.cov(sample.T) - covariance) / spread).abs().max()) < 5.5


def test_no_noise_draws_the_smoothed_mean() -> None:
    nodes = random_nodes(1, num_rows=len(MODELS))
    filtered = filter_forward(MODELS, nodes, start(len(MODELS)))
    backward = backward_kernel(filtered)
    mean, _ = smooth(filtered, backward)
    rows = torch.tensor([2, 0])
    torch.testing.assert_close(draw(backward, rows, torch.zeros(2, 12, 4, dtype=torch.float64)), mean[rows])


def test_nodes_without_detection_teach_nothing() -> None:
    nodes = random_nodes(2)
    keep = nodes.is_observed[0].clone()
    keep[0] = True  # the diffuse start lies at the first node
    fewer = Nodes(nodes.time_s[:, keep], nodes.position_m[:, keep], nodes.covariance_m2[:, keep], nodes.is_observed[:, keep])
    model = MODELS[torch.tensor([2])]
    all_of_them, only_detections = posterior(model, nodes), posterior(model, fewer)
    assert all_of_them.log_likelihood == pytest.approx(only_detections.log_likelihood, rel=1e-10)
    torch.testing.assert_close(all_of_them.mean[keep], only_detections.mean, rtol=0, atol=1e-8)
    torch.testing.assert_close(all_of_them.covariance[keep][:, :, keep], only_detections.covariance, rtol=1e-7, atol=1e-8)


def test_rows_do_not_touch_each_other() -> None:
    nodes = random_nodes(4, num_rows=len(MODELS))
    together = filter_forward(MODELS, nodes, start(len(MODELS)))
    mean, covariance = smooth(together, backward_kernel(together))
    for row in range(len(MODELS)):
        one = torch.tensor([row])
        alone = filter_forward(MODELS[one], nodes[one], start(1))
        alone_mean, alone_covariance = smooth(alone, backward_kernel(alone))
        torch.testing.assert_close(alone.log_likelihood, together.log_likelihood[one], rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(alone_mean, mean[one], rtol=1e-10, atol=1e-10)
        torch.testing.assert_close(alone_covariance, covariance[one], rtol=1e-10, atol=1e-10)


def test_turning_detections_and_random_numbers_turns_samples() -> None:
    """Exact for every sample where detections are as accurate in all directions."""
    nodes, turn = random_nodes(5), turn_matrix(1.1)
    round_ones = Nodes(nodes.time_s, nodes.position_m, 0.04 * torch.eye(2).double().expand(1, 12, 2, 2), nodes.is_observed)
    turned = Nodes(nodes.time_s, nodes.position_m @ turn.mT, round_ones.covariance_m2, nodes.is_observed)
    normal = torch.randn(6, 12, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    both = torch.block_diag(turn, turn)
    rows = torch.zeros(6, dtype=torch.int64)
    model = MODELS[torch.tensor([3])]
    plain = draw(backward_kernel(filter_forward(model, round_ones, start(1))), rows, normal)
    after = draw(backward_kernel(filter_forward(model, turned, start(1))), rows, normal @ both.mT)
    torch.testing.assert_close(after, plain @ both.mT, rtol=0, atol=1e-8)


@pytest.mark.parametrize("sigma_m", [1e-6, 1e-3])
def test_exact_detections_beside_a_diffuse_start_keep_their_digits(sigma_m: float) -> None:
    nodes = random_nodes(6)
    exact = Nodes(nodes.time_s, nodes.position_m.clone(), torch.zeros(1, 12, 2, 2).double(), nodes.is_observed.clone())
    exact.is_observed[:, 5] = False  # two different exact places at one time would contradict each other
    exact.covariance_m2[:] = sigma_m**2 * torch.eye(2, dtype=torch.float64)
    filtered = filter_forward(MODELS[torch.tensor([1])], exact, torch.full((1,), 3000.0, dtype=torch.float64))
    backward = backward_kernel(filtered)
    mean, covariance = smooth(filtered, backward)
    normal = torch.randn(20, 12, 4, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    sample = draw(backward, torch.zeros(20, dtype=torch.int64), normal)
    seen = exact.is_observed[0]
    reach = 6.0 * sigma_m + 1e-4
    assert float((mean[0, seen, :2] - exact.position_m[0, seen]).abs().max()) < reach
    assert float((sample[:, seen, :2] - exact.position_m[0, seen]).abs().max()) < reach
    assert float(covariance.diagonal(dim1=-2, dim2=-1).min()) >= 0.0
