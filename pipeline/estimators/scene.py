"""Checkpoints of the scene preset as estimators, the grid they need, and what they are told of a mission."""

from pathlib import Path

import numpy as np
import torch

from cadence.diffusion.scene import SceneModel, SceneSampling
from cadence.diffusion.scene_frame import SceneConfig
from cadence.errors import ConfigError
from cadence.recordings import NUM_STEPS
from cadence.types import Context
from pipeline.checkpoints import load_weights, network_config, read_info
from pipeline.windows import GridConfig, MissionWindows

_CONTEXT_STEPS = 4320
"""The longest mission of the paper's worlds."""


def load_scene(weights: Path, sampling: SceneSampling | None = None) -> SceneModel:
    """The estimator of a checkpoint; `ConfigError` where it is of another preset or does not fit."""
    info = read_info(weights)
    if info.preset != "scene":
        raise ConfigError(f"{weights}: a checkpoint of the preset {info.preset!r}, expected one of the preset 'scene'")
    config: SceneConfig = network_config(SceneConfig, info, weights)
    network = config.build()
    load_weights(weights, network)
    return SceneModel(network.eval(), config, sampling or SceneSampling())


def scene_grid(config: SceneConfig, stride_steps: int = 16) -> GridConfig:
    """The only grid that a checkpoint takes: from now on, with detections from as far back as missions are long."""
    return GridConfig(config.step_s, 1, NUM_STEPS - 1, stride_steps, _CONTEXT_STEPS)


def scene_context(windows: MissionWindows, start_ns: int) -> Context:
    """What the network is told of a mission: where, and how long ago the mission began; neither goals nor trackers."""
    elapsed_s = torch.from_numpy((windows.origins_ns - start_ns).astype(np.float64) * 1e-9).clamp_min(0.0)
    return Context(torch.from_numpy(windows.datum_m), elapsed_s)
