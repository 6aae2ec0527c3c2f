"""Parts of a window's posterior: which models take part, where steps and detections lie, moments and random numbers."""

from dataclasses import dataclass

import torch
from torch import Tensor

from cadence.bank.smoother import Filtered, Nodes
from cadence.resampling import systematic

MAX_MODELS = 10
"""No more models than this take part in one window."""
MIN_WEIGHT = 5e-3
"""Models below this share of the best one are left out."""


@dataclass(frozen=True, eq=False)
class Chosen:
    """The likeliest models of each row: weight [R, W] (zero where unused), and its Q used pairs in row-major order."""

    weight: Tensor
    row: Tensor
    model: Tensor
    pair_weight: Tensor
    first_pair: Tensor


@dataclass(frozen=True, eq=False)
class Numbers:
    """Random numbers of each row's own seed.

    owner   [R, K] which of the row's chosen models draws the hypothesis
    normal  [R, K, M, S] for the nodes
    uniform [R, K, T, 2] and kick [R, K, T, S] for the continuation after the last detection
    """

    owner: Tensor
    normal: Tensor
    uniform: Tensor
    kick: Tensor


def choose_models(log_posterior: Tensor) -> Chosen:
    """The likeliest models of each row [R, C], at most `MAX_MODELS`, weights normalised; never none."""
    weight, model = torch.softmax(log_posterior, dim=1).topk(min(MAX_MODELS, log_posterior.shape[1]), dim=1)
    weight = torch.where(weight >= MIN_WEIGHT * weight[:, :1], weight, torch.zeros_like(weight))
    weight = weight / weight.sum(1, keepdim=True)
    is_used = weight > 0
    row = is_used.nonzero()[:, 0]
    return Chosen(weight, row, model[is_used], weight[is_used], torch.searchsorted(row, torch.arange(len(weight))))


def drawn_pairs(chosen: Chosen, owner: Tensor) -> tuple[Chosen, Tensor]:
    """The pairs that draw any hypothesis, and which of its row's pairs [R, K] draws each: the others need no filter.

    Args:
        chosen: the models of every row.
        owner: [R, K] which of the row's chosen models draws the hypothesis.
    """
    pair = chosen.first_pair[:, None] + owner
    is_drawn = torch.zeros(len(chosen.row), dtype=torch.bool)
    is_drawn[pair.flatten()] = True
    row = chosen.row[is_drawn]
    first_pair = torch.searchsorted(row, torch.arange(len(owner)))
    number = is_drawn.cumsum(0) - 1
    kept = Chosen(chosen.weight, row, chosen.model[is_drawn], chosen.pair_weight[is_drawn], first_pair)
    return kept, number[pair] - first_pair[:, None]


def at_node(filtered: Filtered, chosen: Chosen, index: Tensor, node: Tensor, num_models: int) -> tuple[Tensor, Tensor, Tensor]:
    """Filtered moments at one node a row, and weights, spread out over C models [R, C, ...]."""
    num_rows = len(node)
    pair = torch.arange(len(chosen.row))
    at = node[chosen.row]
    mean = torch.zeros(num_rows, num_models, *filtered.mean.shape[2:], dtype=torch.float64)
    covariance = torch.zeros(num_rows, num_models, *filtered.covariance.shape[2:], dtype=torch.float64)
    weight = torch.zeros(num_rows, num_models, dtype=torch.float64)
    mean[chosen.row, index] = filtered.mean[pair, at]
    covariance[chosen.row, index] = filtered.covariance[pair, at]
    weight[chosen.row, index] = chosen.pair_weight
    return mean, covariance, weight


def merge_grid(rows: Nodes, time_s: Tensor) -> tuple[Nodes, Tensor]:
    """Grid steps and detections in one time order, and where the grid steps [R, T] ended up."""
    num_rows, num_steps = len(rows.time_s), len(time_s)
    grid = time_s.double().expand(num_rows, num_steps)
    # padding goes behind the last step: each row's own nodes come first, whatever its neighbours are padded to
    detected_s = torch.where(rows.is_observed, rows.time_s, grid[:, -1:])
    time, order = torch.cat([grid, detected_s], dim=1).sort(dim=1, stable=True)
    position = torch.cat([torch.zeros(num_rows, num_steps, 2, dtype=torch.float64), rows.position_m], dim=1)
    eye = torch.eye(2, dtype=torch.float64).expand(num_rows, num_steps, 2, 2)
    covariance = torch.cat([eye, rows.covariance_m2], dim=1)
    observed = torch.cat([torch.zeros(num_rows, num_steps, dtype=torch.bool), rows.is_observed], dim=1)
    step_index = torch.argsort(order, dim=1)[:, :num_steps]
    pick = order[..., None]
    nodes = Nodes(
        time,
        position.gather(1, pick.expand(-1, -1, 2)),
        covariance.gather(1, pick[..., None].expand(-1, -1, 2, 2)),
        observed.gather(1, order),
    )
    return nodes, step_index


def mixture_moments(mean: Tensor, variance: Tensor, chosen: Chosen) -> tuple[Tensor, Tensor]:
    """Mean [R, T, 2] and variance an axis [R, T] of mixtures whose Q components have `mean` [Q, T, 2], `variance` [Q, T]."""
    num_rows = len(chosen.weight)
    total = torch.zeros(num_rows, *mean.shape[1:], dtype=torch.float64)
    total.index_add_(0, chosen.row, chosen.pair_weight[:, None, None] * mean)
    spread = variance + 0.5 * ((mean - total[chosen.row]) ** 2).sum(-1)
    mixed = torch.zeros(num_rows, mean.shape[1], dtype=torch.float64)
    mixed.index_add_(0, chosen.row, chosen.pair_weight[:, None] * spread)
    return total, mixed


def random_numbers(
    weight: Tensor, rows: Nodes, seeds: Tensor, num_hypotheses: int, num_nodes: int, num_steps: int, size: int
) -> Numbers:
    """Each row draws from its own seed and only for its own nodes, so that its neighbours in the batch do not matter.

    Models are allotted to hypotheses by systematic resampling, in random order; states have length `size`.
    """
    num_rows, k = len(weight), num_hypotheses
    owner = torch.empty(num_rows, k, dtype=torch.int64)
    normal = torch.zeros(num_rows, k, num_nodes, size, dtype=torch.float64)
    uniform = torch.empty(num_rows, k, num_steps, 2, dtype=torch.float64)
    kick = torch.empty(num_rows, k, num_steps, size, dtype=torch.float64)
    num_detections = rows.is_observed.sum(-1).tolist()
    for row, seed in enumerate(seeds.tolist()):
        generator = torch.Generator().manual_seed(seed)
        start = torch.rand(1, generator=generator, dtype=torch.float64).item()
        order = torch.randperm(k, generator=generator)
        owner[row] = torch.from_numpy(systematic(weight[row].numpy(), k, start))[order]
        used = num_steps + num_detections[row]
        drawn = torch.randn(k, used, size, generator=generator, dtype=torch.float64)
        normal[row, :, : used - 1] = drawn[:, :-1]
        # samples are drawn backwards from the last node, which may be padding: its numbers are the ones that spread the end
        normal[row, :, -1] = drawn[:, -1]
        uniform[row] = torch.rand(k, num_steps, 2, generator=generator, dtype=torch.float64)
        kick[row] = torch.randn(k, num_steps, size, generator=generator, dtype=torch.float64)
    return Numbers(owner, normal, uniform, kick)
