"""Guidance: pushing samples towards what the constraints allow while they are drawn.

`adam_guidance` is the paper's procedure (algorithm 1); `clean_estimate_guidance` is the default here. The final,
exact step is `cadence.constraints.repair`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from cadence.constraints import Constraint
from cadence.constraints.motion import step_lengths
from cadence.constraints.obstacles import ObstacleConstraint, Obstacles


def adam_guidance(mean: Tensor, cost_fn: Callable[[Tensor], Tensor], lr: float = 1e-2, iterations: int = 8) -> Tensor:
    """The posterior mean [..., T, 2] after a few steps of a fresh Adam on the cost, through autograd.

    Algorithm 1 of Ye et al., MRS 2023, with the learning rate and the iterations of their code. The mean is whatever
    the sampler walks in (normalised units there); `cost_fn` maps it to costs of any shape, which are summed. Adam steps are
    about `lr` long whatever the size of the violation.
    """
    with torch.enable_grad():
        moved = mean.detach().clone().requires_grad_(True)
        adam = torch.optim.Adam([moved], lr=lr)
        for _ in range(iterations):
            adam.zero_grad()
            cost = cost_fn(moved).sum()
            cost.backward()  # type: ignore[no-untyped-call]
            adam.step()
    return moved.detach()


@dataclass(frozen=True)
class PaperCost:
    """J = 7 · mountain + 50 · mean step length, the cost of the paper's algorithm 1.

    `unit_m` is the length in metres of one unit of the step length (half the map side where positions are normalised to
    [-1, 1], as in the paper); the mountain term has no unit.
    """

    obstacles: Obstacles
    unit_m: float = 1.0
    mountain_weight: float = 7.0
    step_weight: float = 50.0
    offset_m: Tensor | None = None

    def cost(self, position_m: Tensor) -> Tensor:
        """Cost [...] of tracks position_m [..., T, 2] in metres; differentiable, gradients finite also for parked tracks."""
        mountain = self.obstacles.mountain_cost(position_m, offset_m=self.offset_m)
        return self.mountain_weight * mountain + self.step_weight * step_lengths(position_m).mean(dim=-1) / self.unit_m

    def gradient(self, position_m: Tensor) -> Tensor:
        """Gradient of `cost`, like position_m (by autograd, as in the paper)."""
        with torch.enable_grad():
            position = position_m.detach().requires_grad_(True)
            (gradient,) = torch.autograd.grad(self.cost(position).sum(), position)
        return gradient


def clean_estimate_guidance(
    position_m: Tensor,
    constraints: Sequence[Constraint],
    scale_m: Tensor,
    num_steps: int = 4,
    strength: float = 1.0,
) -> Tensor:
    """The clean estimate [..., T, 2] moved towards what the constraints allow, as far as it is uncertain.

    scale_m [..., T, 1] is the local standard deviation: zero (at exact detections) means that a step stays where it is.
    Every step is s² / (s² + g²) of the violation g: all of a violation that is small against the uncertainty,
    never more than strength · s / 2. Steps whose sigma allows it converge to feasible.
    """
    if len(constraints) == 1 and isinstance(constraints[0], ObstacleConstraint) and num_steps > 1:
        # of obstacles each position knows by itself: what lies clear of them stays, and need not be looked at again
        moved = clean_estimate_guidance(position_m, constraints, scale_m, 1, strength)
        is_moved = (moved != position_m).any(dim=-1)
        own = constraints[0].at(is_moved)
        scale_m = scale_m.expand(*is_moved.shape, 1)[is_moved]
        moved[is_moved] = clean_estimate_guidance(moved[is_moved], [own], scale_m, num_steps - 1, strength)
        return moved
    variance = scale_m.square()
    for _ in range(num_steps):
        gradient = torch.zeros_like(position_m)
        for constraint in constraints:
            gradient = gradient + constraint.gradient(position_m)
        squared = gradient.square().sum(dim=-1, keepdim=True)
        # As s² / (s² + g²), without infinity over infinity where nothing is known, and exactly zero where s is.
        gain = (variance > 0) / (1 + squared / variance.clamp_min(torch.finfo(variance.dtype).tiny))
        position_m = position_m - strength * gain * gradient
    return position_m
