"""Kalman filter and Rauch-Tung-Striebel smoother with one motion model: the classical rivals.

Each is a bank of a single model, that of greatest likelihood for the log's detections: smoothed past, extrapolated future,
joint samples (Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001, ch. 6 and 8).
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

from cadence.bank.bank import Bank, BankPosterior, default_step, typical_speed
from cadence.bank.components import MotionModels, constant_velocity, ornstein_uhlenbeck
from cadence.bank.fitting import fit_constant_velocity, fit_ornstein_uhlenbeck
from cadence.bank.rows import track_rows
from cadence.bank.smoother import Nodes
from cadence.types import Detections, HypothesisSet, WindowBatch

_NUM_GRIDS = 4
"""A rival gets its optimum to a few per cent in every parameter; the bank, which mixes models, is content with a third."""


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
class ConstantVelocityKalman:
    """Constant velocity with white acceleration noise; `bank` holds the one model, in units of steps and step lengths."""

    bank: Bank = dataclasses.field(default_factory=lambda: _single(constant_velocity([0.01])))
    name: str = "cv_kalman"

    def fit(self, tracks: Detections, step_s: float | None = None) -> "ConstantVelocityKalman":
        """The noise of greatest likelihood for the stretches `tracks` [B, 1, N]; `step_s` as for `Bank.fit`."""
        return dataclasses.replace(self, bank=_fitted(self.bank, tracks, step_s, fit_constant_velocity))

    def posterior(self, windows: WindowBatch, num_hypotheses: int) -> BankPosterior:
        """Smoothed moments and joint samples, rows as for `Bank.posterior`."""
        return self.bank.posterior(windows, num_hypotheses)

    def sample(self, windows: WindowBatch, num_hypotheses: int) -> HypothesisSet:
        """Joint samples of past and future; deterministic in the windows' seeds. ValueError before `fit`."""
        return self.bank.sample(windows, num_hypotheses)


@dataclass(frozen=True, eq=False)
class OrnsteinUhlenbeckKalman:
    """Velocity that forgets (integrated Ornstein-Uhlenbeck); `bank` holds the one model, in steps and step lengths."""

    bank: Bank = dataclasses.field(default_factory=lambda: _single(ornstein_uhlenbeck([10.0], [0.7], [0.0])))
    name: str = "ou_kalman"

    def fit(self, tracks: Detections, step_s: float | None = None) -> "OrnsteinUhlenbeckKalman":
        """Relaxation time and speed of greatest likelihood for the stretches `tracks` [B, 1, N]; `step_s` as for `Bank.fit`."""
        return dataclasses.replace(self, bank=_fitted(self.bank, tracks, step_s, fit_ornstein_uhlenbeck))

    def posterior(self, windows: WindowBatch, num_hypotheses: int) -> BankPosterior:
        """Smoothed moments and joint samples, rows as for `Bank.posterior`."""
        return self.bank.posterior(windows, num_hypotheses)

    def sample(self, windows: WindowBatch, num_hypotheses: int) -> HypothesisSet:
        """Joint samples of past and future; deterministic in the windows' seeds. ValueError before `fit`."""
        return self.bank.sample(windows, num_hypotheses)
