"""MapScore: how early the true cell comes when a map is searched from the most probable cell on.

R = (0.5 - r) / 0.5 with r the share of the map's cells that are more probable than the true one, half of the equally probable
ones counted (Koester and others, MapScore, 2014): 1 for the very first cell, 0 for a random order, -1 for the last. The larger
the map, the higher the score of the same forecast: only scores on the same map compare.
"""

import torch
from torch import Tensor

_MAX_PAIRS = 500_000
"""Of a place and a hypothesis at once: what a processor keeps near."""


def map_score(density: Tensor, at_truth: Tensor) -> Tensor:
    """MapScore [R] of densities [R, N] at the N equal cells of a map, and at the cell of the truth [R]."""
    truth = at_truth[:, None]
    is_tied = (density - truth).abs() <= 1e-9 * truth.abs()
    denser = (~is_tied & (density > truth)).double().mean(dim=1)
    score: Tensor = (0.5 - denser - 0.5 * is_tied.double().mean(dim=1)) / 0.5
    return score


def map_density(position_m: Tensor, weight: Tensor, place_m: Tensor, cell_m: float) -> Tensor:
    """Density [R, N], up to a factor, at places [R, N, 2] of hypotheses [R, K, 2] with weights [R, K].

    Each hypothesis is spread by a kernel 1 / (1 + d² / h²)² about as wide as its neighbours are far, at least half a cell. Its
    tail orders places that no hypothesis is near to by their distance, where a count of cells would find them all equal.
    """
    num_hypotheses, num_places = position_m.shape[1], place_m.shape[1]
    rows = max(1, _MAX_PAIRS // (num_hypotheses * max(num_places, num_hypotheses)))
    # about the hypotheses: squares of far coordinates would cost digits
    middle_m = position_m.double().mean(dim=1, keepdim=True)
    position_m, weight, place_m = position_m.double() - middle_m, weight.double(), place_m.double() - middle_m
    parts = [slice(row, row + rows) for row in range(0, len(position_m), rows)]
    found = [_density_rows(position_m[part], weight[part], place_m[part], cell_m) for part in parts]
    return torch.cat(found) if found else place_m.new_zeros(0, num_places)


def _density_rows(position_m: Tensor, weight: Tensor, place_m: Tensor, cell_m: float) -> Tensor:
    """The sum over hypotheses of weight h² / (h² + d²)², where one product of matrices gives h² + d² of all pairs."""
    between = torch.cdist(position_m, position_m, compute_mode="donot_use_mm_for_euclid_dist")
    near = min(position_m.shape[1], 1 + int(position_m.shape[1] ** 0.5))
    square_m2 = between.kthvalue(near, dim=-1).values.clamp_min(0.5 * cell_m).square()  # [R, K]
    length_m2 = (position_m.square().sum(-1) + square_m2)[..., None]
    of_hypotheses = torch.cat([-2.0 * position_m, torch.ones_like(length_m2), length_m2], dim=-1)
    of_places = torch.cat([place_m, place_m.square().sum(-1, keepdim=True), torch.ones_like(place_m[..., :1])], dim=-1)
    kernel = (of_places @ of_hypotheses.mT).square_().reciprocal_()  # [R, N, K]
    return (kernel @ (weight * square_m2)[..., None])[..., 0]


def ring_density(distance_m: Tensor, radii_m: Tensor, shares: Tensor) -> Tensor:
    """Density [R, N] of the distance rings of search and rescue at distances [R, N] from where a target was last seen.

    The target is within the radii [R, Q] with the shares [Q]; in a ring all places are alike, and what is left outside the last
    one lies within twice its radius.
    """
    outer = torch.cat([radii_m, 2.0 * radii_m[:, -1:]], dim=1).clamp_min(1e-9)
    inner = torch.cat([torch.zeros_like(radii_m[:, :1]), outer[:, :-1]], dim=1)
    share = torch.diff(torch.cat([torch.zeros(1), shares.float(), torch.ones(1)]).double())
    density = share / (outer.square() - inner.square()).clamp_min(1e-12)
    ring = torch.searchsorted(outer.double(), distance_m.double().contiguous())  # [R, N]: so many radii are less
    padded = torch.cat([density, torch.zeros_like(density[:, :1])], dim=1)
    return padded.gather(1, ring)
