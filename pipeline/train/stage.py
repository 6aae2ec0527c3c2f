"""The train stage: from synthetic kinematics or logs with truth to a checkpoint; killed and started again it goes on."""

from collections.abc import Callable, Mapping
from pathlib import Path

import torch

from pipeline.checkpoints import RIVALS
from pipeline.manifest import StageResult
from pipeline.progress import Progress
from pipeline.train.config import TrainConfig
from pipeline.train.general import train_general
from pipeline.train.paper import train_absolute
from pipeline.train.place import train_place
from pipeline.train.rivals import train_rivals


def train(out: Path, config: TrainConfig, progress: Progress, force: bool = False) -> StageResult:
    """Train into the folder `out`: checkpoint.safetensors + .json, curve.csv, curve.png, and the state to go on from.

    A state of an earlier, killed call with the same configuration is taken up; `force` starts anew.
    """
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    return TRAININGS[config.preset](out, config, progress, force)


TRAININGS: Mapping[str, Callable[[Path, TrainConfig, Progress, bool], StageResult]] = {
    "general": train_general,
    "paper": train_absolute,
    "place": train_place,
    **dict.fromkeys(RIVALS, train_rivals),
}
"""How a checkpoint of each preset is made."""
