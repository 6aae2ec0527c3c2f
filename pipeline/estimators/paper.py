"""The paper's preset: the published architecture in absolute coordinates, on a grid of its own."""

from pathlib import Path

from cadence.diffusion.absolute import AbsoluteConfig, AbsoluteModel
from cadence.diffusion.settings import AbsoluteSampling
from cadence.network.trajectory import TrajectoryNetwork
from pipeline.checkpoints import expect_preset, network_config
from pipeline.estimators.loaded import Loaded
from pipeline.estimators.samplings import Samplings
from pipeline.grids import GridConfig
from pipeline.weights import load_network


def load_paper(weights: Path, samplings: Samplings) -> Loaded:
    """The checkpoint as the stages see it."""
    model = load_absolute(weights, samplings.paper)
    return Loaded("paper", model, lambda grid: absolute_grid(model.config, grid.stride_steps))


def load_absolute(weights: Path, sampling: AbsoluteSampling | None = None) -> AbsoluteModel:
    """The estimator of a checkpoint; `ConfigError` where it is of another preset or does not fit."""
    info = expect_preset(weights, "paper")
    config: AbsoluteConfig = network_config(AbsoluteConfig, info, weights)
    network = load_network(weights, lambda: TrajectoryNetwork(config.network))
    return AbsoluteModel(network, config, sampling or AbsoluteSampling())


def absolute_grid(config: AbsoluteConfig, stride_steps: int = 16) -> GridConfig:
    """The only grid that a checkpoint takes; its windows read detections from as far back as ages are scaled to."""
    context_steps = max(config.history_steps, round(config.age_scale_steps))
    return GridConfig(config.step_s, config.history_steps, config.horizon_steps, stride_steps, context_steps)
