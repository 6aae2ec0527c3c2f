"""Distances between hypotheses and truth. The displacement error at a horizon is `expected_distance` at that step."""

import torch
from torch import Tensor


def expected_distance(position_m: Tensor, weight: Tensor, truth_m: Tensor) -> Tensor:
    """Weighted mean over the hypotheses of the distance to the truth, metres [B, A, T].

    At one step this is the paper's displacement error (FDE where the step is the last one).
    """
    return _over_hypotheses(weight, distance_to_truth(position_m, truth_m))


def ade(position_m: Tensor, weight: Tensor, truth_m: Tensor, is_known: Tensor) -> Tensor:
    """Average displacement error [B, A]: the expected distance averaged over the known steps; NaN without any."""
    return masked_mean(expected_distance(position_m, weight, truth_m), is_known)


def mean_error(position_m: Tensor, weight: Tensor, truth_m: Tensor) -> Tensor:
    """Distance of the weighted mean position to the truth, metres [B, A, T]."""
    mean_m = torch.einsum("bk,bkats->bats", weight.double(), position_m.double())
    error: Tensor = torch.linalg.vector_norm(mean_m - truth_m.double(), dim=-1)
    return error


def min_ade_distance(position_m: Tensor, weight: Tensor, truth_m: Tensor, is_known: Tensor, is_joint: bool = False) -> Tensor:
    """Distance at every step of the hypothesis with the least summed error over the known steps, metres [B, A, T].

    The hypothesis is chosen for each agent, or with `is_joint` once for all of a window's agents. Hypotheses of weight
    zero cannot be chosen; otherwise the weights do not matter, so compare only sets of the same number of hypotheses.
    """
    distance_m = distance_to_truth(position_m, truth_m)
    summed_m = torch.where(is_known[:, None], distance_m, 0.0).sum(dim=-1)  # [B, K, A]
    if is_joint:
        # An inactive agent (NaN) must not decide for the others.
        summed_m = torch.nan_to_num(summed_m, nan=0.0).sum(dim=-1, keepdim=True).expand_as(summed_m)
    summed_m = summed_m.masked_fill((weight <= 0)[:, :, None], torch.inf)
    best = summed_m.argmin(dim=1)  # [B, A]
    index = best[:, None, :, None].expand(-1, 1, -1, distance_m.shape[-1])
    return distance_m.gather(1, index).squeeze(1)


def min_ade(position_m: Tensor, weight: Tensor, truth_m: Tensor, is_known: Tensor, is_joint: bool = False) -> Tensor:
    """`min_ade_distance` averaged over the known steps, metres [B, A]; NaN without any."""
    return masked_mean(min_ade_distance(position_m, weight, truth_m, is_known, is_joint), is_known)


def spread(position_m: Tensor, weight: Tensor) -> Tensor:
    """Root of the weighted mean squared distance of the hypotheses to their mean, metres [B, A, T].

    Hypotheses without the agent (NaN) are left out; NaN where no hypothesis has it.
    """
    is_there = position_m.isfinite().all(dim=-1)
    share = weight.double()[:, :, None, None] * is_there
    # weights of an agent that is in every hypothesis sum to one already, but for the last bit
    share = torch.where(is_there.all(dim=1, keepdim=True), share, share / share.sum(dim=1, keepdim=True))
    position_m = torch.where(is_there[..., None], position_m.double(), 0.0)
    mean_m = (share[..., None] * position_m).sum(dim=1, keepdim=True)
    return (share * (position_m - mean_m).square().sum(dim=-1)).sum(dim=1).sqrt()


def masked_mean(values: Tensor, is_known: Tensor) -> Tensor:
    """Mean over the last axis of the values that are known; NaN where none is."""
    return torch.where(is_known, values, 0.0).sum(dim=-1) / is_known.sum(dim=-1)


def distance_to_truth(position_m: Tensor, truth_m: Tensor) -> Tensor:
    """Distance of every hypothesis to the truth, metres [B, K, A, T]."""
    distance: Tensor = torch.linalg.vector_norm(position_m.double() - truth_m.double()[:, None], dim=-1)
    return distance


def _over_hypotheses(weight: Tensor, values: Tensor) -> Tensor:
    return torch.einsum("bk,bkat->bat", weight.double(), values)
