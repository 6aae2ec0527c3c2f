"""Who forecasts: trained checkpoints by their preset, and rivals that need no training of their own, by name."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from cadence.baselines.kalman import ConstantVelocityKalman, OrnsteinUhlenbeckKalman
from cadence.baselines.library import TrajectoryLibrary
from cadence.constraints.obstacles import Obstacles
from cadence.diffusion.absolute import AbsoluteSampling
from cadence.diffusion.scene import SceneSampling
from cadence.errors import ConfigError
from cadence.types import Context, Detections, Estimator
from cadence.worlds.recordings import Recordings, cut_windows
from pipeline.absolute import load_absolute
from pipeline.checkpoints import find_checkpoint, read_info
from pipeline.scene import load_scene
from pipeline.train_rivals import load_rival
from pipeline.training_run import OUTPUTS

_NUM_FITTED = 64
"""Detections an episode, the last ones, that models of motion are fitted to."""


class Forecaster(Protocol):
    """An estimator that may want to know where its windows are, and what is in the way there."""

    @property
    def name(self) -> str:
        """What it is called."""
        ...

    def placed(self, context: Context, obstacles: Obstacles | None = None) -> Estimator:
        """The estimator for the windows of a context."""
        ...


class Placeable(Protocol):
    """An estimator that wants to know where its windows are."""

    @property
    def name(self) -> str:
        """What it is called."""
        ...

    def placed(self, context: Context) -> Estimator:
        """The estimator for the windows of a context."""
        ...


@dataclass(frozen=True, eq=False)
class Unguided:
    """A forecaster that keeps out of nothing."""

    estimator: Placeable

    @property
    def name(self) -> str:
        """The estimator's."""
        return self.estimator.name

    def placed(self, context: Context, obstacles: Obstacles | None = None) -> Estimator:
        """The estimator in its place."""
        return self.estimator.placed(context)


@dataclass(frozen=True, eq=False)
class Anywhere:
    """A forecaster that sees relative positions only."""

    estimator: Estimator

    @property
    def name(self) -> str:
        """The estimator's."""
        return self.estimator.name

    def placed(self, context: Context, obstacles: Obstacles | None = None) -> Estimator:
        """The estimator itself."""
        return self.estimator


@dataclass(frozen=True)
class Samplings:
    """How checkpoints are sampled, by preset."""

    paper: AbsoluteSampling = field(default_factory=AbsoluteSampling)
    scene: SceneSampling = field(default_factory=SceneSampling)


def _paper(weights: Path, samplings: Samplings) -> Forecaster:
    return load_absolute(weights, samplings.paper)


def _scene(weights: Path, samplings: Samplings) -> Forecaster:
    return load_scene(weights, samplings.scene)


def _mixture(weights: Path, samplings: Samplings) -> Forecaster:
    return Unguided(load_rival(weights, uses_goal=True))


LOADERS: Mapping[str, Callable[[Path, Samplings], Forecaster]] = {
    "scene": _scene,
    "paper": _paper,
    "vrnn": _mixture,
    "grammi": _mixture,
    "grammi_without_mi": _mixture,
}
"""How a checkpoint of each preset becomes a forecaster."""


def load_forecaster(name: str, samplings: Samplings | None = None) -> Forecaster:
    """The forecaster of a .safetensors file or a shipped name; `ConfigError` where it is of a preset that does not forecast."""
    weights = find_checkpoint(name)
    preset = read_info(weights).preset
    if preset not in LOADERS:
        raise ConfigError(
            f"{weights}: a checkpoint of the preset {preset!r}, which does not forecast; give one of {', '.join(LOADERS)}"
        )
    return LOADERS[preset](weights, samplings or Samplings())


def label_of(name: str) -> str:
    """What tables call a checkpoint: its name, or that of the folder of its training."""
    path = Path(name)
    return path.resolve().parent.name if path.name == OUTPUTS[0] else path.stem if name.endswith(".safetensors") else name


@dataclass(frozen=True, eq=False)
class RivalData:
    """What rivals may learn from.

    seen      the evaluated episodes: only their detections may be looked at
    training  other episodes, truth and all; None: there are none
    """

    seen: Recordings
    training: Recordings | None
    known_start: bool = True

    def stretches(self) -> Detections:
        """The last detections of each episode as one row [E, 1, N], for fitting; of training episodes where there are some."""
        recordings = self.seen if self.training is None else self.training.select(slice(0, 200))
        last = recordings.length - 1
        windows = cut_windows(
            recordings, np.arange(len(recordings)), last, known_start=self.known_start, num_detections=_NUM_FITTED
        )
        return windows.windows.detections

    def library(self) -> Recordings:
        """The training episodes. `ConfigError` where there are none."""
        if self.training is None:
            raise ConfigError(
                "evaluate.forecast.rivals: this rival remembers training episodes; set evaluate.forecast.training, "
                "or leave it out"
            )
        return self.training


def _cv(data: RivalData) -> Forecaster:
    return Anywhere(ConstantVelocityKalman().fit(data.stretches(), data.seen.step_s))


def _ou(data: RivalData) -> Forecaster:
    return Anywhere(OrnsteinUhlenbeckKalman().fit(data.stretches(), data.seen.step_s))


def _library(data: RivalData) -> Forecaster:
    return Unguided(TrajectoryLibrary.from_recordings(data.library()))


FORECAST_RIVALS: Mapping[str, Callable[[RivalData], Forecaster]] = {"cv": _cv, "ou": _ou, "library": _library}
"""cv, ou: Kalman filters with constant velocity and with Ornstein-Uhlenbeck velocity, fitted to detections by likelihood;
library: continuations of the training episodes that resemble the window."""
