"""The speed limit: kept exactly, with the ends where they were, by the nearest track; what cannot keep it is said."""

import itertools

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from cadence.constraints.speed import exceeds, limit_steps, needed_speed


def tracks(num: int = 50, steps: int = 30, seed: int = 0) -> Tensor:
    """Random walks with a jump here and there."""
    generator = torch.Generator().manual_seed(seed)
    step = torch.randn(num, steps, 2, generator=generator, dtype=torch.float64)
    is_jump = torch.rand(num, steps, 1, generator=generator, dtype=torch.float64) < 0.05
    return torch.where(is_jump, 8.0 * step, step).cumsum(dim=1)


def pins(num: int, steps: int, *indices: int) -> Tensor:
    pinned = torch.zeros(num, steps, dtype=torch.bool)
    pinned[:, list(indices)] = True
    return pinned


def test_a_track_that_keeps_the_limit_is_bit_identical() -> None:
    track = tracks()
    moved, is_kept = limit_steps(track, pins(50, 30, 0, 29), 1e6)
    assert torch.equal(moved, track) and bool(is_kept.all())


@given(st.integers(0, 10_000), st.sets(st.integers(0, 29), min_size=1, max_size=6))
def test_the_limit_holds_and_pinned_steps_stay_where_that_can_be(seed: int, pinned: set[int]) -> None:
    track, longest = tracks(20, seed=seed), 3.0
    where = pins(20, 30, *pinned)
    moved, is_kept = limit_steps(track, where, longest)
    assert torch.equal(moved[where], track[where])
    assert torch.equal(is_kept, ~exceeds(moved, longest))
    order = sorted(pinned)
    can = torch.ones(20, dtype=torch.bool)
    for first, second in itertools.pairwise(order):
        can &= (track[:, second] - track[:, first]).norm(dim=-1) <= longest * (second - first) * (1 - 1e-6)
    assert bool((is_kept | ~can).all())


def test_one_jump_is_spread_over_its_neighbours_by_hand() -> None:
    """Four steps of which one is 4 long lead 4 east; the nearest with none over 2 gives 1 to each of the others... in part."""
    track = torch.tensor([[[0.0, 0.0], [0.0, 0.0], [4.0, 0.0], [4.0, 0.0]]], dtype=torch.float64)
    moved, is_kept = limit_steps(track, pins(1, 4, 0, 3), 2.0)
    assert bool(is_kept) and moved[0, :, 0].tolist() == pytest.approx([0.0, 1.0, 3.0, 4.0], abs=1e-6)


def test_each_track_keeps_a_limit_of_its_own() -> None:
    track, where = tracks(), pins(50, 30, 0)
    longest = torch.linspace(1.0, 4.0, 50, dtype=torch.float64)[:, None]
    moved, is_kept = limit_steps(track, where, longest)
    assert bool(is_kept.all())
    for row in (0, 20, 49):
        alone, _ = limit_steps(track[row : row + 1], where[:1], float(longest[row]))
        torch.testing.assert_close(moved[row], alone[0])


def test_free_ends_are_only_shortened() -> None:
    track = torch.tensor([[[0.0, 0.0], [0.0, 6.0], [1.0, 6.0], [9.0, 6.0]]], dtype=torch.float64)
    moved, is_kept = limit_steps(track, pins(1, 4, 1), 2.0)
    assert bool(is_kept) and moved[0].tolist() == [
        pytest.approx(place) for place in ([0.0, 4.0], [0.0, 6.0], [1.0, 6.0], [3.0, 6.0])
    ]


def test_two_pins_too_far_apart_are_not_kept_and_the_rest_is() -> None:
    track = torch.tensor([[[0.0, 0.0], [9.0, 0.0], [9.0, 9.0]]], dtype=torch.float64)
    moved, is_kept = limit_steps(track, pins(1, 3, 0, 1), 2.0)
    assert not bool(is_kept) and moved[0, 2].tolist() == pytest.approx([9.0, 2.0])


def test_the_speed_that_detections_ask_for() -> None:
    """Between 10 s and 12 s 100 m, of which 4 m may be noise, in the second row 40; the third row has one detection only."""
    time_s = torch.tensor([[0.0, 10.0, 12.0, 99.0]]).double().expand(3, 4)
    place = torch.tensor([[0.0, 0.0], [30.0, 0.0], [30.0, 100.0], [5000.0, 0.0]]).double().expand(3, 4, 2)
    sigma = torch.tensor([[1.0], [10.0], [1.0]]).double().expand(3, 4)
    is_observed = torch.tensor([[True, True, True, False], [True, True, True, False], [True, False, False, False]])
    speed, gap_s = needed_speed(time_s, place, sigma, is_observed)
    assert speed.tolist() == pytest.approx([48.0, 30.0, 0.0]) and gap_s.tolist() == [2.0, 2.0, 0.0]
    none = needed_speed(time_s[:, :1], place[:, :1], sigma[:, :1], is_observed[:, :1])
    assert none[0].tolist() == [0.0] * 3
