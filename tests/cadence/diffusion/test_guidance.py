"""Guidance: pinned steps stay, what sigma allows becomes feasible, the paper's Adam does what Adam does."""

import math

import pytest
import torch

from cadence.constraints.motion import SpeedConstraint, step_lengths
from cadence.constraints.obstacles import ObstacleConstraint, Obstacles
from cadence.diffusion.guidance import PaperCost, adam_guidance, clean_estimate_guidance

HILL = Obstacles(torch.tensor([[0.0, 0.0, 10.0]], dtype=torch.float64))


def through_the_hill(num=41):
    x = torch.linspace(-40, 40, num)
    return torch.stack([x, torch.full_like(x, 2.0)], dim=-1)


def test_no_constraint_and_no_violation_change_nothing():
    track, scale = through_the_hill() + 100, torch.ones(41, 1)
    assert torch.equal(clean_estimate_guidance(track, [], scale), track)
    assert torch.equal(clean_estimate_guidance(track, [ObstacleConstraint(HILL)], scale), track)


def test_pinned_steps_stay_exactly():
    track, scale = through_the_hill(), torch.full((41, 1), 20.0)
    scale[20] = 0
    moved = clean_estimate_guidance(track, [ObstacleConstraint(HILL, 1.0), SpeedConstraint(1.0, 1.0)], scale)
    assert torch.equal(moved[20], track[20])
    assert not torch.equal(moved[19], track[19])


def test_converges_to_feasible_where_sigma_allows():
    constraint = ObstacleConstraint(HILL, margin_m=1.0)
    track = through_the_hill()
    moved = clean_estimate_guidance(track, [constraint], torch.full((41, 1), 50.0), num_steps=8)
    distance, _ = HILL.signed_distance(moved)
    assert distance.min() > 0.99
    tight = clean_estimate_guidance(track, [constraint], torch.full((41, 1), 0.1), num_steps=8)
    assert HILL.signed_distance(tight)[0].min() < -5


def test_steps_are_bounded_and_grow_with_the_violation():
    track = torch.tensor([[0.0, 9.0], [0.0, 1.0]])
    moved = clean_estimate_guidance(track, [ObstacleConstraint(HILL)], torch.full((2, 1), 4.0), num_steps=1)
    shift = (moved - track).norm(dim=-1)
    assert shift[0].item() == pytest.approx(16 / 17)
    assert shift.max() <= 2.0
    assert clean_estimate_guidance(track, [ObstacleConstraint(HILL)], torch.full((2, 1), 4.0), 1, 0.5)[0, 1].item() == (
        pytest.approx(9 + 8 / 17)
    )


def test_batches_and_translation():
    track = through_the_hill().double().expand(2, 3, 41, 2)
    scale = torch.full((2, 3, 41, 1), 9.0, dtype=torch.float64)
    alone = clean_estimate_guidance(track[0, 0], [ObstacleConstraint(HILL)], scale[0, 0])
    torch.testing.assert_close(clean_estimate_guidance(track, [ObstacleConstraint(HILL)], scale)[1, 2], alone)
    offset = torch.tensor([[500.0, -300.0]], dtype=torch.float64)
    shifted = clean_estimate_guidance(track - offset, [ObstacleConstraint(HILL, offset_m=offset)], scale)
    torch.testing.assert_close(shifted + offset, clean_estimate_guidance(track, [ObstacleConstraint(HILL)], scale))


def test_speed_and_obstacle_together_stay_finite_on_parked_tracks():
    parked = torch.zeros(2, 10, 2)
    moved = clean_estimate_guidance(parked, [ObstacleConstraint(HILL), SpeedConstraint(1.0, 1.0)], torch.ones(2, 10, 1))
    assert torch.isfinite(moved).all()


def test_adam_is_a_fresh_adam():
    mean = torch.randn(3, 5, 2, generator=torch.Generator().manual_seed(0))
    once = adam_guidance(mean, lambda x: x.square().sum(dim=(-2, -1)), lr=1e-2, iterations=1)
    # Adam's first step is lr times the sign of the gradient, whatever its size.
    torch.testing.assert_close(once, mean - 1e-2 * mean.sign(), atol=1e-6, rtol=0)
    assert torch.equal(adam_guidance(mean, lambda x: x.sum(), iterations=0), mean)


def test_adam_works_without_grad_and_leaves_its_input():
    mean = through_the_hill() / 50
    kept = mean.clone()
    with torch.no_grad():
        moved = adam_guidance(mean, lambda x: PaperCost(HILL, unit_m=50.0).cost(50 * x))
    assert torch.equal(mean, kept) and not moved.requires_grad
    cost = PaperCost(HILL, unit_m=50.0)
    assert cost.cost(50 * moved) < cost.cost(50 * mean)


def test_papers_cost_by_hand():
    track = torch.tensor([[0.0, 0.0], [5.0, 0.0], [25.0, 0.0]], dtype=torch.float64)
    assert PaperCost(HILL).cost(track).item() == pytest.approx(7 * 1.5 / 3 + 50 * 12.5)
    assert PaperCost(HILL, unit_m=10.0).cost(track).item() == pytest.approx(7 * 1.5 / 3 + 50 * 1.25)


def test_papers_cost_is_finite_on_parked_tracks():
    parked = torch.zeros(2, 4, 2, dtype=torch.float64)
    assert torch.isfinite(PaperCost(HILL).gradient(parked)).all()
    assert torch.isfinite(adam_guidance(parked, PaperCost(HILL).cost)).all()


def test_the_papers_step_cost_freezes_tracks_and_the_hinge_does_not():
    track = through_the_hill() + torch.tensor([0.0, 100.0])
    assert step_lengths(adam_guidance(track, PaperCost(HILL).cost, lr=0.1)).mean() < step_lengths(track).mean()
    slow = clean_estimate_guidance(track, [SpeedConstraint(3.0, 1.0)], torch.full((41, 1), math.inf))
    assert torch.equal(slow, track)
