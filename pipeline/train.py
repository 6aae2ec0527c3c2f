"""The train stage: from synthetic kinematics or logs with truth to a checkpoint; killed and started again it goes on."""

import csv
import functools
import io
import os
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from cadence.errors import InputError
from cadence.network.residual import ResidualNetwork, ResidualNetworkConfig
from cadence.training.loop import OptimiserConfig, Trainer
from cadence.training.residual import residual_loss
from cadence.training.synthetic import ResidualWindows, SyntheticConfig, join_windows
from pipeline.checkpoints import CheckpointInfo, save_checkpoint
from pipeline.config import config_as_dict
from pipeline.manifest import StageResult, write_atomic
from pipeline.progress import Progress
from pipeline.shards import synthetic_shard
from pipeline.train_absolute import AbsoluteTraining, train_absolute

_VALIDATION_SEED_OFFSET = 500_009
_STEPS_A_SHARD = 120
"""New shards join at this pace, so that making them does not hold up the start."""


@dataclass(frozen=True)
class TrainConfig:
    """What to train, on what, for how long.

    preset            "general" (residual of the bank) or "paper" (absolute coordinates, the published architecture)
    data              folder of MCAP logs with truth; None = synthetic kinematics (general) or the simulator (paper)
    seed              of weights, data and noise
    batch_size        windows a step
    num_shards        synthetic shards of about 1250 windows; a shard is made when it is first needed
    num_validation_shards  shards from other scenarios, never trained on
    validate_every, save_every  steps
    threads           of torch; None = as many as there are cores
    network, windows  of the general preset
    paper             of the paper preset
    """

    preset: Literal["general", "paper"] = "general"
    data: Path | None = None
    seed: int = 0
    batch_size: int = 128
    num_shards: int = 48
    num_validation_shards: int = 1
    validate_every: int = 500
    save_every: int = 250
    threads: int | None = None
    network: ResidualNetworkConfig = field(default_factory=ResidualNetworkConfig)
    windows: SyntheticConfig = field(default_factory=SyntheticConfig)
    optimiser: OptimiserConfig = field(default_factory=OptimiserConfig)
    paper: AbsoluteTraining = field(default_factory=AbsoluteTraining)


def train(out: Path, config: TrainConfig, progress: Progress, force: bool = False) -> StageResult:
    """Train into the folder `out`: checkpoint.safetensors + .json, curve.csv, curve.png, and the state to go on from.

    A state of an earlier, killed call with the same configuration is taken up; `force` starts anew.
    """
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    if config.preset == "paper":
        return train_absolute(out, config, progress, force)
    torch.manual_seed(config.seed)
    trainer = Trainer(ResidualNetwork(config.network), config.optimiser)
    curve = _resume(out, config, trainer, force)
    if curve:
        progress.note(f"train: going on at step {trainer.step} of {config.optimiser.num_steps}")
    validation = _validation(out, config)
    supply = _Supply(out, config)
    with progress.bar(config.optimiser.num_steps, "train", unit="step") as bar:
        bar.update(trainer.step)
        recent: list[float] = []
        while trainer.step < config.optimiser.num_steps:
            generator = torch.Generator().manual_seed(config.seed * 7_919 + trainer.step)
            batch = supply.batch(trainer.step, generator)
            recent.append(trainer.advance(functools.partial(residual_loss, windows=batch, generator=generator)))
            bar.update(1)
            is_last = trainer.step == config.optimiser.num_steps
            if trainer.step % config.validate_every == 0 or is_last:
                curve.append((trainer.step, sum(recent) / len(recent), _validation_loss(trainer, validation)))
                recent = []
                bar.set_postfix_str(f"loss {curve[-1][1]:.4f}, validation {curve[-1][2]:.4f}")
            if trainer.step % config.save_every == 0 or is_last:
                _save(out, config, trainer, curve)
    _draw_curve(out, curve)
    outputs = ("checkpoint.safetensors", "checkpoint.json", "curve.csv", "curve.png")
    summary = {"steps": trainer.step, "validation_loss": curve[-1][2], "checkpoint": str(out / outputs[0])}
    return StageResult("train", "done", tuple(out / name for name in outputs), summary)


class _Supply:
    """Batches by step: shards in rotation, so that a killed training sees the same batches again."""

    def __init__(self, out: Path, config: TrainConfig) -> None:
        self.out, self.config = out, config
        self.shards: dict[int, ResidualWindows] = {}
        self.logs: ResidualWindows | None = None
        if config.data is not None:
            from pipeline.train_logs import windows_of_logs

            self.logs = windows_of_logs(config.data, out / "windows", is_validation=False)

    def batch(self, step: int, generator: torch.Generator) -> ResidualWindows:
        """`batch_size` windows: a half each of two shards, or all of the logs."""
        size = self.config.batch_size
        if self.logs is not None:
            return self.logs[torch.randint(len(self.logs), (size,), generator=generator)]
        parts = []
        for index in torch.randint(min(self.config.num_shards, 2 + step // _STEPS_A_SHARD), (2,), generator=generator).tolist():
            shard = self._shard(index)
            parts.append(shard[torch.randint(len(shard), (size // 2,), generator=generator)])
        return join_windows(parts)

    def _shard(self, index: int) -> ResidualWindows:
        if index not in self.shards:
            self.shards[index] = synthetic_shard(self.out / "windows", self.config.windows, self.config.seed, index)
        return self.shards[index]


def _validation(out: Path, config: TrainConfig) -> ResidualWindows:
    if config.data is not None:
        from pipeline.train_logs import windows_of_logs

        return windows_of_logs(config.data, out / "windows", is_validation=True)
    seed = config.seed + _VALIDATION_SEED_OFFSET
    return join_windows(
        [synthetic_shard(out / "windows", config.windows, seed, index) for index in range(config.num_validation_shards)]
    )


@torch.no_grad()
def _validation_loss(trainer: Trainer, windows: ResidualWindows) -> float:
    generator = torch.Generator().manual_seed(1)
    parts = [torch.arange(begin, min(begin + 256, len(windows))) for begin in range(0, len(windows), 256)]
    losses = [residual_loss(trainer.ema.network, windows[part], generator) * len(part) for part in parts]  # type: ignore[arg-type]
    return float(sum(float(loss) for loss in losses) / len(windows))


def _state_key(config: TrainConfig) -> str:
    return repr(sorted(item for item in config_as_dict(config).items() if item[0] != "paper"))


def _resume(out: Path, config: TrainConfig, trainer: Trainer, force: bool) -> list[tuple[int, float, float]]:
    path = out / "state.safetensors"
    key = out / "state.key"
    if force or not path.is_file() or not key.is_file() or key.read_text() != _state_key(config):
        return []
    try:
        trainer.restore(load_file(path))
    except (SafetensorError, OSError, KeyError) as error:
        raise InputError(f"{path}: the state to go on from cannot be read ({error}); start anew with --force") from error
    with (out / "curve.csv").open(newline="") as file:
        rows = list(csv.reader(file))[1:]
    return [(int(a), float(b), float(c)) for a, b, c in rows if int(a) <= trainer.step]


def _save(out: Path, config: TrainConfig, trainer: Trainer, curve: list[tuple[int, float, float]]) -> None:
    out.mkdir(parents=True, exist_ok=True)
    table = io.StringIO()
    csv.writer(table).writerows([("step", "loss", "validation_loss"), *curve])
    write_atomic(out / "curve.csv", table.getvalue())
    partial = out / f".state.{os.getpid()}.part"
    save_file(trainer.state(), partial)
    write_atomic(out / "state.key", _state_key(config))
    os.replace(partial, out / "state.safetensors")
    training = {
        "command": "cadence " + " ".join(sys.argv[1:]),
        "config": config_as_dict(config),
        "steps": trainer.step,
        "seed": config.seed,
    }
    scores = {"validation_loss": curve[-1][2], "zero_loss_note": "a network that answers zero scores about 1"} if curve else {}
    info = CheckpointInfo(config.preset, config_as_dict(config.network), training, scores)
    save_checkpoint(out / "checkpoint.safetensors", trainer.ema.network, info)


def _draw_curve(out: Path, curve: list[tuple[int, float, float]]) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    steps, loss, validation = zip(*curve, strict=True)
    axes.plot(steps, loss, label="training")
    axes.plot(steps, validation, label="validation (average weights)")
    axes.set(xlabel="step", ylabel="mean square error of the velocity")
    axes.legend()
    axes.grid(alpha=0.3)
    figure.savefig(out / "curve.png", dpi=110)
