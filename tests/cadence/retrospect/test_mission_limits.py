import math

import torch

from cadence.constraints.obstacles import Obstacles
from cadence.retrospect.limits import MissionLimits

TIME_S = torch.arange(80).double()
NOWHERE = torch.zeros(2, dtype=torch.float64)


def ways(num: int, sigma_m: float, seed: int = 0) -> torch.Tensor:
    """Tracks eastward at 1 m/s that wander between steps 0, 40 and 79, where all agree."""
    g = torch.Generator().manual_seed(seed)
    bump = torch.sin(math.pi * TIME_S / 40.0).abs() ** 0.5
    bump[[0, 40, 79]] = 0.0
    straight = torch.stack([TIME_S, torch.zeros_like(TIME_S)], -1)
    return straight + sigma_m * bump[:, None] * torch.randn(num, 80, 2, generator=g, dtype=torch.float64)


def limits(obstacles: Obstacles | None = None, **changes) -> MissionLimits:
    values = {"max_speed_mps": None, "plausible_speed_mps": None} | changes
    return MissionLimits(obstacles or Obstacles.none(), 0.1, NOWHERE, length_m=1.0, **values)


def every(way_m: torch.Tensor) -> torch.Tensor:
    return torch.ones(way_m.shape[:2], dtype=torch.bool)


def test_a_speed_is_kept_exactly_and_what_is_known_stays():
    way_m = ways(50, 1.0)
    rule = limits(max_speed_mps=1.6)
    moved, replaced = rule.mended(way_m, TIME_S, 0)
    assert rule.keeps(moved, every(moved), TIME_S).all() and not replaced.any()
    torch.testing.assert_close(moved[:, [0, 40, 79]], way_m[:, [0, 40, 79]])
    assert len({row.numpy().tobytes() for row in moved}) == 50


def test_uneven_steps_may_be_as_long_as_their_time():
    time_s = torch.cat([TIME_S[:40], 40.0 + 5.0 * torch.arange(40).double()])
    way_m = ways(30, 1.0)
    way_m[:, :, 0] += time_s - TIME_S
    rule = limits(plausible_speed_mps=1.4)
    assert not rule.keeps(way_m, every(way_m), time_s).all()
    moved, _ = rule.mended(way_m, time_s, 0)
    assert rule.keeps(moved, every(moved), time_s).all()


def test_obstacles_are_gone_round():
    rule = limits(Obstacles(torch.tensor([[20.0, 0.0, 2.0], [60.0, 1.0, 3.0]]).double()))
    way_m = ways(20, 0.3)
    assert not rule.keeps(way_m, every(way_m), TIME_S).any()
    moved, _ = rule.mended(way_m, TIME_S, 0)
    assert rule.keeps(moved, every(moved), TIME_S).all()


def test_what_cannot_be_mended_gives_its_place_to_what_keeps_the_limits():
    way_m = ways(10, 0.1)
    way_m[7, 30:50, 1] += 100.0
    rule = limits(max_speed_mps=3.0)
    moved, replaced = rule.mended(way_m, TIME_S, 0)
    assert rule.keeps(moved, every(moved), TIME_S).all()
    assert replaced.nonzero()[:, 0].tolist() in ([7], [])
    way_m = ways(10, 0.01)
    impossible = limits(max_speed_mps=0.5)
    moved, replaced = impossible.mended(way_m, TIME_S, 0)
    assert not replaced.any() and torch.isfinite(moved).all()


def test_where_there_is_no_limit_or_no_track_nothing_is_moved():
    way_m = ways(3, 1.0)
    assert limits().mended(way_m, TIME_S, 0)[0] is way_m
    nowhere = torch.full_like(way_m, torch.nan)
    assert limits(max_speed_mps=1.0).mended(nowhere, TIME_S, 0)[0] is nowhere


def test_steps_that_nobody_asked_for_count_for_nothing():
    way_m = ways(4, 0.0)
    way_m[0, 60:] += 500.0
    asked = every(way_m)
    asked[0, 60:] = False
    rule = limits(Obstacles(torch.tensor([[579.0, 500.0, 2.0]]).double()), max_speed_mps=2.0)
    assert rule.keeps(way_m, asked, TIME_S).all() and not rule.keeps(way_m, every(way_m), TIME_S)[0]
