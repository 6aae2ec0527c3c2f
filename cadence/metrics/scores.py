"""Proper scores of weighted samples: the energy score (Gneiting and Raftery 2007), lower is better.

Two forms of the spread term E|X - X'| / 2:

* plain: over all pairs, the pairs of a sample with itself among them. The score of the delivered set taken as it is. With K
  independent samples it lies above the score of their law by E|X - X'| / 2K.
* fair: over pairs of different samples, divided by 1 - sum w^2 (Ferro 2014): unbiased for the law of K independent
  samples of equal weight, and the usual generalisation for others.

Plain is the default: what is delivered is a finite weighted set, and dependence between its members (stratified or
antithetic draws, repaired samples) cannot make this score look better than it is, as it can with the fair form. Compare
plain scores only at the same K.
"""

import torch
from torch import Tensor

_MAX_PAIRS = 8_000_000
"""Pairwise distances held at once (64 MB)."""


def energy_score(position_m: Tensor, weight: Tensor, truth_m: Tensor, is_fair: bool = False) -> Tensor:
    """Energy score of the position at every step, metres [B, A, T]; of one coordinate alone it is the CRPS."""
    b, k, a, t, s = position_m.shape
    samples = position_m.double().permute(0, 2, 3, 1, 4).reshape(b * a * t, k, s)
    weights = weight.double()[:, None, None].expand(b, a, t, k).reshape(b * a * t, k)
    return _energy(samples, weights, truth_m.double().reshape(b * a * t, s), is_fair).reshape(b, a, t)


def trajectory_energy_score(
    position_m: Tensor, weight: Tensor, truth_m: Tensor, is_known: Tensor, is_fair: bool = False
) -> Tensor:
    """Energy score of the joint trajectory of all agents over the known steps [B]; NaN without any.

    The distance of two trajectories is the root mean square over the known (agent, step) cells, in metres.
    """
    b, k = weight.shape
    count = is_known.flatten(1).sum(dim=1)
    scale = torch.where(count > 0, count.double().rsqrt(), torch.nan)
    samples = torch.where(is_known[:, None, ..., None], position_m.double(), 0.0).reshape(b, k, -1)
    truth = torch.where(is_known[..., None], truth_m.double(), 0.0).reshape(b, -1)
    return _energy(samples, weight.double(), truth, is_fair) * scale


def _energy(samples: Tensor, weight: Tensor, truth: Tensor, is_fair: bool) -> Tensor:
    """Energy score of rows: samples [R, K, D], weight [R, K], truth [R, D] -> [R]."""
    k = weight.shape[1]
    rows = max(1, _MAX_PAIRS // (k * k))
    chunks = zip(torch.split(samples, rows), torch.split(weight, rows), torch.split(truth, rows), strict=True)
    parts = [_energy_rows(points, mass, target, is_fair) for points, mass, target in chunks]
    return torch.cat(parts) if parts else samples.new_zeros(0)


def _energy_rows(samples: Tensor, weight: Tensor, truth: Tensor, is_fair: bool) -> Tensor:
    to_truth = (weight * torch.linalg.vector_norm(samples - truth[:, None], dim=-1)).sum(dim=1)
    # The exact mode: matrix products lose half of the digits for close samples far from the datum.
    pairs = torch.cdist(samples, samples, compute_mode="donot_use_mm_for_euclid_dist")
    spread = torch.einsum("rk,rkl,rl->r", weight, pairs, weight)
    if is_fair:
        spread = spread / (1.0 - weight.square().sum(dim=1))
    score: Tensor = to_truth - 0.5 * spread
    return score
