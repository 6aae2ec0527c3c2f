"""The general preset as an estimator: answers of zero, exact detections, seeds, neighbours, agents, shares, guides."""

import dataclasses
import math

import pytest
import torch
from fixtures.bank import as_tracks, random_windows
from torch import Tensor

from cadence.bank.bank import Bank
from cadence.bank.fitting import FLOOR_STEPS
from cadence.diffusion import general
from cadence.diffusion.general import GeneralModel
from cadence.diffusion.transport import bend_of
from cadence.network.residual import ResidualNetwork, ResidualNetworkConfig
from cadence.types import Detections, WindowBatch

WINDOWS = random_windows(num_windows=3, num_detections=5, history=16, horizon=8)
BANK = Bank().fit(as_tracks(WINDOWS.detections), 1.0)
NUM = 4


def network(head_scale: float = 0.3, bias: float = 0.0, seed: int = 0) -> ResidualNetwork:
    """A small network with random weights; `head_scale` 0 answers `bias` everywhere."""
    with torch.random.fork_rng(devices=[]):
        torch.random.manual_seed(seed)
        net = ResidualNetwork(ResidualNetworkConfig(width=8, multipliers=(1, 2), encoder_size=8, level_size=8)).eval()
        with torch.no_grad():
            net.unet.head.weight.normal_(0.0, head_scale) if head_scale else net.unet.head.weight.zero_()
            net.unet.head.bias.fill_(bias)
    return net


MODEL = GeneralModel(BANK, network())


def sampled(model: GeneralModel, windows: WindowBatch = WINDOWS, num: int = NUM) -> Tensor:
    """Positions of the active agents [R, K, T, 2]."""
    return model.sample(windows, num).position_m.transpose(1, 2)[windows.is_active]


def in_sigmas(position: Tensor, other: Tensor, windows: WindowBatch = WINDOWS) -> Tensor:
    return (position - other) / BANK.posterior(windows, 1).sigma_m[:, None, :, None]


def test_without_a_network_the_banks_samples_are_returned() -> None:
    bank = BANK.sample(WINDOWS, NUM)
    for model in (GeneralModel(BANK, None), dataclasses.replace(MODEL, share_past=0.0, share_future=0.0)):
        found = model.sample(WINDOWS, NUM)
        assert torch.equal(found.position_m, bank.position_m)
        assert torch.equal(found.weight, bank.weight) and found.status == bank.status


@pytest.mark.parametrize("num_steps", [1, 2, 7])
def test_an_answer_of_zero_gives_the_bank_back(num_steps: int) -> None:
    fresh = ResidualNetwork(ResidualNetworkConfig(width=8, multipliers=(1, 2)))
    found = sampled(GeneralModel(BANK, fresh.eval(), num_steps=num_steps))
    assert in_sigmas(found, BANK.posterior(WINDOWS, NUM).sample_m).abs().max() < 1e-5
    assert in_sigmas(sampled(MODEL), found).abs().max() > 0.1  # the random network does answer


@pytest.mark.parametrize("num_steps", [1, 5])
def test_a_constant_answer_moves_by_its_integral_over_the_angle(num_steps: int) -> None:
    """By hand: dx/dangle = c from pi/2 to 0 adds -c pi / 2, in bank sigmas, to the hypotheses that are the network's."""
    bias = 0.4
    model = GeneralModel(BANK, network(0.0, bias), num_steps=num_steps, share_past=1.0, share_future=0.25, is_smooth=False)
    shift = in_sigmas(sampled(model), BANK.posterior(WINDOWS, NUM).sample_m) / (-bias * math.pi / 2)
    part = shift[0, :, :, 0]
    torch.testing.assert_close(shift, part[..., None].expand_as(shift), atol=1e-4, rtol=0)
    origin = WINDOWS.origin_index
    torch.testing.assert_close(part[:, : origin - 3], torch.ones(NUM, origin - 3, dtype=torch.float64), atol=1e-4, rtol=0)
    future = part[:, origin + 5 :].round()
    torch.testing.assert_close(part[:, origin + 5 :], future, atol=1e-4, rtol=0)
    assert future.sum(0).tolist() == [1.0] * 4 and torch.equal(future, future[:, :1].expand_as(future))  # a quarter of four
    steps = torch.diff(part)
    assert steps.max() < 1e-4 and steps.min() > -1.0 / 8 - 1e-4  # downhill, without a jump


@pytest.mark.parametrize(("past", "future", "untouched"), [(1.0, 0.0, slice(20, None)), (0.0, 1.0, slice(0, 12))])
def test_where_the_share_is_zero_the_bank_stays(past: float, future: float, untouched: slice) -> None:
    model = dataclasses.replace(MODEL, share_past=past, share_future=future, is_smooth=False)
    shift = in_sigmas(sampled(model), BANK.posterior(WINDOWS, NUM).sample_m).abs()
    assert shift[:, :, untouched].max() < 1e-5 < 0.1 < shift.max()


@pytest.mark.parametrize(("share", "num"), [(0.5, 4), (0.5, 5), (0.3, 10)])
def test_a_share_of_the_hypotheses_is_the_networks_and_the_others_are_the_banks(share: float, num: int) -> None:
    found = sampled(dataclasses.replace(MODEL, share_past=share, share_future=share), num=num)
    from_bank = in_sigmas(found, BANK.posterior(WINDOWS, num).sample_m).abs().amax((0, 2, 3)) < 1e-5
    from_network = in_sigmas(found, sampled(MODEL, num=num)).abs().amax((0, 2, 3)) < 1e-5
    assert torch.equal(from_bank, ~from_network)
    assert int(from_network.sum()) == math.floor(share * num)


@pytest.mark.parametrize("sampler", ["rotation", "ddim", "dpmpp"])
def test_samples_go_through_exact_detections(sampler: str) -> None:
    times = torch.tensor([-13.0, -9.0, -8.0, -2.0], dtype=torch.float64)
    place = torch.randn(2, 1, 4, 2, generator=torch.Generator().manual_seed(4), dtype=torch.float64).cumsum(2)
    covariance = torch.zeros(2, 1, 4, 2, 2, dtype=torch.float64)
    detections = Detections(times.expand(2, 1, 4), place, covariance, torch.ones(2, 1, 4, dtype=torch.bool))
    windows = WindowBatch(WINDOWS.time_s, detections, torch.tensor([1, 2]), WINDOWS.origin_index)
    found = sampled(dataclasses.replace(MODEL, sampler=sampler), windows)
    at = (times + windows.origin_index).long()
    floor_m = FLOOR_STEPS * BANK.length_m(1.0)
    assert floor_m == pytest.approx(1e-3 * BANK.length_m(1.0))
    assert (found[:, :, at] - place).norm(dim=-1).max() < 15.0 * floor_m
    assert (found[:, :, 5] - found[:, :1, 5]).norm(dim=-1).max() > 30.0 * floor_m  # and differ in between


def test_same_seed_same_bytes_and_another_seed_other_samples() -> None:
    first = sampled(MODEL)
    assert torch.equal(first, sampled(MODEL))
    other = sampled(MODEL, dataclasses.replace(WINDOWS, seeds=WINDOWS.seeds + 100))
    assert (first - other).abs().amax((1, 2, 3)).min() > 1e-3


def test_a_window_does_not_depend_on_its_neighbours(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = MODEL.sample(WINDOWS, NUM).position_m
    for index in range(3):
        alone = MODEL.sample(WINDOWS[index : index + 1], NUM).position_m
        torch.testing.assert_close(alone[0], whole[index], atol=1e-4, rtol=1e-4, equal_nan=True)
    monkeypatch.setattr(general, "_MAX_BATCH", NUM + 1)  # one row at a time
    torch.testing.assert_close(MODEL.sample(WINDOWS, NUM).position_m, whole, atol=1e-4, rtol=1e-4, equal_nan=True)


def test_swapping_agents_swaps_their_hypotheses() -> None:
    """A row's stream comes from its window's seed and its place; the seed of the swapped windows makes up for the place."""
    back = 7_919 * pow(1_000_003, -1, 2**62)
    seeds = torch.tensor([(seed - back) % 2**62 for seed in WINDOWS.seeds.tolist()])
    d = WINDOWS.detections
    swapped = Detections(*(value.flip(1) for value in (d.time_s, d.position_m, d.covariance_m2, d.is_observed)))
    found = MODEL.sample(dataclasses.replace(WINDOWS, detections=swapped, seeds=seeds), NUM).position_m
    torch.testing.assert_close(found[:, :, 1], MODEL.sample(WINDOWS, NUM).position_m[:, :, 0], atol=1e-4, rtol=1e-4)


def test_agents_that_were_not_seen_get_nothing() -> None:
    d = WINDOWS.detections
    seen = d.is_observed.clone()
    seen[1, 0] = seen[2] = False
    found = MODEL.sample(dataclasses.replace(WINDOWS, detections=dataclasses.replace(d, is_observed=seen)), NUM)
    assert found.status == (("ok", "ok"), ("no_detections", "ok"), ("no_detections", "no_detections"))
    is_known = torch.isfinite(found.position_m).flatten(3).all(-1)
    assert torch.equal(is_known, seen.any(-1)[:, None].expand(3, NUM, 2))
    torch.testing.assert_close(found.weight, torch.full((3, NUM), 1.0 / NUM, dtype=torch.float64))
    none = dataclasses.replace(WINDOWS, detections=dataclasses.replace(d, is_observed=torch.zeros_like(seen)))
    assert MODEL.sample(none, NUM).position_m.isnan().all()


@pytest.mark.parametrize("sampler", ["rotation", "ddim", "dpmpp"])
def test_guides_see_metres_and_have_the_last_word_on_clean_estimates(sampler: str) -> None:
    """A guide that leaves things alone changes nothing; one that knows the answer gets it."""
    plain = dataclasses.replace(MODEL, sampler=sampler, is_smooth=False)
    rows_seen: list[slice] = []
    sigma = BANK.posterior(WINDOWS, 1).sigma_m

    def keep(position: Tensor, sigma_m: Tensor, rows: slice) -> Tensor:
        assert torch.equal(sigma_m, sigma[rows]) and position.shape == (len(sigma[rows]), NUM, 24, 2)
        rows_seen.append(rows)
        return position

    posterior = BANK.posterior(WINDOWS, NUM)
    kept = in_sigmas(plain.denoised(posterior, WINDOWS, keep), sampled(plain))
    assert kept.abs().max() < 1e-3 and len(rows_seen) == plain.num_steps
    target = BANK.posterior(WINDOWS, 1).mean_m[:, None] + 0.5 * sigma[:, None, :, None]
    slow = dataclasses.replace(plain, num_steps=24)
    led = slow.denoised(posterior, WINDOWS, lambda p, s, r: target[r].expand_as(p))
    assert in_sigmas(led, target).abs().max() < (0.4 if sampler == "rotation" else 1e-3)


def test_what_the_network_adds_is_smooth() -> None:
    """A network of chance shakes the tracks; what is left of that goes as far, but bends half as much."""
    raw = dataclasses.replace(MODEL, is_smooth=False)
    bank = BANK.posterior(WINDOWS, NUM).sample_m
    smooth, rough = (sampled(model) for model in (MODEL, raw))
    assert bend_of(smooth).mean() < 0.6 * bend_of(rough).mean()
    assert in_sigmas(smooth, bank).square().mean() > 0.3 * in_sigmas(rough, bank).square().mean()


def test_fit_fits_the_bank_and_nothing_else() -> None:
    model = dataclasses.replace(MODEL, bank=Bank()).fit(as_tracks(WINDOWS.detections), 1.0)
    assert model.bank.speed_mps == BANK.speed_mps and model.network is MODEL.network
    assert torch.equal(sampled(model), sampled(MODEL))
