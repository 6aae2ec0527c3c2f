"""All limits together: what one of them moves must not break another."""

import pytest
import torch
from torch import Tensor

from cadence.constraints.checker import segments_in_collision
from cadence.constraints.limits import KeepOut, within_limits
from cadence.constraints.obstacles import Obstacles
from cadence.constraints.speed import exceeds

LONGEST_M = 3.0
DATUM = torch.tensor([[100.0, -40.0], [90.0, -35.0]], dtype=torch.float64)[:, None, None]
LOW, HIGH = torch.tensor([80.0, -60.0]).double(), torch.tensor([115.0, -25.0]).double()
EDGE = (LOW - DATUM, HIGH - DATUM)
WALL = Obstacles(torch.tensor([[108.0, -30.0, 4.0], [100.0, -50.0, 3.0]], dtype=torch.float64))


def walks(num: int = 40, steps: int = 60) -> Tensor:
    """Random walks [2, K, T, 2] from their datum, some far beyond the map."""
    generator = torch.Generator().manual_seed(3)
    step = 2.5 * torch.randn(2, num, steps, 2, generator=generator, dtype=torch.float64)
    step[:, :, 0] = 0.0
    return step.cumsum(dim=2)


def kept(keep_out: KeepOut) -> tuple[Tensor, Tensor]:
    track = walks()
    is_first = (torch.arange(track.shape[2]) == 0).expand(track.shape[:-1])
    return within_limits(track, keep_out, is_first, LONGEST_M, is_first)


def test_no_state_leaves_the_map_and_no_step_becomes_longer() -> None:
    keep_out = KeepOut(Obstacles.none(), 0.0, DATUM, EDGE)
    assert not bool(keep_out.is_inside(walks()).all())
    moved, is_clear = kept(keep_out)
    place = moved + DATUM
    assert bool(is_clear.all()) and bool(((place >= LOW) & (place <= HIGH)).all())
    assert not bool(exceeds(moved, LONGEST_M).any())
    assert torch.equal(moved[:, :, 0], walks()[:, :, 0])


def test_obstacles_edge_and_speed_hold_together_or_it_is_said() -> None:
    moved, is_clear = kept(KeepOut(WALL, 0.0, DATUM, EDGE))
    good = is_clear & ~exceeds(moved, LONGEST_M)
    assert float(good.double().mean()) > 0.8
    place = (moved + DATUM)[good]
    assert bool(((place >= LOW - 1e-6) & (place <= HIGH + 1e-6)).all())
    assert not bool(segments_in_collision(place, WALL).any())


def test_a_way_round_that_leaves_the_map_is_not_clear() -> None:
    """The obstacle closes the map from edge to edge: there is no way to the other side."""
    ring = torch.tensor([[104.0, -70.0], [108.0, -70.0], [108.0, -10.0], [104.0, -10.0]], dtype=torch.float64)
    wall = Obstacles(torch.zeros(0, 3, dtype=torch.float64), ((ring,),))
    across = torch.linspace(0.0, 14.0, 30).double()[None, None, :, None] * torch.tensor([1.0, 0.0]).double()
    ends = torch.zeros(1, 1, 30, dtype=torch.bool)
    ends[..., [0, -1]] = True
    edge = (EDGE[0][:1], EDGE[1][:1])
    assert within_limits(across, KeepOut(wall, 0.0, DATUM[:1]), ends, None, ends)[1].all()
    assert not within_limits(across, KeepOut(wall, 0.0, DATUM[:1], edge), ends, None, ends)[1].any()


@pytest.mark.parametrize("has_edge", [False, True])
def test_what_keeps_all_limits_is_bit_identical(has_edge: bool) -> None:
    still = torch.zeros(2, 3, 10, 2, dtype=torch.float64)
    is_first = (torch.arange(10) == 0).expand(2, 3, 10)
    moved, is_clear = within_limits(still, KeepOut(WALL, 0.0, DATUM, EDGE if has_edge else None), is_first, 1.0, is_first)
    assert torch.equal(moved, still) and bool(is_clear.all())
