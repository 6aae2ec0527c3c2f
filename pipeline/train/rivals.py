"""Training of the learned rivals: VRNN and GrAMMI without and with mutual information, on windows cut out of recordings."""

import copy
import dataclasses
import functools
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from cadence.baselines.grammi import GrammiNetwork, GrammiNetworkConfig
from cadence.baselines.mixture import HistoryConfig, MixtureFrame, MixtureModel
from cadence.baselines.vrnn import VrnnNetwork, VrnnNetworkConfig
from cadence.errors import ConfigError
from cadence.recordings import Recordings, cut_windows
from cadence.training.loop import Loss, Trainer
from cadence.training.mixtures import MixtureWindows, grammi_loss, hidden_goals, mixture_windows, vrnn_loss
from pipeline.checkpoints import CheckpointInfo, load_weights, network_config, read_info, save_checkpoint
from pipeline.episodes.recordings import RecordingsConfig, load_recordings
from pipeline.manifest import StageResult, write_atomic
from pipeline.progress import Progress
from pipeline.train.run import OUTPUTS, TrainingRun, run_training

if TYPE_CHECKING:
    from pipeline.train.stage import TrainConfig

Rival = Literal["vrnn", "grammi_without_mi", "grammi"]
RIVALS: tuple[Rival, ...] = ("vrnn", "grammi_without_mi", "grammi")
"""Presets of this module."""

_BATCHES_A_BLOCK = 32
"""Batches cut at once: cutting has a fixed cost that goes with the recordings."""
_VALIDATION_STREAM = 500_009
_MARGIN = 1.02
"""Map limits taken from the recordings get this much room."""


@dataclass(frozen=True)
class VrnnConfig:
    """What belongs to a VRNN's checkpoint: the network, and what its numbers mean."""

    network: VrnnNetworkConfig = field(default_factory=VrnnNetworkConfig)
    frame: MixtureFrame = field(default_factory=MixtureFrame)


@dataclass(frozen=True)
class GrammiConfig:
    """What belongs to a GrAMMI's checkpoint: the network, and what its numbers mean."""

    network: GrammiNetworkConfig = field(default_factory=GrammiNetworkConfig)
    frame: MixtureFrame = field(default_factory=MixtureFrame)


@dataclass(frozen=True)
class RivalTraining:
    """How the learned rivals are trained; the defaults are the published values where there are any.

    vrnn, grammi   the networks
    sources        where episodes come from; without any one is simulated as the defaults of a source say
    validation_share  of each source's episodes, whole ones, its last; at least one
    centre_m, scale_m  the map's centre and half its side; by default from the training episodes
    age_scale_steps, elapsed_scale_steps  ages of detections and elapsed time are counted in so many steps
    hidden_goals   share of the windows in which the known goal is hidden
    num_validation_windows  random ones, of the validation episodes
    kl_weight      of the divergence in the VRNN's loss
    mi_weight      of the cross-entropy in GrAMMI's loss
    tuning_steps, tuning_rate  of GrAMMI with mutual information, which goes on from the model without
    start          checkpoint to go on from; a GrAMMI may grow a posterior, and its one trunk may become one for each horizon.
                   GrAMMI with mutual information needs one without, and trains it in the folder without_mi where none is given
    """

    vrnn: VrnnNetworkConfig = field(default_factory=VrnnNetworkConfig)
    grammi: GrammiNetworkConfig = field(default_factory=GrammiNetworkConfig)
    sources: tuple[RecordingsConfig, ...] = ()
    validation_share: float = 0.1
    centre_m: tuple[float, float] | None = None
    scale_m: float | None = None
    age_scale_steps: float = 4320.0
    elapsed_scale_steps: float = 4320.0
    hidden_goals: float = 0.5
    num_validation_windows: int = 4000
    kl_weight: float = 0.01
    mi_weight: float = 2.0
    tuning_steps: int = 4000
    tuning_rate: float = 8e-5
    start: Path | None = None

    def __post_init__(self) -> None:
        if not 0 < self.validation_share < 1 or not 0 <= self.hidden_goals <= 1:
            raise ValueError("validation_share must lie between 0 and 1, hidden_goals in 0 ... 1")
        if min(self.num_validation_windows, self.tuning_steps) < 1 or not self.tuning_rate > 0:
            raise ValueError("num_validation_windows, tuning_steps and tuning_rate must be positive")
        if min(self.kl_weight, self.mi_weight) < 0:
            raise ValueError("kl_weight and mi_weight must not be negative")
        MixtureFrame(1.0, (0.0, 0.0), self.scale_m or 1.0, self.age_scale_steps, self.elapsed_scale_steps)


def train_rivals(out: Path, config: "TrainConfig", progress: Progress, force: bool = False) -> StageResult:
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
    config: "TrainConfig",
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


def load_rival(weights: Path, uses_goal: bool = False) -> MixtureModel:
    """The estimator of a rival's checkpoint; `ConfigError` where it is of another preset or does not fit."""
    info = read_info(weights)
    config = _description(info, weights)
    network = _fresh(config)
    load_weights(weights, network)
    return MixtureModel(network.eval(), config.frame, info.preset, uses_goal)


def _description(info: CheckpointInfo, weights: Path) -> VrnnConfig | GrammiConfig:
    """What the checkpoint says of its network."""
    if info.preset not in RIVALS:
        raise ConfigError(f"{weights}: a checkpoint of the preset {info.preset!r}, expected one of {', '.join(RIVALS)}")
    found: VrnnConfig | GrammiConfig = network_config(VrnnConfig if info.preset == "vrnn" else GrammiConfig, info, weights)
    return found


def _train(
    out: Path, config: "TrainConfig", recordings: Recordings, validation: Recordings, progress: Progress, force: bool
) -> StageResult:
    """One training; `config.rival.start` gives the weights to begin with, as far as the network has them."""
    rival, optimiser = config.rival, config.optimiser
    out.mkdir(parents=True, exist_ok=True)
    frame = _frame(rival, recordings)
    description: VrnnConfig | GrammiConfig
    description = VrnnConfig(rival.vrnn, frame) if config.preset == "vrnn" else GrammiConfig(rival.grammi, frame)
    history, horizons = description.network.history, description.network.horizons
    source = _Source(recordings, frame, history, horizons, config.seed, config.batch_size)
    checks = _cut(validation, frame, history, horizons, rival.num_validation_windows, [config.seed, _VALIDATION_STREAM])
    with torch.random.fork_rng(devices=[]):  # layers take their first weights from the global stream, which is left as it was
        torch.random.manual_seed(config.seed)
        trainer = Trainer(_network(description, rival.start), optimiser)

    def loss_at(step: int) -> Loss:
        generator = torch.Generator().manual_seed(config.seed * 7_919 + step)
        windows = hidden_goals(source.batch(step), rival.hidden_goals, generator)
        return functools.partial(_loss, windows=windows, rival=rival, generator=generator)

    run = TrainingRun(out, config.preset, config, description, optimiser.num_steps, rival.start)
    best = _Best(out, run.key, force)

    @torch.no_grad()
    def validate(network: nn.Module) -> float:
        score = _validation_loss(network, checks, rival.hidden_goals)
        best.offer(trainer.step, score, network)
        return score

    result = run_training(run, trainer, loss_at, validate, progress, force)
    return best.ship(result, trainer.ema.network)


def _fresh(description: VrnnConfig | GrammiConfig) -> VrnnNetwork | GrammiNetwork:
    if isinstance(description, VrnnConfig):
        return VrnnNetwork(description.network)
    return GrammiNetwork(description.network)


def _network(description: VrnnConfig | GrammiConfig, start: Path | None) -> VrnnNetwork | GrammiNetwork:
    """A fresh network, or one that begins with the weights of `start`."""
    network = _fresh(description)
    if start is None:
        return network
    before = _description(read_info(start), start)
    if not _grows_into(before, description):
        raise ConfigError(f"{start}: not the same network or map; set train.rival alike")
    trained = _fresh(before)
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


def _loss(network: nn.Module, windows: MixtureWindows, rival: RivalTraining, generator: torch.Generator) -> Tensor:
    if isinstance(network, VrnnNetwork):
        return vrnn_loss(network, windows, generator, rival.kl_weight)
    assert isinstance(network, GrammiNetwork)
    return grammi_loss(network, windows, rival.mi_weight)


def _validation_loss(network: nn.Module, windows: MixtureWindows, share: float) -> float:
    """Mean negative log likelihood over windows and horizons, latent variables at their mean, the goal known in some."""
    generator = torch.Generator().manual_seed(1)
    windows = hidden_goals(windows, share, generator)
    total = 0.0
    for pick in torch.split(torch.arange(len(windows)), 512):
        part = windows[pick]
        total += float(network(part.inputs).negative_log_likelihood(part.target).mean()) * len(part)
    return total / len(windows)


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
            self.block = number, self.cut(_BATCHES_A_BLOCK * self.batch_size, [self.seed, number])
        return self.block[1][slice(index * self.batch_size, (index + 1) * self.batch_size)]


def _cut(
    recordings: Recordings,
    frame: MixtureFrame,
    history: HistoryConfig,
    horizons: tuple[int, ...],
    num_windows: int,
    seed: Sequence[int],
) -> MixtureWindows:
    """Random windows as the network sees them."""
    rows = np.random.default_rng(list(seed)).integers(0, len(recordings.position_m), num_windows)
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
        self.weights, self.note = out / "best.safetensors", out / "best.json"
        self.key = key
        self.step, self.loss = -1, float("inf")
        if not force and self.note.is_file():
            found = json.loads(self.note.read_text(encoding="utf-8"))
            if found["key"] == key:
                self.step, self.loss = found["step"], found["loss"]

    def offer(self, step: int, loss: float, network: nn.Module) -> None:
        """Keep the network if it is better than all before."""
        if loss < self.loss:
            self.step, self.loss = step, loss
            save_file({name: value.contiguous() for name, value in network.state_dict().items()}, self.weights)
            write_atomic(self.note, json.dumps({"key": self.key, "step": step, "loss": loss}) + "\n")

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
