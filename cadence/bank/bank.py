"""The bank of motion models: weights by expectation maximisation, posterior mixtures, joint samples.

Every model gives a Gaussian posterior over the whole window given the detections; the window's posterior is their mixture,
weighted by prior weight times likelihood. The prior weights, the speed unit and so the meaning of every model are learned
from all detections of a log (empirical Bayes), without any truth.
"""

import dataclasses
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from cadence.bank.components import MotionModels, concatenate, default_models
from cadence.bank.fitting import DIFFUSE_STEPS, FLOOR_STEPS, fit_ornstein_uhlenbeck, log_likelihood, with_floor
from cadence.bank.mixture import (
    MAX_MODELS,
    MIN_WEIGHT,
    Chosen,
    Numbers,
    at_node,
    choose_models,
    drawn_pairs,
    merge_grid,
    mixture_moments,
    random_numbers,
)
from cadence.bank.rows import active_rows, scatter_hypotheses, spaced, track_rows
from cadence.bank.smoother import Filtered, Nodes, backward_kernel, draw, filter_forward, smooth
from cadence.bank.switching import SwitchingModels, continue_moments, continue_samples, durations_after
from cadence.types import Detections, HypothesisSet, WindowBatch

_NUM_EM_ROUNDS = 30
_MAX_PAIRS = 1024
NEAR_STEPS = 0.3
"""Detections at least so far apart show a velocity and how it changes; all of a burst would rule."""


@dataclass(frozen=True, eq=False)
class BankPosterior:
    """What the bank says of R rows (active agents of windows) on a grid of T steps.

    mean_m   [R, T, 2] mean of the mixture
    sigma_m  [R, T] root mean variance of an axis, never below a thousandth of a step length
    sample_m [R, K, T, 2] joint samples
    """

    mean_m: Tensor
    sigma_m: Tensor
    sample_m: Tensor


@dataclass(frozen=True, eq=False)
class Bank:
    """A weighted bank and the units of one log.

    models       C motion models in units of steps and step lengths
    log_weight   [C] log of the prior weights; equal where None
    later_weight [C] weights of the models that take over after the last detection; the prior weights where None
    near_weights the same two [C] where detections nearer to each other are believed as well (`near`)
    speed_mps    the log's typical speed: one step length is speed_mps * step_s; None until fitted
    switch_rate  how often, per step, the model changes after the last detection
    temper       exponent of the likelihood when models are weighed
    spacing_steps  detections closer than this say nothing when models are weighed: short steps within bursts, which are not
                 what is asked for, would rule
    noise_steps  standard deviation an axis that detections have beside their own, in step lengths
    pseudo_count how many stretches' worth of evidence the flat prior over models holds against the log
    """

    models: MotionModels = dataclasses.field(default_factory=default_models)
    log_weight: Tensor | None = None
    later_weight: Tensor | None = None
    near_weights: tuple[Tensor, Tensor] | None = None
    speed_mps: float | None = None
    switch_rate: float = 1.0 / 32.0
    temper: float = 1.0
    spacing_steps: float = 1.0
    noise_steps: float = 0.0
    pseudo_count: float = 3.0
    name: str = "bank"

    def fit(self, tracks: Detections, step_s: float | None = None) -> "Bank":
        """The bank with speed unit and weights learned from the stretches of detections `tracks` [B, 1, N].

        The Ornstein-Uhlenbeck model of greatest likelihood joins the bank as its last model.

        Args:
            tracks: one stretch a row; rows of about a window's length let the weights tell windows apart.
            step_s: step of the windows to come; by default a sixteenth of the mean stretch.
        """
        rows = track_rows(tracks)
        step_s = step_s or default_step(rows)
        speed_mps = typical_speed(rows, step_s)
        rows = rows[rows.is_observed.sum(-1) > 1]
        if len(rows.time_s) == 0:
            return dataclasses.replace(self, speed_mps=speed_mps)
        telling = spaced(rows, self.spacing_steps * step_s)
        models = concatenate(self.models, fit_ornstein_uhlenbeck(telling, step_s, speed_mps))
        log_weight, evidence = em_weights(log_likelihood(models, telling, step_s, speed_mps), self.pseudo_count)
        near = spaced(rows, NEAR_STEPS * step_s)
        near_weights = em_weights(log_likelihood(models, near, step_s, speed_mps), self.pseudo_count)
        learned = dataclasses.replace(self, log_weight=log_weight, later_weight=evidence, near_weights=near_weights)
        return dataclasses.replace(learned, models=models, speed_mps=speed_mps)

    @property
    def near(self) -> "Bank":
        """The bank with its models weighed by detections within bursts as well, which show how a target moves."""
        if self.near_weights is None:
            return self
        log_weight, later_weight = self.near_weights
        return dataclasses.replace(self, spacing_steps=NEAR_STEPS, log_weight=log_weight, later_weight=later_weight)

    def posterior(self, windows: WindowBatch, num_hypotheses: int, evidence: Tensor | None = None) -> BankPosterior:
        """Moments and joint samples for the active agents of `windows`, rows in the order of `is_active.nonzero()`.

        `evidence` is what `model_evidence` says of these windows, where that is known already.
        """
        return self._posterior(windows, num_hypotheses, evidence, True)

    def _posterior(
        self, windows: WindowBatch, num_hypotheses: int, evidence: Tensor | None, with_moments: bool
    ) -> BankPosterior:
        rows, seeds = active_rows(windows)
        floor_m = FLOOR_STEPS * self._speed() * windows.step_s
        rows = with_floor(rows, self.noise_steps * self.length_m(windows.step_s))
        if evidence is None:  # one model alone is the likeliest whatever it says
            evidence = torch.zeros(len(rows.time_s), 1) if len(self.models) == 1 else model_evidence(self, windows)
        log_posterior = self.temper * evidence + self._log_weight()
        parts = []
        nodes = with_floor(rows, floor_m)
        chunk = max(1, _MAX_PAIRS // MAX_MODELS)
        for begin in range(0, len(rows.time_s), chunk):
            part = torch.arange(begin, min(begin + chunk, len(rows.time_s)))
            parts.append(
                self._posterior_rows(nodes[part], log_posterior[part], seeds[part], windows, num_hypotheses, with_moments)
            )
        if not parts:
            empty = torch.zeros(0, windows.num_steps, 2, dtype=torch.float64)
            return BankPosterior(
                empty, empty[..., 0], torch.zeros(0, num_hypotheses, windows.num_steps, 2, dtype=torch.float64)
            )
        mean, sigma, sample = (torch.cat(columns) for columns in zip(*parts, strict=True))
        return BankPosterior(mean, sigma.clamp_min(floor_m), sample)

    def sample(self, windows: WindowBatch, num_hypotheses: int, evidence: Tensor | None = None) -> HypothesisSet:
        """Joint samples of the bank itself: the rival and release gate of the diffusion model."""
        return scatter_hypotheses(self._posterior(windows, num_hypotheses, evidence, False).sample_m, windows)

    def about(self) -> dict[str, float | int | None]:
        """What a summary says of it."""
        return {"speed_mps": self.speed_mps, "switch_rate": self.switch_rate, "num_models": len(self.models)}

    def only(self, is_member: Tensor) -> "Bank":
        """The bank without the models [C] that are no members: weights shared out among the others."""
        later = self._log_weight().exp() if self.later_weight is None else self.later_weight
        later = torch.where(is_member, later if bool(later[is_member].any()) else self._log_weight().exp(), 0.0)
        log_weight = torch.where(is_member, self._log_weight(), -torch.inf)
        return dataclasses.replace(self, log_weight=log_weight.log_softmax(0), later_weight=later / later.sum())

    def length_m(self, step_s: float) -> float:
        """One step length: the way at the log's typical speed in a step."""
        return self._speed() * step_s

    def _speed(self) -> float:
        if self.speed_mps is None:
            raise ValueError("Bank: fit() it to the detections of a log first; it has no speed unit")
        return self.speed_mps

    def _log_weight(self) -> Tensor:
        if self.log_weight is None:
            return torch.full((len(self.models),), -math.log(len(self.models)), dtype=torch.float64)
        return self.log_weight

    def _models_after(self, chosen: Chosen) -> tuple[Tensor, Tensor, Tensor]:
        """Models at work after the last detection [C'], where each pair's model stands among them, and their weights."""
        weight = self._log_weight().exp() if self.later_weight is None else self.later_weight
        takes_part = weight > 0
        takes_part[chosen.model] = True
        index = takes_part.cumsum(0) - 1
        return takes_part.nonzero()[:, 0], index[chosen.model], weight[takes_part]

    def _posterior_rows(
        self, rows: Nodes, log_posterior: Tensor, seeds: Tensor, windows: WindowBatch, num_hypotheses: int, with_moments: bool
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Mean [R, T, 2], sigma [R, T] and samples [R, K, T, 2] of some rows whose detections have their floor already.

        Without moments those are zero, which takes half of the time.
        """
        models = self.models.scaled(windows.step_s, self._speed())
        diffuse_m = DIFFUSE_STEPS * self.length_m(windows.step_s)
        chosen = choose_models(log_posterior)
        smoothed = _smooth_rows(models, rows, chosen, seeds, windows.time_s, num_hypotheses, diffuse_m, with_moments)
        if self.switch_rate > 0.0:
            last_s = torch.where(rows.is_observed, rows.time_s, rows.time_s[:, :1]).amax(1)
            durations = durations_after(windows.time_s.double(), last_s)
            if bool((durations > 0).any()):
                self._switch_after(smoothed, models, durations, windows.step_s, with_moments)
        return smoothed.mean_m, smoothed.variance_m2.sqrt(), smoothed.sample_m

    def _switch_after(
        self, smoothed: "_Smoothed", models: MotionModels, durations: Tensor, step_s: float, with_moments: bool
    ) -> None:
        """Replace what `smoothed` says of the time after the last detection (durations [R, T]) by models that change."""
        # only models that carry weight take part after the last detection
        taking_part, chosen_index, later = self._models_after(smoothed.chosen)
        switching = SwitchingModels(models[taking_part], later, self.switch_rate / step_s)
        begin = int((durations > 0).any(0).to(torch.int64).argmax())
        durations = durations[:, begin:]
        is_after = durations > 0
        node = smoothed.last_node
        num_hypotheses, numbers = smoothed.sample_m.shape[1], smoothed.numbers
        state = smoothed.state[torch.arange(len(node))[:, None], torch.arange(num_hypotheses), node[:, None]]
        later_sample = continue_samples(
            switching,
            durations,
            chosen_index[smoothed.pair],
            state,
            numbers.uniform[:, :, begin:],
            numbers.kick[:, :, begin:],
        )
        replaced = [(smoothed.sample_m[:, :, begin:], later_sample, is_after[:, None, :, None])]
        if with_moments:
            mean, covariance, weight = at_node(smoothed.filtered, smoothed.chosen, chosen_index, node, len(taking_part))
            later_mean, later_variance = continue_moments(switching, durations, weight, mean, covariance)
            replaced += [
                (smoothed.mean_m[:, begin:], later_mean, is_after[..., None]),
                (smoothed.variance_m2[:, begin:], later_variance, is_after),
            ]
        for whole, part, where in replaced:
            whole.copy_(torch.where(where, part, whole))


def model_evidence(bank: Bank, windows: WindowBatch) -> Tensor:
    """Log likelihood [R, C] of the detections of active agents under every model of a bank."""
    rows, _ = active_rows(windows)
    length_m = bank.length_m(windows.step_s)
    telling = spaced(with_floor(rows, bank.noise_steps * length_m), bank.spacing_steps * windows.step_s)
    return log_likelihood(bank.models, telling, windows.step_s, bank._speed())


@dataclass(frozen=True, eq=False)
class _Smoothed:
    """Rows between their detections: the mixture on the grid, and what is needed to go on after the last detection.

    mean_m [R, T, 2], variance_m2 [R, T], sample_m [R, K, T, 2]; state [R, K, M, S] of the samples at the nodes, pair [R, K]
    which pair of row and model drew them, last_node [R] of the last detection.
    """

    chosen: Chosen
    filtered: Filtered
    numbers: Numbers
    mean_m: Tensor
    variance_m2: Tensor
    sample_m: Tensor
    state: Tensor
    pair: Tensor
    last_node: Tensor


def _smooth_rows(
    models: MotionModels,
    rows: Nodes,
    chosen: Chosen,
    seeds: Tensor,
    time_s: Tensor,
    num_hypotheses: int,
    diffuse_m: float,
    with_moments: bool,
) -> _Smoothed:
    """Filter, smooth and sample every pair of row and chosen model, and mix the models of each row."""
    nodes, step_index = merge_grid(rows, time_s)
    num_nodes = nodes.time_s.shape[1]
    numbers = random_numbers(chosen.weight, rows, seeds, num_hypotheses, num_nodes, len(time_s), models.num_states)
    if not with_moments:
        chosen, owner = drawn_pairs(chosen, numbers.owner)
        numbers = dataclasses.replace(numbers, owner=owner)
    diffuse = torch.full((len(chosen.row),), diffuse_m, dtype=torch.float64)
    filtered = filter_forward(models[chosen.model], nodes[chosen.row], diffuse)
    backward = backward_kernel(filtered)
    mean = torch.zeros(len(rows.time_s), len(time_s), 2, dtype=torch.float64)
    variance = torch.zeros_like(mean[..., 0])
    if with_moments:
        node_mean, node_covariance = smooth(filtered, backward)
        pick = step_index[chosen.row]
        each_mean = node_mean[..., :2].gather(1, pick[..., None].expand(-1, -1, 2))
        each_variance = (0.5 * (node_covariance[..., 0, 0] + node_covariance[..., 1, 1])).gather(1, pick)
        mean, variance = mixture_moments(each_mean, each_variance, chosen)
    pair = chosen.first_pair[:, None] + numbers.owner
    state = draw(backward, pair.flatten(), numbers.normal.flatten(0, 1)).view(len(mean), num_hypotheses, num_nodes, -1)
    sample = state[..., :2].gather(2, step_index[:, None, :, None].expand(-1, num_hypotheses, -1, 2))
    last_node = (nodes.is_observed * torch.arange(1, num_nodes + 1)).argmax(1)
    return _Smoothed(chosen, filtered, numbers, mean, variance, sample, state, pair, last_node)


def em_weights(log_likelihood: Tensor, pseudo_count: float) -> tuple[Tensor, Tensor]:
    """Mixture weights of greatest likelihood over all rows: log weights shrunk towards equal ones, and the bare evidence.

    Args:
        log_likelihood: [R, C].
        pseudo_count: total weight of the flat Dirichlet prior, in rows.

    Returns:
        Log weights [C], and weights [C] without the prior's share (models of under half a per cent left out).
    """
    num_rows, num_models = log_likelihood.shape
    log_weight = torch.full((num_models,), -math.log(num_models), dtype=torch.float64)
    for _ in range(_NUM_EM_ROUNDS):
        responsibility = torch.softmax(log_likelihood + log_weight, dim=1).sum(0)
        log_weight = ((responsibility + pseudo_count / num_models) / (num_rows + pseudo_count)).log()
    evidence = torch.where(responsibility >= MIN_WEIGHT * num_rows, responsibility, torch.zeros_like(responsibility))
    return log_weight, evidence / evidence.sum()


def typical_speed(rows: Nodes, step_s: float) -> float:
    """Root mean square speed between successive detections, measurement noise taken off; never zero.

    Pairs closer than a quarter of a step are left out: there noise divided by time would rule.
    """
    duration = torch.diff(rows.time_s, dim=1)
    is_pair = rows.is_observed[:, 1:] & rows.is_observed[:, :-1] & (duration > 0.25 * step_s)
    noise = rows.covariance_m2.diagonal(dim1=-2, dim2=-1).sum(-1)
    square = (torch.diff(rows.position_m, dim=1) ** 2).sum(-1) - noise[:, 1:] - noise[:, :-1]
    floor_mps = max(0.05 * math.sqrt(_least_noise(noise, rows.is_observed)) / step_s, 1e-6)
    if not is_pair.any():
        return max(floor_mps, 1.0 / step_s)
    speed_square = (square / duration.clamp_min(1e-9) ** 2)[is_pair].clamp_min(0.0)
    weight = duration[is_pair].clamp(max=8.0 * step_s)
    # false positions make absurd speeds: cap at the speed below which the target spends 98 % of the time
    ordered, order = speed_square.sort()
    share = weight[order].cumsum(0) / weight.sum()
    cap = ordered[int(torch.searchsorted(share, torch.tensor(0.98, dtype=share.dtype)).clamp(max=len(ordered) - 1))]
    mean_square = float((weight * speed_square.clamp(max=cap)).sum() / weight.sum())
    return max(math.sqrt(mean_square), floor_mps)


def _least_noise(noise_m2: Tensor, is_observed: Tensor) -> float:
    """Mean noise [R, N] of the row that is known best: a row that says nothing must not decide for the others."""
    has_any = is_observed.any(1)
    if not has_any.any():
        return 0.0
    total = torch.where(is_observed, noise_m2, torch.zeros_like(noise_m2)).sum(1)
    return float((total[has_any] / is_observed[has_any].sum(1)).min())


def default_step(rows: Nodes) -> float:
    """Step for windows nobody has planned yet: a sixteenth of the mean stretch, in seconds."""
    if len(rows.time_s) == 0:
        return 1.0
    length = rows.time_s.amax(1) - rows.time_s[:, 0]
    return max(float(length.mean()) / 16.0, 1e-3)
