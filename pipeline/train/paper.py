"""Training of the paper's preset: windows in absolute coordinates from episodes of one target, logs or the simulator."""

import dataclasses
import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from torch import Tensor, nn

from cadence.arrays import Float64s, Int64s
from cadence.bank.rows import active_rows
from cadence.diffusion.absolute import AbsoluteConfig, detection_rows
from cadence.errors import ConfigError, InputError
from cadence.network.trajectory import TrajectoryNetwork
from cadence.recordings import Recordings, cut_windows
from cadence.seeds import derived_seed, numpy_stream, torch_stream
from cadence.training.absolute import AbsoluteWindows, absolute_loss, forecast_rows, join_absolute
from cadence.training.loop import Trainer, untrained
from cadence.worlds.patrol import simulate_patrol
from pipeline.arrays import Column
from pipeline.episodes.pool import load_pool
from pipeline.grids import Grid
from pipeline.manifest import StageResult
from pipeline.progress import Progress
from pipeline.train.config import AbsoluteTraining, TrainConfig
from pipeline.train.lessons import Source, lessons_of
from pipeline.train.missions import TrainingMission, mission_of_episode, missions_of_logs
from pipeline.train.run import TrainingRun, run_training
from pipeline.windows import MissionWindows, build_windows, truth_on_grid

_STEPS_AN_EPISODE = 10
"""A new simulated episode joins after this many steps, so that simulating does not hold up the start."""
_FIRST_EPISODES = 8
_MARGIN = 1.02
"""Map limits taken from the truth get this much room."""


def train_absolute(out: Path, config: TrainConfig, progress: Progress, force: bool = False) -> StageResult:
    """Train the paper's preset into `out`; see `pipeline.train.stage.train`.

    From `config.paper.sources`, or else from the logs in `config.data`, or without these from the simulator.
    """
    source = _source(out, config, progress)
    trainer = Trainer(untrained(lambda: TrajectoryNetwork(config.paper.network), config.seed), config.optimiser)
    schedule = config.paper.network.schedule()

    def loss(network: nn.Module, windows: AbsoluteWindows, generator: torch.Generator) -> Tensor:
        assert isinstance(network, TrajectoryNetwork)
        return absolute_loss(network, windows, schedule, generator)

    run = TrainingRun(out, "paper", config, source.model, config.optimiser.num_steps)
    return run_training(run, trainer, lessons_of(source, loss), progress, force)


class _Source(Source[AbsoluteWindows], Protocol):
    """Windows, and the model whose units they are in."""

    model: AbsoluteConfig


def _source(out: Path, config: TrainConfig, progress: Progress) -> _Source:
    if config.paper.sources:
        if config.data is not None:
            raise ConfigError("train.data and train.paper.sources: both say what to train on; give one of them")
        return _EpisodeSource(out / "episodes", config, progress)
    return _LogSource(out, config, progress) if config.data is not None else _PatrolSource(config)


class _EpisodeSource:
    """Windows cut out of episodes of one target when they are needed, every step of every episode equally likely."""

    def __init__(self, cache: Path, config: TrainConfig, progress: Progress) -> None:
        paper = config.paper
        load = functools.partial(load_pool, cache=cache, step_s=paper.step_s, where="train.paper", progress=progress)
        self.pool, self.paper, self.seed, self.batch_size = load(paper.sources), paper, config.seed, config.batch_size
        if paper.validation:
            held_out = load(paper.validation)
        else:
            self.pool, held_out = self.pool.split(paper.validation_share)
        self.model = paper.model_config(*_map_limits(paper, [part.position_m.T for part in self.pool.parts]))
        drawn = held_out.rows_of_each(paper.num_validation_windows, numpy_stream(config.seed, "validation"))
        windows = join_absolute([self._cut(part, rows) for part, rows in drawn])
        self.validation = self._hidden(windows, torch_stream(config.seed, "hidden goals"))

    def batch(self, step: int, generator: torch.Generator) -> AbsoluteWindows:
        rng = numpy_stream(self.seed, "windows", step)
        drawn = self.pool.rows(self.batch_size, rng)
        return self._hidden(join_absolute([self._cut(part, rows) for part, rows in drawn]), generator)

    def _cut(self, part: Recordings, rows: Int64s) -> AbsoluteWindows:
        episode = np.searchsorted(part.offset, rows, side="right") - 1
        keep = self.model.network.max_detections
        cut = cut_windows(part, episode, rows - part.offset[episode], num_detections=keep, num_tracker_steps=1)
        return forecast_rows(cut, self.model)

    def _hidden(self, windows: AbsoluteWindows, generator: torch.Generator) -> AbsoluteWindows:
        """Some of the windows are not told the goal."""
        if not self.model.optional_goal or windows.extra is None:
            return windows
        is_hidden = torch.rand(len(windows), 1, generator=generator) < self.paper.hidden_goals
        extra = torch.cat([windows.extra[:, :2].masked_fill(is_hidden, 0.0), windows.extra[:, 2:]], dim=1)
        return dataclasses.replace(windows, extra=extra)


class _LogSource:
    """Windows of a folder of logs; some of the logs, whole, are for validation."""

    def __init__(self, out: Path, config: TrainConfig, progress: Progress) -> None:
        assert config.data is not None
        paper = config.paper
        missions = missions_of_logs(config.data, out / "logs", config.extract, progress)
        order = numpy_stream(config.seed, "missions").permutation(len(missions))
        num_validation = min(max(1, round(paper.validation_share * len(missions))), len(missions) - 1)
        kept = [missions[index] for index in sorted(order[num_validation:])]
        held_out = [missions[index] for index in sorted(order[:num_validation])]
        places = [np.stack([mission.truth[name].to_numpy() for name in ("x_m", "y_m")]) for mission in kept]
        self.model, self.batch_size = paper.model_config(*_map_limits(paper, places)), config.batch_size
        self.windows, self.validation = (
            _joined([mission_windows(m, paper, self.model, derived_seed(config.seed, part, i)) for i, m in ms], config.data)
            for part, ms in (("training", enumerate(kept)), ("validation", enumerate(held_out)))
        )

    def batch(self, step: int, generator: torch.Generator) -> AbsoluteWindows:
        return self.windows[torch.randint(len(self.windows), (self.batch_size,), generator=generator)]


class _PatrolSource:
    """Windows of simulated episodes, each a function of its seed alone; more join as the training goes on."""

    def __init__(self, config: TrainConfig) -> None:
        self.config, paper = config, config.paper
        centre = paper.centre_m or (0.0, 0.0)
        self.model = paper.model_config(centre, paper.scale_m or 0.5 * paper.patrol.side_m)
        self.episodes: dict[int, AbsoluteWindows] = {}
        self.validation = join_absolute([self._simulated("validation", i) for i in range(paper.num_validation_episodes)])
        if len(self.validation) == 0:
            raise ConfigError("train.paper.patrol: no window of the validation episodes has a detection; raise detection_rate")

    def batch(self, step: int, generator: torch.Generator) -> AbsoluteWindows:
        num = min(self.config.paper.num_episodes, _FIRST_EPISODES + step // _STEPS_AN_EPISODE)
        pick = torch.randint(num, (self.config.batch_size,), generator=generator)
        counts = torch.bincount(pick, minlength=num).tolist()
        parts = []
        for index, count in enumerate(counts):
            windows = self._episode(index) if count else self.validation[:0]
            if len(windows):
                parts.append(windows[torch.randint(len(windows), (count,), generator=generator)])
        # episodes in which nothing was seen leave gaps; none at all is next to impossible
        return join_absolute(parts or [self.validation[: self.config.batch_size]])

    def _episode(self, index: int) -> AbsoluteWindows:
        if index not in self.episodes:
            self.episodes[index] = self._simulated("training", index)
        return self.episodes[index]

    def _simulated(self, part: str, index: int) -> AbsoluteWindows:
        seed = derived_seed(self.config.seed, part, index)
        episode = simulate_patrol(self.config.paper.patrol, numpy_stream(seed, "episode"))
        mission = mission_of_episode(episode, f"{part}-{index}")
        return mission_windows(mission, self.config.paper, self.model, seed)


@dataclass(frozen=True, eq=False)
class KnownWindows:
    """Windows with truth_m [B, A, T, 2] relative to their datum, is_known [B, A, T], elapsed [B]."""

    windows: MissionWindows
    truth_m: Tensor
    is_known: Tensor
    elapsed: Tensor


def draw_windows(mission: TrainingMission, training: AbsoluteTraining, model: AbsoluteConfig, seed: int) -> KnownWindows:
    """`num_windows` windows of a mission with at least one detection, at random whole steps after its first truth sample."""
    step_ns = round(model.step_s * 1e9)
    times = mission.truth["time_ns"].to_numpy()
    rng = numpy_stream(seed, "origins")
    num_steps = max(1, int(times.max() - times.min()) // step_ns + 1)
    origins = times.min() + step_ns * np.sort(rng.integers(0, num_steps, training.num_windows))
    grid = Grid(step_ns, model.history_steps, model.horizon_steps, origins, training.context_steps)
    windows = build_windows(mission.detections, grid, seed)
    truth_m, is_known = truth_on_grid(mission.truth, windows, training.max_gap_steps * model.step_s)
    if training.parked_tail:
        truth_m, is_known = _parked(mission, windows, truth_m, is_known)
    elapsed = torch.from_numpy((origins - times.min()) / step_ns / model.age_scale_steps)
    return KnownWindows(windows, _filled(truth_m, is_known), is_known, elapsed)


def mission_windows(mission: TrainingMission, training: AbsoluteTraining, model: AbsoluteConfig, seed: int) -> AbsoluteWindows:
    """Training windows of a mission: those of its agents that were detected before the window's origin; maybe none."""
    if mission.detections.num_rows == 0:
        return _no_windows(model)
    return _normalised(draw_windows(mission, training, model, seed), model)


def _normalised(known: KnownWindows, model: AbsoluteConfig) -> AbsoluteWindows:
    """Active agents as rows, in the network's units; rows without any known step are left out."""
    windows, is_known = known.windows, known.is_known
    nodes, _ = active_rows(windows.batch)
    window, agent = windows.batch.is_active.nonzero(as_tuple=True)
    centre = torch.tensor(model.centre_m, dtype=torch.float64) - torch.from_numpy(windows.datum_m)[window]
    if model.relative:
        centre = nodes.position_m[torch.arange(len(window)), nodes.is_observed.sum(dim=1) - 1]
    age = -nodes.time_s / model.step_s / model.age_scale_steps
    place = (nodes.position_m - centre[:, None]) / model.scale_m
    rows, is_observed = detection_rows(age, place, nodes.is_observed, model.network.max_detections)
    clean = ((known.truth_m[window, agent] - centre[:, None]) / model.scale_m).float()
    extra = known.elapsed[window, None].float() if model.network.elapsed else None
    found = AbsoluteWindows(clean, is_known[window, agent], rows, is_observed, extra)
    return found[is_known[window, agent].any(dim=-1).nonzero()[:, 0]]


def _no_windows(model: AbsoluteConfig) -> AbsoluteWindows:
    t, n = model.network.num_steps, model.network.max_detections
    none = torch.zeros(0, t, 2), torch.zeros(0, t, dtype=torch.bool), torch.zeros(0, n, 3), torch.zeros(0, n, dtype=torch.bool)
    return AbsoluteWindows(*none, torch.zeros(0, 1) if model.network.elapsed else None)


def _parked(mission: TrainingMission, windows: MissionWindows, truth_m: Tensor, is_known: Tensor) -> tuple[Tensor, Tensor]:
    """Every agent stays at its last true position after the end of its truth."""
    truth_m, is_known = truth_m.clone(), is_known.clone()
    steps_ns = windows.origins_ns[:, None] + np.round(windows.batch.time_s.numpy() * 1e9).astype(np.int64)
    agents = np.array(mission.truth["agent_id"].to_pylist(), dtype=object)
    times = mission.truth["time_ns"].to_numpy()
    places: Float64s = np.stack([mission.truth[name].to_numpy() for name in ("x_m", "y_m")], axis=-1)
    for index, agent in enumerate(windows.agent_ids):
        mine = np.flatnonzero(agents == agent)
        if len(mine):
            last = mine[np.argmax(times[mine])]
            is_after = torch.from_numpy(steps_ns > times[last])
            spot = torch.from_numpy(places[last] - windows.datum_m)[:, None]
            truth_m[:, index] = torch.where(is_after[..., None], spot, truth_m[:, index])
            is_known[:, index] |= is_after
    return truth_m, is_known


def _filled(truth_m: Tensor, is_known: Tensor) -> Tensor:
    """Unknown steps take the value of the known one before, or else the first one after: they do not count, but are seen."""
    steps = torch.arange(is_known.shape[-1]).expand(is_known.shape)
    before = torch.where(is_known, steps, -1).cummax(dim=-1).values
    first = torch.where(is_known, steps, is_known.shape[-1] - 1).amin(dim=-1, keepdim=True)
    index = torch.where(before >= 0, before, first)
    return truth_m.gather(-2, index[..., None].expand(truth_m.shape))


def _map_limits(training: AbsoluteTraining, places_m: Sequence[Column]) -> tuple[tuple[float, float], float]:
    """Centre and half side of the square that holds all places [2, N], with a little room; what is configured is kept."""
    low = np.min([place.min(axis=1) for place in places_m], axis=0).astype(np.float64)
    high = np.max([place.max(axis=1) for place in places_m], axis=0).astype(np.float64)
    middle = 0.5 * (low + high)
    centre = training.centre_m or (float(middle[0]), float(middle[1]))
    half = float(np.maximum(high - np.array(centre), np.array(centre) - low).max()) * _MARGIN
    return centre, training.scale_m or (half if half > 0 else 1.0)


def _joined(parts: list[AbsoluteWindows], data: Path) -> AbsoluteWindows:
    windows = join_absolute(parts)
    if len(windows) == 0:
        raise InputError(f"{data}: no window of these logs has both a detection and truth; check that agents are named alike")
    return windows
