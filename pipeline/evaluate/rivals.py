"""The rivals by name, each fitted to the detections of one log — never to its truth."""

from collections.abc import Callable, Mapping

from cadence.baselines.interpolation import Hold, LinearInterpolation
from cadence.baselines.kalman import ConstantVelocityKalman, OrnsteinUhlenbeckKalman, RandomWalkKalman
from cadence.types import Estimator
from pipeline.estimators.fitting import FittingData


def _tuned(rival: ConstantVelocityKalman | OrnsteinUhlenbeckKalman | RandomWalkKalman, data: FittingData) -> Estimator:
    return rival.fit(data.tracks, data.grid.step_s).tuned(data.tests)


RIVALS: Mapping[str, Callable[[FittingData], Estimator]] = {
    "bank": FittingData.fitted_bank,
    "cv": lambda data: _tuned(ConstantVelocityKalman(), data),
    "ou": lambda data: _tuned(OrnsteinUhlenbeckKalman(), data),
    "linear": lambda data: LinearInterpolation().fit(data.tracks),
    "hold": lambda data: Hold().fit(data.tracks),
}
"""bank: the bank of motion models that the diffusion model starts from; cv, ou: Kalman + RTS with constant velocity and with
Ornstein-Uhlenbeck velocity, fitted by likelihood and then by hindsight, as the bank; linear, hold: interpolation."""
