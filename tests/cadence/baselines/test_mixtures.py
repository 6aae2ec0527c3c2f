"""Mixtures and the rivals that answer with them: against torch's own, counted draws, symmetries, overfitting a handful."""

import dataclasses

import numpy as np
import pytest
import torch
from fixtures.recordings import random_recordings
from torch import distributions

from cadence.baselines.grammi import GrammiNetwork, GrammiNetworkConfig, PoolingConvolution
from cadence.baselines.mixture import (
    HORIZONS,
    GaussianMixture,
    HistoryConfig,
    MixtureFrame,
    MixtureModel,
    RawMixture,
    encode_sequences,
    mixture_inputs,
    straight_tracks,
)
from cadence.baselines.recurrence import run_recurrence
from cadence.baselines.vrnn import VrnnNetwork, VrnnNetworkConfig
from cadence.errors import ConfigError
from cadence.network.encoder import DetectionEncoder
from cadence.recordings import choose_windows, cut_windows
from cadence.training.mixtures import grammi_loss, hidden_goals, mixture_windows, vrnn_loss
from cadence.types import Context

HISTORY = HistoryConfig(max_detections=20, tracker_steps=8)
FRAME = MixtureFrame(60.0, (500.0, 500.0), 500.0, 100.0, 200.0)
GRAMMI = GrammiNetworkConfig(hidden_size=8, graph_size=6, tracker_size=4, history=HISTORY)
VRNN = VrnnNetworkConfig(hidden_size=8, latent_size=3, history=dataclasses.replace(HISTORY, tracker_steps=0))


def recordings(seed=0, lengths=(150, 40, 300)):
    return random_recordings(seed, lengths, 0.2)


def windows(num=12, seed=0, **changes):
    rec = recordings(seed)
    return cut_windows(rec, *choose_windows(rec, num, np.random.default_rng(1)), num_tracker_steps=8, **changes)


def seeded(make):
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return make().eval()


def models(**changes):
    networks = {"grammi": seeded(lambda: GrammiNetwork(GRAMMI)), "vrnn": seeded(lambda: VrnnNetwork(VRNN))}
    return [MixtureModel(network, FRAME, name, **changes) for name, network in networks.items()]


def random_mixture(rows=4, horizons=3, gaussians=5):
    stream = torch.Generator().manual_seed(2)
    raw = RawMixture(
        torch.randn(rows, horizons, gaussians, generator=stream),
        torch.randn(rows, horizons, gaussians, 2, generator=stream),
        torch.randn(rows, horizons, gaussians, 2, generator=stream),
    )
    return raw, torch.randn(rows, horizons, 2, generator=stream)


def test_likelihood_is_that_of_torch_distributions():
    raw, target = random_mixture()
    components = distributions.Independent(distributions.Normal(raw.mean, raw.log_sigma.exp()), 1)
    expected = distributions.MixtureSameFamily(distributions.Categorical(logits=raw.logits), components)
    torch.testing.assert_close(raw.negative_log_likelihood(target), -expected.log_prob(target))
    datum = torch.full((4, 2), 100.0, dtype=torch.float64)
    metres = raw.in_metres(FRAME, datum)
    truth = target.double() * FRAME.scale_m + 500.0 - datum[:, None]
    torch.testing.assert_close(metres.mean(), expected.mean.double() * 500.0 + 400.0, rtol=1e-5, atol=1e-2)
    density = expected.log_prob(target).double() - 2 * np.log(500.0)
    torch.testing.assert_close(metres.log_density(truth), density, rtol=1e-5, atol=1e-5)


def test_the_papers_measure_and_the_draws_of_a_mixture_made_by_hand():
    weight = torch.tensor([[[0.25, 0.75]]], dtype=torch.float64)
    mean = torch.tensor([[[[0.0, 0.0], [100.0, 0.0]]]], dtype=torch.float64)
    sigma = torch.tensor([[[[1.0, 2.0], [3.0, 4.0]]]], dtype=torch.float64)
    mixture = GaussianMixture(weight, mean, sigma)
    truth = torch.tensor([[[0.0, 40.0]]], dtype=torch.float64)
    assert mixture.expected_distance(truth).item() == pytest.approx(0.25 * 40 + 0.75 * np.hypot(100, 40))
    draws = mixture.sample(20_000, torch.tensor([7]))[0, :, 0]
    is_second = draws[:, 0] > 50
    assert is_second.double().mean().item() == pytest.approx(0.75, abs=0.01)
    for which, m, s in ((~is_second, mean[0, 0, 0], sigma[0, 0, 0]), (is_second, mean[0, 0, 1], sigma[0, 0, 1])):
        torch.testing.assert_close(draws[which].mean(0), m, atol=0.1, rtol=0)
        torch.testing.assert_close(draws[which].std(0), s, rtol=0.05, atol=0)
    with pytest.raises(ValueError, match="shapes"):
        GaussianMixture(weight, mean[..., :1], sigma)


def test_draws_belong_to_their_seed_and_horizons_are_independent():
    mixture = random_mixture()[0].in_metres(FRAME, torch.zeros(4, 2))
    seeds = torch.tensor([3, 9, 3, 4])
    draws = mixture.sample(6, seeds)
    alone = GaussianMixture(mixture.weight[1:2], mixture.mean_m[1:2], mixture.sigma_m[1:2]).sample(6, seeds[1:2])
    assert torch.equal(draws[1:2], alone)
    assert not torch.equal(draws, mixture.sample(6, seeds + 1))
    same = GaussianMixture(
        torch.ones(1, 2, 1), torch.zeros(1, 2, 1, 2, dtype=torch.float64), torch.ones(1, 2, 1, 2, dtype=torch.float64)
    )
    points = same.sample(4000, torch.tensor([1]))[0]
    assert abs(float(torch.corrcoef(points[:, :, 0].T)[0, 1])) < 0.06


def test_draws_are_spread_evenly_over_components_and_come_in_mirrored_pairs():
    weight = torch.tensor([[[0.2, 0.8], [0.6, 0.4]]], dtype=torch.float64)
    mean = 1000.0 * torch.arange(8, dtype=torch.float64).reshape(1, 2, 2, 2)
    mixture = GaussianMixture(weight, mean, torch.ones_like(mean))
    for seed in range(5):
        draws = mixture.sample(20, torch.tensor([seed]))[0]
        for horizon, count in ((0, 4), (1, 12)):
            is_first = (draws[:, horizon] - mean[0, horizon, 0]).norm(dim=-1) < 500
            assert int(is_first.sum()) == count
            centre = mean[0, horizon].index_select(0, (~is_first[::2]).long())
            torch.testing.assert_close(0.5 * (draws[::2, horizon] + draws[1::2, horizon]), centre)
    assert mixture.sample(3, torch.tensor([1])).shape == (1, 3, 2, 2)


def test_tracks_are_straight_between_the_draws():
    points = torch.tensor([[0.0, 0.0], [10.0, 20.0], [10.0, 0.0]])
    track = straight_tracks(points, (0, 5, 7), 9)
    expected = [[0, 0], [2, 4], [4, 8], [6, 12], [8, 16], [10, 20], [10, 10], [10, 0], [10, 0]]
    torch.testing.assert_close(track, torch.tensor(expected, dtype=torch.float32))
    assert torch.equal(straight_tracks(points[:1], (3,), 5), torch.zeros(5, 2))


def test_samples_pass_through_the_mixtures_draws():
    found = windows()
    for model in models():
        mixture, drawn = model.mixture(found.windows), model.sample(found.windows, 5)
        assert mixture.weight.shape == (12, 5, 4) and drawn.position_m.shape == (12, 5, 1, 120, 2)
        points = mixture.sample(5, found.windows.seeds)
        torch.testing.assert_close(drawn.position_m[:, :, 0, list(HORIZONS)], points)
        assert drawn.status == (("ok",),) * 12
        torch.testing.assert_close(mixture.weight.sum(-1), torch.ones(12, 5, dtype=torch.float64))


def test_what_a_window_gets_does_not_depend_on_its_neighbours():
    found = windows()
    for model in models(draws_latents=True, rows_at_once=5):
        whole = model.sample(found.windows, 3).position_m
        pick = torch.tensor([7, 2])
        part = found[pick]
        again = model.sample(part.windows, 3).position_m
        torch.testing.assert_close(again, whole[pick], rtol=0, atol=0.02)  # float32 in units of 500 m


def test_latent_draws_follow_the_seed_and_their_mean_is_free_of_noise():
    found = windows()
    model = models(draws_latents=True)[1]
    other = dataclasses.replace(found.windows, seeds=found.windows.seeds + 1)
    first, second = model.mixture(found.windows), model.mixture(other)
    assert torch.equal(first.mean_m, model.mixture(found.windows).mean_m)
    assert not torch.allclose(first.mean_m, second.mean_m, atol=1e-3)
    mean = dataclasses.replace(model, draws_latents=False)
    assert torch.equal(mean.mixture(found.windows).mean_m, mean.mixture(other).mean_m)


def test_the_order_of_the_trackers_does_not_matter_and_absent_ones_are_not_there():
    found = windows()
    model = models()[0]
    tracker = found.context.tracker_m
    here = model.mixture(found.windows)
    swapped = dataclasses.replace(found.context, tracker_m=tracker[:, :, [2, 0, 1]])
    more = torch.cat([torch.full_like(tracker[:, :, :2], torch.nan), tracker], dim=2)
    for context in (swapped, dataclasses.replace(found.context, tracker_m=more)):
        same = model.mixture(found.windows.with_context(context))
        torch.testing.assert_close(same.mean_m, here.mean_m, rtol=0, atol=0.02)
    fewer = dataclasses.replace(found.context, tracker_m=tracker[:, :, :2])
    assert not torch.allclose(model.mixture(found.windows.with_context(fewer)).mean_m, here.mean_m, atol=0.1)
    for nobody in (None, tracker[:, :, :0], torch.full_like(tracker, torch.nan)):
        alone = model.mixture(found.windows.with_context(dataclasses.replace(found.context, tracker_m=nobody)))
        assert torch.isfinite(alone.mean_m).all()


def test_the_graph_convolution_hears_the_largest_of_the_others():
    layer = seeded(lambda: PoolingConvolution(3, 2))
    states = torch.randn(1, 4, 3, generator=torch.Generator().manual_seed(0))
    is_present = torch.tensor([[True, True, False, True]])
    found = layer(states, is_present)
    for node in range(4):
        others = [other for other in (0, 1, 3) if other != node]
        heard = torch.relu(layer.pool(states[0, others])).amax(dim=0)
        torch.testing.assert_close(found[0, node], layer.own(states[0, node]) + layer.others(heard))


def test_a_known_goal_is_read_only_where_it_is_wanted():
    found = windows()
    nowhere = dataclasses.replace(found.context, known_goal_m=torch.full((12, 1, 2), torch.nan, dtype=torch.float64))
    elsewhere = dataclasses.replace(found.context, known_goal_m=found.context.known_goal_m + 100.0)
    for model in models():
        blind = model.mixture(found.windows).mean_m
        assert torch.equal(model.mixture(found.windows.with_context(nowhere)).mean_m, blind)
        knowing = dataclasses.replace(model, uses_goal=True)
        seeing = knowing.mixture(found.windows).mean_m
        assert not torch.allclose(seeing, blind, atol=0.1)
        assert not torch.allclose(knowing.mixture(found.windows.with_context(elsewhere)).mean_m, seeing, atol=0.1)
        assert torch.equal(knowing.mixture(found.windows.with_context(nowhere)).mean_m, blind)
    batch = mixture_windows(found, FRAME, HISTORY, HORIZONS)
    hidden = hidden_goals(batch, 1.0, torch.Generator().manual_seed(0)).inputs.extra(HISTORY)
    assert hidden[:, 1:].abs().max() == 0 and hidden_goals(batch, 0.0, torch.Generator()).inputs.has_goal.all()


def test_windows_without_detections_are_not_answered():
    rec = recordings()
    rec.is_detected[: rec.offset[1]] = False
    found = cut_windows(rec, np.array([0, 2]), np.array([30, 250]), known_start=False, num_tracker_steps=8)
    for model in models():
        assert torch.isnan(model.mixture(found.windows).mean_m[0]).all()
        drawn = model.sample(found.windows, 2)
        assert drawn.status == (("no_detections",), ("ok",))
        assert torch.isnan(drawn.position_m[0]).all() and torch.isfinite(drawn.position_m[1]).all()


def test_inputs_are_normalised_and_left_packed():
    found = windows()
    inputs = mixture_inputs(found.windows, FRAME, dataclasses.replace(HISTORY, tracker_stride=3))
    detections, row = found.windows.detections, int(found.step.argmax())
    count = min(20, int(detections.count[row, 0]))
    last = inputs.rows[row, count - 1]
    at = int(detections.count[row, 0]) - 1
    assert last[0] == pytest.approx(-float(detections.time_s[row, 0, at]) / 60 / 100)
    place = detections.position_m[row, 0, at] + found.context.datum_m[row]
    torch.testing.assert_close(last[1:].double(), (place - 500.0) / 500.0, atol=1e-6, rtol=0)
    assert int(inputs.is_observed[row].sum()) == count and inputs.is_tracked.shape == (12, 3, 3)
    track = found.context.tracker_m[row, [1, 4, 7], 2].double()
    torch.testing.assert_close(inputs.tracker_rows[row, 2, :, 1:].double(), (track - 500.0) / 500.0, atol=1e-6, rtol=0)
    torch.testing.assert_close(inputs.tracker_rows[row, 2, :, 0], torch.tensor([0.06, 0.03, 0.0]))
    half = inputs[torch.tensor([row])]
    assert half.rows.shape == (1, count, 3) and half.extra(HISTORY).shape == (1, 4)
    with pytest.raises(ConfigError, match="time since"):
        mixture_inputs(found.windows.with_context(Context(found.context.datum_m)), FRAME, HISTORY)


def test_sequences_encoded_in_groups_are_those_encoded_at_once():
    encoder = seeded(lambda: DetectionEncoder(3, 6))
    stream = torch.Generator().manual_seed(0)
    count = torch.randint(1, 30, (150,), generator=stream)
    is_observed = torch.arange(30) < count[:, None]
    rows = torch.randn(150, 30, 3, generator=stream)
    torch.testing.assert_close(encode_sequences(encoder, rows, is_observed), encoder(rows, is_observed))


def test_vrnn_steps_are_the_recurrence_written_plainly():
    """Gates, latent variables and divergence of one window at a time, from the layers by their names."""
    network = seeded(lambda: VrnnNetwork(VRNN))
    batch = mixture_windows(windows(5), FRAME, VRNN.history, HORIZONS)
    noise = torch.randn(*batch.inputs.is_observed.shape, 3, generator=torch.Generator().manual_seed(1))
    raw, divergence = network.forward_with_divergence(batch.inputs, noise)
    for row in range(5):
        state, total = torch.zeros(8), 0.0
        for step in range(int(batch.inputs.is_observed[row].sum())):
            feature = network.of_detection(batch.inputs.rows[row, step])
            hidden = torch.relu(network.posterior_in(torch.cat([feature, state])))
            mean, raw_sigma = network.posterior_out(torch.relu(network.posterior(hidden))).chunk(2)
            sigma = torch.nn.functional.softplus(raw_sigma) + 1e-4
            prior_mean, prior_raw = network.prior(state).chunk(2)
            prior = distributions.Normal(prior_mean, torch.nn.functional.softplus(prior_raw) + 1e-4)
            total += distributions.kl_divergence(distributions.Normal(mean, sigma), prior).sum()
            latent = torch.relu(network.of_latent(mean + sigma * noise[row, step]))
            of_input = network.recurrence_in(torch.cat([feature, latent])).chunk(3)
            of_state = network.recurrence(state).chunk(3)
            reset, update = (torch.sigmoid(of_input[i] + of_state[i]) for i in (0, 1))
            proposed = torch.tanh(of_input[2] + reset * of_state[2])
            state = (1 - update) * proposed + update * state
        code = torch.cat([latent, state, batch.inputs.extra(VRNN.history)[row]])
        expected = network.decoder(code.expand(1, 5, -1))
        torch.testing.assert_close(raw.mean[row], expected.mean[0], atol=1e-5, rtol=1e-4)
        torch.testing.assert_close(divergence[row], total, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("sizes", [[4], [3, 3, 2, 1], [5, 1, 1]])
def test_the_gradient_of_the_recurrence_is_that_of_finite_differences(sizes):
    stream = torch.Generator().manual_seed(3)
    h, z, p = 3, 2, sum(sizes)
    shapes = [(p, h), (p, 3 * h), (p, z), (h, 4 * h), (h, h), (h,), (h, 2 * z), (2 * z,), (z, h), (h,), (h, 3 * h)]
    values = [torch.randn(shape, generator=stream, dtype=torch.float64) for shape in shapes]
    given = [value.requires_grad_(index != 2) for index, value in enumerate(values)]
    assert torch.autograd.gradcheck(lambda f, g, e, *weights: run_recurrence(f, g, e, weights, sizes), given)


def test_the_posterior_is_paid_for_naming_the_component():
    config = dataclasses.replace(GRAMMI, mutual_information=True)
    network = seeded(lambda: GrammiNetwork(config))
    batch = mixture_windows(windows(), FRAME, HISTORY, HORIZONS)
    raw, log_probability = network.forward_with_posterior(batch.inputs)
    assert log_probability.shape == (12, 5, 4, 4)
    torch.testing.assert_close(log_probability.exp().sum(-1), torch.ones(12, 5, 4))
    right = torch.stack([log_probability[..., k, k] for k in range(4)], dim=-1)
    expected = raw.negative_log_likelihood(batch.target).mean() - 2.0 * right.mean()
    torch.testing.assert_close(grammi_loss(network, batch), expected)
    with pytest.raises(ValueError, match="mutual_information is off"):
        seeded(lambda: GrammiNetwork(GRAMMI)).forward_with_posterior(batch.inputs)


def test_a_trunk_for_each_horizon_is_a_model_for_each_horizon():
    network = seeded(lambda: GrammiNetwork(dataclasses.replace(GRAMMI, shared_trunk=False, horizons=(0, 9))))
    batch = mixture_windows(windows(), FRAME, HISTORY, (0, 9))
    network(batch.inputs).negative_log_likelihood(batch.target)[:, 0].mean().backward()
    first, second = (list(trunk.parameters()) for trunk in network.trunks)
    assert any(value.grad.abs().max() > 0 for value in first)
    assert all(value.grad is None or value.grad.abs().max() == 0 for value in second)


@pytest.mark.parametrize("kind", ["grammi", "posterior", "vrnn"])
def test_a_handful_of_windows_is_learned_by_heart(kind):
    history = HistoryConfig(max_detections=6, tracker_steps=4)
    batch = mixture_windows(windows(4), FRAME, history, HORIZONS)
    grammi = dataclasses.replace(
        GRAMMI, hidden_size=24, num_gaussians=2, history=history, mutual_information=kind == "posterior"
    )
    vrnn = dataclasses.replace(VRNN, hidden_size=24, num_gaussians=2)
    network = seeded(lambda: VrnnNetwork(vrnn) if kind == "vrnn" else GrammiNetwork(grammi))
    optimiser = torch.optim.Adam(network.parameters(), 0.01)
    stream = torch.Generator().manual_seed(0)
    for _ in range(120):
        optimiser.zero_grad()
        loss = vrnn_loss(network, batch, stream) if kind == "vrnn" else grammi_loss(network, batch)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
    with torch.no_grad():
        mixture = network(batch.inputs).in_metres(FRAME, torch.zeros(4, 2))
    truth_m = batch.target.double() * 500.0 + 500.0
    # the best common Gaussian of windows all over the map has a sigma of about 290 m; here it is below 50 m
    assert float(-mixture.log_density(truth_m).mean()) < np.log(2 * np.pi) + 1.0 + 2 * np.log(50.0)


def test_settings_and_grids_that_cannot_be():
    for bad in (
        lambda: GrammiNetworkConfig(horizons=(0, 0)),
        lambda: GrammiNetworkConfig(hidden_size=0),
        lambda: VrnnNetworkConfig(history=HistoryConfig()),
        lambda: VrnnNetworkConfig(latent_size=0),
        lambda: MixtureFrame(scale_m=0.0),
        lambda: HistoryConfig(tracker_stride=0),
    ):
        with pytest.raises(ValueError):
            bad()
    found = windows(3)
    model = models()[0]
    with pytest.raises(ValueError, match="where they are"):
        model.mixture(found.windows.with_context(None))
    short = dataclasses.replace(found.windows, time_s=found.windows.time_s[:60])
    with pytest.raises(ConfigError, match="horizon_steps = 119"):
        model.mixture(short.with_context(found.context))
    slow = dataclasses.replace(found.windows, time_s=2 * found.windows.time_s)
    with pytest.raises(ConfigError, match="step_s = 60"):
        model.mixture(slow.with_context(found.context))
    assert model.fit(found.windows.detections) is model
