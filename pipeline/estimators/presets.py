"""The presets: every kind of checkpoint, how it becomes an estimator, and which settings it reads.

A new preset is a module beside this one and an entry in PRESETS. Modules are imported when they load something: which settings
are read is asked before every run, also where nothing is to be done, and must not cost torch.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from cadence.errors import ConfigError, DeviceError
from pipeline.checkpoints import RIVALS, find_checkpoint, read_info
from pipeline.config import changed_settings
from pipeline.estimators.samplings import Samplings

if TYPE_CHECKING:
    from cadence.types import Estimator
    from pipeline.estimators.loaded import Loaded

NO_CHECKPOINT = "none"
"""Stands for the bank alone where a checkpoint is named."""


@dataclass(frozen=True)
class Preset:
    """One kind of checkpoint.

    load       weights and settings → what the stages use
    reads      settings of [infer] that it reads, beside those that every preset does (`READ_BY_ALL`); a name with a full stop
               at its end stands for the whole table
    runs_on    devices that it runs on, beside the choice of its own ("auto")
    infers     it draws hypotheses of a recorded mission
    forecasts  it forecasts by the paper's protocol, without being fitted to a log
    """

    load: Callable[[Path, Samplings], "Loaded"]
    reads: tuple[str, ...] = ()
    runs_on: tuple[str, ...] = ("cpu",)
    infers: bool = True
    forecasts: bool = True


def _load_general(weights: Path | None, samplings: Samplings) -> "Loaded":
    from pipeline.estimators.general import load_general

    return load_general(weights, samplings)


def _load_place(weights: Path, samplings: Samplings) -> "Loaded":
    from pipeline.estimators.place import load_place

    return load_place(weights, samplings)


def _load_paper(weights: Path, samplings: Samplings) -> "Loaded":
    from pipeline.estimators.paper import load_paper

    return load_paper(weights, samplings)


def _load_mixture(weights: Path, samplings: Samplings) -> "Loaded":
    from pipeline.estimators.mixtures import load_mixture

    return load_mixture(weights, samplings)


READ_BY_ALL = (
    "checkpoint", "num_hypotheses", "seed", "device", "default_sigma_m", "is_strict", "is_associated", "association.",
    "evidence.",
    "grid.stride_steps",
)  # fmt: skip
"""Settings of [infer] that act whatever the preset."""

_BANK = ("grid.", "guidance.")

PRESETS: Mapping[str, Preset] = {
    "general": Preset(_load_general, ("sampler", "num_steps", "is_gated", *_BANK), ("cpu", "cuda"), forecasts=False),
    "place": Preset(_load_place, ("is_tested", "place.", "guidance.")),
    "paper": Preset(_load_paper, ("is_tested", "paper.")),
    **dict.fromkeys(RIVALS, Preset(_load_mixture, infers=False)),
}


def find_weights(checkpoint: str) -> Path | None:
    """The file that a checkpoint's name stands for; None for the bank alone. `ConfigError` where there is none."""
    return None if checkpoint == NO_CHECKPOINT else find_checkpoint(checkpoint)


def load_estimator(checkpoint: str, samplings: Samplings) -> "Loaded":
    """What infer draws with. `ConfigError` for checkpoints that cannot be read or do not infer."""
    weights = find_weights(checkpoint)
    if weights is None:
        return _load_general(None, samplings)
    return _load(_preset(weights, "draw hypotheses of missions", lambda preset: preset.infers), weights, samplings)


def load_forecaster(checkpoint: str, samplings: Samplings | None = None) -> "Estimator":
    """The estimator that the paper's protocol scores. `ConfigError` for checkpoints that cannot be read or do not forecast."""
    weights = find_checkpoint(checkpoint)
    preset = _preset(weights, "forecast", lambda preset: preset.forecasts)
    return _load(preset, weights, samplings or Samplings()).estimator


def refuse_unread(checkpoint: str, config: object) -> None:
    """`ConfigError` where a setting of [infer] differs from its default and the checkpoint's preset does not read it.

    Checkpoints of presets that do not infer pass: loading them says more.
    """
    weights = find_weights(checkpoint)
    name = "bank" if weights is None else read_info(weights).preset
    if name != "bank" and name not in PRESETS:
        return
    reads = _BANK if name == "bank" else PRESETS[name].reads
    unread = _unread(changed_settings(config), (*READ_BY_ALL, *reads))
    if unread:
        known = ", ".join(f"infer.{setting.removesuffix('.')}" for setting in (*reads, *READ_BY_ALL))
        raise ConfigError(
            f"infer.{unread[0]}: checkpoint {checkpoint!r} (preset {name}) does not read it, so it would change nothing; "
            f"leave it out. Read are: {known}"
        )


def _unread(settings: Iterable[str], reads: Iterable[str]) -> list[str]:
    known = tuple(reads)
    return [
        setting
        for setting in settings
        if not any(setting == name or (name.endswith(".") and setting.startswith(name)) for name in known)
    ]


def _load(preset: Preset, weights: Path, samplings: Samplings) -> "Loaded":
    device = samplings.device
    if device != "auto" and device.partition(":")[0] not in preset.runs_on:
        known = ", ".join(preset.runs_on)
        raise DeviceError(f"infer.device {device!r}: {weights.stem} does not run there; use auto, or one of: {known}")
    return preset.load(weights, samplings)


def _preset(weights: Path, purpose: str, serves: Callable[[Preset], bool]) -> Preset:
    name = read_info(weights).preset
    preset = PRESETS.get(name)
    if preset is None or not serves(preset):
        able = ", ".join(known for known, preset in PRESETS.items() if serves(preset))
        raise ConfigError(f"{weights}: a checkpoint of the preset {name!r}, which does not {purpose}; give one of {able}")
    return preset
