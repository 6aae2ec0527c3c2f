"""The train stage: from synthetic kinematics or logs with truth to a checkpoint; killed and started again it goes on."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch

from cadence.network.residual import ResidualNetworkConfig
from cadence.training.loop import OptimiserConfig
from cadence.training.synthetic import SyntheticConfig
from pipeline.extract.stage import ExtractConfig
from pipeline.manifest import StageResult
from pipeline.progress import Progress
from pipeline.train.general import train_general
from pipeline.train.paper import AbsoluteTraining, train_absolute
from pipeline.train.rivals import RIVALS, RivalTraining, train_rivals
from pipeline.train.scene import SceneTraining, train_scene


@dataclass(frozen=True)
class TrainConfig:
    """What to train, on what, for how long.

    preset            "general" (residual of the bank), "paper" (absolute coordinates, the published architecture), "scene" (one
                      place learned by heart), or one of the paper's rivals: "vrnn", "grammi_without_mi", "grammi" (which
                      trains the one without first)
    data              folder of MCAP logs with truth; None = synthetic kinematics (general) or the simulator (paper)
    extract           where truth and detections are in the logs of `data`
    seed              of weights, data and noise
    batch_size        windows a step
    num_shards        synthetic shards of about 1250 windows; a shard is made when it is first needed
    num_validation_shards  shards from other scenarios, never trained on
    validate_every, save_every  steps
    threads           of torch; None = as many as there are cores
    network, windows  of the general preset
    paper             of the paper preset
    scene             of the scene preset
    rival             of the rivals
    """

    preset: Literal["general", "paper", "scene", "vrnn", "grammi_without_mi", "grammi"] = "general"
    data: Path | None = None
    extract: ExtractConfig = field(default_factory=ExtractConfig)
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
    scene: SceneTraining = field(default_factory=SceneTraining)
    rival: RivalTraining = field(default_factory=RivalTraining)

    def __post_init__(self) -> None:
        if self.batch_size < 2:
            raise ValueError("batch_size must be at least 2")
        counts = (self.num_shards, self.num_validation_shards, self.validate_every, self.save_every, self.optimiser.num_steps)
        if min(counts) < 1:
            raise ValueError(
                "num_shards, num_validation_shards, validate_every, save_every and optimiser.num_steps must be at least 1"
            )
        factor = 2 ** (len(self.network.multipliers) - 1)
        if (self.windows.history_steps + self.windows.horizon_steps) % factor:
            raise ValueError(
                f"windows.history_steps + windows.horizon_steps must be a multiple of {factor}, as network halves them"
            )


def train(out: Path, config: TrainConfig, progress: Progress, force: bool = False) -> StageResult:
    """Train into the folder `out`: checkpoint.safetensors + .json, curve.csv, curve.png, and the state to go on from.

    A state of an earlier, killed call with the same configuration is taken up; `force` starts anew.
    """
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    if config.preset in RIVALS:
        return train_rivals(out, config, progress, force)
    presets = {"general": train_general, "paper": train_absolute, "scene": train_scene}
    return presets[config.preset](out, config, progress, force)
