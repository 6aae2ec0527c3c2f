"""One training's files: curve, state to go on from, checkpoint; the loop that is the same for every preset."""

import csv
import io
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import nn

from cadence.errors import InputError
from cadence.training.loop import Trainer
from pipeline.checkpoints import WEIGHTS_NAME, CheckpointInfo, read_info, windows_seen
from pipeline.config import config_as_dict
from pipeline.files import write_atomic
from pipeline.manifest import StageResult
from pipeline.progress import Progress
from pipeline.train.config import TrainConfig
from pipeline.train.lessons import Lessons, W
from pipeline.weights import read_note, save_checkpoint, write_tensors

Curve = list[tuple[int, float, float]]
"""(step, training loss, validation loss) of every validation."""
OUTPUTS = (WEIGHTS_NAME, "checkpoint.json", "curve.csv", "curve.png")


@dataclass(frozen=True)
class TrainingRun:
    """What the loop needs to know of a training.

    out        its folder
    preset     of the checkpoint
    config     the whole configuration: a state of another one is not taken up
    network    the configuration that the checkpoint needs to be read again
    num_steps  optimiser steps
    start      checkpoint that the training began with, whose windows count too
    """

    out: Path
    preset: str
    config: TrainConfig
    network: object
    num_steps: int
    start: Path | None = None

    @property
    def key(self) -> str:
        """What a state belongs to."""
        return repr(sorted(config_as_dict(self.config).items()))


def run_training(
    run: TrainingRun,
    trainer: Trainer,
    lessons: Lessons[W],
    progress: Progress,
    force: bool = False,
    on_validation: Callable[[int, float, nn.Module], object] = lambda *_: None,
) -> StageResult:
    """Train to the last step, going on from a killed call's state unless `force`; the checkpoint holds the average weights.

    Args:
        run: of the training.
        trainer: fresh.
        lessons: what it is taught.
        progress: bar and notes.
        force: start anew.
        on_validation: is told each step at which the network was examined, the loss and the average weights.
    """
    curve = [] if force else _resume(run, trainer)
    if trainer.step:
        progress.note(f"train: going on at step {trainer.step} of {run.num_steps}")
    recent: list[float] = []
    spent = _cpu_seconds(run.out / OUTPUTS[0]) if trainer.step else _cpu_seconds(run.start)
    begin = time.process_time()
    with progress.bar(run.num_steps, "train", unit="step") as bar:
        bar.update(trainer.step)
        while trainer.step < run.num_steps:
            recent.append(trainer.advance(lessons.loss_at(trainer.step, run.config.seed)))
            bar.update(1)
            is_last = trainer.step == run.num_steps
            if trainer.step % run.config.validate_every == 0 or is_last:
                curve.append((trainer.step, sum(recent) / len(recent), lessons.validation_loss(trainer.ema.network)))
                on_validation(trainer.step, curve[-1][2], trainer.ema.network)
                recent = []
                bar.set_postfix_str(f"loss {curve[-1][1]:.4f}, validation {curve[-1][2]:.4f}")
            if trainer.step % run.config.save_every == 0 or is_last:
                _save(run, trainer, curve, None if spent is None else spent + time.process_time() - begin)
    _draw_curve(run.out, curve)
    summary: dict[str, Any] = {"steps": trainer.step, "checkpoint": str(run.out / OUTPUTS[0])}
    summary["validation_loss"] = curve[-1][2] if curve else None
    return StageResult("train", "done", tuple(run.out / name for name in OUTPUTS), summary)


def _resume(run: TrainingRun, trainer: Trainer) -> Curve:
    path = run.out / "state.safetensors"
    if not path.is_file():
        return []
    try:
        if read_note(path) != run.key:
            return []
        trainer.restore(load_file(path))
        with (run.out / "curve.csv").open(newline="", encoding="utf-8") as file:
            rows = list(csv.reader(file))[1:]
        return [(int(a), float(b), float(c)) for a, b, c in rows if int(a) <= trainer.step]
    except (SafetensorError, OSError, KeyError, ValueError) as error:
        raise InputError(f"{path}: the state to go on from cannot be read ({error}); start anew with --force") from error


def _save(run: TrainingRun, trainer: Trainer, curve: Curve, cpu_seconds: float | None) -> None:
    table = io.StringIO()
    csv.writer(table).writerows([("step", "loss", "validation_loss"), *curve])
    write_atomic(run.out / "curve.csv", table.getvalue())
    write_tensors(run.out / "state.safetensors", trainer.state(), run.key)
    training = {
        "command": "cadence " + " ".join(sys.argv[1:]),
        "config": config_as_dict(run.config),
        "steps": trainer.step,
        "windows": trainer.step * run.config.batch_size + _windows_before(run.start),
        "cpu_seconds": cpu_seconds,
    }
    scores = {"validation_loss": curve[-1][2]} if curve else {}
    info = CheckpointInfo(run.preset, config_as_dict(run.network), training, scores)
    save_checkpoint(run.out / OUTPUTS[0], trainer.ema.network, info)


def _windows_before(start: Path | None) -> int:
    """Windows that the checkpoint has seen that a training began with, itself and those before it."""
    return 0 if start is None else int(windows_seen(read_info(start).training) or 0)


def _cpu_seconds(checkpoint: Path | None) -> float | None:
    """Processor time behind a checkpoint, all that it began with included; 0 without one, None where it does not say."""
    if checkpoint is None:
        return 0.0
    seconds = read_info(checkpoint).training.get("cpu_seconds") if checkpoint.is_file() else None
    return None if seconds is None else float(seconds)


def _draw_curve(out: Path, curve: Curve) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    steps, loss, validation = zip(*curve, strict=True)
    axes.plot(steps, loss, label="training")
    axes.plot(steps, validation, label="validation (average weights)")
    axes.set(xlabel="step", ylabel="mean square error")
    axes.legend()
    axes.grid(alpha=0.3)
    figure.savefig(out / "curve.png", dpi=110)
