"""Training of the learned rivals: VRNN and GrAMMI without and with mutual information, on windows cut out of recordings."""

import copy
import dataclasses
import functools
import json
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from cadence.baselines.grammi import GrammiNetwork
from cadence.baselines.mixture import HistoryConfig, MixtureFrame
from cadence.baselines.vrnn import VrnnNetwork
from cadence.errors import ConfigError
from cadence.recordings import Recordings, cut_windows
from cadence.seeds import numpy_stream, torch_stream
from cadence.training.loop import Trainer, untrained
from cadence.training.mixtures import MixtureWindows, grammi_loss, hidden_goals, mixture_windows, vrnn_loss
from pipeline.checkpoints import RIVALS, CheckpointInfo, expect_preset, read_info
from pipeline.episodes.recordings import RecordingsConfig, load_recordings
from pipeline.estimators.mixtures import GrammiConfig, VrnnConfig, fresh_rival, rival_config
from pipeline.manifest import StageResult
from pipeline.progress import Progress
from pipeline.train.config import RivalTraining, TrainConfig
from pipeline.train.lessons import Lessons, in_parts
from pipeline.train.run import OUTPUTS, TrainingRun, run_training
from pipeline.weights import load_weights, read_note, save_checkpoint, write_tensors

_BATCHES_A_BLOCK = 32
"""Batches cut at once: cutting has a fixed cost that goes with the recordings."""
_VALIDATION_BATCH = 512
_MARGIN = 1.02
"""Map limits taken from the recordings get this much room."""


def train_rivals(out: Path, config: TrainConfig, progress: Progress, force: bool = False) -> StageResult:
    """Train the preset of `config` on its sources into `out`; see `pipeline.train.stage.train`."""
    rival = config.rival
    kept, held_out = [], []
    for source in rival.sources or (RecordingsConfig(),):
        recordings = load_recordings(source, out / "recordings", progress).recordings.apart()
        if len(recordings) < 2:
            raise ConfigError("train.rival.sources: a source has one episode; two are needed, whole ones are for validation")
        num = min(max(1, round(rival.validation_share * len(recordings))), len(recordings) - 1)
        kept.append(recordings.select(slice(0, len(recordings) - num)))
        held_out.append(recordings.select(slice(len(recordings) - num, None)))
    return train_rival(out, config, Recordings.concatenate(kept), Recordings.concatenate(held_out), progress, force)


def train_rival(
    out: Path,
    config: TrainConfig,
    recordings: Recordings,
    validation: Recordings,
    progress: Progress,
    force: bool = False,
) -> StageResult:
    """Train the preset of `config` on recordings; the checkpoint is the best by the likelihood of the validation windows."""
    if config.preset != "grammi":
        return _train(out, config, recordings, validation, progress, force)
    start = config.rival.start
    if start is None:
        first = dataclasses.replace(config, preset="grammi_without_mi")
        train_rival(out / "without_mi", first, recordings, validation, progress, force)
        start = out / "without_mi" / OUTPUTS[0]
    rival = dataclasses.replace(
        config.rival, start=start, grammi=dataclasses.replace(config.rival.grammi, mutual_information=True)
    )
    optimiser = dataclasses.replace(
        config.optimiser, num_steps=rival.tuning_steps, learning_rate=rival.tuning_rate, warm_up_steps=1
    )
    tuned = dataclasses.replace(config, rival=rival, optimiser=optimiser)
    return _train(out, tuned, recordings, validation, progress, force)


def _train(
    out: Path, config: TrainConfig, recordings: Recordings, validation: Recordings, progress: Progress, force: bool
) -> StageResult:
    """One training; `config.rival.start` gives the weights to begin with, as far as the network has them."""
    rival, optimiser = config.rival, config.optimiser
    out.mkdir(parents=True, exist_ok=True)
    frame = _frame(rival, recordings)
    description: VrnnConfig | GrammiConfig
    description = VrnnConfig(rival.vrnn, frame) if config.preset == "vrnn" else GrammiConfig(rival.grammi, frame)
    history, horizons = description.network.history, description.network.horizons
    source = _Source(recordings, frame, history, horizons, config.seed, config.batch_size)
    checks = _cut(validation, frame, history, horizons, rival.num_validation_windows, numpy_stream(config.seed, "validation"))
    checks = hidden_goals(checks, rival.hidden_goals, torch_stream(config.seed, "hidden goals"))
    trainer = Trainer(untrained(lambda: _network(description, rival.start), config.seed), optimiser)

    def batch(step: int, generator: torch.Generator) -> MixtureWindows:
        return hidden_goals(source.batch(step), rival.hidden_goals, generator)

    def loss(network: nn.Module, windows: MixtureWindows, generator: torch.Generator) -> Tensor:
        if isinstance(network, VrnnNetwork):
            return vrnn_loss(network, windows, generator, rival.kl_weight)
        assert isinstance(network, GrammiNetwork)
        return grammi_loss(network, windows, rival.mi_weight)

    lessons = Lessons(batch, loss, in_parts(checks, _VALIDATION_BATCH), _negative_log_likelihood)
    run = TrainingRun(out, config.preset, config, description, optimiser.num_steps, rival.start)
    best = _Best(out, run.key, force)
    result = run_training(run, trainer, lessons, progress, force, best.offer)
    return best.ship(result, trainer.ema.network)


def _network(description: VrnnConfig | GrammiConfig, start: Path | None) -> VrnnNetwork | GrammiNetwork:
    """A fresh network, or one that begins with the weights of `start`."""
    network = fresh_rival(description)
    if start is None:
        return network
    before = rival_config(expect_preset(start, *RIVALS), start)
    if not _grows_into(before, description):
        raise ConfigError(f"{start}: not the same network or map; set train.rival alike")
    trained = fresh_rival(before)
    load_weights(start, trained)
    if isinstance(network, GrammiNetwork) and isinstance(trained, GrammiNetwork):
        trained.trunks.extend(copy.deepcopy(trained.trunks[0]) for _ in network.trunks[len(trained.trunks) :])
    network.load_state_dict(trained.state_dict(), strict=False)
    return network


def _grows_into(before: VrnnConfig | GrammiConfig, description: VrnnConfig | GrammiConfig) -> bool:
    """Whether the networks are alike, but for a posterior that comes in, or one trunk that becomes one for each horizon."""
    if isinstance(before, GrammiConfig) and isinstance(description, GrammiConfig):
        old, new = before.network, description.network
        grown = dataclasses.replace(
            old,
            mutual_information=old.mutual_information or new.mutual_information,
            shared_trunk=old.shared_trunk and new.shared_trunk,
        )
        before = dataclasses.replace(before, network=grown)
    return before == description


def _negative_log_likelihood(network: nn.Module, windows: MixtureWindows, _: torch.Generator) -> Tensor:
    """Mean over windows and horizons, latent variables at their mean."""
    mean: Tensor = network(windows.inputs).negative_log_likelihood(windows.target).mean()
    return mean


class _Source:
    """Batches of random windows, every step of every episode equally likely; a batch depends on seed and step alone."""

    def __init__(
        self,
        recordings: Recordings,
        frame: MixtureFrame,
        history: HistoryConfig,
        horizons: tuple[int, ...],
        seed: int,
        batch_size: int,
    ) -> None:
        self.seed, self.batch_size = seed, batch_size
        self.cut = functools.partial(_cut, recordings, frame, history, horizons)
        self.block: tuple[int, MixtureWindows] | None = None

    def batch(self, step: int) -> MixtureWindows:
        number, index = divmod(step, _BATCHES_A_BLOCK)
        if self.block is None or self.block[0] != number:
            self.block = number, self.cut(_BATCHES_A_BLOCK * self.batch_size, numpy_stream(self.seed, "windows", number))
        return self.block[1][slice(index * self.batch_size, (index + 1) * self.batch_size)]


def _cut(
    recordings: Recordings,
    frame: MixtureFrame,
    history: HistoryConfig,
    horizons: tuple[int, ...],
    num_windows: int,
    rng: np.random.Generator,
) -> MixtureWindows:
    """Random windows as the network sees them."""
    rows = rng.integers(0, len(recordings.position_m), num_windows)
    episode = np.searchsorted(recordings.offset, rows, side="right") - 1
    windows = cut_windows(
        recordings,
        episode,
        rows - recordings.offset[episode],
        num_detections=history.max_detections,
        num_tracker_steps=max(1, history.tracker_steps),
    )
    return mixture_windows(windows, frame, history, horizons)


class _Best:
    """The weights of least validation loss so far, kept beside the training's state."""

    def __init__(self, out: Path, key: str, force: bool) -> None:
        self.weights, self.key = out / "best.safetensors", key
        self.step, self.loss = -1, float("inf")
        note = read_note(self.weights) if self.weights.is_file() and not force else None
        found = json.loads(note) if note is not None else {}
        if found.get("key") == key:
            self.step, self.loss = found["step"], found["loss"]

    def offer(self, step: int, loss: float, network: nn.Module) -> None:
        """Keep the network if it is better than all before."""
        if loss < self.loss:
            self.step, self.loss = step, loss
            write_tensors(self.weights, network.state_dict(), json.dumps({"key": self.key, "step": step, "loss": loss}))

    def ship(self, result: StageResult, network: nn.Module) -> StageResult:
        """Put the best weights into the checkpoint, in place of the last ones."""
        checkpoint = Path(result.outputs[0])
        info: CheckpointInfo = read_info(checkpoint)
        if self.step >= 0:
            network.load_state_dict(load_file(self.weights))
        training = {**info.training, "best_step": self.step}
        save_checkpoint(
            checkpoint, network, dataclasses.replace(info, training=training, scores={"validation_loss": self.loss})
        )
        return dataclasses.replace(result, summary={**result.summary, "validation_loss": self.loss, "best_step": self.step})


def _frame(rival: RivalTraining, recordings: Recordings) -> MixtureFrame:
    """The map's limits from the training episodes, with a little room; what is configured is kept."""
    low, high = (bound(recordings.position_m, axis=0).astype(np.float64) for bound in (np.min, np.max))
    middle = 0.5 * (low + high)
    centre = rival.centre_m or (float(middle[0]), float(middle[1]))
    half = float(np.maximum(high - np.array(centre), np.array(centre) - low).max()) * _MARGIN
    scale = rival.scale_m or (half if half > 0 else 1.0)
    return MixtureFrame(recordings.step_s, centre, scale, rival.age_scale_steps, rival.elapsed_scale_steps)
