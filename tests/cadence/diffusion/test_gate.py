"""The gate: a bad network is switched off, a good one draws most hypotheses; and what is withheld to find out."""

import dataclasses
import itertools
import math

import pytest
import torch
from fixtures.bank import as_tracks, random_windows

from cadence.bank.bank import Bank
from cadence.bank.hindsight import withhold
from cadence.diffusion.gate import gated
from cadence.diffusion.general import GeneralModel
from cadence.network.residual import ResidualNetwork, ResidualNetworkConfig
from cadence.types import Detections, WindowBatch

WINDOWS = random_windows(num_windows=10, num_agents=1, num_detections=6, history=16, horizon=8)
BANK = Bank().fit(as_tracks(WINDOWS.detections), 1.0)


def later() -> Detections:
    """Where the bank expects the agents one step and five steps after the origin."""
    posterior = BANK.posterior(WINDOWS, 1)
    steps = torch.tensor([1, 5])
    place = posterior.mean_m[:, WINDOWS.origin_index + steps][:, None]
    covariance = 0.01 * torch.eye(2, dtype=torch.float64).expand(10, 1, 2, 2, 2)
    return Detections(steps.double().expand(10, 1, 2), place, covariance, torch.ones(10, 1, 2, dtype=torch.bool))


LATER = later()
LATER_SIGMA_M = BANK.posterior(WINDOWS, 1).sigma_m[:, [16, 20]][:, None]


def network(bias: float, head_scale: float = 0.0) -> ResidualNetwork:
    with torch.random.fork_rng(devices=[]):
        torch.random.manual_seed(3)
        net = ResidualNetwork(ResidualNetworkConfig(width=8, multipliers=(1, 2))).eval()
        with torch.no_grad():
            net.unet.head.weight.normal_(0.0, head_scale) if head_scale else net.unet.head.weight.zero_()
            net.unet.head.bias.fill_(bias)
    return net


PAST = withhold(random_windows(num_windows=24, num_agents=1, num_detections=8, history=32, horizon=8), 0)


def ratios(model: GeneralModel) -> tuple[float | None, ...]:
    """Of the network, past before future."""
    assert model.gate is not None
    return dataclasses.astuple(model.gate)


@pytest.mark.parametrize(("bias", "head_scale"), [(6.0, 0.0), (0.0, 20.0)])
def test_a_bad_network_is_switched_off(bias: float, head_scale: float) -> None:
    found = gated(GeneralModel(BANK, network(bias, head_scale)), PAST, (WINDOWS, LATER))
    assert max(found.share_past, found.share_future) < 0.1
    assert all(ratio is not None and ratio > 1.05 for ratio in ratios(found))


def test_a_network_that_knows_better_draws_most() -> None:
    """The targets end up two bank sigmas from where the bank expects them; the network has learned just that."""
    moved = dataclasses.replace(LATER, position_m=LATER.position_m + 2.0 * LATER_SIGMA_M[..., None])
    found = gated(GeneralModel(BANK, network(-2.0 / (math.pi / 2))), PAST, (WINDOWS, moved))
    assert found.share_future > 0.7
    assert found.gate is not None and found.gate.future_network is not None and found.gate.future_network < 1.0


def test_a_network_that_answers_zero_ties() -> None:
    found = gated(GeneralModel(BANK, network(0.0)), PAST, (WINDOWS, LATER))
    assert all(ratio == pytest.approx(1.0, abs=1e-4) for ratio in ratios(found))
    torch.testing.assert_close(found.sample(WINDOWS, 3).position_m, BANK.sample(WINDOWS, 3).position_m, atol=1e-4, rtol=1e-4)


def test_with_too_little_to_test_on_it_is_half_and_half() -> None:
    network_model = GeneralModel(BANK, network(6.0))
    few = dataclasses.replace(LATER, is_observed=LATER.is_observed & (torch.arange(10) < 3)[:, None, None])
    found = gated(network_model, PAST, (WINDOWS, few))
    assert [ratio is None for ratio in ratios(found)] == [False, True] and found.share_future == 0.5
    none = gated(network_model, withhold(WINDOWS[:0], 0), (WINDOWS[:0], LATER[:0]))
    assert (none.share_past, none.share_future) == (0.5, 0.5) and ratios(none) == (None, None)
    alone = GeneralModel(BANK, None)
    assert gated(alone, PAST, (WINDOWS, LATER)) is alone


def row(detections: Detections, window: int, agent: int) -> list[tuple[float, ...]]:
    """What one agent's detections say, in their order."""
    seen = detections.is_observed[window, agent]
    columns = [detections.time_s[window, agent][seen][:, None], detections.position_m[window, agent][seen]]
    columns.append(detections.covariance_m2[window, agent][seen].flatten(1))
    return [tuple(values) for values in torch.cat(columns, 1).tolist()]


def split_bursts(detections: list[tuple[float, ...]], apart_s: float) -> list[list[tuple[float, ...]]]:
    bursts = [detections[:1]]
    for before, after in itertools.pairwise(detections):
        if after[0] - before[0] > apart_s:
            bursts.append([])
        bursts[-1].append(after)
    return bursts


def check_withheld(windows: WindowBatch, seed: int) -> int:
    kept, burst = withhold(windows, seed)
    num_withheld = 0
    for window in range(windows.num_windows):
        for agent in range(windows.num_agents):
            whole, left, gone = (row(d, window, agent) for d in (windows.detections, kept.detections, burst))
            assert sorted(left + gone) == sorted(whole) and left == [item for item in whole if item not in gone]
            assert left[:1] == whole[:1] and left[-1:] == whole[-1:]
            bursts = split_bursts(whole, 1.5 * windows.step_s)
            assert bool(gone) == (len(bursts) > 2)
            if gone:
                chosen = bursts.index(gone)
                unlike = {
                    index: abs(math.log((bursts[index + 1][0][0] - bursts[index - 1][-1][0]) / (16.0 * windows.step_s)))
                    for index in range(1, len(bursts) - 1)
                }
                assert unlike[chosen] <= min(unlike.values()) + 1e-5  # what remains is a gap like those that are asked for
            observed = kept.detections.is_observed[window, agent]
            assert torch.equal(observed, torch.arange(len(observed)) < len(left))  # padding last
            num_withheld += len(gone)
    return num_withheld


@pytest.mark.parametrize("seed", range(4))
def test_one_burst_is_withheld_and_never_an_end(seed: int) -> None:
    windows = random_windows(num_windows=8, num_agents=2, num_detections=9, seed=seed, history=16, horizon=8)
    assert check_withheld(windows, seed) > 8
    assert torch.equal(withhold(windows, seed)[1].is_observed, withhold(windows, seed)[1].is_observed)
