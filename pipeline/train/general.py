"""Training of the general preset: windows of synthetic kinematics made on the fly, or of logs with truth."""

from pathlib import Path

import torch

from cadence.errors import InputError
from cadence.network.residual import ResidualNetwork
from cadence.seeds import derived_seed, numpy_stream
from cadence.training.loop import Trainer, untrained
from cadence.training.residual import residual_loss
from cadence.training.synthetic import ResidualWindows, join_windows, residual_windows
from pipeline.estimators.fitting import FittingData
from pipeline.grids import GridConfig, plan_grid
from pipeline.manifest import StageResult
from pipeline.progress import Progress
from pipeline.train.config import TrainConfig
from pipeline.train.lessons import Source, lessons_of
from pipeline.train.missions import TrainingMission, missions_of_logs
from pipeline.train.run import TrainingRun, run_training
from pipeline.train.shards import synthetic_shard
from pipeline.windows import build_windows, truth_on_grid

_VALIDATION_SHARE = 0.1
_STEPS_A_SHARD = 120
"""New shards join at this pace, so that making them does not hold up the start."""
_MAX_GAP_STEPS = 4.0


def train_general(out: Path, config: TrainConfig, progress: Progress, force: bool = False) -> StageResult:
    """Train the general preset into `out`; see `pipeline.train.stage.train`. `config.data` None means synthetic kinematics."""
    is_of_logs = config.data is not None
    source: Source[ResidualWindows] = _LogSource(out, config, progress) if is_of_logs else _SyntheticSource(out, config)
    trainer = Trainer(untrained(lambda: ResidualNetwork(config.network), config.seed), config.optimiser)
    run = TrainingRun(out, "general", config, config.network, config.optimiser.num_steps)
    return run_training(run, trainer, lessons_of(source, residual_loss), progress, force)


class _SyntheticSource:
    """Shards of synthetic windows, two of them for each batch; each shard depends on its seed alone."""

    def __init__(self, out: Path, config: TrainConfig) -> None:
        self.folder, self.config = out / "windows", config
        self.shards: dict[int, ResidualWindows] = {}
        self.seed, seed = derived_seed(config.seed, "training"), derived_seed(config.seed, "validation")
        numbers = range(config.num_validation_shards)
        self.validation = join_windows([synthetic_shard(self.folder, config.windows, seed, index) for index in numbers])

    def batch(self, step: int, generator: torch.Generator) -> ResidualWindows:
        num_open = min(self.config.num_shards, 2 + step // _STEPS_A_SHARD)
        parts = []
        for index in torch.randint(num_open, (2,), generator=generator).tolist():
            if index not in self.shards:
                self.shards[index] = synthetic_shard(self.folder, self.config.windows, self.seed, index)
            shard = self.shards[index]
            parts.append(shard[torch.randint(len(shard), (self.config.batch_size // 2,), generator=generator)])
        return join_windows(parts)


class _LogSource:
    """Windows of a folder of logs; a tenth of the logs, whole, is for validation."""

    def __init__(self, out: Path, config: TrainConfig, progress: Progress) -> None:
        assert config.data is not None
        missions = missions_of_logs(config.data, out / "logs", config.extract, progress)
        order = numpy_stream(config.seed, "missions").permutation(len(missions)).tolist()
        parts = [mission_windows(missions[index], config, derived_seed(config.seed, "mission", index)) for index in order]
        usable = [part for part in parts if part is not None]
        if len(usable) < 2:
            raise InputError(
                f"{config.data}: {len(usable)} of {len(parts)} logs have windows with truth at every step, two are needed; use"
                f" longer logs, truth at least every {_MAX_GAP_STEPS:g} steps, or a smaller train.windows"
            )
        num_validation = max(1, round(_VALIDATION_SHARE * len(usable)))
        held_out, kept = usable[:num_validation], usable[num_validation:]
        self.windows, self.validation = join_windows(kept), join_windows(held_out)
        self.batch_size = config.batch_size

    def batch(self, step: int, generator: torch.Generator) -> ResidualWindows:
        return self.windows[torch.randint(len(self.windows), (self.batch_size,), generator=generator)]


def mission_windows(mission: TrainingMission, config: TrainConfig, seed: int) -> ResidualWindows | None:
    """Windows of one log with truth at every step, seen through the bank fitted to that log; None without any."""
    grid_config = GridConfig(history_steps=config.windows.history_steps, horizon_steps=config.windows.horizon_steps)
    grid = plan_grid(mission.detections, grid_config)
    windows = build_windows(mission.detections, grid, seed)
    truth_m, is_known = truth_on_grid(mission.truth, windows, _MAX_GAP_STEPS * grid.step_s)
    usable = torch.nonzero((is_known.all(-1) & windows.batch.is_active).any(-1))[:, 0]
    if len(usable) == 0:
        return None
    bank = FittingData.of(mission.detections, grid, windows).fitted_bank()
    batch = windows.batch[usable]
    all_windows = residual_windows(bank, batch, truth_m[usable], config.windows.num_samples)
    return all_windows[is_known[usable].all(-1)[batch.is_active]]
