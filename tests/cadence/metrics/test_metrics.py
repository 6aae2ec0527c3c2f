"""Metrics: golden values, hand-computed cases, calibration of the coverage, weights respected everywhere."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from cadence import metrics

GOLDEN = Path(__file__).resolve().parents[3].parent / "shared" / "data" / "metric_golden.json"


@pytest.fixture(scope="module")
def golden() -> dict:
    if not GOLDEN.is_file():
        pytest.skip("../shared/data/metric_golden.json is not here")
    return json.loads(GOLDEN.read_text())


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(7)


def golden_samples() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(0)
    truth, samples = rng.normal(size=(5, 2)), rng.normal(size=(5, 30, 2))
    position = torch.from_numpy(samples)[:, :, None, None]
    return position, torch.full((5, 30), 1 / 30, dtype=torch.float64), torch.from_numpy(truth)[:, None, None]


def uniform(b: int, k: int) -> torch.Tensor:
    return torch.full((b, k), 1.0 / k, dtype=torch.float64)


def randn(generator: torch.Generator, *shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def test_energy_score_golden(golden: dict) -> None:
    score = metrics.energy_score(*golden_samples())
    assert score.flatten().tolist() == pytest.approx(golden["energy_score_nrg"], abs=1e-12)


def test_energy_score_of_one_coordinate_is_the_crps(golden: dict) -> None:
    position, weight, truth = golden_samples()
    score = metrics.energy_score(position[..., :1], weight, truth[..., :1])
    assert score.flatten().tolist() == pytest.approx(golden["crps_x_properscoring"], abs=1e-12)


def test_gospa_and_ospa_golden(golden: dict) -> None:
    estimated, truth = torch.tensor(golden["gospa_X"]), torch.tensor(golden["gospa_Y"])
    estimated, truth = estimated.double(), truth.double()
    found = metrics.gospa(estimated, truth, cutoff_m=10.0)
    for name, want in golden["gospa_c10_p2"].items():
        assert getattr(found, name) == pytest.approx(want, rel=1e-5)
    assert metrics.ospa(estimated, truth, cutoff_m=10.0) == pytest.approx(golden["ospa_c10_p2"], rel=1e-5)


def test_gospa_and_ospa_of_empty_sets() -> None:
    none, two = torch.zeros(0, 2), torch.zeros(2, 2)
    assert metrics.gospa(none, none, 10.0).distance == 0.0
    assert metrics.ospa(none, none, 10.0) == 0.0
    assert metrics.gospa(two, none, 10.0) == metrics.Gospa(10.0, 0.0, 0.0, 100.0)
    assert metrics.gospa(none, two, 10.0).missed == 100.0
    assert metrics.ospa(none, two, 10.0) == 10.0


def test_distances_by_hand() -> None:
    position = torch.tensor([[[[3.0, 4.0], [0.0, 0.0]]], [[[0.0, 0.0], [0.0, 8.0]]]])[None]  # B1 K2 A1 T2
    weight, truth = torch.tensor([[0.25, 0.75]]), torch.zeros(1, 1, 2, 2)
    known = torch.ones(1, 1, 2, dtype=torch.bool)
    assert metrics.expected_distance(position, weight, truth).tolist() == [[[1.25, 6.0]]]
    assert metrics.ade(position, weight, truth, known).item() == pytest.approx(3.625)
    assert metrics.mean_error(position, weight, truth).tolist() == [[[1.25, 6.0]]]
    assert metrics.min_ade_distance(position, weight, truth, known).tolist() == [[[5.0, 0.0]]]
    assert metrics.min_ade(position, weight, truth, known).item() == pytest.approx(2.5)
    known[..., 1] = False
    assert metrics.ade(position, weight, truth, known).item() == pytest.approx(1.25)
    assert metrics.min_ade(position, weight, truth, known).item() == 0.0
    assert math.isnan(metrics.ade(position, weight, truth, torch.zeros_like(known)).item())


def test_min_ade_joint_picks_one_hypothesis_for_all_agents() -> None:
    distance = torch.tensor([[[0.0], [9.0]], [[5.0], [0.0]]])  # K2 A2 T1: best differs by agent
    position = torch.stack([distance, torch.zeros_like(distance)], dim=-1)[None]
    weight, truth, known = uniform(1, 2), torch.zeros(1, 2, 1, 2), torch.ones(1, 2, 1, dtype=torch.bool)
    assert metrics.min_ade(position, weight, truth, known).tolist() == [[0.0, 0.0]]
    assert metrics.min_ade(position, weight, truth, known, is_joint=True).tolist() == [[5.0, 0.0]]


def test_zero_weight_is_as_absent(generator: torch.Generator) -> None:
    position, truth = randn(generator, 3, 6, 2, 4, 2), randn(generator, 3, 2, 4, 2)
    known = torch.ones(3, 2, 4, dtype=torch.bool)
    position[:, 4:] = truth[:, None]  # perfect, but without weight
    weight = torch.zeros(3, 6, dtype=torch.float64)
    weight[:, :4] = 0.25
    few, flat = position[:, :4], uniform(3, 4)
    for function in (metrics.expected_distance, metrics.mean_error, metrics.energy_score, metrics.coverage):
        torch.testing.assert_close(function(position, weight, truth), function(few, flat, truth))
    for function in (metrics.ade, metrics.min_ade, metrics.trajectory_energy_score):
        torch.testing.assert_close(function(position, weight, truth, known), function(few, flat, truth, known))


def test_weights_are_repetitions(generator: torch.Generator) -> None:
    position, truth = randn(generator, 2, 2, 1, 3, 2), randn(generator, 2, 1, 3, 2)
    weight = torch.tensor([[0.25, 0.75]]).expand(2, 2)
    repeated = position[:, [0, 1, 1, 1]]
    for function in (metrics.expected_distance, metrics.mean_error, metrics.energy_score):
        torch.testing.assert_close(function(position, weight, truth), function(repeated, uniform(2, 4), truth))


def test_fair_energy_score_does_not_depend_on_the_number_of_samples(generator: torch.Generator) -> None:
    truth = randn(generator, 20000, 1, 1, 2)
    few, many = (randn(generator, 20000, k, 1, 1, 2) for k in (4, 32))
    scores = [metrics.energy_score(s, uniform(20000, s.shape[1]), truth, is_fair=True).mean().item() for s in (few, many)]
    assert scores[0] == pytest.approx(scores[1], abs=0.01)
    assert metrics.energy_score(few, uniform(20000, 4), truth).mean().item() > scores[0] + 0.1
    assert scores[1] == pytest.approx(math.sqrt(math.pi) / 2, abs=0.01)  # E|X - X'| / 2 of a plane Gaussian


def test_energy_score_prefers_the_right_spread(generator: torch.Generator) -> None:
    truth, noise = randn(generator, 4000, 1, 1, 2), randn(generator, 4000, 30, 1, 1, 2)
    scores = [metrics.energy_score(s * noise, uniform(4000, 30), truth).mean().item() for s in (0.3, 1.0, 2.0)]
    assert scores[1] < min(scores[0], scores[2])


def test_trajectory_energy_score_by_hand() -> None:
    position = torch.zeros(1, 2, 1, 4, 2)
    position[0, 1] = 2.0  # apart by sqrt(8) at every step: root mean square sqrt(8)
    truth, known = torch.zeros(1, 1, 4, 2), torch.tensor([[[True, True, True, False]]])
    position[..., 3, :] = torch.nan  # unknown steps do not matter
    score = metrics.trajectory_energy_score(position, uniform(1, 2), truth, known)
    assert score.item() == pytest.approx(math.sqrt(8) * (0.5 - 0.25))
    assert metrics.trajectory_energy_score(position, uniform(1, 2), truth, known, is_fair=True).item() == pytest.approx(0.0)
    assert metrics.trajectory_energy_score(position, uniform(1, 2), truth, torch.zeros_like(known)).isnan().all()


@pytest.mark.parametrize("k", [10, 30, 100])
@pytest.mark.parametrize("shape", ["round", "elongated", "two modes"])
def test_coverage_is_calibrated(k: int, shape: str, generator: torch.Generator) -> None:
    n = 2000
    points = randn(generator, n, k + 1, 2)
    if shape == "elongated":
        points = points @ torch.tensor([[100.0, 80.0], [0.0, 1.0]], dtype=torch.float64) + 1e5
    if shape == "two modes":
        points[..., 0] += 8.0 * (torch.rand(n, k + 1, generator=generator) < 0.3)
    found = metrics.coverage(points[:, 1:, None, None], uniform(n, k), points[:, 0, None, None], (0.5, 0.9)).mean(dim=(1, 2, 3))
    assert found[0].item() == pytest.approx(0.5, abs=3.5 * math.sqrt(0.25 / n))
    assert found[1].item() == pytest.approx(0.9, abs=3.5 * math.sqrt(0.09 / n))


def test_coverage_sees_wrong_spread_and_holes(generator: torch.Generator) -> None:
    truth, noise = randn(generator, 2000, 1, 1, 2), randn(generator, 2000, 50, 1, 1, 2)
    narrow, wide = (metrics.coverage(s * noise, uniform(2000, 50), truth).mean(dim=(1, 2, 3)) for s in (0.5, 2.0))
    # A Gaussian of half the width holds 1 - exp(-r^2 / 8) of a standard one within its own 90 % radius.
    assert narrow[1].item() == pytest.approx(1 - 0.1**0.25, abs=0.04)
    assert wide[1].item() > 0.99
    modes = noise * 0.3
    modes[:, :25, ..., 0] -= 5.0
    modes[:, 25:, ..., 0] += 5.0
    between = metrics.coverage(modes, uniform(2000, 50), torch.zeros_like(truth)).mean(dim=(1, 2, 3))
    assert between[1].item() < 0.02  # a region around the mean would hold it every time


def test_coverage_of_weighted_samples(generator: torch.Generator) -> None:
    n, k = 4000, 60
    truth = randn(generator, n, 1, 1, 2)
    points = 1.5 * randn(generator, n, k, 1, 1, 2)  # drawn too wide, put right by their weights
    log_weight = -0.5 * points.square().sum(dim=-1) * (1.0 - 1.0 / 2.25)
    weight = log_weight[..., 0, 0].softmax(dim=1)
    found = metrics.coverage(points, weight, truth).mean(dim=(1, 2, 3))
    assert found[0].item() == pytest.approx(0.5, abs=0.03)
    assert found[1].item() == pytest.approx(0.9, abs=0.02)


def test_coverage_of_equal_samples() -> None:
    same = torch.zeros(1, 30, 1, 1, 2)
    assert metrics.coverage(same, uniform(1, 30), torch.ones(1, 1, 1, 2)).flatten().tolist() == [0.0, 0.0]
    assert metrics.coverage(same, uniform(1, 30), torch.zeros(1, 1, 1, 2)).flatten().tolist() == pytest.approx([0.5, 0.9])
    rounded = torch.full((1, 1, 1, 2), 2e-4)  # what float32 makes of an exact detection far from the datum
    assert metrics.coverage(same, uniform(1, 30), rounded).flatten().tolist() == pytest.approx([0.5, 0.9])


def test_bootstrap_mean_covers_and_is_deterministic() -> None:
    rng = np.random.default_rng(3)
    hits = 0
    for _ in range(100):
        effect = rng.normal(size=40).repeat(5)  # five windows a group share their effect
        found = metrics.bootstrap_mean(effect, np.arange(40).repeat(5), rng, num_resamples=400)
        hits += found.low <= 0.0 <= found.high
    assert 86 <= hits <= 99
    values, groups = rng.normal(size=50), rng.integers(5, size=50)
    first, second = (metrics.bootstrap_mean(values, groups, np.random.default_rng(1)) for _ in range(2))
    assert first == second
    assert (first.num_values, first.num_groups) == (50, 5)
    assert first.value == pytest.approx(values.mean())


def test_bootstrap_ratio_is_paired() -> None:
    scale = np.exp(np.random.default_rng(2).normal(size=60))
    found = metrics.bootstrap_ratio(0.9 * scale, scale, np.arange(60), np.random.default_rng(0))
    assert (found.value, found.low, found.high) == pytest.approx((0.9, 0.9, 0.9))
    one = metrics.bootstrap_ratio([1.0, np.nan, 3.0], [2.0, 1.0, 2.0], ["a", "a", "a"], np.random.default_rng(0))
    assert one.value == 1.0 and math.isnan(one.low) and one.num_values == 2
    with pytest.raises(ValueError, match="shapes"):
        metrics.bootstrap_ratio([1.0], [1.0, 2.0], ["a"], np.random.default_rng(0))


def test_spread_of_a_ring() -> None:
    angle = torch.linspace(0, 2 * math.pi, 9)[:-1]
    ring = 5.0 * torch.stack([angle.cos(), angle.sin()], dim=-1)[None, :, None, None]
    assert metrics.spread(ring, uniform(1, 8)).item() == pytest.approx(5.0)


def test_spread_counts_only_hypotheses_that_have_the_agent() -> None:
    position = torch.tensor([[0.0, 0.0], [4.0, 0.0], [torch.nan, torch.nan]])[None, :, None, None]
    found = metrics.spread(position, torch.tensor([[0.1, 0.3, 0.6]]))
    assert found.item() == pytest.approx(4.0 * (0.25 * 0.75) ** 0.5)
    assert metrics.spread(torch.full((1, 3, 1, 1, 2), torch.nan), uniform(1, 3)).isnan().all()
