"""The bank as an estimator: what changes with the world around it and what must not, its weights and its speed unit."""

import dataclasses
import math

import pytest
import torch
from fixtures.bank import Moved, as_tracks, dense_posterior, random_windows, simulate, turn_matrix
from hypothesis import given, settings
from hypothesis import strategies as st

from cadence.bank.bank import Bank, default_step, em_weights, typical_speed
from cadence.bank.components import concatenate, constant_velocity, default_models, ornstein_uhlenbeck
from cadence.bank.fitting import DIFFUSE_STEPS, FLOOR_STEPS, log_likelihood
from cadence.bank.mixture import MAX_MODELS, choose_models, merge_grid, mixture_moments
from cadence.bank.rows import active_rows, scatter_hypotheses, track_rows
from cadence.bank.smoother import Nodes
from cadence.types import Detections, WindowBatch

EYE = torch.eye(2, dtype=torch.float64)
NO_SHIFT = torch.zeros(2, dtype=torch.float64)
WINDOWS = random_windows()
BANK = Bank().fit(as_tracks(WINDOWS.detections), 1.0)


def isotropic(windows: WindowBatch, sigma_m: float) -> WindowBatch:
    covariance = (sigma_m**2 * EYE).expand(*windows.detections.time_s.shape, 2, 2)
    return dataclasses.replace(windows, detections=dataclasses.replace(windows.detections, covariance_m2=covariance))


# --- what the bank says, against the dense Gaussian


def single(index: int) -> Bank:
    return Bank(models=default_models()[torch.tensor([index])], speed_mps=0.9, switch_rate=0.0, temper=1.0)


@pytest.mark.parametrize("index", [1, 40])
def test_one_model_is_gaussian_conditioning(index: int) -> None:
    bank, windows = single(index), random_windows(num_windows=2, history=10, horizon=4)
    posterior = bank.posterior(windows, 2)
    rows, _ = active_rows(windows)
    nodes, step_index = merge_grid(rows, windows.time_s)
    nodes = dataclasses.replace(nodes, covariance_m2=nodes.covariance_m2 + (FLOOR_STEPS * bank.length_m(1.0)) ** 2 * EYE)
    for row in (0, 3):  # the second one is padded
        want = dense_posterior(bank.models.scaled(1.0, 0.9), nodes[torch.tensor([row])], DIFFUSE_STEPS * bank.length_m(1.0))
        torch.testing.assert_close(posterior.mean_m[row], want.mean[step_index[row], :2], rtol=0, atol=2e-4)
        variance = torch.stack([0.5 * want.covariance[m, :2, m, :2].trace() for m in step_index[row].tolist()])
        torch.testing.assert_close(posterior.sigma_m[row], variance.sqrt(), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("switch_rate", [0.0, 1.0 / 8.0])
def test_samples_have_the_moments(switch_rate: float) -> None:
    num, bank = 600, dataclasses.replace(BANK, switch_rate=switch_rate)
    posterior = bank.posterior(WINDOWS, num)
    sample, mean, sigma = posterior.sample_m, posterior.mean_m, posterior.sigma_m
    # systematic resampling of the models only makes the mean more exact than independent samples would
    error = (sample.mean(1) - mean).norm(dim=-1) / (sigma * math.sqrt(2.0 / num))
    assert float(error.max()) < 4.5
    square = 0.5 * ((sample - mean[:, None]) ** 2).sum(-1)
    error = (square.mean(1) - sigma**2) / (square.std(1) / math.sqrt(num))
    assert float(error.abs().max()) < 6.0  # heavy tails: the standard error itself is an estimate
    assert float(error.abs().mean()) < 1.2


def test_no_time_after_the_last_detection() -> None:
    """A window without horizon whose last detection lies at the origin itself."""
    windows = random_windows(horizon=0)
    d = windows.detections
    at_origin = dataclasses.replace(
        d, time_s=d.time_s - torch.where(d.is_observed, d.time_s, -torch.inf).amax(-1, keepdim=True)
    )
    windows = dataclasses.replace(windows, detections=at_origin)
    none, often = (dataclasses.replace(BANK, switch_rate=rate).posterior(windows, 3) for rate in (0.0, 0.5))
    assert torch.equal(none.sample_m, often.sample_m)


def test_samples_pass_through_exact_detections() -> None:
    windows = isotropic(WINDOWS, 0.0)
    # detections on grid steps, so that a step and a detection are at one time
    at = windows.detections.time_s.round() - 2.0 * torch.arange(windows.detections.time_s.shape[-1]).flip(0)
    windows = dataclasses.replace(windows, detections=dataclasses.replace(windows.detections, time_s=at))
    posterior = BANK.posterior(windows, 16)
    rows, _ = active_rows(windows)
    step = (rows.time_s - windows.time_s[0]).round().long()
    inside = rows.is_observed & (step >= 0)
    row, column = inside.nonzero(as_tuple=True)
    error = posterior.sample_m[row, :, step[row, column]] - rows.position_m[row, column][:, None]
    assert len(row) > 20
    assert float(error.abs().max()) < 6.0 * FLOOR_STEPS * BANK.length_m(1.0)


def test_switching_of_rate_zero_is_its_limit() -> None:
    none, almost = (dataclasses.replace(BANK, switch_rate=rate).posterior(WINDOWS, 5) for rate in (0.0, 1e-9))
    torch.testing.assert_close(none.mean_m, almost.mean_m, rtol=0, atol=1e-5)
    torch.testing.assert_close(none.sigma_m, almost.sigma_m, rtol=1e-5, atol=1e-5)


def test_switching_changes_nothing_up_to_the_last_detection() -> None:
    none, often = (dataclasses.replace(BANK, switch_rate=rate).posterior(WINDOWS, 5) for rate in (0.0, 0.5))
    rows, _ = active_rows(WINDOWS)
    last = torch.where(rows.is_observed, rows.time_s, -torch.inf).amax(1)
    before = WINDOWS.time_s <= last[:, None]
    assert before.any() and not before.all()
    for one, other in ((none.mean_m, often.mean_m), (none.sigma_m, often.sigma_m)):
        assert torch.equal(one[before], other[before])
    assert torch.equal(none.sample_m.transpose(1, 2)[before], often.sample_m.transpose(1, 2)[before])
    assert not torch.allclose(none.sigma_m[~before], often.sigma_m[~before])


# --- what must not matter


def test_same_seed_same_bytes_and_other_seed_other_samples() -> None:
    one, two = (Bank().fit(as_tracks(WINDOWS.detections), 1.0).posterior(WINDOWS, 4) for _ in range(2))
    for name in ("mean_m", "sigma_m", "sample_m"):
        assert torch.equal(getattr(one, name), getattr(two, name))
    other = BANK.posterior(dataclasses.replace(WINDOWS, seeds=WINDOWS.seeds + 1), 4)
    assert torch.equal(one.mean_m, other.mean_m)
    assert not torch.equal(one.sample_m, other.sample_m)


def test_a_window_does_not_depend_on_its_neighbours() -> None:
    together = BANK.sample(WINDOWS, 4).position_m
    for window in range(WINDOWS.num_windows):
        alone = BANK.sample(WINDOWS[slice(window, window + 1)], 4).position_m
        torch.testing.assert_close(alone[0], together[window], rtol=0, atol=1e-6)


def test_padding_does_not_matter() -> None:
    d = WINDOWS.detections
    wider = Detections(
        torch.nn.functional.pad(d.time_s, (0, 3), value=-7.0),
        torch.nn.functional.pad(torch.where(d.is_observed[..., None], d.position_m, 1e6), (0, 0, 0, 3)),
        torch.cat([d.covariance_m2, 5.0 * EYE.expand(*d.time_s.shape[:2], 3, 2, 2)], 2),
        torch.nn.functional.pad(d.is_observed, (0, 3)),
    )
    plain, padded = BANK.posterior(WINDOWS, 3), BANK.posterior(dataclasses.replace(WINDOWS, detections=wider), 3)
    torch.testing.assert_close(padded.sample_m, plain.sample_m, rtol=0, atol=1e-9)


def test_swapping_agents_swaps_the_moments() -> None:
    d = WINDOWS.detections
    swapped = Detections(d.time_s.flip(1), d.position_m.flip(1), d.covariance_m2.flip(1), d.is_observed.flip(1))
    plain, flipped = BANK.posterior(WINDOWS, 2), BANK.posterior(dataclasses.replace(WINDOWS, detections=swapped), 2)
    order = torch.arange(WINDOWS.num_windows * 2).view(-1, 2).flip(1).flatten()
    torch.testing.assert_close(flipped.mean_m, plain.mean_m[order], rtol=0, atol=1e-8)
    torch.testing.assert_close(flipped.sigma_m, plain.sigma_m[order], rtol=1e-8, atol=1e-9)


# --- what moves with the world


@settings(max_examples=6)
@given(st.floats(-1e5, 1e5), st.floats(1e-2, 1e3), st.floats(0.03, 20.0), st.floats(-1e6, 1e6))
def test_what_is_learned_has_no_place_no_unit_and_no_time(x: float, scale: float, time_scale: float, shift: float) -> None:
    world = Moved(EYE, torch.tensor([x, -x], dtype=torch.float64), scale, time_scale, shift)
    d = as_tracks(WINDOWS.detections)
    rows = track_rows(d)
    moved = track_rows(world.detections(d))
    plain_speed = typical_speed(rows, 1.0)
    speed = typical_speed(moved, time_scale)
    assert speed == pytest.approx(plain_speed * scale / time_scale, rel=1e-5)
    models = default_models()[torch.tensor([0, 5, 20, 33, 50])]
    got = log_likelihood(models, moved, time_scale, plain_speed * scale / time_scale)
    # densities have the unit 1 / m^2 a detection
    want = log_likelihood(models, rows, 1.0, plain_speed) - 2.0 * math.log(scale) * rows.is_observed.sum(1, keepdim=True)
    torch.testing.assert_close(got, want, rtol=0, atol=1e-3)


@settings(max_examples=6)
@given(st.floats(-1e5, 1e5), st.floats(1e-2, 1e3), st.floats(0.03, 20.0))
def test_place_and_units_do_not_matter(x: float, scale: float, time_scale: float) -> None:
    world = Moved(EYE, torch.tensor([x, -x], dtype=torch.float64), scale, time_scale)
    same = dataclasses.replace(BANK, speed_mps=(BANK.speed_mps or 0.0) * scale / time_scale)
    plain, got = BANK.posterior(WINDOWS, 3), same.posterior(world.windows(WINDOWS), 3)
    sigma = plain.sigma_m
    assert float(((got.mean_m - world.positions(plain.mean_m)) / scale / sigma[..., None]).abs().max()) < 2e-3
    assert float((got.sigma_m / scale / sigma - 1.0).abs().max()) < 2e-3
    assert float(((got.sample_m - world.positions(plain.sample_m)) / scale / sigma[:, None, :, None]).abs().max()) < 5e-3


@pytest.mark.parametrize("matrix", [turn_matrix(0.7), turn_matrix(-2.5), torch.diag(torch.tensor([1.0, -1.0]).double())])
def test_turning_or_mirroring_the_world_does_so_to_the_moments(matrix: torch.Tensor) -> None:
    world = Moved(matrix, NO_SHIFT)
    turned = Bank().fit(world.detections(as_tracks(WINDOWS.detections)), 1.0)
    assert turned.speed_mps == pytest.approx(BANK.speed_mps)
    plain, got = BANK.posterior(WINDOWS, 2), turned.posterior(world.windows(WINDOWS), 2)
    torch.testing.assert_close(got.mean_m, world.positions(plain.mean_m), rtol=0, atol=1e-3)
    torch.testing.assert_close(got.sigma_m, plain.sigma_m, rtol=1e-3, atol=1e-4)


# --- learning from a log


def test_weights_concentrate_on_the_models_that_made_the_log() -> None:
    models = concatenate(
        constant_velocity([0.03**2]),
        constant_velocity([0.5**2]),
        ornstein_uhlenbeck([1.0], [1.0], [0.0]),
        ornstein_uhlenbeck([30.0], [0.7], [0.5, -0.5]),
    )
    times = torch.arange(12, dtype=torch.float64) * 1.5
    parts = [simulate(models[torch.tensor([index])], times, 0.05, num, index) for index, num in ((0, 60), (3, 20))]
    names = [name for name, value in vars(parts[0]).items() if value is not None]
    tracks = Detections(**{name: torch.cat([getattr(part, name) for part in parts]) for name in names})
    log_weight, evidence = em_weights(log_likelihood(models, track_rows(tracks), 1.0, 1.0), 3.0)
    assert log_weight.exp().tolist() == pytest.approx([0.75, 0.0, 0.0, 0.25, 0.0], abs=0.04)
    assert evidence.tolist() == pytest.approx([0.75, 0.0, 0.0, 0.25, 0.0], abs=0.02)


def test_the_model_of_greatest_likelihood_joins_the_bank() -> None:
    true = ornstein_uhlenbeck([6.0], [0.7], [0.0])
    times = torch.arange(16, dtype=torch.float64) * 2.0
    fitted = Bank().fit(simulate(true, times, 0.02, 80, 1), 1.0)
    last = fitted.models[torch.tensor([-1])]
    assert len(fitted.models) == len(default_models()) + 1
    scale = float(fitted.speed_mps or 0.0)
    assert float(1.0 / last.relaxation_rate) == pytest.approx(6.0, rel=0.25)
    assert float(last.initial_speed) * scale == pytest.approx(0.7, rel=0.1)


@given(st.integers(1, 6), st.integers(1, 5), st.integers(0, 1000), st.floats(0.1, 10.0))
def test_weights_are_weights(num_rows: int, num_models: int, seed: int, pseudo_count: float) -> None:
    g = torch.Generator().manual_seed(seed)
    likelihood = 30.0 * torch.randn(num_rows, num_models, generator=g, dtype=torch.float64)
    log_weight, evidence = em_weights(likelihood, pseudo_count)
    assert float(log_weight.exp().sum()) == pytest.approx(1.0)
    assert float(evidence.sum()) == pytest.approx(1.0)
    assert torch.isfinite(log_weight).all()
    # a likelihood known up to a factor a row says the same
    shifted, _ = em_weights(likelihood + torch.randn(num_rows, 1, generator=g, dtype=torch.float64), pseudo_count)
    torch.testing.assert_close(shifted, log_weight)


def straight_tracks(speed: float, sigma_m: float, num: int = 30) -> Detections:
    g = torch.Generator().manual_seed(0)
    time_s = torch.rand(num, 1, 20, generator=g, dtype=torch.float64).mul(60.0).sort(-1).values
    heading = 2 * math.pi * torch.rand(num, 1, 1, generator=g, dtype=torch.float64)
    velocity = speed * torch.stack([heading.cos(), heading.sin()], -1)
    position = velocity * time_s[..., None] + sigma_m * torch.randn(num, 1, 20, 2, generator=g, dtype=torch.float64)
    covariance = (sigma_m**2 * EYE).expand(num, 1, 20, 2, 2)
    return Detections(time_s, position, covariance, torch.ones_like(time_s, dtype=torch.bool))


@pytest.mark.parametrize("sigma_m", [0.0, 2.0])
def test_typical_speed_is_the_speed_without_the_noise(sigma_m: float) -> None:
    speed = typical_speed(track_rows(straight_tracks(5.0, sigma_m)), 1.0)
    assert speed == pytest.approx(5.0, rel=1e-6 if sigma_m == 0.0 else 0.12)


def test_one_false_position_hardly_changes_the_typical_speed() -> None:
    tracks = straight_tracks(5.0, 0.1)
    tracks.position_m[3, 0, 7] += 1e6
    assert typical_speed(track_rows(tracks), 1.0) == pytest.approx(5.0, rel=0.05)


def test_a_row_that_says_nothing_does_not_decide_the_speed_of_others() -> None:
    tracks = straight_tracks(5.0, 0.1)
    covariance = tracks.covariance_m2.clone()
    covariance[0] = 1e8 * EYE
    assert typical_speed(track_rows(dataclasses.replace(tracks, covariance_m2=covariance)), 1.0) == pytest.approx(5.0, rel=0.05)


def test_speed_is_never_zero() -> None:
    still = dataclasses.replace(straight_tracks(0.0, 0.0), covariance_m2=torch.zeros(30, 1, 20, 2, 2).double())
    assert typical_speed(track_rows(still), 1.0) > 0.0
    past = dataclasses.replace(still, time_s=still.time_s - 60.0)[slice(0, 4)]
    posterior = Bank().fit(still, 0.1).posterior(dataclasses.replace(WINDOWS, detections=past), 3)
    assert torch.isfinite(posterior.sample_m).all()
    assert float(posterior.sample_m.abs().max()) < 1.0


def test_a_log_of_lone_detections_gets_a_speed_but_no_weights() -> None:
    tracks = as_tracks(WINDOWS.detections)
    lone = dataclasses.replace(tracks, is_observed=torch.arange(7).expand(8, 1, 7) < 1)
    bank = Bank().fit(lone, 2.0)
    assert bank.log_weight is None and bank.speed_mps is not None
    one = dataclasses.replace(
        WINDOWS, detections=dataclasses.replace(WINDOWS.detections, is_observed=lone.is_observed.view(4, 2, 7))
    )
    assert torch.isfinite(bank.sample(one, 2).position_m).all()


def test_default_step_is_a_sixteenth_of_the_mean_stretch() -> None:
    rows = Nodes(
        torch.tensor([[3.0, 19.0], [0.0, 48.0]], dtype=torch.float64),
        torch.zeros(2, 2, 2),
        torch.zeros(2, 2, 2, 2),
        torch.ones(2, 2) > 0,
    )
    assert default_step(rows) == 2.0
    assert default_step(rows[torch.zeros(0, dtype=torch.int64)]) == 1.0


# --- the estimator's call


def test_agents_that_were_not_seen_get_nothing() -> None:
    observed = WINDOWS.detections.is_observed.clone()
    observed[1, 0] = observed[2] = False
    windows = dataclasses.replace(WINDOWS, detections=dataclasses.replace(WINDOWS.detections, is_observed=observed))
    found = BANK.sample(windows, 3)
    assert tuple(found.position_m.shape) == (4, 3, 2, WINDOWS.num_steps, 2)
    assert found.status == (("ok", "ok"), ("no_detections", "ok"), ("no_detections", "no_detections"), ("ok", "ok"))
    is_ok = torch.tensor([[word == "ok" for word in row] for row in found.status])
    assert torch.equal(found.position_m.isfinite().all(-1).all(-1).all(1), is_ok)
    torch.testing.assert_close(found.weight, torch.full((4, 3), 1 / 3, dtype=torch.float64))
    # the others do not notice
    torch.testing.assert_close(found.position_m[0], BANK.sample(WINDOWS, 3).position_m[0], rtol=0, atol=1e-6)


def test_windows_without_any_detection() -> None:
    nothing = dataclasses.replace(WINDOWS.detections, is_observed=torch.zeros(4, 2, 7, dtype=torch.bool))
    found = BANK.sample(dataclasses.replace(WINDOWS, detections=nothing), 3)
    assert found.position_m.isnan().all()
    assert found.position_m.shape == (4, 3, 2, WINDOWS.num_steps, 2)


def test_an_unfitted_bank_says_so() -> None:
    with pytest.raises(ValueError, match="fit"):
        Bank().sample(WINDOWS, 2)


# --- parts


@given(st.integers(1, 5), st.integers(1, 30), st.integers(0, 1000))
def test_the_likeliest_models_are_chosen(num_rows: int, num_models: int, seed: int) -> None:
    log_posterior = 5.0 * torch.randn(num_rows, num_models, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    chosen = choose_models(log_posterior)
    torch.testing.assert_close(chosen.weight.sum(1), torch.ones(num_rows, dtype=torch.float64))
    for row in range(num_rows):
        mine = chosen.row == row
        assert 1 <= int(mine.sum()) <= MAX_MODELS
        assert int(chosen.model[mine][0]) == int(log_posterior[row].argmax())
        assert int(chosen.row[chosen.first_pair[row]]) == row
        used = chosen.weight[row][chosen.weight[row] > 0]
        torch.testing.assert_close(chosen.pair_weight[mine], used)


def test_mixture_moments_by_hand() -> None:
    chosen = choose_models(torch.tensor([[0.25, 0.75]], dtype=torch.float64).log())  # the second model comes first
    mean = torch.tensor([[[4.0, 0.0]], [[0.0, 8.0]]], dtype=torch.float64)
    total, variance = mixture_moments(mean, torch.tensor([[2.0], [6.0]], dtype=torch.float64), chosen)
    assert total[0, 0].tolist() == pytest.approx([3.0, 2.0])
    # 0.75 (2 + (1 + 4) / 2) + 0.25 (6 + (9 + 36) / 2)
    assert float(variance) == pytest.approx(10.5)


def test_merged_nodes_are_in_order_and_steps_are_found_again() -> None:
    rows, _ = active_rows(WINDOWS)
    nodes, step_index = merge_grid(rows, WINDOWS.time_s)
    assert bool((torch.diff(nodes.time_s, dim=1) >= 0).all())
    torch.testing.assert_close(nodes.time_s.gather(1, step_index), WINDOWS.time_s.expand(len(rows.time_s), -1))
    assert not nodes.is_observed.gather(1, step_index).any()
    assert torch.equal(nodes.is_observed.sum(1), rows.is_observed.sum(1))


def test_rows_go_back_to_their_windows_and_agents() -> None:
    active = WINDOWS.is_active
    label = active.nonzero().double()  # window, agent
    sample = label[:, None, None].expand(-1, 3, WINDOWS.num_steps, -1)
    found = scatter_hypotheses(sample, WINDOWS).position_m
    for window, agent in active.nonzero().tolist():
        assert found[window, :, agent].unique(dim=1).squeeze(1).tolist() == [[window, agent]] * 3
    _, seeds = active_rows(WINDOWS)
    assert len(set(seeds.tolist())) == len(seeds)
