"""How hypotheses move: step lengths against those of the truth, and states inside obstacles."""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class StepLengths:
    """Length of one step in metres, over all hypotheses (weighted) and known steps.

    `roughness_m` is the mean length of the second difference: jitter shows there before it shows in the length.
    """

    mean_m: float
    median_m: float
    p95_m: float
    roughness_m: float


def step_length_statistics(position_m: Tensor, weight: Tensor, is_known: Tensor) -> StepLengths:
    """Statistics of the hypotheses' steps between known steps; NaN where there are none.

    The truth is measured in the same way as one hypothesis of weight one: `truth_m[:, None]`, `torch.ones(B, 1)`.
    """
    first = position_m.double().diff(dim=3)
    length_m, mass = _known(first, weight, is_known[..., 1:] & is_known[..., :-1])
    is_triple = is_known[..., 2:] & is_known[..., 1:-1] & is_known[..., :-2]
    bend_m, bend_mass = _known(first.diff(dim=3), weight, is_triple)
    return StepLengths(
        mean_m=_weighted_mean(length_m, mass),
        median_m=_weighted_quantile(length_m, mass, 0.5),
        p95_m=_weighted_quantile(length_m, mass, 0.95),
        roughness_m=_weighted_mean(bend_m, bend_mass),
    )


def collision_share(is_inside: Tensor, weight: Tensor, is_known: Tensor) -> Tensor:
    """Weighted share of states inside an obstacle [B]: is_inside [B, K, A, T] bool; NaN for windows without known steps.

    `is_known` here says which cells count (active agents; pass all True for every state).
    """
    share = torch.einsum("bk,bkat->bat", weight.double(), is_inside.double())
    return torch.where(is_known, share, 0.0).flatten(1).sum(dim=1) / is_known.flatten(1).sum(dim=1)


def _known(difference_m: Tensor, weight: Tensor, is_known: Tensor) -> tuple[Tensor, Tensor]:
    """Lengths and masses, flat, of differences [B, K, A, T', 2] where known [B, A, T']."""
    length_m = torch.linalg.vector_norm(difference_m, dim=-1)
    chosen = is_known[:, None].expand_as(length_m)
    return length_m[chosen], weight.double()[:, :, None, None].expand_as(length_m)[chosen]


def _weighted_mean(values: Tensor, mass: Tensor) -> float:
    return float((values * mass).sum() / mass.sum())


def _weighted_quantile(values: Tensor, mass: Tensor, level: float) -> float:
    if not len(values):
        return float("nan")
    values, order = values.sort()
    reached = mass[order].cumsum(dim=0)
    return float(values[int(torch.searchsorted(reached, level * reached[-1]).clamp(max=len(values) - 1))])
