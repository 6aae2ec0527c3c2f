"""The bank of height: exact where one mode is at work, calibrated on its own prior, and beside any estimator."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from cadence.bank.bank import Bank
from cadence.height.bank import HeightBank, HeightBeside, HeightTrack
from cadence.height.draws import draw, random_numbers
from cadence.height.filtering import Nodes, Switching, filter_forward
from cadence.height.modes import Modes, steps
from cadence.types import Detections, HypothesisSet, WindowBatch


def doubles(*values):
    return torch.tensor(values, dtype=torch.float64)


def one_mode(relaxation=0.0, diffusion=0.0, initial=1.0, walk=0.0, home=0.0):
    return Modes(*(doubles(value) for value in (relaxation, diffusion, initial, walk, home, 0.0)))


def detections(time_s, height_m, variance_m2=1.0):
    """One agent of one window; the plane is not looked at."""
    time, height = doubles(*time_s)[None, None], doubles(*height_m)[None, None]
    shape = time.shape
    return Detections(
        time, torch.zeros(*shape, 2, dtype=torch.float64), torch.eye(2, dtype=torch.float64).expand(*shape, 2, 2),
        torch.ones(shape, dtype=torch.bool), height, torch.full(shape, variance_m2, dtype=torch.float64),
    )  # fmt: skip


def windows_of(found, num_steps=12, origin=8, seed=3):
    time_s = (torch.arange(num_steps, dtype=torch.float64) - origin) * 10.0
    return WindowBatch(time_s, found, torch.full((len(found.time_s),), seed), origin)


def dense_posterior(mode, nodes, diffuse_m):
    """Mean [M] and covariance [M, M] of the heights of one row by one Gaussian of all states, without any recursion."""
    num = nodes.time_s.shape[1]
    mean = torch.zeros(2 * num, dtype=torch.float64)
    start = nodes.height_m[0, nodes.is_observed[0].to(torch.int64).argmax()]
    joint = torch.zeros(2 * num, 2 * num, dtype=torch.float64)
    joint[0, 0], joint[1, 1], mean[0] = diffuse_m**2, float(mode.initial_rate) ** 2, start
    for m in range(1, num):
        to = steps(mode, (nodes.time_s[:, m] - nodes.time_s[:, m - 1]))
        matrix = doubles(1.0, float(to.gain), 0.0, float(to.keep)).view(2, 2)
        noise = doubles(float(to.noise_zz), float(to.noise_zv), float(to.noise_zv), float(to.noise_vv)).view(2, 2)
        before, now = slice(2 * m - 2, 2 * m), slice(2 * m, 2 * m + 2)
        mean[now] = matrix @ mean[before]
        joint[now, : 2 * m] = matrix @ joint[before, : 2 * m]
        joint[: 2 * m, now] = joint[now, : 2 * m].T
        joint[now, now] = matrix @ joint[before, before] @ matrix.T + noise
    seen = (2 * nodes.is_observed[0].nonzero()[:, 0]).tolist()
    gain = torch.linalg.solve(joint[seen][:, seen] + torch.diag(nodes.variance_m2[0, nodes.is_observed[0]]), joint[seen]).T
    mean = mean + gain @ (nodes.height_m[0, nodes.is_observed[0]] - mean[seen])
    joint = joint - gain @ joint[seen]
    return mean[::2], joint[::2, ::2]


@pytest.mark.parametrize(
    "mode",
    [
        one_mode(diffusion=0.02, initial=2.0),
        one_mode(relaxation=0.1, diffusion=0.4, initial=1.4),
        one_mode(initial=0.0, walk=3.0),
        one_mode(relaxation=0.05, initial=1.0, home=40.0),
    ],
    ids=["climb", "forgets", "walk", "home"],
)
def test_samples_under_one_mode_are_those_of_the_exact_posterior(mode):
    time_s = doubles(-50.0, -40.0, -33.0, -20.0, -12.0, 0.0, 10.0, 20.0)[None]
    is_observed = torch.tensor([[False, True, False, True, True, False, False, False]])
    height_m = doubles(0.0, 100.0, 0.0, 130.0, 128.0, 0.0, 0.0, 0.0)[None]
    nodes = Nodes(time_s, height_m, torch.full_like(time_s, 4.0), is_observed)
    switching = Switching(mode, doubles(0.0))
    num = 40_000
    heights, _ = draw(
        switching, nodes, filter_forward(switching, nodes, 300.0), random_numbers(torch.tensor([5]), torch.tensor([8]), num, 8)
    )
    mean, covariance = dense_posterior(mode, nodes, 300.0)
    sigma = covariance.diagonal().clamp_min(1e-9).sqrt()
    assert ((heights[0].mean(0) - mean).abs() < 5.0 * sigma / math.sqrt(num) + 1e-3).all()
    scale = sigma[:, None] * sigma
    assert ((torch.cov(heights[0].T) - covariance).abs() < 0.04 * scale + 1e-3).all()


def test_log_likelihood_is_that_of_the_exact_gaussian():
    mode = one_mode(relaxation=0.1, diffusion=0.4, initial=1.4)
    time_s, height_m = doubles(0.0, 7.0, 20.0)[None], doubles(100.0, 104.0, 97.0)[None]
    nodes = Nodes(time_s, height_m, torch.full_like(time_s, 4.0), torch.ones(1, 3, dtype=torch.bool))
    found = filter_forward(Switching(mode, doubles(0.0)), nodes, 300.0).log_likelihood
    unseen = dataclasses.replace(
        nodes, is_observed=torch.tensor([[True, False, False]]), variance_m2=torch.full_like(time_s, 1e30)
    )
    mean, prior = dense_posterior(mode, unseen, 300.0)
    law = torch.distributions.MultivariateNormal(mean, prior + 4.0 * torch.eye(3, dtype=torch.float64))
    assert float(found) == pytest.approx(float(law.log_prob(height_m[0])), rel=1e-6)


def simulated(bank, time_s, num, seed):
    """Heights [num, T] of the bank's own prior: modes may end at every time, as they do after the last detection."""
    rows = Nodes(doubles(time_s[0])[None], doubles(1000.0)[None], doubles(1e-6)[None], torch.ones(1, 1, dtype=torch.bool))
    return bank.sample_rows(rows, doubles(*time_s), torch.tensor([seed]), num)[0]


def test_targets_of_its_own_prior_lie_in_its_regions():
    """Own-prior check: targets drawn from the prior, detections of them, and the 90 % region holds 88 to 92 %."""
    bank = HeightBank(rate_mps=2.0, step_s=10.0)
    time_s = [10.0 * step for step in range(40)]
    truth = simulated(bank, time_s, 700, 1)
    seen = [0, 1, 9, 10, 22, 23]
    noise = torch.randn(len(truth), len(seen), generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    observed = truth[:, seen] + 3.0 * noise
    time = doubles(*(time_s[index] for index in seen)).expand(len(truth), -1)
    rows = Nodes(time, observed, torch.full_like(observed, 9.0), torch.ones_like(observed, dtype=torch.bool))
    drawn = bank.sample_rows(rows, doubles(*time_s), torch.arange(len(truth)), 99)
    rank = (drawn < truth[:, None]).double().mean(1)
    is_held = (rank > 0.05) & (rank < 0.95)
    for part in (slice(2, 9), slice(11, 22), slice(25, 40)):
        assert 0.87 < float(is_held[:, part].double().mean()) < 0.93


def test_a_level_flight_is_drawn_level_and_a_climb_goes_on():
    level = detections([-80.0, -75.0, -40.0, -35.0, 0.0], [1000.0, 1000.0, 1000.0, 1000.0, 1000.0], 4.0)
    climb = detections([-80.0, -75.0, -40.0, -35.0, 0.0], [1000.0, 1025.0, 1200.0, 1225.0, 1400.0], 4.0)
    bank = HeightBank(rate_mps=3.0, step_s=10.0)
    flat, rising = (bank.sample(windows_of(found), 200)[0, :, 0] for found in (level, climb))
    assert float((flat[:, 2:9] - 1000.0).abs().quantile(0.8)) < 8.0
    assert 1425.0 < float(rising[:, 9].median()) < 1455.0


def test_heights_depend_on_the_windows_seed_and_on_nothing_else():
    one, other = detections([-80.0, -40.0, 0.0], [1000.0, 1100.0, 1050.0]), detections([-70.0, -3.0], [20.0, 25.0])
    padded = Detections(*(torch.nn.functional.pad(value, (0, 0) * (value.ndim - 3) + (0, 1)) for value in vars(other).values()))
    bank = HeightBank(rate_mps=3.0, step_s=10.0)
    both = Detections(*(torch.cat(pair) for pair in zip(vars(one).values(), vars(padded).values(), strict=True)))
    together = bank.sample(windows_of(both), 9)
    torch.testing.assert_close(together[:1], bank.sample(windows_of(one), 9), rtol=0, atol=0)
    torch.testing.assert_close(together[1:], bank.sample(windows_of(other), 9), rtol=0, atol=0)
    assert not torch.equal(bank.sample(windows_of(one, seed=4), 9), together[:1])


def test_shifting_height_and_time_shifts_the_samples():
    heights = [1000.0, 1100.0, 1050.0]
    bank = HeightBank(rate_mps=3.0, step_s=10.0)
    plain = bank.sample(windows_of(detections([-80.0, -40.0, 0.0], heights)), 9)
    higher = bank.sample(windows_of(detections([-80.0, -40.0, 0.0], [h + 512.0 for h in heights])), 9)
    torch.testing.assert_close(higher, plain + 512.0, rtol=0, atol=1e-6)


def test_weights_are_learned_from_the_log():
    rng = np.random.default_rng(0)
    time_s = np.sort(rng.uniform(0, 4000.0, 120))
    flat = detections(time_s, 500.0 + rng.normal(0, 2.0, 120), 4.0)
    walk = detections(
        time_s, 500.0 + np.cumsum(rng.normal(0, 1, 120) * 20.0 * np.sqrt(np.diff(time_s, prepend=0.0) / 10.0)), 4.0
    )
    fits = [HeightBank().fit(found, 50.0) for found in (flat, walk)]
    level = [float(fit.log_weight.exp()[:3].sum()) for fit in fits]
    assert level[0] > 0.6 > 0.3 > level[1]
    assert fits[0].rate_mps < 0.3 * fits[1].rate_mps
    assert fits[0].about()["num_modes"] == len(fits[0].modes)


def test_heights_that_state_no_variance_are_exact():
    found = detections([-80.0, -40.0, 0.0], [1000.0, 1100.0, 1050.0], math.nan)
    bank = HeightBank().fit(found, 10.0)
    assert 0.5 < bank.rate_mps < 5.0
    drawn = bank.sample(windows_of(found), 20)[0, :, 0]
    assert float((drawn[:, [0, 4, 8]] - torch.tensor([1000.0, 1100.0, 1050.0])).abs().max()) < 0.5


def test_a_single_detection_is_enough():
    fit = HeightBank().fit(detections([0.0], [700.0]), 10.0)
    assert fit.log_weight is None
    found = fit.sample(windows_of(detections([-20.0], [700.0])), 50)[0, :, 0]
    assert float((found[:, 6] - 700.0).abs().max()) < 5.0
    assert found.isfinite().all()


def test_agents_without_heights_are_left_out():
    found = detections([-80.0, -40.0, 0.0], [1000.0, math.nan, 1050.0])
    bank = HeightBank(rate_mps=3.0, step_s=10.0)
    assert bank.sample(windows_of(found), 5).isfinite().all(), "a detection without a height among others"
    none = dataclasses.replace(found, height_m=torch.full_like(found.height_m, math.nan))
    assert bank.sample(windows_of(none), 5).isnan().all()
    with pytest.raises(ValueError, match="have no heights"):
        bank.sample(windows_of(dataclasses.replace(found, height_m=None, height_variance_m2=None)), 5)
    with pytest.raises(ValueError, match="fit"):
        HeightBank().sample(windows_of(found), 5)


def test_heights_stand_beside_the_plane_of_any_estimator():
    found = detections([-80.0, -40.0, 0.0], [1000.0, 1100.0, 1050.0])
    windows, plane = windows_of(found), Bank(speed_mps=5.0)
    beside = HeightBeside(plane, HeightBank(rate_mps=3.0, step_s=10.0))
    drawn = beside.sample(windows, 7)
    assert isinstance(drawn, HypothesisSet)
    torch.testing.assert_close(drawn.position_m, plane.sample(windows, 7).position_m, rtol=0, atol=0)
    assert drawn.height_m.shape == (1, 7, 1, 12)
    assert beside.name == "bank"
    assert beside.fit(found).plane.speed_mps is not None


def test_stories_have_heights_at_any_times():
    tracks = [
        HeightTrack(np.array([0.0, 40.0, 90.0]), np.array([100.0, 100.0, 400.0]), np.array([1.0, np.nan, 1.0])),
        HeightTrack(np.array([5.0]), np.array([np.nan]), np.array([1.0])),
    ]
    time_s = np.array([0.0, 3.0, 40.0, 41.5, 90.0, 120.0])
    bank = HeightBank(rate_mps=3.0, step_s=10.0)
    heights = bank.on_times(tracks, time_s, 30, 4)
    assert heights.shape == (30, 2, 6)
    assert np.isnan(heights[:, 1]).all()
    assert np.abs(heights[:, 0, [0, 2, 4]] - [100.0, 100.0, 400.0]).max() < 6.0
    np.testing.assert_array_equal(heights, bank.on_times(tracks, time_s, 30, 4))


def test_shapes_are_checked():
    found = detections([-80.0, 0.0], [1.0, 2.0])
    with pytest.raises(ValueError, match="go together"):
        dataclasses.replace(found, height_m=None)
    with pytest.raises(ValueError, match="heights have shape"):
        dataclasses.replace(found, height_m=torch.zeros(1, 1, 3))
    with pytest.raises(ValueError, match="height_m has shape"):
        HypothesisSet(torch.zeros(1, 2, 1, 3, 2), torch.full((1, 2), 0.5), (("ok",),), height_m=torch.zeros(1, 2, 1, 4))
