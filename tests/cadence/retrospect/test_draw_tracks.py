import dataclasses
import itertools
import math

import numpy as np
import pytest
import torch
from fixtures.bank import dense_posterior
from scipy.stats import ks_2samp

from cadence.bank.bank import Bank
from cadence.bank.components import concatenate, constant_velocity, home_ranges, ornstein_uhlenbeck, transition
from cadence.bank.fitting import DIFFUSE_STEPS, FLOOR_STEPS
from cadence.bank.mixture import merge_grid
from cadence.bank.smoother import Nodes, diffuse_start, filter_from
from cadence.metrics import coverage
from cadence.retrospect.chains import Chains
from cadence.retrospect.draw import draw_tracks
from cadence.retrospect.filtering import Plan, Tracks
from cadence.retrospect.timeline import Timeline


def timeline_of(num_steps: int, stretch: int = 16) -> Timeline:
    return Timeline(torch.arange(num_steps).double(), torch.arange(0, num_steps, stretch), 1.0)


def tracks_of(time_s, position_m, sigma_m: float = 0.1, begin_s=None, end_s=None, seed: int = 0) -> Tracks:
    time_s, position_m = torch.as_tensor(time_s).double(), torch.as_tensor(position_m).double()
    r, n = time_s.shape
    covariance = (sigma_m**2 * torch.eye(2, dtype=torch.float64)).expand(r, n, 2, 2).clone()
    rows = Nodes(time_s, position_m, covariance, torch.ones(r, n, dtype=torch.bool))
    begin = time_s[:, 0] if begin_s is None else torch.as_tensor(begin_s).double()
    end = time_s[:, -1] if end_s is None else torch.as_tensor(end_s).double()
    return Tracks(rows, begin, end, torch.arange(r) + seed)


@pytest.mark.parametrize(
    "models", [ornstein_uhlenbeck([8.0], [0.7], [0.1]), constant_velocity([0.01]), home_ranges([4.0], [0.5], [5.0])]
)
def test_with_one_model_it_is_the_smoother_of_the_whole_mission(models):
    time_s = torch.tensor([[2.5, 9.0, 16.0, 30.25, 31.0, 47.9, 60.0]]).double()
    position_m = torch.tensor([[[0, 0], [3, 1], [5, 4], [9, 2], [9.5, 1.5], [15, 8], [20, 3]]]).double()
    timeline = timeline_of(70)
    drawn = draw_tracks(Bank(models, speed_mps=1.0), tracks_of(time_s, position_m, begin_s=[0.0], end_s=[69.0]), timeline, 2400)
    grid = timeline.time_s[None]
    every = torch.cat([grid, time_s], 1)
    order = every[0].argsort(stable=True)
    seen = torch.cat([torch.zeros(1, 70, dtype=torch.bool), torch.ones(1, 7, dtype=torch.bool)], 1)
    place = torch.cat([torch.zeros(1, 70, 2, dtype=torch.float64), position_m], 1)
    noise = ((0.1**2 + FLOOR_STEPS**2) * torch.eye(2, dtype=torch.float64)).expand(1, 77, 2, 2)
    exact = dense_posterior(models, Nodes(every[:, order], place[:, order], noise, seen[:, order]), DIFFUSE_STEPS)
    at = torch.argsort(order)[:70]
    mean, covariance = exact.mean[at, :2], exact.covariance[at, :2][..., at, :2]
    variance = covariance.permute(0, 2, 1, 3).diagonal(dim1=0, dim2=1).permute(2, 0, 1)  # [T, 2, 2]
    sigma = variance.diagonal(dim1=-2, dim2=-1).sqrt()
    error = (drawn[0].mean(0) - mean) / sigma
    assert float(error.abs().max()) < 4.5 / math.sqrt(2400)
    centred = drawn[0] - drawn[0].mean(0)
    found = (centred**2).mean(0).sqrt()
    assert float((found / sigma - 1.0).abs().max()) < 4.5 / math.sqrt(2 * 2400)
    # steps of different stretches are as correlated as they should be
    for one, other in ((15, 16), (14, 18), (20, 25), (31, 33), (3, 40)):
        wanted = float(covariance[one, 0, other, 0]) / float(sigma[one, 0] * sigma[other, 0])
        got = float((centred[:, one, 0] * centred[:, other, 0]).mean() / (found[one, 0] * found[other, 0]))
        assert abs(got - wanted) < 4.5 / math.sqrt(2400)


def wandering(num_tracks: int, models, time_s, sigma_m: float, seed: int, stretch: int = 16) -> tuple[torch.Tensor, Tracks]:
    """Tracks drawn from the prior of `models`, one anew each stretch, on the steps 0, 1, ..., and detections of them."""
    g = torch.Generator().manual_seed(seed)
    state = torch.zeros(num_tracks, models.num_states, dtype=torch.float64)
    model = torch.randint(len(models), (num_tracks,), generator=g)
    state[:, 2:4] = models.initial_speed[model][:, None] * torch.randn(num_tracks, 2, generator=g, dtype=torch.float64)
    matrix, noise = transition(models, torch.ones(len(models), dtype=torch.float64))
    root = torch.linalg.cholesky(noise + 1e-15 * torch.eye(models.num_states))
    way = [state[:, :2]]
    for step in range(1, int(time_s.max()) + 1):
        if (step - 1) % stretch == 0 and step > 1:
            model = torch.randint(len(models), (num_tracks,), generator=g)
        kick = torch.randn(num_tracks, models.num_states, 1, generator=g, dtype=torch.float64)
        state = (matrix[model] @ state[..., None] + root[model] @ kick)[..., 0]
        way.append(state[:, :2])
    truth = torch.stack(way, 1)
    seen = truth[:, time_s.long()] + sigma_m * torch.randn(num_tracks, len(time_s), 2, generator=g, dtype=torch.float64)
    return truth, tracks_of(time_s.expand(num_tracks, -1), seen, sigma_m)


SEEN_S = torch.tensor([0, 1, 11, 20, 30, 31, 45, 52, 53, 64, 78, 95]).double()


def test_its_own_prior_is_covered_as_it_says():
    models = ornstein_uhlenbeck([20.0, 2.0], [0.7, 1.2], [0.0])
    truth, tracks = wandering(150, models, SEEN_S, 0.05, seed=1)
    bank = Bank(models, speed_mps=1.0, switch_rate=1e6)  # nothing is kept from stretch to stretch
    drawn = draw_tracks(bank, tracks, timeline_of(96), 60)
    every = torch.full((len(drawn), 60), 1.0 / 60, dtype=torch.float64)
    unseen = [step for step in range(2, 95, 2) if step not in SEEN_S.tolist()]
    inside = coverage(drawn[:, :, None, unseen], every, truth[:, None, unseen], (0.9,))[0]
    assert 0.88 <= float(inside.double().mean()) <= 0.92


def test_tracks_pass_their_detections_and_are_unbroken():
    models = concatenate(ornstein_uhlenbeck([20.0, 2.0], [0.7, 1.2], [0.0]), home_ranges([4.0], [0.5], [5.0]))
    _, tracks = wandering(6, ornstein_uhlenbeck([20.0, 2.0], [0.7, 1.2], [0.0]), SEEN_S, 0.05, seed=2)
    drawn = draw_tracks(Bank(models, speed_mps=1.0), tracks, timeline_of(96), 50)
    assert torch.isfinite(drawn).all()
    away = (drawn[:, :, SEEN_S.long()] - tracks.rows.position_m[:, None]).norm(dim=-1)
    assert float(away.max()) < 0.05 * 5.5
    assert float(drawn.diff(dim=2).norm(dim=-1).max()) < 8.0  # six deviations of the fastest model's step


def test_motion_at_the_borders_of_stretches_is_as_inside():
    models = ornstein_uhlenbeck([20.0, 2.0, 5.0], [0.7, 1.2, 1.0], [0.0])
    _, tracks = wandering(150, models, SEEN_S, 0.05, seed=3)
    bank = Bank(models, speed_mps=1.0)
    at = [laws_of_motion(draw_tracks(bank, tracks, timeline_of(96), 2)[:, 0])]
    # the same steps of the same tracks, but with borders elsewhere
    other = Timeline(torch.arange(96).double(), torch.cat([torch.zeros(1).long(), torch.arange(8, 96, 16)]), 1.0)
    later = dataclasses.replace(tracks, seeds=tracks.seeds + 1000)
    at.append(laws_of_motion(draw_tracks(bank, later, other, 2)[:, 0]))
    for border, inside in zip(*at, strict=True):
        assert ks_2samp(border, inside).pvalue > 0.01


def laws_of_motion(way_m: torch.Tensor) -> list[np.ndarray]:
    """Lengths of the steps into 16, 32, ..., the turns there, and what the step changes by [tracks x borders] each."""
    step = way_m.diff(dim=1)
    borders = torch.arange(16, 95, 16)
    before, after = step[:, borders - 1], step[:, borders]
    angle = torch.atan2(after[..., 1], after[..., 0]) - torch.atan2(before[..., 1], before[..., 0])
    laws = before.norm(dim=-1), torch.remainder(angle + math.pi, 2 * math.pi), (after - before).norm(dim=-1)
    return [law.flatten().numpy() for law in laws]


def test_a_track_depends_on_its_own_detections_alone():
    models = ornstein_uhlenbeck([20.0, 2.0], [0.7, 1.2], [0.0])
    _, tracks = wandering(3, models, SEEN_S, 0.05, seed=4)
    bank, timeline = Bank(models, speed_mps=1.0), timeline_of(96)
    together = draw_tracks(bank, tracks, timeline, 8)
    torch.testing.assert_close(together, draw_tracks(bank, tracks, timeline, 8), rtol=0, atol=0)
    alone = torch.cat([draw_tracks(bank, tracks[torch.tensor([row])], timeline, 8) for row in range(3)])
    torch.testing.assert_close(together, alone)


def test_agents_come_and_go_and_may_be_asked_for_before_and_after():
    models = ornstein_uhlenbeck([20.0], [0.7], [0.0])
    time_s = torch.tensor([[20.5, 40.2, 40.2], [70.0, 71.0, 90.0]]).double()
    tracks = tracks_of(time_s, torch.zeros(2, 3, 2), begin_s=[20.5, 60.0], end_s=[40.2, 200.0])
    is_there = ~torch.isnan(draw_tracks(Bank(models, speed_mps=1.0), tracks, timeline_of(96), 4)[..., 0])
    assert (is_there == is_there[:, :1]).all()
    assert [row.nonzero()[[0, -1], 0].tolist() for row in is_there[:, 0]] == [[20, 41], [60, 95]]
    assert (is_there[:, 0].sum(1) == torch.tensor([22, 36])).all()


def test_one_detection_is_enough():
    drawn = draw_tracks(Bank(speed_mps=1.0), tracks_of([[3.4]], [[[5.0, 6.0]]]), timeline_of(40), 200)
    is_there = ~torch.isnan(drawn[0, 0, :, 0])
    assert is_there.nonzero()[:, 0].tolist() == [3, 4]
    assert float((drawn[0, :, 3].mean(0) - torch.tensor([5.0, 6.0])).abs().max()) < 0.5


def test_a_model_that_cannot_have_been_is_not_drawn():
    # a target that stands still in the first half and runs in the second
    time_s = torch.arange(0, 128, 4).double()
    x = torch.where(time_s < 64, 0.01 * (time_s % 8), 1.5 * (time_s - 64))
    tracks = tracks_of(time_s[None], torch.stack([x, 0 * x], -1)[None], sigma_m=0.02)
    bank = Bank(ornstein_uhlenbeck([100.0], [0.01, 1.5], [0.0]), speed_mps=1.0)
    timeline = timeline_of(128, 64)
    found = Plan.of([bank], torch.zeros(60).long(), tracks, timeline).filtered()
    for stretch in (0, 1):
        share = torch.softmax(found[stretch].log_weight, 0)[found[stretch].model == stretch].sum()
        assert float(share) > 0.999


def test_a_model_is_kept_as_the_bank_says():
    bank = Bank(ornstein_uhlenbeck([100.0], [0.5, 0.5000001], [0.0]), speed_mps=1.0, switch_rate=0.02)
    chains = Chains.of(bank, torch.zeros(1, 10, 2).double(), timeline_of(160, 16))
    uniform = torch.rand(1, 40000, generator=torch.Generator().manual_seed(1)).double()
    first, log_weight = chains.proposed(0, None, uniform)
    second, _ = chains.proposed(1, first, uniform.flip(1))
    assert float(log_weight.abs().max()) < 1e-9  # nothing is known: what is proposed is the prior
    assert abs(float((second != first).double().mean()) - 0.5 * (1.0 - math.exp(-0.02 * 16))) < 0.01


def test_what_led_across_a_gap_is_weighed_as_whole_chains_are():
    # seen at rest, then far away: one of the three stretches was a fast one, and nobody was seen in the second
    time_s = torch.tensor([[0.0, 1.0, 14.0, 40.0, 44.0]]).double()
    x = torch.tensor([0.0, 0.05, 0.4, 9.0, 9.5]).double()
    tracks = tracks_of(time_s, torch.stack([x, 0 * x], -1)[None], sigma_m=0.02)
    bank = Bank(ornstein_uhlenbeck([10.0], [0.05, 0.8], [0.0]), speed_mps=1.0, switch_rate=0.03)
    timeline = timeline_of(45)
    plan = Plan.of([bank], torch.zeros(2000).long(), tracks, timeline)
    log_weight = {chain: _log_weight(plan, chain) for chain in itertools.product((0, 1), repeat=3)}
    total = np.logaddexp.reduce(list(log_weight.values()))
    exact = sum(math.exp(value - total) for chain, value in log_weight.items() if chain[2] == 1)
    last = plan.filtered()[2]
    share = torch.softmax(last.log_weight, 0)[last.model == 1].sum()
    assert 0.1 < exact < 0.9
    assert float(share) == pytest.approx(exact, abs=0.05)


def _log_weight(plan: Plan, chain: tuple[int, ...]) -> float:
    """Log of prior times likelihood of the detections of a plan of one track under a whole chain of models."""
    chains, total = plan.chains[0], math.log(0.5)
    model = plan.models[torch.tensor(chain[:1])]
    mean, covariance = diffuse_start(model, plan.nodes.position_m[:1, 0], torch.tensor([plan.diffuse_m]))
    for stretch, number in enumerate(chain):
        if stretch:
            total += math.log(chains.passes(stretch, torch.tensor(chain[stretch - 1]))[number])
        ends = torch.tensor([16.0 * stretch, min(16.0 * stretch + 16.0, 44.0)]).double()
        nodes, _ = merge_grid(plan.detections(stretch)[:1], ends)
        filtered = filter_from(plan.models[torch.tensor([number])], nodes, mean, covariance)
        mean, covariance = filtered.mean[:, -1], filtered.covariance[:, -1]
        total += float(filtered.log_likelihood)
    return total


def test_stretches_must_be_in_order():
    with pytest.raises(ValueError, match="increase"):
        Timeline(torch.tensor([0.0, 0.0]), torch.tensor([0]), 1.0)
    with pytest.raises(ValueError, match="ascend"):
        Timeline(torch.arange(4).double(), torch.tensor([1, 2]), 1.0)
