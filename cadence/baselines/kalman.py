"""Kalman filter and Rauch-Tung-Striebel smoother with one motion model: the classical rivals.

Each is a bank of a single model: smoothed past, extrapolated future, joint samples (Bar-Shalom, Li, Kirubarajan, "Estimation
with Applications to Tracking and Navigation", 2001, ch. 6 and 8). Settings are those of greatest likelihood for the log's
detections. Likelihood is ruled by short steps within bursts, and by the few targets that manoeuvre; where the gaps between
bursts count, `tuned` goes on from there by how well withheld detections are foreseen, as the bank's settings are chosen.
"""

import dataclasses
import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Self

import torch

from cadence.bank.bank import Bank, BankPosterior, default_step, typical_speed
from cadence.bank.components import MotionModels, constant_velocity, ornstein_uhlenbeck
from cadence.bank.fitting import FLOOR_STEPS, fit_constant_velocity, fit_ornstein_uhlenbeck
from cadence.bank.hindsight import LEAST_TESTS, Test, hindsight_scores, num_tests
from cadence.bank.rows import track_rows
from cadence.bank.smoother import Nodes
from cadence.types import Detections, HypothesisSet, WindowBatch

_NUM_GRIDS = 4
"""A rival gets its optimum to a few per cent in every parameter; the bank, which mixes models, is content with a third."""
_FACTORS = (8.0, 2.0, 2.0**0.5)
"""Steps of the search by hindsight, one after the other."""
_LEAST_GAIN = 1e-3
"""Of the logarithm of the scores, by which a step has to make them better."""
_LEAST_SCORE = 1e-12
"""Scores are estimates of what cannot be negative."""

Values = tuple[float, ...]


@dataclass(frozen=True, eq=False)
class _SingleModel(ABC):
    """A bank of one model, in units of steps and step lengths, for detections with some further noise.

    noise_steps  standard deviation an axis that detections have beside their own, in step lengths
    """

    bank: Bank
    name: str = ""
    noise_steps: float = FLOOR_STEPS

    @abstractmethod
    def fit(self, tracks: Detections, step_s: float | None = None) -> Self:
        """The model of greatest likelihood for the stretches `tracks` [B, 1, N]; `step_s` as for `Bank.fit`."""

    def posterior(self, windows: WindowBatch, num_hypotheses: int) -> BankPosterior:
        """Smoothed moments and joint samples, rows as for `Bank.posterior`."""
        return self.bank.posterior(self._noisier(windows), num_hypotheses)

    def sample(self, windows: WindowBatch, num_hypotheses: int) -> HypothesisSet:
        """Joint samples of past and future; deterministic in the windows' seeds. ValueError before `fit`."""
        return self.bank.sample(self._noisier(windows), num_hypotheses)

    def _noisier(self, windows: WindowBatch) -> WindowBatch:
        """The windows; the bank itself adds the least noise that there is."""
        if self.noise_steps <= FLOOR_STEPS:
            return windows
        variance_m2 = (self.noise_steps**2 - FLOOR_STEPS**2) * self.bank.length_m(windows.step_s) ** 2
        covariance = windows.detections.covariance_m2
        wider = covariance + variance_m2 * torch.eye(2, dtype=covariance.dtype)
        return dataclasses.replace(windows, detections=dataclasses.replace(windows.detections, covariance_m2=wider))

    def _tuned(self, start: Values, models: Callable[[Values], MotionModels], tests: Sequence[Test]) -> Self:
        """The rival with the values that foresee best: those of the model from `start` on, and the noise."""
        tests = [test for test in tests if num_tests(*test) >= LEAST_TESTS]

        def cost(values: Values) -> float:
            rival = self._with(models(values[:-1]), values[-1])
            scores = (float(hindsight_scores(rival, *test).mean()) for test in tests)
            return sum(math.log(max(score, _LEAST_SCORE)) for score in scores)

        if not tests:
            return self
        best = _searched((*start, self.noise_steps), cost)
        return self._with(models(best[:-1]), best[-1])

    def _with(self, models: MotionModels, noise_steps: float) -> Self:
        return dataclasses.replace(self, bank=dataclasses.replace(self.bank, models=models), noise_steps=noise_steps)


def _searched(best: Values, cost: Callable[[Values], float]) -> Values:
    """Values of least cost by steps in one of them at a time, as far as it gets better, with smaller and smaller factors."""
    known = {best: cost(best)}
    for factor in _FACTORS:
        before = None
        while best != before:
            before = best
            for index, step in itertools.product(range(len(best)), (1.0 / factor, factor)):
                while True:
                    further = (*best[:index], best[index] * step, *best[index + 1 :])
                    if further not in known:
                        known[further] = cost(further)
                    if known[further] > known[best] - _LEAST_GAIN:
                        break
                    best = further
    return best


def _single(model: MotionModels) -> Bank:
    return Bank(models=model, switch_rate=0.0, temper=1.0)


def _fitted(
    bank: Bank, tracks: Detections, step_s: float | None, fit: Callable[[Nodes, float, float, int], MotionModels]
) -> Bank:
    """The bank with the log's speed unit and its one model fitted to stretches of at least two detections, if there are any."""
    rows = track_rows(tracks)
    step_s = step_s or default_step(rows)
    speed_mps = typical_speed(rows, step_s)
    rows = rows[rows.is_observed.sum(-1) > 1]
    models = fit(rows, step_s, speed_mps, _NUM_GRIDS) if len(rows.time_s) else bank.models
    return dataclasses.replace(bank, models=models, speed_mps=speed_mps)


@dataclass(frozen=True, eq=False)
class ConstantVelocityKalman(_SingleModel):
    """Constant velocity with white acceleration noise."""

    bank: Bank = dataclasses.field(default_factory=lambda: _single(constant_velocity([0.01])))
    name: str = "cv_kalman"

    def fit(self, tracks: Detections, step_s: float | None = None) -> Self:
        """The noise of greatest likelihood for the stretches `tracks` [B, 1, N]; `step_s` as for `Bank.fit`."""
        return dataclasses.replace(self, bank=_fitted(self.bank, tracks, step_s, fit_constant_velocity))

    def tuned(self, tests: Sequence[Test]) -> Self:
        """From `fit` on, noise of motion and detections that foresee best what the windows of tests do not hold."""
        start = (float(self.bank.models.diffusion),)
        return self._tuned(start, lambda values: constant_velocity([values[0]]), tests)


@dataclass(frozen=True, eq=False)
class OrnsteinUhlenbeckKalman(_SingleModel):
    """Velocity that forgets (integrated Ornstein-Uhlenbeck)."""

    bank: Bank = dataclasses.field(default_factory=lambda: _single(ornstein_uhlenbeck([10.0], [0.7], [0.0])))
    name: str = "ou_kalman"

    def fit(self, tracks: Detections, step_s: float | None = None) -> Self:
        """Relaxation time and speed of greatest likelihood for the stretches `tracks` [B, 1, N]; `step_s` as for `Bank.fit`."""
        return dataclasses.replace(self, bank=_fitted(self.bank, tracks, step_s, fit_ornstein_uhlenbeck))

    def tuned(self, tests: Sequence[Test]) -> Self:
        """From `fit` on, memory, speed and noise that foresee best what the windows of tests do not hold."""
        start = (1.0 / float(self.bank.models.relaxation_rate), float(self.bank.models.initial_speed))
        return self._tuned(start, lambda values: ornstein_uhlenbeck([values[0]], [values[1]], [0.0]), tests)


_WALK_MEMORY_STEPS = 0.02
"""A velocity that is forgotten so soon is white noise to every step."""


@dataclass(frozen=True, eq=False)
class RandomWalkKalman(_SingleModel):
    """A random walk: an Ornstein-Uhlenbeck velocity without memory."""

    bank: Bank = dataclasses.field(default_factory=lambda: _single(_walk(5.0)))
    name: str = "random_walk"

    def fit(self, tracks: Detections, step_s: float | None = None) -> Self:
        """The log's speed unit; its speed of spreading is found by `tuned`."""
        return dataclasses.replace(self, bank=_fitted(self.bank, tracks, step_s, lambda *_: self.bank.models))

    def tuned(self, tests: Sequence[Test]) -> Self:
        """The speed of spreading and the noise that foresee best what the windows of tests do not hold."""
        return self._tuned((float(self.bank.models.initial_speed),), lambda values: _walk(values[0]), tests)


def _walk(speed: float) -> MotionModels:
    return ornstein_uhlenbeck([_WALK_MEMORY_STEPS], [speed], [0.0])
