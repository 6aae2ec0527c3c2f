"""Samples of bearings and ranges: own-prior check, a Kalman smoother, a grid with two modes, a ring, outliers."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from torch import Tensor

from cadence.bank.components import MotionModels, constant_velocity, ornstein_uhlenbeck, transition
from cadence.bank.smoother import Nodes, backward_kernel, filter_from, smooth
from cadence.bearings.cells import Prior
from cadence.bearings.draws import Cloud, Known, posterior
from cadence.bearings.linear import sights_of
from cadence.evidence.measurements import KINDS, Measurements, sigma_name
from cadence.metrics.calibration import coverage
from cadence.resampling import systematic

REACH_M, STEP_S = 3000.0, 60.0
NUM_TARGETS = 40
NOBODY = Nodes(
    torch.zeros(1, 1).double(), torch.zeros(1, 1, 2).double(), torch.eye(2).double()[None, None], torch.zeros(1, 1) > 0
)


def measured(time_s, observer_m, sigma_rad=0.03, sigma_m=20.0, **values) -> Measurements:
    num = len(time_s)
    columns = {kind: np.broadcast_to(np.asarray(values.get(kind, np.nan), float), (num,)) for kind in KINDS}
    sigmas = {sigma_name(kind): np.full(num, sigma_m if kind.startswith("range") else sigma_rad) for kind in KINDS}
    place = np.broadcast_to(np.asarray(observer_m, float), (num, 2))
    return Measurements(
        np.asarray(time_s, float), place, np.zeros((num, 2)), np.full(num, np.nan), **columns, **sigmas, agent_ids=(None,) * num
    )


def prior_of(models: MotionModels, speed_mps: float = 4.0, begin_m=(0.0, 0.0), reach_m: float = REACH_M) -> Prior:
    num = len(models)
    weight = torch.full((num,), -math.log(num), dtype=torch.float64)
    return Prior(models.scaled(STEP_S, speed_mps), weight, torch.tensor(begin_m, dtype=torch.float64), reach_m)


def sampled(
    prior: Prior, found: Measurements, asked_s: Tensor, num: int = 500, seed: int = 1, detections=NOBODY, nearest_m=60.0
) -> Cloud:
    at_s = torch.from_numpy(found.time_s.copy())

    def likelihood(state: Tensor) -> Tensor:
        last = state[:, -len(at_s) :].numpy()
        return torch.from_numpy(found.fits(last[..., :2], last[..., 2:4]).sum(axis=-1))

    known = Known(prior, detections, sights_of(found), nearest_m, 4 * REACH_M, torch.zeros(1).double(), likelihood)
    return posterior(known, torch.cat([asked_s, at_s]), num, np.random.default_rng(seed))


def drawn_from(prior: Prior, time_s: Tensor, generator: np.random.Generator) -> Tensor:
    """A track [T, 2] of a sampler's own prior."""
    model = prior.models[torch.tensor([int(generator.integers(len(prior.log_weight)))])]
    spread = np.array([prior.reach_m, prior.reach_m, *[float(model.initial_speed)] * 2])
    state = torch.from_numpy(spread * generator.standard_normal(4))
    state[:2] += prior.begin_m
    places = [state[:2]]
    for duration in torch.diff(time_s):
        matrix, noise = transition(model, duration[None])
        state = matrix[0] @ state + torch.linalg.cholesky(noise[0]) @ torch.from_numpy(generator.standard_normal(4))
        places.append(state[:2])
    return torch.stack(places)


def test_own_prior_check():
    """Targets drawn from the sampler's own prior, bearings made from them: the 90 % region holds them as often as it says.

    The place at the last of six bearings, from an observer that turns. Of 40 targets 36 are expected, with a deviation of 1.9.
    """
    generator = np.random.default_rng(3)
    prior = prior_of(constant_velocity([0.1**2]))
    held, num_few = [], 0
    for seed in range(NUM_TARGETS):
        time_s = torch.arange(0.0, 12.0, 2.0, dtype=torch.float64) * STEP_S
        track_m = drawn_from(prior, time_s, generator)
        elapsed_s = time_s.numpy()
        observer_m = np.stack([8.0 * np.minimum(elapsed_s, 300.0), 8.0 * np.maximum(elapsed_s - 300.0, 0.0)], -1)
        apart = track_m.numpy() - observer_m
        bearing = np.arctan2(apart[:, 1], apart[:, 0]) + 0.03 * generator.standard_normal(len(time_s))
        cloud = sampled(prior, measured(elapsed_s, observer_m, bearing_rad=bearing), time_s[-1:], seed=seed)
        num_few += cloud.num_effective < 20
        pick = torch.from_numpy(systematic(cloud.weight.numpy(), 100, 0.5))
        place_m = cloud.state[pick, 0, :2]
        equal = torch.full((1, 100), 0.01, dtype=torch.float64)
        held.append(float(coverage(place_m[None, :, None, None], equal, track_m[None, None, -1:], (0.9,))))
    assert num_few == 0
    assert 33 <= sum(held) <= 39


def test_bearing_and_range_at_short_range_agree_with_a_kalman_smoother():
    time_s = np.arange(0.0, 6.0) * STEP_S
    track_m = np.stack([4000.0 + 3.0 * time_s, 100.0 - 2.0 * time_s], -1)
    found = measured(
        time_s, (0.0, 0.0), 0.002, 8.0, range_m=np.hypot(*track_m.T), bearing_rad=np.arctan2(track_m[:, 1], track_m[:, 0])
    )
    prior = prior_of(constant_velocity([0.1**2]), begin_m=(4000.0, 0.0), reach_m=500.0)
    cloud = sampled(prior, found, torch.tensor([120.0]).double(), 4000)
    along, across = np.stack(
        [track_m / found.range_m[:, None], np.stack([-track_m[:, 1], track_m[:, 0]], -1) / found.range_m[:, None]]
    )
    noise = (
        64.0 * along[:, :, None] * along[:, None]
        + (0.002 * found.range_m[:, None, None]) ** 2 * across[:, :, None] * across[:, None]
    )
    nodes = Nodes(
        torch.from_numpy(time_s)[None], torch.from_numpy(track_m)[None], torch.from_numpy(noise)[None], torch.ones(1, 6) > 0
    )
    begin = torch.diag(torch.tensor([500.0, 500.0, *[float(prior.models.initial_speed)] * 2]).double() ** 2)
    filtered = filter_from(prior.models, nodes, torch.tensor([[4000.0, 0.0, 0.0, 0.0]]).double(), begin[None])
    mean, covariance = smooth(filtered, backward_kernel(filtered))
    assert cloud.num_effective > 2000
    place_m = cloud.state[:, 0, :2]
    own = cloud.weight @ place_m
    spread = ((cloud.weight[:, None] * (place_m - own) ** 2).sum(0)).sqrt()
    assert own.tolist() == pytest.approx(mean[0, 2, :2].tolist(), abs=0.5)
    assert spread.tolist() == pytest.approx(covariance[0, 2, :2, :2].diagonal().sqrt().tolist(), rel=0.1)


def on_a_grid(found: Measurements, prior: Prior) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """East, north and exact weight of a target that is measured at one moment, and the evidence."""
    steps_m = np.linspace(-6.0, 6.0, 601) * prior.reach_m / 1.5
    x, y = np.meshgrid(steps_m, steps_m, indexing="ij")
    place = np.stack([x, y], -1)[..., None, :]
    density = np.exp(-0.5 * ((x - prior.begin_m[0].item()) ** 2 + (y - prior.begin_m[1].item()) ** 2) / prior.reach_m**2)
    weight = density / density.sum() * np.exp(found.fits(place, place).sum(axis=-1))
    return x, y, weight / weight.sum(), float(np.log(weight.sum()))


@pytest.mark.parametrize(
    ("found", "side"),
    [
        # one bearing of a target on either side of the prior's middle along it, and two ranges that meet at two places
        (measured([0.0], (-4000.0, 500.0), 0.2, bearing_rad=-0.1), 0),
        (measured([0.0, 0.0], [[-2000.0, 500.0], [2500.0, 500.0]], 0.1, 150.0, range_m=[2600.0, 2700.0]), 1),
        (measured([0.0], (300.0, 0.0), 0.1, 200.0, range_m=2500.0), 1),
    ],
)
def test_agrees_with_a_grid(found, side):
    found = dataclasses.replace(found, outlier_share=1e-6)  # that both ranges are outliers is another matter
    prior = prior_of(constant_velocity([0.1**2]))
    x, y, weight, log_evidence = on_a_grid(found, prior)
    cloud = sampled(prior, found, torch.zeros(1).double(), 3000)
    place_m = cloud.state[:, 0, :2]
    assert cloud.num_effective > 300
    for axis, exact in enumerate((x, y)):
        mean = float((weight * exact).sum())
        spread = math.sqrt(float((weight * exact**2).sum()) - mean**2)
        own = float(cloud.weight @ place_m[:, axis])
        assert own == pytest.approx(mean, abs=0.12 * spread)
        assert float((cloud.weight @ (place_m[:, axis] - own) ** 2).sqrt()) == pytest.approx(spread, rel=0.1)
    middle = float((weight * (x, y)[side]).sum())
    upper = float(cloud.weight @ (place_m[:, side] > middle).double())
    assert upper == pytest.approx(float(weight[(x, y)[side] > middle].sum()), abs=0.05)
    assert cloud.log_evidence == pytest.approx(log_evidence, abs=0.1)


def test_wild_bearings_are_left_out_of_the_kernels_and_positions_count():
    time_s = np.arange(0.0, 12.0) * STEP_S
    track_m = np.stack([1500.0 - 3.0 * time_s, 2000.0 + 0.0 * time_s], -1)
    observer_m = np.stack([4.0 * time_s, np.where(time_s > 300.0, 6.0 * (time_s - 300.0), 0.0)], -1)
    apart = track_m - observer_m
    bearing = np.arctan2(apart[:, 1], apart[:, 0])
    bearing[4] += 0.7
    detections = Nodes(
        torch.tensor([[240.0]]).double(), torch.tensor([[[780.0, 2000.0]]]).double(), 400.0 * torch.eye(2).double()[None, None],
        torch.ones(1, 1) > 0,
    )  # fmt: skip
    prior = prior_of(ornstein_uhlenbeck([30.0], [0.7], [0.0]), begin_m=(780.0, 2000.0))
    cloud = sampled(
        prior, measured(time_s, observer_m, bearing_rad=bearing), torch.tensor([660.0]).double(), detections=detections
    )
    assert cloud.num_effective > 100
    assert (cloud.weight @ cloud.state[:, 0, :2]).tolist() == pytest.approx(track_m[-1].tolist(), abs=150.0)
