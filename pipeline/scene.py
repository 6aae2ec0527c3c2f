"""Checkpoints of the scene preset as estimators."""

from pathlib import Path

from cadence.diffusion.scene import SceneModel, SceneSampling
from cadence.diffusion.scene_frame import SceneConfig
from cadence.errors import ConfigError
from pipeline.checkpoints import load_weights, network_config, read_info


def load_scene(weights: Path, sampling: SceneSampling | None = None) -> SceneModel:
    """The estimator of a checkpoint; `ConfigError` where it is of another preset or does not fit."""
    info = read_info(weights)
    if info.preset != "scene":
        raise ConfigError(f"{weights}: a checkpoint of the preset {info.preset!r}, expected one of the preset 'scene'")
    config: SceneConfig = network_config(SceneConfig, info, weights)
    network = config.build()
    load_weights(weights, network)
    return SceneModel(network.eval(), config, sampling or SceneSampling())
