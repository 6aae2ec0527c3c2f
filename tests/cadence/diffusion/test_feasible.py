"""Constraints on hypotheses: guided while drawn, repaired at the end, weighed; and drawing again by weight."""

import dataclasses
import math
from typing import Any

import pytest
import torch
from test_general import network

from cadence.bank.bank import Bank
from cadence.bank.plausible import TopSpeed
from cadence.constraints.agility import Agility
from cadence.constraints.checker import segments_in_collision, states_in_collision
from cadence.constraints.limits import KeepOut
from cadence.constraints.obstacles import Obstacles
from cadence.constraints.speed import exceeds
from cadence.diffusion import general
from cadence.diffusion.feasible import Feasibility, resampled
from cadence.diffusion.general import GeneralModel
from cadence.diffusion.settings import GuidanceConfig
from cadence.types import Context, Detections, WindowBatch

NUM = 8
DATUM = torch.tensor([[1000.0, -500.0], [3000.0, 200.0]], dtype=torch.float64)
TIMES = torch.tensor([-15.0, -14.0, -13.0, -3.0, -2.0, -1.0], dtype=torch.float64)


def line() -> WindowBatch:
    """Two targets that go east at one metre a second, exactly seen before and after a long gap; the second one slower."""
    place = torch.stack([TIMES, 0.05 * TIMES**2], -1) * torch.tensor([1.0, 0.8]).double()[:, None, None]
    covariance = torch.zeros(2, 1, 6, 2, 2, dtype=torch.float64)
    detections = Detections(TIMES.expand(2, 1, 6), place[:, None], covariance, torch.ones(2, 1, 6, dtype=torch.bool))
    grid = torch.arange(24, dtype=torch.float64) - 15
    return WindowBatch(grid, detections, torch.tensor([5, 6]), 15)


WINDOWS = line()
BANK = Bank().fit(WINDOWS.detections, 1.0)
MODEL = GeneralModel(BANK, network(0.2), is_smooth=False)
POSTERIOR = BANK.posterior(WINDOWS, NUM)
LENGTH_M = BANK.length_m(1.0)
PINNED = (TIMES + 15).long()


def in_the_way() -> Obstacles:
    """A circle in each row's frame on the mean way through the gap, and one ahead."""
    middle = POSTERIOR.mean_m[:, 8] + DATUM
    ahead = POSTERIOR.mean_m[:, 20] + DATUM
    radius = torch.full((2, 1), 1.0, dtype=torch.float64)
    return Obstacles(torch.cat([torch.cat([middle, radius], 1), torch.cat([ahead, radius], 1)]))


OBSTACLES = in_the_way()
KEEP_OUT = KeepOut(OBSTACLES, 0.0, DATUM[:, None, None])
LIMITS = Feasibility(KEEP_OUT, 1.0)
NO_LIMITS = Feasibility(dataclasses.replace(KEEP_OUT, obstacles=Obstacles.none()), 1.0)


def sampled(limits: Feasibility | None = None) -> torch.Tensor:
    """What the network makes of the bank's samples, guided but not repaired."""
    return MODEL.denoised(POSTERIOR, WINDOWS, None if limits is None else limits.guide)


def num_inside(position: torch.Tensor) -> int:
    return int(states_in_collision(position, OBSTACLES, offset_m=DATUM[:, None, None]).sum())


def test_guidance_leads_out_and_repair_finishes() -> None:
    plain, guided = sampled(), sampled(LIMITS)
    assert num_inside(guided) < 0.5 * num_inside(plain)
    moved, weight, is_feasible = LIMITS.finish(guided, POSTERIOR.sigma_m, LENGTH_M)
    assert is_feasible.all() and num_inside(moved) == 0
    assert not segments_in_collision(moved, OBSTACLES, offset_m=DATUM[:, None, None]).any()
    assert torch.equal(moved[:, :, PINNED], guided[:, :, PINNED])
    seen = WINDOWS.detections.position_m
    assert (moved[:, :, PINNED] - seen).norm(dim=-1).max() < 15e-3 * LENGTH_M
    torch.testing.assert_close(weight.sum(1), torch.ones(2, dtype=torch.float64))
    assert weight.min() > 0


def test_without_obstacles_guided_is_unguided() -> None:
    plain, guided = sampled(), sampled(NO_LIMITS)
    torch.testing.assert_close(guided, plain, atol=1e-4 * LENGTH_M, rtol=1e-4)
    moved, weight, is_feasible = NO_LIMITS.finish(plain, POSTERIOR.sigma_m, LENGTH_M)
    assert moved is plain and is_feasible.all()
    assert torch.equal(weight, torch.full((2, NUM), 1.0 / NUM, dtype=torch.float64))


def test_samples_obey_the_obstacles_of_the_windows() -> None:
    """`sample` is guidance, repair and weights in one; without a context or with mode "none" there is nothing to obey."""
    here = WINDOWS.with_context(Context(DATUM, obstacles=OBSTACLES))
    found = MODEL.sample(here, NUM)
    moved, weight, _ = LIMITS.finish(sampled(LIMITS), POSTERIOR.sigma_m, LENGTH_M)
    assert torch.equal(found.position_m[:, :, 0], moved) and torch.equal(found.weight, weight)
    assert num_inside(found.position_m[:, :, 0]) == 0
    plain = MODEL.sample(WINDOWS, NUM)
    assert torch.equal(plain.position_m[:, :, 0], sampled())
    careless = dataclasses.replace(MODEL, guidance=GuidanceConfig("none")).sample(here, NUM)
    assert torch.equal(careless.position_m, plain.position_m)


def test_guidance_keeps_what_is_certain_and_what_is_clear() -> None:
    position = POSTERIOR.sample_m
    sigma = POSTERIOR.sigma_m.clone()
    sigma[:, 8] = 0.0
    moved = LIMITS.guide(position, sigma, slice(0, 2))
    assert torch.equal(moved[:, :, 8], position[:, :, 8])
    distance, _ = OBSTACLES.signed_distance(position, offset_m=DATUM[:, None, None])
    assert torch.equal(moved[distance > 0], position[distance > 0])
    second = LIMITS.guide(position[1:], sigma[1:], slice(1, 2))  # each row has a datum of its own
    assert torch.equal(second, moved[1:])
    assert not torch.equal(LIMITS.guide(position[1:], sigma[1:], slice(0, 1)), second)


def test_a_speed_limit_slows_down() -> None:
    fast = dataclasses.replace(NO_LIMITS, max_speed_mps=0.5 * LENGTH_M)
    sigma = torch.full_like(POSTERIOR.sigma_m, 100.0)
    far = POSTERIOR.sample_m + 3.0 * torch.randn(POSTERIOR.sample_m.shape, generator=torch.Generator().manual_seed(0))
    before, after = (torch.diff(p, dim=2).norm(dim=-1).max() for p in (far, fast.guide(far, sigma, slice(0, 2))))
    assert after < 0.8 * before


@pytest.mark.parametrize(("obstacles", "bend", "turn_deg"), [(Obstacles.none(), 0.6, 40.0), (OBSTACLES, 1.5, 80.0)])
def test_stated_acceleration_and_turns_hold_in_every_hypothesis(obstacles: Obstacles, bend: float, turn_deg: float) -> None:
    """With speed and obstacles: what keeps them not is drawn again. Round an obstacle as small as a step not all rows can."""
    stated = GuidanceConfig("clean", 0.0, 6.0 * LENGTH_M, bend * LENGTH_M, turn_deg)
    found = dataclasses.replace(MODEL, guidance=stated).sample(WINDOWS.with_context(Context(DATUM, obstacles=obstacles)), NUM)
    is_ok = torch.tensor([row[0] == "ok" for row in found.status])
    assert bool(is_ok.any()) and (obstacles.count or bool(is_ok.all()))
    track = found.position_m[is_ok][:, :, 0]
    agility = Agility(bend * LENGTH_M, math.radians(turn_deg), 0.05 * LENGTH_M, 6.0 * LENGTH_M)
    assert not bool(agility.exceeds(track).any())
    assert not bool(states_in_collision(track, obstacles, offset_m=DATUM[is_ok][:, None, None]).any())
    assert bool(agility.exceeds(MODEL.sample(WINDOWS, NUM).position_m[:, :, 0]).any())


def test_where_few_keep_the_limits_more_are_drawn_and_what_stays_scarce_says_so() -> None:
    """Limits from loose to ones that nothing keeps: never a few tracks drawn again and again without a word."""
    words = []
    for speed_mps in (8.0, 2.2, 1.9, 1.75, 1.6, 0.3):
        stated = GuidanceConfig("repair", 0.0, speed_mps * LENGTH_M)
        here = WINDOWS.with_context(Context(DATUM, obstacles=OBSTACLES))
        found = dataclasses.replace(MODEL, guidance=stated).sample(here, NUM)
        for row, (word,) in enumerate(found.status):
            num_distinct = len(torch.unique(found.position_m[row, :, 0].flatten(1), dim=0))
            words.append(word)
            assert word != "ok" or num_distinct >= NUM // 2
            assert word in ("infeasible", "scarce") or not bool(exceeds(found.position_m[row], speed_mps * LENGTH_M).any())
    assert {"ok", "infeasible"} <= set(words) <= {"ok", "infeasible", "scarce"}


def test_chosen_from_more_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    """A margin that one draw in four keeps: without more draws two of eight are left, with them all eight differ."""
    stated = GuidanceConfig("none")
    finish = Feasibility.finish

    def every_fourth(limits: Feasibility, position_m: torch.Tensor, *args: Any) -> tuple[torch.Tensor, ...]:
        moved, weight, _ = finish(limits, position_m, *args)
        is_kept = (torch.arange(position_m.shape[1]) % 4 == 0).expand(position_m.shape[:2])
        return moved, weight, is_kept

    monkeypatch.setattr(Feasibility, "finish", every_fourth)
    model = dataclasses.replace(MODEL, guidance=stated)
    for num_more, word, num_distinct in ((8, "ok", 8), (1, "scarce", 2)):
        monkeypatch.setattr(general, "_MORE", num_more)
        found = model.sample(WINDOWS, 8)
        assert found.status == ((word,), (word,))
        assert len(torch.unique(found.position_m[0, :, 0].flatten(1), dim=0)) == num_distinct


def test_margin_is_kept() -> None:
    wide = Feasibility(dataclasses.replace(KEEP_OUT, margin_m=0.4), 1.0)
    moved, _, is_feasible = wide.finish(sampled(), POSTERIOR.sigma_m, LENGTH_M)
    assert is_feasible.all()
    distance, _ = OBSTACLES.signed_distance(moved, offset_m=DATUM[:, None, None])
    assert distance.median() > 0.4 and (distance > 0.39).double().mean() > 0.98


def test_what_was_moved_far_counts_less_and_what_cannot_be_repaired_least() -> None:
    still = POSTERIOR.mean_m[:1, None].expand(1, 3, -1, -1).clone()
    still[0, :2] += torch.tensor([0.0, 40.0])  # two clear of everything, one through the circle
    limits = Feasibility(dataclasses.replace(KEEP_OUT, offset_m=DATUM[:1, None, None]), 1.0)
    _, weight, is_feasible = limits.finish(still, POSTERIOR.sigma_m[:1].clamp_min(0.5), LENGTH_M)
    assert is_feasible.all() and weight[0, 0] == weight[0, 1] > weight[0, 2] > 0
    buried = Obstacles(torch.tensor([[1000.0 + float(TIMES[1]), -500.0 + 0.05 * float(TIMES[1]) ** 2, 0.7]]).double())
    limits = Feasibility(dataclasses.replace(limits.keep_out, obstacles=buried), 1.0)
    _, weight, is_feasible = limits.finish(still, POSTERIOR.sigma_m[:1], LENGTH_M)
    assert is_feasible.tolist() == [[True, True, False]]
    assert weight[0, 2] == pytest.approx(1e-3 * float(weight[0, 0]))
    _, weight, is_feasible = limits.finish(still[:, 2:].expand(1, 4, -1, -1).clone(), POSTERIOR.sigma_m[:1], LENGTH_M)
    assert not is_feasible.any() and weight.tolist() == [[0.25] * 4]


def test_drawn_again_by_weight() -> None:
    """Systematic: every hypothesis appears floor(K w) or ceil(K w) times; rows do not disturb one another."""
    g = torch.Generator().manual_seed(1)
    weight = torch.rand(6, NUM, generator=g, dtype=torch.float64) ** 3
    weight = weight / weight.sum(1, keepdim=True)
    weight[3] = 1.0 / NUM
    name = torch.arange(6 * NUM, dtype=torch.float64).view(6, NUM, 1, 1).expand(6, NUM, 5, 2)
    seeds = torch.arange(6) + 40
    out = resampled(name, weight, seeds)
    assert torch.equal(out[3], name[3])
    for row in range(6):
        drawn = out[row] - row * NUM
        assert torch.equal(drawn, drawn[:, :1, :1].expand(NUM, 5, 2))  # whole hypotheses
        count = torch.bincount(drawn[:, 0, 0].long(), minlength=NUM)
        expected = NUM * weight[row]
        assert count.sum() == NUM and (count >= expected.floor() - 1e-9).all() and (count <= expected.ceil() + 1e-9).all()
        assert torch.equal(resampled(name[row : row + 1], weight[row : row + 1], seeds[row : row + 1])[0], out[row])
    assert torch.equal(resampled(name, weight, seeds), out)
    assert not torch.equal(resampled(name, weight, seeds + 1), out)


def test_weights_are_met_on_average() -> None:
    weight = torch.tensor([[0.05, 0.15, 0.8]], dtype=torch.float64).expand(400, 3)
    name = torch.arange(3, dtype=torch.float64).view(1, 3, 1, 1).expand(400, 3, 1, 2)
    out = resampled(name, weight, torch.arange(400))[..., 0, 0]
    share = torch.bincount(out.long().flatten(), minlength=3) / 1200
    torch.testing.assert_close(share.double(), weight[0], atol=0.04, rtol=0)


def test_hypotheses_keep_the_top_speeds_that_the_log_makes_plausible() -> None:
    top_mps = TopSpeed(1.9).spread(NUM)
    limits = Feasibility.of(WINDOWS, GuidanceConfig(), top_mps)
    wildness = torch.where(POSTERIOR.sigma_m > 0.5 * LENGTH_M, 3.0, 1.0)[:, None, :, None]
    wild_m = POSTERIOR.mean_m[:, None] + wildness * (POSTERIOR.sample_m - POSTERIOR.mean_m[:, None])
    moved, _, is_kept = limits.finish(wild_m, POSTERIOR.sigma_m, LENGTH_M)
    assert exceeds(wild_m, top_mps[:, None]).any() and not exceeds(moved, top_mps[:, None]).any()
    assert is_kept.all() and torch.equal(moved[:, :, PINNED], wild_m[:, :, PINNED])
    stated = Feasibility.of(WINDOWS, GuidanceConfig(max_speed_mps=1.85), top_mps).longest_m
    assert isinstance(stated, torch.Tensor) and stated.max() == 1.85


@pytest.mark.parametrize("seen_mps", [1.1, 1.4, 1.6])
def test_a_way_round_may_be_a_little_faster_than_is_plausible(seen_mps: float) -> None:
    limits = dataclasses.replace(LIMITS, plausible_mps=TopSpeed(seen_mps).spread(NUM))
    moved, _, is_kept = limits.finish(POSTERIOR.sample_m, POSTERIOR.sigma_m, LENGTH_M)
    most_m = TopSpeed(seen_mps).spread(NUM).max()
    assert torch.equal(is_kept, ~exceeds(moved, 1.3 * most_m))
    assert (exceeds(moved, most_m) & is_kept).any() and not is_kept.all()
