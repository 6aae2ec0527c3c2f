"""How far joint hypotheses of several agents are from the truth, for `rendezvous.py`."""

import dataclasses
import itertools

import numpy as np
import torch
from torch import Tensor

from cadence import metrics
from cadence.arrays import Float64s
from cadence.recordings import ForecastWindows
from cadence.types import HypothesisSet
from cadence.worlds.joint import meets
from cadence.worlds.rendezvous_map import SITES_M

HORIZONS = (0, 29, 59, 89, 119)
MEETING_M = 1500.0
"""Half of the least distance of two sites. Truth meets as often at 300 m; hypotheses may be a kilometre off."""
RADII_M = (500.0, 1000.0, MEETING_M, 2000.0, 3000.0)


@dataclasses.dataclass(frozen=True, eq=False)
class Scores:
    """What one estimator got, a value a window [B] or a window and horizon [B, H], in metres unless said otherwise.

    at_step, ade, least  error of single hypotheses at the step and on average up to it, and of the best joint hypothesis
    mean_error           of the mean of the hypotheses
    joint, joint_set     energy score of all agents' tracks as one vector; the same with the kindest order of agents
    is_inside            [B, H] share of agents inside the 90 % region
    meets                [B, R] share of hypotheses in which all agents meet at one site, for the radii `RADII_M`
    """

    at_step: Tensor
    ade: Tensor
    least: Tensor
    mean_error: Tensor
    joint: Tensor
    joint_set: Tensor
    is_inside: Tensor
    meets: Float64s

    @staticmethod
    def of(drawn: HypothesisSet, windows: ForecastWindows, has_names: bool) -> "Scores":
        """Where the origin is unknown, the agents of every hypothesis are put in the order that suits the truth best."""
        truth, weight = windows.truth_m.double(), drawn.weight.double()
        position = drawn.position_m.double()
        is_known = torch.ones(truth.shape[:-1], dtype=torch.bool)
        joint = metrics.trajectory_energy_score(position, weight, truth, is_known)
        joint_set = torch.stack([set_energy(p, t) for p, t in zip(position, truth, strict=True)])
        absolute = position + windows.context.datum_m[:, None, None, None]
        share = np.stack([meets(absolute.numpy(), SITES_M, radius_m).mean(axis=1) for radius_m in RADII_M], axis=1)
        if not has_names:
            position = torch.stack([arranged(p, t) for p, t in zip(position, truth, strict=True)])
        at = list(HORIZONS)
        error = metrics.expected_distance(position, weight, truth).mean(dim=1)  # [B, T], mean over agents
        upto = error.cumsum(dim=1) / torch.arange(1, truth.shape[2] + 1)
        least = metrics.min_ade_distance(position, weight, truth, is_known, is_joint=True).mean(dim=1)
        mean_error = metrics.mean_error(position, weight, truth).mean(dim=1)[:, at]
        inside = metrics.coverage(position[:, :, :, at], weight, truth[:, :, at], (0.9,))[0].mean(dim=1)
        return Scores(error[:, at], upto[:, at], least[:, at], mean_error, joint, joint_set, inside, share)


def arranged(position: Tensor, truth: Tensor) -> Tensor:
    """Hypotheses [K, A, T, 2], the agents of each in the order of least error."""
    orders = torch.tensor(list(itertools.permutations(range(position.shape[1]))))
    cost = (position[:, :, None] - truth[None, None]).norm(dim=-1).sum(dim=-1)  # [K, drawn, true]
    total = torch.stack([cost[:, order, torch.arange(len(order))].sum(dim=1) for order in orders], dim=1)
    best = orders[total.argmin(dim=1)]  # [K, A]
    return position.gather(1, best[:, :, None, None].expand_as(position))


def set_energy(position: Tensor, truth: Tensor) -> Tensor:
    """Energy score of hypotheses [K, A, T, 2] whose agents have no order: distances are those of the best matching."""
    k, a = position.shape[:2]
    flat = torch.cat([position, truth[None]]).flatten(2)  # [K + 1, A, T * 2]
    squared = torch.cdist(flat.flatten(0, 1), flat.flatten(0, 1)).square().reshape(k + 1, a, k + 1, a).permute(0, 2, 1, 3)
    orders = list(itertools.permutations(range(a)))
    least = torch.stack([squared[:, :, torch.arange(a), list(order)].sum(dim=-1) for order in orders]).amin(dim=0)
    distance = (least / (a * truth.shape[1])).sqrt()
    return distance[:k, k].mean() - 0.5 * distance[:k, :k].mean()
