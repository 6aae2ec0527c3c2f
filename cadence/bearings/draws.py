"""Weighted joint samples of the exact posterior, by importance sampling from cells.

Cells of one model share its law of tracks, so that it cancels: a sample of model c has the weight

    L(x) / sum_l beta_l G_l(x) / size_l,    over the cells l of model c,

with L the exact likelihood, G_l the kernels of a cell, and beta_l its share of the samples (deterministic mixture: Veach and
Guibas 1995; Owen and Zhou 2000). The mean weight is the evidence. Any cells are right in the end; how many samples count says
how good they are. Where few do, what all samples miss is taken for outliers and left out of the kernels, never of the
likelihood, and then ranges are spaced more finely. That what fits well may yet be an outlier is not sought.
"""

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from cadence.bank.smoother import Backward, Nodes, backward_kernel, draw
from cadence.bearings.cells import Cells, Prior, Problem, first_cells, refined
from cadence.bearings.linear import Sights, turned
from cadence.bearings.profiles import Profiles, supposed_tracks
from cadence.resampling import effective_number, resample, systematic

_MOST_MODELS = 8
_MOST_CELLS = 1024
_LEAST_SIZE = 10.0
"""Cells so much smaller than the largest, as logarithms, are left out."""
_NUM_REFINED = 3
_ENOUGH = 0.1
"""Of the samples that are to count; below it other cells are tried."""
_TOLD = 0.5
"""Power of the first sizes by which models are drawn, as these are rough."""
_COARSE, _FINE = 1.8, 1.35
_MOST_TRIES = 4
_MOST_DEVIATIONS = 3.5
_MOST_OUTLIERS = 0.2
_DAMPED = 0.3
"""Power of the weights that tell outliers: one sample of all the weight would tell of itself."""


@dataclass(frozen=True, eq=False)
class Known:
    """What is known of one agent of one window.

    detections  one row [1, N] of its positions, perhaps none observed
    sights      bearings and ranges, one or more
    nearest_m, farthest_m  ranges that are supposed where none is measured
    begin_s     [1] when the window begins: the prior's place is that of the first node from here on
    supposed_m  [P, M, 2] tracks at the sights that positions make likely; without any, tracks are supposed at several ranges
    likelihood  exact log likelihood [D] of states [D, M, S] at the times that are asked for
    """

    prior: Prior
    detections: Nodes
    sights: Sights
    nearest_m: float
    farthest_m: float
    begin_s: Tensor
    likelihood: Callable[[Tensor], Tensor]
    supposed_m: Tensor | None = None


@dataclass(frozen=True, eq=False)
class Cloud:
    """Weighted samples of one agent.

    state         [D, M, S] at the times that were asked for
    model         [D] which motion model each follows
    weight        [D] sums to one
    log_evidence  log likelihood of all that is known; a perfect measurement has likelihood one
    num_effective how many samples count
    """

    state: Tensor
    model: Tensor
    weight: Tensor
    log_evidence: float
    num_effective: float


def posterior(known: Known, time_s: Tensor, num: int, generator: np.random.Generator) -> Cloud:
    """`num` weighted samples at `time_s` [M] of the posterior given everything: the best of a few tries."""
    best: Cloud | None = None
    is_used, ratio = torch.ones(len(known.sights), dtype=torch.bool), _COARSE
    for _ in range(_MOST_TRIES):
        cloud, is_outlying = _sampled(known, is_used, ratio, time_s, num, generator)
        best = cloud if best is None or cloud.num_effective > best.num_effective else best
        if cloud.num_effective > _ENOUGH * num:
            break
        is_fitting = ~is_outlying if float(is_outlying.double().mean()) <= _MOST_OUTLIERS else is_used
        if torch.equal(is_fitting, is_used):
            if ratio == _FINE or known.supposed_m is not None:
                break
            ratio = _FINE
        is_used = is_fitting
    assert best is not None
    return best


def _sampled(
    known: Known, is_used: Tensor, ratio: float, time_s: Tensor, num: int, generator: np.random.Generator
) -> tuple[Cloud, Tensor]:
    """Samples from cells about some of the sights, and which of all sights [M] they miss."""
    sights = known.sights[is_used]
    if known.supposed_m is None:
        profiles = supposed_tracks(sights, known.nearest_m, known.farthest_m, ratio)
    else:
        profiles = Profiles.about(known.supposed_m[:, is_used])
    problem = Problem(known.prior, known.detections, sights, profiles)
    cells, prior = _few_models(first_cells(problem, known.begin_s), known.prior, float(generator.random()))
    problem, cells = dataclasses.replace(problem, prior=prior), _largest(cells)
    for _ in range(_NUM_REFINED):
        cells = _largest(refined(problem, cells, known.begin_s))
    parts_s = (time_s, known.sights.time_s, sights.time_s, sights.time_s[profiles.anchor_row])
    cells, filtered, index = problem.filtered(cells, torch.cat(parts_s))
    asked, seen, told = (
        index[: len(time_s)],
        index[len(time_s) :][: len(known.sights)],
        index[len(time_s) + len(known.sights) :],
    )
    share = torch.softmax(cells.log_size, 0)
    owner = torch.from_numpy(systematic(share.numpy(), num, float(generator.random())))
    state = _drawn(backward_kernel(filtered), owner, generator)
    log_weight = known.likelihood(state[:, asked]) - _log_density(cells, share, owner, state[:, told, :2])
    weight = torch.softmax(log_weight, 0)
    log_evidence = float(log_weight.logsumexp(0)) - math.log(num)
    cloud = Cloud(state[:, asked], cells.model[owner], weight, log_evidence, effective_number(weight.numpy()))
    missed = torch.softmax(_DAMPED * log_weight, 0) @ _is_missed(known.sights, state[:, seen, :2]).double()
    return cloud, missed > 0.5


def _few_models(cells: Cells, prior: Prior, uniform: float) -> tuple[Cells, Prior]:
    """The cells of a few models, drawn by what they may explain, and a prior that is right in expectation.

    To leave out the smallest cells of all models instead would take away from the far ends of what bearings allow (measured).
    """
    num_models = len(prior.log_weight)
    size = torch.full((num_models, int(cells.profile.max()) + 1), -torch.inf, dtype=torch.float64)
    size[cells.model, cells.profile] = cells.log_size
    chance = torch.softmax(_TOLD * size.logsumexp(1), 0)
    chosen, weight = resample(chance.numpy(), _MOST_MODELS, uniform)
    log_weight = torch.full_like(prior.log_weight, -torch.inf)
    log_weight[chosen] = prior.log_weight[chosen] + torch.from_numpy(weight).log() - chance[chosen].log()
    cells = cells[torch.isin(cells.model, torch.from_numpy(chosen))]
    more = (log_weight - prior.log_weight)[cells.model]
    return dataclasses.replace(cells, log_size=cells.log_size + more), dataclasses.replace(prior, log_weight=log_weight)


def _largest(cells: Cells) -> Cells:
    order = cells.log_size.argsort(descending=True, stable=True)[:_MOST_CELLS]
    return cells[order[cells.log_size[order] > cells.log_size[order[0]] - _LEAST_SIZE]]


def _drawn(kernel: Backward, owner: Tensor, generator: np.random.Generator) -> Tensor:
    """States [D, M, S] at all nodes, of the cell `owner` [D] each."""
    shape = (len(owner), kernel.gain.shape[1] + 1, kernel.gain.shape[-1])
    return draw(kernel, owner, torch.from_numpy(generator.standard_normal(shape)))


def _log_density(cells: Cells, share: Tensor, owner: Tensor, place_m: Tensor) -> Tensor:
    """Log [D] of the denominator of the weights of samples at [D, M, 2]; `owner` [D] is the cell of each."""
    model, log_share = cells.model[owner], share.log() - cells.log_size
    found = torch.empty(len(owner), dtype=torch.float64)
    for one in sorted(set(model.tolist())):
        some, rows = (cells.model == one).nonzero()[:, 0], (model == one).nonzero()[:, 0]
        found[rows] = torch.logsumexp(cells[some].log_kernels(place_m[rows]) + log_share[some], 1)
    return found


def _is_missed(sights: Sights, place_m: Tensor) -> Tensor:
    """Which sights [D, M] samples at [D, M, 2] are far from."""
    apart = place_m - sights.observer_m
    error = turned(sights.bearing_rad - torch.atan2(apart[..., 1], apart[..., 0])) / sights.bearing_sigma_rad
    beyond = (sights.ground_m - torch.linalg.vector_norm(apart, dim=-1)) / sights.ground_sigma_m
    is_missed: Tensor = (error.abs() > _MOST_DEVIATIONS) | (beyond.abs() > _MOST_DEVIATIONS)
    return is_missed  # false where nothing was measured
