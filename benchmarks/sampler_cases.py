"""Windows of simulated patrols, each with the shipped model fitted to its detections: what samplers are compared on."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from cadence.bank.bank import BankPosterior
from cadence.bank.rows import active_rows
from cadence.constraints.obstacles import Obstacles
from cadence.diffusion.general import GeneralModel
from cadence.network.residual_context import ResidualContext, build_context
from cadence.worlds.episode import Episode
from cadence.worlds.patrol import PatrolConfig, simulate_patrol
from pipeline.estimators.fitting import FittingData
from pipeline.estimators.presets import load_estimator
from pipeline.estimators.samplings import GeneralSampling, Samplings
from pipeline.grids import GridConfig, plan_grid
from pipeline.train.missions import mission_of_episode
from pipeline.windows import MissionWindows, build_windows, truth_on_grid


@dataclass(frozen=True, eq=False)
class Case:
    """Some windows of one episode, the model fitted to its detections, and the truth [B, A, T, 2] and where it is known."""

    windows: MissionWindows
    model: GeneralModel
    obstacles: Obstacles
    unit_m: float
    num_hypotheses: int
    truth_m: Tensor
    is_known: Tensor

    @property
    def datum_m(self) -> Tensor:
        """Place of every row's datum in the obstacles' frame [R, 1, 1, 2]."""
        window = self.windows.batch.is_active.nonzero()[:, 0]
        return torch.from_numpy(self.windows.datum_m)[window][:, None, None]


def obstacles_of(episode: Episode) -> Obstacles:
    """The land of an episode."""
    terrain = episode.terrain
    return Obstacles(torch.from_numpy(terrain.circles_m), tuple((torch.from_numpy(p),) for p in terrain.polygons_m))


def build_case(seed: int, index: int, num_windows: int, num_hypotheses: int, weights: Path) -> Case | None:
    """Windows evenly over one episode with truth at every step; None where it has too few."""
    episode = simulate_patrol(PatrolConfig(), np.random.default_rng([seed, index]))
    if len(episode.detections) < 20:
        return None
    mission = mission_of_episode(episode, f"patrol-{seed}-{index}")
    grid = plan_grid(mission.detections, GridConfig(stride_steps=4))
    windows = build_windows(mission.detections, grid, seed)
    truth_m, is_known = truth_on_grid(mission.truth, windows, 4.0 * grid.step_s)
    usable = torch.nonzero((is_known[..., grid.origin_index + 1 :].all(-1) & windows.batch.is_active).all(1))[:, 0]
    if len(usable) < num_windows:
        return None
    loaded = load_estimator(str(weights), Samplings(general=GeneralSampling(is_gated=False)))
    model = loaded.fitted(FittingData.of(mission.detections, grid, windows)).estimator
    assert isinstance(model, GeneralModel)
    pick = usable[torch.linspace(0, len(usable) - 1, num_windows).round().long()]
    chosen = dataclasses.replace(
        windows, batch=windows.batch[pick], origins_ns=windows.origins_ns[pick.numpy()], datum_m=windows.datum_m[pick.numpy()]
    )
    unit_m = 0.5 * episode.terrain.side_m
    return Case(chosen, model, obstacles_of(episode), unit_m, num_hypotheses, truth_m[pick], is_known[pick])


def bank_context(case: Case) -> tuple[BankPosterior, ResidualContext]:
    """What the bank says of the windows, and what the network is told of it."""
    batch, bank = case.windows.batch, case.model.bank
    posterior = bank.posterior(batch, case.num_hypotheses)
    context = build_context(posterior, active_rows(batch)[0], batch.time_s, batch.step_s, bank.length_m(batch.step_s))
    return posterior, context
