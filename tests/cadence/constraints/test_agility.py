"""Limits on acceleration and turn: kept exactly by the least smoothing, or not at all."""

import math

import pytest
import torch
from torch import Tensor

from cadence.constraints.agility import Agility, calmed, turns
from cadence.constraints.speed import exceeds

SIGMA = torch.full((2, 50), 5.0, dtype=torch.float64)
SIGMA[:, [0, 20]] = 1e-3


def tracks(num: int = 30) -> Tensor:
    """Tracks [2, K, 50, 2] that drift east and shake."""
    generator = torch.Generator().manual_seed(5)
    step = torch.randn(2, num, 50, 2, generator=generator, dtype=torch.float64) + torch.tensor([2.0, 0.0])
    track = step.cumsum(dim=2)
    return track - track[:, :, :1]


def test_turns_by_hand() -> None:
    """East, north, a step without length, north, west by 45 degrees."""
    track = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [1.0, 1.001], [1.0, 2.0], [0.0, 3.0]]).double()
    found = [math.degrees(angle) for angle in turns(track, 0.01).tolist()]
    assert found == pytest.approx([90.0, 0.0, 0.0, 45.0])


@pytest.mark.parametrize(
    "agility",
    [
        Agility(max_bend_m=0.4),
        Agility(max_turn_rad=math.radians(12.0), least_m=0.1),
        Agility(max_bend_m=0.4, max_turn_rad=math.radians(12.0), least_m=0.1, longest_m=3.0),
    ],
)
def test_what_is_calmed_keeps_every_limit_and_its_detections(agility: Agility) -> None:
    track = tracks()
    assert agility.exceeds(track).all()
    calm = calmed(track, SIGMA, agility)
    is_kept = ~agility.exceeds(calm)
    assert float(is_kept.double().mean()) > 0.95
    kept = calm[is_kept]
    if agility.max_bend_m is not None:
        assert float(kept.diff(n=2, dim=-2).norm(dim=-1).max()) <= agility.max_bend_m * (1 + 1e-6)
    if agility.longest_m is not None:
        assert not exceeds(kept, agility.longest_m).any()
    assert float((calm - track)[:, :, [0, 20]].norm(dim=-1).max()) < 0.01  # where something was seen
    assert torch.equal(calm[~is_kept], track[~is_kept])


def test_calm_tracks_are_bit_identical_and_do_not_disturb_others() -> None:
    track = tracks()
    straight = torch.linspace(0.0, 90.0, 50).double()[:, None] * torch.tensor([1.0, 0.5]).double()
    track[0, 3] = straight
    calm = calmed(track, SIGMA, Agility(max_bend_m=0.4))
    assert torch.equal(calm[0, 3], straight)
    alone = calmed(track[1:], SIGMA[1:], Agility(max_bend_m=0.4))
    torch.testing.assert_close(alone[0], calm[1])
    assert torch.equal(calmed(track, SIGMA, Agility(max_bend_m=1e6)), track)


def test_a_looser_limit_smooths_less() -> None:
    track = tracks()
    moved = [
        float((calmed(track, SIGMA, Agility(max_bend_m=bend_m)) - track).norm(dim=-1).mean()) for bend_m in (0.3, 1.0, 3.0)
    ]
    assert moved[0] > moved[1] > moved[2] > 0.0


def test_what_cannot_be_is_left_as_it_is() -> None:
    """Three places held to a millimetre, a right angle between them."""
    corner = torch.tensor([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0]]).double()[None, None]
    agility = Agility(max_turn_rad=0.1, least_m=0.1)
    calm = calmed(corner, torch.full((1, 3), 1e-3, dtype=torch.float64), Agility(max_bend_m=1.0))
    assert torch.equal(calm, corner) and bool(agility.exceeds(corner).all())
