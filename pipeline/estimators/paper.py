"""Checkpoints of the paper's preset as estimators, and the grid they need."""

from pathlib import Path

import torch

from cadence.constraints.obstacles import Obstacles
from cadence.diffusion.absolute import AbsoluteConfig, AbsoluteModel, AbsoluteSampling
from cadence.errors import ConfigError
from cadence.network.trajectory import TrajectoryNetwork
from cadence.types import Context
from pipeline.checkpoints import load_weights, network_config, read_info
from pipeline.windows import GridConfig, MissionWindows


def load_absolute(weights: Path, sampling: AbsoluteSampling | None = None) -> AbsoluteModel:
    """The estimator of a checkpoint of the paper's preset; `ConfigError` where it is of another preset or does not fit."""
    info = read_info(weights)
    if info.preset != "paper":
        raise ConfigError(f"{weights}: a checkpoint of the preset {info.preset!r}, expected one of the preset 'paper'")
    config: AbsoluteConfig = network_config(AbsoluteConfig, info, weights)
    network = TrajectoryNetwork(config.network)
    load_weights(weights, network)
    return AbsoluteModel(network.eval(), config, sampling or AbsoluteSampling())


def absolute_grid(config: AbsoluteConfig, stride_steps: int = 16) -> GridConfig:
    """The only grid that a checkpoint takes; its windows read detections from as far back as ages are scaled to."""
    context_steps = max(config.history_steps, round(config.age_scale_steps))
    return GridConfig(config.step_s, config.history_steps, config.horizon_steps, stride_steps, context_steps)


def absolute_context(windows: MissionWindows) -> Context:
    """What a checkpoint is told of a mission: where its windows are."""
    return Context(torch.from_numpy(windows.datum_m))


def placed(model: AbsoluteModel, windows: MissionWindows, obstacles: Obstacles | None = None) -> AbsoluteModel:
    """The model for the windows of one mission."""
    return model.placed(absolute_context(windows), obstacles)
