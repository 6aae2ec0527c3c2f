"""Who forecasts: trained checkpoints by their preset, and rivals that are fitted to episodes in seconds, by name."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from cadence.baselines.kalman import ConstantVelocityKalman, OrnsteinUhlenbeckKalman
from cadence.baselines.library import TrajectoryLibrary
from cadence.baselines.particle import ParticleFilter
from cadence.baselines.recorded_kalman import RecordedKalman
from cadence.constraints.obstacles import Obstacles
from cadence.diffusion.absolute import AbsoluteSampling
from cadence.diffusion.scene import SceneSampling
from cadence.errors import ConfigError
from cadence.recordings import Recordings
from cadence.types import Context, Estimator
from pipeline.checkpoints import find_checkpoint, read_info
from pipeline.estimators.paper import load_absolute
from pipeline.estimators.scene import load_scene
from pipeline.infer.placed_draws import Forecaster
from pipeline.train.rivals import load_rival
from pipeline.train.run import OUTPUTS


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


def _cv(training: Recordings) -> Forecaster:
    return Anywhere(RecordedKalman.from_recordings(training, ConstantVelocityKalman()))


def _ou(training: Recordings) -> Forecaster:
    return Anywhere(RecordedKalman.from_recordings(training, OrnsteinUhlenbeckKalman()))


def _particle(training: Recordings) -> Forecaster:
    return Anywhere(ParticleFilter.from_recordings(training))


def _library(training: Recordings) -> Forecaster:
    return Unguided(TrajectoryLibrary.from_recordings(training))


FORECAST_RIVALS: Mapping[str, Callable[[Recordings], Forecaster]] = {
    "cv": _cv, "ou": _ou, "particle": _particle, "library": _library,
}  # fmt: skip
"""cv, ou: Kalman filters with constant velocity and with Ornstein-Uhlenbeck velocity, fitted to the training episodes;
particle: a particle filter whose motion has their moments; library: continuations of those that resemble the window."""
