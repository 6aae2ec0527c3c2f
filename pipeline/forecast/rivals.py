"""Rivals that are fitted to episodes in seconds, by name, and what tables call a checkpoint."""

from collections.abc import Callable, Mapping
from pathlib import Path

from cadence.baselines.kalman import ConstantVelocityKalman, OrnsteinUhlenbeckKalman
from cadence.baselines.library import TrajectoryLibrary
from cadence.baselines.particle import ParticleFilter
from cadence.baselines.recorded_kalman import RecordedKalman
from cadence.recordings import Recordings
from cadence.types import Estimator
from pipeline.checkpoints import WEIGHTS_NAME

FORECAST_RIVALS: Mapping[str, Callable[[Recordings], Estimator]] = {
    "cv": lambda training: RecordedKalman.from_recordings(training, ConstantVelocityKalman()),
    "ou": lambda training: RecordedKalman.from_recordings(training, OrnsteinUhlenbeckKalman()),
    "particle": ParticleFilter.from_recordings,
    "library": TrajectoryLibrary.from_recordings,
}
"""cv, ou: Kalman filters with constant velocity and with Ornstein-Uhlenbeck velocity, fitted to the training episodes;
particle: a particle filter whose motion has their moments; library: continuations of those that resemble the window."""


def label_of(name: str) -> str:
    """What tables call a checkpoint: its name, or that of the folder of its training."""
    path = Path(name)
    return path.resolve().parent.name if path.name == WEIGHTS_NAME else path.stem if name.endswith(".safetensors") else name
