"""Infer: detections → hypotheses: the model fitted to the log, all windows batched, constraints kept."""

import dataclasses
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import pyarrow as pa
import pyarrow.compute as pc
import torch
from torch import Tensor

from cadence.association.types import AssociationConfig
from cadence.bank.bank import Bank
from cadence.bank.hindsight import choose_by_hindsight
from cadence.bank.rows import active_rows
from cadence.constraints.obstacles import Obstacles
from cadence.diffusion.absolute import AbsoluteSampling
from cadence.diffusion.feasible import Feasibility, resampled
from cadence.diffusion.gate import gated
from cadence.diffusion.general import GeneralModel
from cadence.diffusion.scene import SceneModel, SceneSampling
from cadence.errors import ConfigError, DeviceError
from cadence.network.residual import ResidualNetwork, ResidualNetworkConfig
from cadence.types import Context, Detections, HypothesisSet, WindowBatch
from pipeline.arrays import Int64s
from pipeline.checkpoints import DEFAULT, checkpoint_hash, find_checkpoint, load_weights, network_config, read_info
from pipeline.estimators.paper import absolute_context, absolute_grid, load_absolute
from pipeline.estimators.scene import load_scene, scene_context, scene_grid
from pipeline.extract.obstacle_sources import read_obstacles
from pipeline.infer.draws import Drawn, draw_tracks, draw_ways
from pipeline.infer.placed_draws import Forecaster, draw_placed
from pipeline.infer.rows import hypothesis_rows, window_rows, with_association
from pipeline.infer.ways import Sources, WayWindows, build_way_windows, tell_sources
from pipeline.ingest.stage import CATALOGUE_NAME, read_catalogue
from pipeline.manifest import StageResult, run_stage
from pipeline.progress import Progress
from pipeline.tables import read_table, write_table
from pipeline.windows import Grid, GridConfig, MissionWindows, build_windows, fit_tracks, later_detections

_ROWS_AT_ONCE = 48
_HINDSIGHT_ROWS = 64


@dataclass(frozen=True)
class GuidanceConfig:
    """How constraints act on hypotheses.

    mode           "clean" guides while sampling and repairs at the end; "repair" only repairs; "none" ignores constraints;
                   of the scene preset only "none" counts (infer.scene says how it guides), and the paper preset has infer.paper
    margin_m       distance to keep from obstacles
    max_speed_mps  a speed that the target cannot exceed; None = no limit
    """

    mode: Literal["clean", "repair", "none"] = "clean"
    margin_m: float = 0.0
    max_speed_mps: float | None = None

    def __post_init__(self) -> None:
        if self.margin_m < 0 or (self.max_speed_mps is not None and not self.max_speed_mps > 0):
            raise ValueError("margin_m must not be negative, max_speed_mps must be positive")


@dataclass(frozen=True)
class InferConfig:
    """How hypotheses are drawn.

    num_hypotheses   for each window
    seed             of all random numbers
    checkpoint       a .safetensors file, the name of a shipped one, or "none" for the bank alone
    sampler          "rotation", "ddim" or "dpmpp"
    num_steps        evaluations of the network a hypothesis
    default_sigma_m  accuracy of detections that state none
    device           "auto", "cpu" or "cuda"
    paper            how a checkpoint of the paper preset is sampled; it brings its own grid
    scene            how a checkpoint of the scene preset is sampled; it brings its own grid
    is_gated         the network moves all, half or none of the hypotheses, as withheld detections of this log advise
    is_associated    detections of unknown origin are told apart; otherwise they are taken for one agent called "unknown"
    association      how they are told apart
    """

    num_hypotheses: int = 30
    seed: int = 0
    checkpoint: str = DEFAULT
    sampler: Literal["rotation", "ddim", "dpmpp"] = "rotation"
    num_steps: int = 6
    default_sigma_m: float = 0.0
    device: str = "auto"
    is_gated: bool = True
    is_associated: bool = True
    association: AssociationConfig = field(default_factory=AssociationConfig)
    grid: GridConfig = field(default_factory=GridConfig)
    guidance: GuidanceConfig = field(default_factory=GuidanceConfig)
    paper: AbsoluteSampling = field(default_factory=AbsoluteSampling)
    scene: SceneSampling = field(default_factory=SceneSampling)

    def __post_init__(self) -> None:
        if self.num_hypotheses < 1 or self.num_steps < 1 or self.default_sigma_m < 0:
            raise ValueError("num_hypotheses and num_steps must be at least 1, default_sigma_m not negative")


def infer(directory: Path, config: InferConfig, progress: Progress, force: bool = False) -> StageResult:
    """Draw hypotheses for every window of the mission in `directory`: hypotheses.parquet and windows.parquet.

    Where detections of unknown origin were told apart, associations.parquet and labels.parquet hold how.
    """
    weights = None if config.checkpoint == "none" else find_checkpoint(config.checkpoint)
    inputs = [directory / "detections.parquet", directory / "obstacles.json"]
    if weights is not None:
        read_info(weights)  # names what is wrong with it more plainly than an input that is missing
        inputs += [weights, weights.with_suffix(".json")]
    detections, frame = read_table(inputs[0], "detections")

    def body(folder: Path) -> dict[str, Any]:
        plan = _plan(config, detections, read_obstacles(inputs[1]), weights, _mission_start_ns(directory, detections))
        log_id = str(detections["log_id"][0])
        parts, statuses = [], []
        with progress.bar(plan.windows.batch.num_windows, "infer", unit="window") as bar:
            for part, positions, weight, status in plan.draws:
                parts.append(hypothesis_rows(log_id, plan.windows, plan.seen.sources.grid, part, positions, weight))
                rows = window_rows(plan.windows, part, positions, weight, status)
                statuses.append(rows if plan.seen.ways is None else with_association(rows, plan.seen.ways, part))
                bar.update(len(part))
        tracks, windows = pa.concat_tables(parts), pa.concat_tables(statuses)
        write_table(tracks, folder / "hypotheses.parquet", "hypotheses", frame)
        write_table(windows, folder / "windows.parquet", "windows", frame)
        if plan.seen.sources.association is not None:
            found = plan.seen.sources.association.rows(detections)
            write_table(found, folder / "associations.parquet", "associations", frame)
            labels = plan.seen.sources.association.labels(plan.seen.sources.grid)
            write_table(labels, folder / "labels.parquet", "labels", frame)
        counts = windows["status"].value_counts().to_pylist()
        return {
            "num_windows": plan.windows.batch.num_windows,
            "num_agents": len(plan.windows.agent_ids),
            "num_tracks": tracks.num_rows,
            "status": {str(item["values"]): int(item["counts"]) for item in counts},
            "step_s": plan.seen.sources.grid.step_s,
            "context_steps": plan.seen.sources.grid.context_steps,
            "checkpoint": config.checkpoint,
            "checkpoint_sha256": None if weights is None else checkpoint_hash(weights),
            "seed": config.seed,
            **plan.about,
        }

    return run_stage("infer", directory, config=config, inputs=inputs, body=body, force=force)


@dataclass(frozen=True, eq=False)
class _Seen:
    """The windows, by name; `ways` where there are several ways to tell whose detections they hold."""

    sources: Sources
    named: MissionWindows
    ways: WayWindows | None

    @staticmethod
    def of(config: InferConfig, detections: pa.Table, grid: GridConfig) -> "_Seen":
        """The windows of a log on the grid that the model takes."""
        sigma_m, association = config.default_sigma_m, config.association if config.is_associated else None
        sources = tell_sources(detections, grid, association, config.seed, sigma_m, config.guidance.max_speed_mps)
        named = build_windows(sources.named, sources.grid, config.seed, sigma_m)
        is_told = sources.association is not None
        ways = build_way_windows(detections, sources, config.seed, config.num_hypotheses, sigma_m) if is_told else None
        return _Seen(sources, named, ways)


@dataclass(frozen=True, eq=False)
class _Plan:
    """What is to be drawn: the windows, the draws as they come, and what the summary says of the model."""

    seen: _Seen
    draws: Iterator[Drawn]
    about: dict[str, Any]

    @property
    def windows(self) -> MissionWindows:
        """What the tables speak of."""
        return self.seen.named if self.seen.ways is None else self.seen.ways.windows


def _mission_start_ns(directory: Path, detections: pa.Table) -> int:
    """When the log begins; without a catalogue the first detection."""
    if (directory / CATALOGUE_NAME).is_file():
        return read_catalogue(directory).start_ns
    return int(pc.min(detections["time_ns"]).as_py() or 0)


def _plan(config: InferConfig, detections: pa.Table, obstacles: Obstacles, weights: Path | None, start_ns: int) -> _Plan:
    """The draws by the preset of the checkpoint, which decides the grid as well."""
    preset = None if weights is None else read_info(weights).preset
    if weights is not None and preset == "scene":
        scene = _limited(load_scene(weights, config.scene), config.guidance)
        seen = _Seen.of(config, detections, scene_grid(scene.config, config.grid.stride_steps))
        limits = Obstacles.none() if config.guidance.mode == "none" else obstacles
        draws = _placed_draws(scene, seen, lambda windows: scene_context(windows, start_ns), config.num_hypotheses, limits)
        return _Plan(seen, draws, {"preset": "scene"} | _association_summary(seen))
    if weights is not None and preset == "paper":
        paper = load_absolute(weights, config.paper)
        seen = _Seen.of(config, detections, absolute_grid(paper.config, config.grid.stride_steps))
        draws = _placed_draws(paper, seen, absolute_context, config.num_hypotheses, obstacles)
        return _Plan(seen, draws, {"preset": "paper"} | _association_summary(seen))
    seen = _Seen.of(config, detections, config.grid)
    model = fitted_model(config, seen.sources.named, seen.sources.grid, seen.named, weights)
    if seen.ways is None:
        draws = draw_hypotheses(model, seen.named, config, obstacles)
    else:
        draws = draw_tracks(seen.ways, lambda windows: draw_hypotheses(model, windows, config, obstacles))
    return _Plan(seen, draws, _model_summary(model) | _association_summary(seen))


def _limited(scene: SceneModel, guidance: GuidanceConfig) -> SceneModel:
    """The scene model with the margin and the speed limit of all presets, where they are stricter than its own."""
    margin_m = max(scene.sampling.margin_m, guidance.margin_m)
    longest_m = scene.config.max_step_m
    if guidance.max_speed_mps is not None:
        longest_m = min(longest_m, guidance.max_speed_mps * scene.config.step_s)
    return dataclasses.replace(
        scene,
        sampling=dataclasses.replace(scene.sampling, margin_m=margin_m),
        config=dataclasses.replace(scene.config, max_step_m=longest_m),
    )


def _placed_draws(
    model: Forecaster,
    seen: _Seen,
    context_of: Callable[[MissionWindows], Context],
    num_hypotheses: int,
    obstacles: Obstacles,
) -> Iterator[Drawn]:
    if seen.ways is None:
        return draw_placed(model, seen.named.batch, context_of(seen.named), num_hypotheses, obstacles)
    context = context_of(seen.ways.windows)

    def sample(batch: WindowBatch, window: Int64s, count: int) -> HypothesisSet:
        return model.placed(context[torch.from_numpy(window)], obstacles).sample(batch, count)

    return draw_ways(seen.ways, num_hypotheses, sample)


def _association_summary(seen: _Seen) -> dict[str, Any]:
    """What the summary says of detections of unknown origin; empty where there are none."""
    association = seen.sources.association
    if association is None:
        return {}
    return {
        "association": {
            "num_detections": len(association.stream),
            "num_agents": len(association.agent_ids),
            "mean_num_ways": sum(ways.num_ways for ways in association.ways) / len(association.ways),
        }
    }


def load_model(config: InferConfig, weights: Path | None) -> GeneralModel:
    """The model before it has seen a log; `ConfigError` where the checkpoint is of another kind or does not fit."""
    device = _device(config.device)
    network = None
    if weights is not None:
        info = read_info(weights)
        if info.preset != "general":
            raise ConfigError(f"{weights}: a checkpoint of the {info.preset} preset; expected one of the general preset")
        network = ResidualNetwork(network_config(ResidualNetworkConfig, info, weights))
        load_weights(weights, network)
        network.eval().to(device)
    return GeneralModel(Bank(), network, config.sampler, config.num_steps, device=device)


def fitted_model(
    config: InferConfig, detections: pa.Table, grid: Grid, windows: MissionWindows, weights: Path | None
) -> GeneralModel:
    """The model fitted to the log's detections; settings of the bank and the network's part in it chosen by hindsight."""
    sigma_m = config.default_sigma_m
    unfitted = load_model(config, weights)
    _check_steps(unfitted.network, grid)
    bank = fitted_bank(fit_tracks(detections, grid, sigma_m), detections, grid, windows, sigma_m)
    model = dataclasses.replace(unfitted, bank=bank)
    return gated(model, *_hindsight_windows(detections, grid, windows, sigma_m)) if config.is_gated else model


def _check_steps(network: ResidualNetwork | None, grid: Grid) -> None:
    factor = 1 if network is None else 2 ** (len(network.config.multipliers) - 1)
    if grid.num_steps % factor:
        raise ConfigError(
            f"infer.grid: history_steps + horizon_steps is {grid.num_steps}; this checkpoint wants a multiple of {factor}"
        )


def fitted_bank(
    tracks: Detections, detections: pa.Table, grid: Grid, windows: MissionWindows, default_sigma_m: float = 0.0
) -> Bank:
    """The bank fitted to a log: weights by likelihood, the choice among its settings by hindsight on later detections."""
    bank = Bank().fit(tracks, grid.step_s)
    some, later = _hindsight_windows(detections, grid, windows, default_sigma_m)
    return choose_by_hindsight(bank, some, later)


def _hindsight_windows(
    detections: pa.Table, grid: Grid, windows: MissionWindows, default_sigma_m: float
) -> tuple[WindowBatch, Detections]:
    """Evenly spread windows in which something was detected before the origin and after it, and what was after it."""
    later = later_detections(detections, grid, windows, default_sigma_m)
    useful = (windows.batch.is_active & later.is_observed.any(-1)).sum(1)
    order = torch.nonzero(useful)[:, 0]
    num = max(1, int(_HINDSIGHT_ROWS / float(useful[order].double().mean()))) if len(order) else 0
    chosen = order[torch.linspace(0, len(order) - 1, min(num, len(order))).round().long()]
    return windows.batch[chosen], later[chosen]


def draw_hypotheses(model: GeneralModel, windows: MissionWindows, config: InferConfig, obstacles: Obstacles) -> Iterator[Drawn]:
    """Windows in chunks: their indices, positions [B', K, A, T, 2] about the datum, weights [B', K], status [B'][A]."""
    batch = windows.batch
    datum = torch.from_numpy(windows.datum_m)
    per_window = batch.is_active.sum(1).clamp_min(1)
    chunk_of = (per_window.cumsum(0) - 1) // _ROWS_AT_ONCE
    for chunk in range(int(chunk_of[-1]) + 1):
        part = torch.nonzero(chunk_of == chunk)[:, 0]
        if len(part):
            yield part, *_draw_part(model, batch[part], datum[part], config, obstacles)


def _draw_part(
    model: GeneralModel, batch: WindowBatch, datum_m: Tensor, config: InferConfig, obstacles: Obstacles
) -> tuple[Tensor, Tensor, list[list[str]]]:
    active = batch.is_active
    offset_m = datum_m[active.nonzero()[:, 0], None, None]
    limits = Feasibility(obstacles, config.guidance.margin_m, config.guidance.max_speed_mps, batch.step_s, offset_m)
    is_limited = obstacles.count > 0 or config.guidance.max_speed_mps is not None
    guided = dataclasses.replace(model, guide=limits.guide if is_limited and config.guidance.mode == "clean" else None)
    drawn = guided.sample(batch, config.num_hypotheses)
    position, weight = drawn.position_m, drawn.weight
    status = [list(row) for row in drawn.status]
    rows = position.transpose(1, 2)[active]
    is_finite = torch.isfinite(rows).flatten(1).all(1)
    if not bool(is_finite.all()):
        rows = torch.where(is_finite[:, None, None, None], rows, model.bank.posterior(batch, config.num_hypotheses).sample_m)
    if config.guidance.mode != "none" and len(rows):
        sigma = model.bank.posterior(batch, 1).sigma_m if obstacles.count else torch.ones(rows.shape[0], rows.shape[2])
        rows, row_weight, is_feasible = limits.finish(rows, sigma, model.bank.length_m(batch.step_s))
        if batch.num_agents == 1:
            weight = weight.clone()
            weight[active[:, 0]] = row_weight
        else:
            rows = resampled(rows, row_weight, active_rows(batch)[1])
    else:
        is_feasible = torch.ones(rows.shape[:2], dtype=torch.bool)
    for row, (b, a) in enumerate(active.nonzero().tolist()):
        if not bool(is_finite[row]):
            status[b][a] = "guidance_diverged"
        elif not bool(is_feasible[row].all()):
            status[b][a] = "infeasible"
    position = torch.full_like(position.transpose(1, 2), math.nan)
    position[active] = rows
    return position.transpose(1, 2), weight, status


def _model_summary(model: GeneralModel) -> dict[str, Any]:
    bank = model.bank
    ratios = dataclasses.asdict(model.gate) if model.gate else {}
    return {
        "sampler": model.sampler,
        "num_steps": model.num_steps if model.network is not None else 0,
        "network": {"share_past": model.share_past, "share_future": model.share_future, **ratios},
        "bank": {"speed_mps": bank.speed_mps, "switch_rate": bank.switch_rate, "num_models": len(bank.models)},
    }


def _device(name: str) -> str:
    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        torch.zeros(1, device=name)
    except (RuntimeError, AssertionError) as error:
        raise DeviceError(f"infer.device {name!r}: not to be had here ({str(error).splitlines()[0]}); use cpu") from error
    return name
