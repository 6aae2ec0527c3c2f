"""Cells: one motion model smoothed about one supposed track. Together they propose what the exact likelihood then weighs.

A cell is Gaussian: the model's law of tracks, times detections, times the kernels of measurements made linear, all of which
have peak one, so that cells of different ranges are comparable by their normalisers.
"""

import dataclasses
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from cadence.bank.components import MotionModels
from cadence.bank.mixture import merge_grid
from cadence.bank.smoother import Filtered, Nodes, backward_kernel, diffuse_start, filter_from, smooth
from cadence.bearings.linear import Sights, pseudo_positions
from cadence.bearings.profiles import Profiles

_MOST_ROWS = 2048
_NUM_COARSE = 8
_LEAST_COARSE_SIZE = 15.0
"""Cells so much smaller than the largest, as logarithms, are left out by what a few of the sights say."""


@dataclass(frozen=True, eq=False)
class Prior:
    """The law of tracks before anything is measured.

    models     C motion models in seconds and metres
    log_weight [C]
    begin_m    [2] the place at the first node is normal about it
    reach_m    with this deviation an axis
    """

    models: MotionModels
    log_weight: Tensor
    begin_m: Tensor
    reach_m: float


@dataclass(frozen=True, eq=False)
class Cells:
    """L cells.

    model     [L] which motion model
    profile   [L] which supposed track it began with
    kernel_m  [L, M + E, 2] and kernel_m2 [L, M + E, 2, 2]: sights made linear, then anchors
    log_size  [L] log of the prior weight times the normaliser
    """

    model: Tensor
    profile: Tensor
    kernel_m: Tensor
    kernel_m2: Tensor
    log_size: Tensor

    def __len__(self) -> int:
        return len(self.model)

    def __getitem__(self, index: Tensor) -> "Cells":
        """Some of the cells."""
        return Cells(*(value[index] for value in vars(self).values()))

    def log_kernels(self, place_m: Tensor) -> Tensor:
        """Log of the product of all kernels [D, L] at places [D, M + E, 2]."""
        precision = torch.linalg.inv(self.kernel_m2)
        apart = place_m[:, None] - self.kernel_m
        return -0.5 * torch.einsum("dlni,lnij,dlnj->dl", apart, precision, apart)


@dataclass(frozen=True, eq=False)
class Problem:
    """What is known of one agent of one window.

    detections  one row [1, N] of its positions, perhaps none observed
    sights      one or more
    profiles    supposed tracks at them
    """

    prior: Prior
    detections: Nodes
    sights: Sights
    profiles: Profiles

    def filtered(self, cells: Cells, time_s: Tensor) -> tuple[Cells, Filtered, Tensor]:
        """Cells with their sizes, filtered over all that is known and `time_s` [T], and the nodes [T] of these."""
        num = len(cells)
        seen = self.detections.is_observed[0]
        anchor_s = self.sights.time_s[self.profiles.anchor_row]
        known_s = torch.cat([self.detections.time_s[0, seen], self.sights.time_s, anchor_s])
        position_m = torch.cat([self.detections.position_m[:, seen].expand(num, -1, 2), cells.kernel_m], 1)
        covariance = torch.cat([self.detections.covariance_m2[:, seen].expand(num, -1, 2, 2), cells.kernel_m2], 1)
        is_known = torch.ones(num, len(known_s), dtype=torch.bool)
        nodes, index = merge_grid(Nodes(known_s.expand(num, -1), position_m, covariance, is_known), time_s)
        models = self.prior.models[cells.model]
        reach_m = torch.full((num,), self.prior.reach_m, dtype=torch.float64)
        begin = diffuse_start(models, self.prior.begin_m.expand(num, 2), reach_m)
        filtered = filter_from(models, nodes, *begin)
        peak = (0.5 * torch.logdet(cells.kernel_m2) + math.log(2.0 * math.pi)).sum(1)
        log_size = self.prior.log_weight[cells.model] + filtered.log_likelihood + peak
        return dataclasses.replace(cells, log_size=log_size), filtered, index[0]


def first_cells(problem: Problem, begin_s: Tensor) -> Cells:
    """Every model about every supposed track that may count, with sizes; `begin_s` [1] is when the window begins.

    A few of the sights tell which those are: the full sizes of the others are not worth their cost.
    """
    num_models, num_profiles = len(problem.prior.log_weight), len(problem.profiles.supposed_m)
    model = torch.arange(num_models).repeat_interleave(num_profiles)
    profile = torch.arange(num_profiles).repeat(num_models)
    coarse = _thinned(problem)
    if len(coarse.sights) < len(problem.sights):
        size = _sized(coarse, model, profile, begin_s).log_size
        may_count = size > size.max() - _LEAST_COARSE_SIZE
        model, profile = model[may_count], profile[may_count]
    return _sized(problem, model, profile, begin_s)


def _thinned(problem: Problem) -> Problem:
    """The same with no more than `_NUM_COARSE` of the sights, the first and the last among them."""
    num, profiles = len(problem.sights), problem.profiles
    rows = torch.linspace(0, num - 1, min(num, _NUM_COARSE), dtype=torch.float64).round().long()
    anchor_row = torch.searchsorted(rows, profiles.anchor_row)
    profiles = dataclasses.replace(profiles, supposed_m=profiles.supposed_m[:, rows], anchor_row=anchor_row)
    return dataclasses.replace(problem, sights=problem.sights[rows], profiles=profiles)


def _sized(problem: Problem, model: Tensor, profile: Tensor, begin_s: Tensor) -> Cells:
    """Cells of models [L] about supposed tracks [L], with sizes."""
    kernel_m, kernel_m2 = _kernels(problem, problem.profiles.supposed_m, torch.arange(len(problem.profiles.supposed_m)))
    sizes = []
    for some in torch.split(torch.arange(len(model)), _MOST_ROWS):
        at = profile[some]
        cells = Cells(model[some], at, kernel_m[at], kernel_m2[at], torch.zeros(len(some), dtype=torch.float64))
        sizes.append(problem.filtered(cells, begin_s)[0].log_size)
    return Cells(model, profile, kernel_m[profile], kernel_m2[profile], torch.cat(sizes))


def refined(problem: Problem, cells: Cells, begin_s: Tensor) -> Cells:
    """The cells with measurements linear about their own smoothed tracks."""
    time_s = torch.cat([begin_s, problem.sights.time_s])
    cells, filtered, index = problem.filtered(cells, time_s)
    mean, _ = smooth(filtered, backward_kernel(filtered))
    kernel_m, kernel_m2 = _kernels(problem, mean[:, index[1:], :2], cells.profile)
    return dataclasses.replace(cells, kernel_m=kernel_m, kernel_m2=kernel_m2)


def _kernels(problem: Problem, supposed_m: Tensor, profile: Tensor) -> tuple[Tensor, Tensor]:
    position_m, covariance = pseudo_positions(problem.sights, supposed_m)
    anchor_m, anchor_m2 = problem.profiles.anchor_m[profile], problem.profiles.anchor_m2[profile]
    return torch.cat([position_m, anchor_m], 1), torch.cat([covariance, anchor_m2], 1)
