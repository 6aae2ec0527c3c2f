"""Training of the place preset: one place learned by heart, from the episodes of a world or of a folder of logs."""

import dataclasses
from pathlib import Path

import torch
from torch import nn

from cadence.diffusion.place_frame import PlaceConfig
from cadence.network.attention import Team
from cadence.network.place import Pieces, PlaceInputs, PlaceNetwork
from cadence.seeds import numpy_stream
from cadence.training.loop import Trainer, untrained
from cadence.training.place_losses import PlaceWindows, diffusion_loss, energy_loss, place_windows
from pipeline.checkpoints import find_checkpoint
from pipeline.episodes.pool import EpisodePool, load_pool
from pipeline.manifest import StageResult
from pipeline.progress import Progress
from pipeline.train.config import PlaceTraining, TrainConfig
from pipeline.train.lessons import Lessons
from pipeline.train.run import TrainingRun, run_training
from pipeline.weights import load_weights

_VALIDATION_BATCH = 250


def train_place(out: Path, config: TrainConfig, progress: Progress, force: bool = False) -> StageResult:
    """Train the place preset into `out`; see `pipeline.train.stage.train`."""
    place, cache = config.place, out / "episodes"
    model = _model_config(place)
    together = model.network.attention_heads > 0
    pool, held_out = (
        load_pool(sources, cache, model.step_s, "train.place.model", progress, together)
        for sources in (place.sources, place.validation)
    )
    network = untrained(model.build, config.seed)
    if place.start is not None:
        load_weights(find_checkpoint(place.start), network)
    return train_place_network(out, config, network, pool, held_out, progress, force)


def train_place_network(
    out: Path,
    config: TrainConfig,
    network: PlaceNetwork,
    pool: EpisodePool,
    held_out: EpisodePool,
    progress: Progress,
    force: bool = False,
) -> StageResult:
    """Train a network that begins as it is given, on the windows of `pool`; those of `held_out` validate it."""
    place = config.place
    model = _model_config(place)

    def batch(step: int, generator: torch.Generator) -> PlaceWindows:
        rng = numpy_stream(config.seed, "windows", step)
        drawn = pool.rows(config.batch_size, rng)
        return _joined([place_windows(part, rows, model, place.told, rng) for part, rows in drawn])

    def loss(network: nn.Module, windows: PlaceWindows, generator: torch.Generator) -> torch.Tensor:
        assert isinstance(network, PlaceNetwork)
        if place.objective == "diffusion":
            return diffusion_loss(network, windows, model, place.path_weight, generator)
        return energy_loss(network, windows, model, place.num_samples, place.score_weights, generator)

    rng = numpy_stream(config.seed, "validation")
    checks = held_out.rows_of_each(place.num_validation_windows, rng)
    validation = _joined([place_windows(part, rows, model, place.told, rng) for part, rows in checks])
    lessons = Lessons(batch, loss, list(validation.parts(_VALIDATION_BATCH)))
    start = None if place.start is None else find_checkpoint(place.start)
    run = TrainingRun(out, "place", config, model, config.optimiser.num_steps, start)
    return run_training(run, Trainer(network, config.optimiser), lessons, progress, force)


def _model_config(place: PlaceTraining) -> PlaceConfig:
    return dataclasses.replace(place.model, few_steps=place.few_steps if place.objective == "energy" else 0)


def _joined(parts: list[PlaceWindows]) -> PlaceWindows:
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
    return PlaceWindows(PlaceInputs(**joined, pieces=pieces), clean, is_real, team)
