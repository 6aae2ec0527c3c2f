"""Steps by hand; the speed hinge against autograd, with parked tracks."""

import itertools
import math

import pytest
import torch

from cadence.constraints.motion import SpeedConstraint, step_lengths

L_TRACK = torch.tensor([[0.0, 0.0], [3.0, 4.0], [6.0, 8.0], [2.0, 11.0], [2.0, 11.0]], dtype=torch.float64)


def test_steps_by_hand():
    assert step_lengths(L_TRACK).tolist() == [5, 5, 5, 0]


def test_gradient_is_that_of_the_cost():
    track = torch.randn(3, 20, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64).requires_grad_()
    constraint = SpeedConstraint(1.2, 1.0)
    constraint.cost(track).sum().backward()
    torch.testing.assert_close(track.grad, constraint.gradient(track))
    assert constraint.cost(track).shape == (3,)
    assert (constraint.gradient(track) != 0).any()


def test_a_parked_track_costs_nothing_and_has_a_finite_gradient():
    parked = torch.zeros(4, 2).requires_grad_()
    constraint = SpeedConstraint(1.0, 1.0)
    cost = constraint.cost(parked)
    cost.backward()
    assert cost.item() == 0
    assert torch.isfinite(parked.grad).all() and (constraint.gradient(parked) == 0).all()


def test_unit_descent_slows_a_track_down():
    track = torch.cumsum(torch.randn(50, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 3, dim=0)
    constraint = SpeedConstraint(3.0, 1.0)
    costs = []
    for _ in range(300):
        costs.append(constraint.cost(track).item())
        track = track - constraint.gradient(track)
    assert all(after <= before for before, after in itertools.pairwise(costs))
    assert costs[-1] < 1e-3 * costs[0]


@pytest.mark.parametrize(("speed", "step"), [(0.0, 1.0), (-1.0, 1.0), (1.0, 0.0), (math.nan, 1.0)])
def test_meaningless_limits_are_refused(speed, step):
    with pytest.raises(ValueError, match="above zero"):
        SpeedConstraint(speed, step)
