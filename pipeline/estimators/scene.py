"""The scene preset: one place learned by heart, on a grid of its own."""

import dataclasses
from pathlib import Path

from cadence.diffusion.feasible import GuidanceConfig
from cadence.diffusion.scene import SceneModel, SceneSampling
from cadence.diffusion.scene_frame import SceneConfig
from cadence.errors import ConfigError
from cadence.recordings import NUM_STEPS
from pipeline.checkpoints import expect_preset, load_network, network_config
from pipeline.estimators.loaded import Loaded
from pipeline.estimators.samplings import Samplings
from pipeline.windows import GridConfig

_CONTEXT_STEPS = 4320
"""The longest mission of the paper's worlds."""


def load_place(weights: Path, samplings: Samplings) -> Loaded:
    """The checkpoint as the stages see it."""
    model = _limited(load_scene(weights, samplings.scene), samplings.guidance)
    return Loaded("scene", model, lambda grid: scene_grid(model.config, grid.stride_steps))


def load_scene(weights: Path, sampling: SceneSampling | None = None) -> SceneModel:
    """The estimator of a checkpoint; `ConfigError` where it is of another preset or does not fit."""
    info = expect_preset(weights, "scene")
    config: SceneConfig = network_config(SceneConfig, info, weights)
    return SceneModel(load_network(weights, config.build), config, sampling or SceneSampling())


def scene_grid(config: SceneConfig, stride_steps: int = 16) -> GridConfig:
    """The only grid that a checkpoint takes: from now on, with detections from as far back as missions are long."""
    return GridConfig(config.step_s, 1, NUM_STEPS - 1, stride_steps, _CONTEXT_STEPS)


def _limited(scene: SceneModel, guidance: GuidanceConfig) -> SceneModel:
    """The model with the margin and the speed limit of all presets where they are stricter than its own, or without any."""
    if guidance.mode == "repair":
        raise ConfigError(
            "infer.guidance.mode: 'repair' is not for the scene preset; infer.scene.guidance = \"none\" only repairs there"
        )
    longest_m = scene.config.max_step_m
    if guidance.max_speed_mps is not None:
        longest_m = min(longest_m, guidance.max_speed_mps * scene.config.step_s)
    sampling = dataclasses.replace(scene.sampling, margin_m=max(scene.sampling.margin_m, guidance.margin_m))
    if guidance.mode == "none":
        sampling = dataclasses.replace(sampling, guidance="none", is_repaired=False)
    return dataclasses.replace(scene, sampling=sampling, config=dataclasses.replace(scene.config, max_step_m=longest_m))
