"""The place preset: one place learned by heart, on a grid of its own."""

import dataclasses
from pathlib import Path

from cadence.diffusion.place import PlaceModel
from cadence.diffusion.place_frame import PlaceConfig
from cadence.diffusion.settings import GuidanceConfig, PlaceSampling
from cadence.errors import ConfigError
from cadence.recordings import NUM_STEPS
from pipeline.checkpoints import expect_preset, network_config
from pipeline.estimators.loaded import Loaded
from pipeline.estimators.samplings import Samplings
from pipeline.grids import GridConfig
from pipeline.weights import load_network

_CONTEXT_STEPS = 4320
"""The longest mission of the paper's worlds."""
_PAST_STEPS = 120
"""So far back from now silence is heard."""


def load_place(weights: Path, samplings: Samplings) -> Loaded:
    """The checkpoint as the stages see it."""
    model = _limited(load_place_model(weights, samplings.place), samplings.guidance)
    return Loaded(
        "place", model, lambda grid: place_grid(model.config, grid.stride_steps), num_past=_PAST_STEPS, knows_standing=True
    )


def load_place_model(weights: Path, sampling: PlaceSampling | None = None) -> PlaceModel:
    """The estimator of a checkpoint; `ConfigError` where it is of another preset or does not fit."""
    info = expect_preset(weights, "place")
    config: PlaceConfig = network_config(PlaceConfig, info, weights)
    return PlaceModel(load_network(weights, config.build), config, sampling or PlaceSampling())


def place_grid(config: PlaceConfig, stride_steps: int = 16) -> GridConfig:
    """The only grid that a checkpoint takes: from now on, with detections from as far back as missions are long."""
    return GridConfig(config.step_s, 1, NUM_STEPS - 1, stride_steps, _CONTEXT_STEPS)


def _limited(model: PlaceModel, guidance: GuidanceConfig) -> PlaceModel:
    """The model with the margin and the speed limit of all presets where they are stricter than its own, or without any."""
    if guidance.mode == "repair":
        raise ConfigError(
            "infer.guidance.mode: 'repair' is not for the place preset; infer.place.guidance = \"none\" only repairs there"
        )
    for name in ("max_acceleration_mps2", "max_turn_rate_dps"):
        if getattr(guidance, name) is not None:
            raise ConfigError(f"infer.guidance.{name}: is for the general preset; a place model has learned how targets turn")
    longest_m = model.config.max_step_m
    if guidance.max_speed_mps is not None:
        longest_m = min(longest_m, guidance.max_speed_mps * model.config.step_s)
    sampling = dataclasses.replace(model.sampling, margin_m=max(model.sampling.margin_m, guidance.margin_m))
    if guidance.mode == "none":
        sampling = dataclasses.replace(sampling, guidance="none", is_repaired=False)
    return dataclasses.replace(model, sampling=sampling, config=dataclasses.replace(model.config, max_step_m=longest_m))
