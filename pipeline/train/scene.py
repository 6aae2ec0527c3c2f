"""Training of the scene preset: one place learned by heart, from the episodes of a world or of a folder of logs."""

import dataclasses
from pathlib import Path

import torch
from torch import nn

from cadence.diffusion.scene_frame import SceneConfig
from cadence.network.attention import Team
from cadence.network.scene import Pieces, SceneInputs, SceneNetwork
from cadence.seeds import numpy_stream
from cadence.training.loop import Trainer, untrained
from cadence.training.scene import SceneWindows, diffusion_loss, energy_loss, scene_windows
from pipeline.checkpoints import find_checkpoint, load_weights
from pipeline.episodes.pool import EpisodePool, load_pool
from pipeline.manifest import StageResult
from pipeline.progress import Progress
from pipeline.train.config import SceneTraining, TrainConfig
from pipeline.train.lessons import Lessons
from pipeline.train.run import TrainingRun, run_training

_VALIDATION_BATCH = 250


def train_scene(out: Path, config: TrainConfig, progress: Progress, force: bool = False) -> StageResult:
    """Train the scene preset into `out`; see `pipeline.train.stage.train`."""
    scene, cache = config.scene, out / "episodes"
    model = _model_config(scene)
    together = model.network.attention_heads > 0
    pool, held_out = (
        load_pool(sources, cache, model.step_s, "train.scene.model", progress, together)
        for sources in (scene.sources, scene.validation)
    )
    network = untrained(model.build, config.seed)
    if scene.start is not None:
        load_weights(find_checkpoint(scene.start), network)
    return train_scene_network(out, config, network, pool, held_out, progress, force)


def train_scene_network(
    out: Path,
    config: TrainConfig,
    network: SceneNetwork,
    pool: EpisodePool,
    held_out: EpisodePool,
    progress: Progress,
    force: bool = False,
) -> StageResult:
    """Train a network that begins as it is given, on the windows of `pool`; those of `held_out` validate it."""
    scene = config.scene
    model = _model_config(scene)

    def batch(step: int, generator: torch.Generator) -> SceneWindows:
        rng = numpy_stream(config.seed, "windows", step)
        drawn = pool.rows(config.batch_size, rng)
        return _joined([scene_windows(part, rows, model, scene.told, rng) for part, rows in drawn])

    def loss(network: nn.Module, windows: SceneWindows, generator: torch.Generator) -> torch.Tensor:
        assert isinstance(network, SceneNetwork)
        if scene.objective == "diffusion":
            return diffusion_loss(network, windows, model, scene.path_weight, generator)
        return energy_loss(network, windows, model, scene.num_samples, scene.score_weights, generator)

    rng = numpy_stream(config.seed, "validation")
    checks = held_out.rows_of_each(scene.num_validation_windows, rng)
    validation = _joined([scene_windows(part, rows, model, scene.told, rng) for part, rows in checks])
    lessons = Lessons(batch, loss, list(validation.parts(_VALIDATION_BATCH)))
    start = None if scene.start is None else find_checkpoint(scene.start)
    run = TrainingRun(out, "scene", config, model, config.optimiser.num_steps, start)
    return run_training(run, Trainer(network, config.optimiser), lessons, progress, force)


def _model_config(scene: SceneTraining) -> SceneConfig:
    return dataclasses.replace(scene.model, few_steps=scene.few_steps if scene.objective == "energy" else 0)


def _joined(parts: list[SceneWindows]) -> SceneWindows:
    """One set of several; trackers that only some have are absent in the others."""
    num_trackers = max(part.inputs.trackers.shape[1] for part in parts)
    columns: dict[str, list[torch.Tensor]] = {}
    for part in parts:
        pad = num_trackers - part.inputs.trackers.shape[1]
        values = {name: value for name, value in vars(part.inputs).items() if name != "pieces"} | vars(part.inputs.pieces)
        values["trackers"] = nn.functional.pad(values["trackers"], (0, 0, 0, pad))
        values["is_tracker"] = nn.functional.pad(values["is_tracker"], (0, pad))
        for name, value in values.items():
            columns.setdefault(name, []).append(value)
    joined = {name: torch.cat(values) for name, values in columns.items()}
    pieces = Pieces(*(joined.pop(name) for name in ("last", "start", "duration", "span")))
    teams = [part.team for part in parts if part.team is not None]
    team = Team(torch.cat([team.is_present for team in teams])) if teams else None
    clean, is_real = (torch.cat([getattr(part, name) for part in parts]) for name in ("clean", "is_real"))
    return SceneWindows(SceneInputs(**joined, pieces=pieces), clean, is_real, team)
