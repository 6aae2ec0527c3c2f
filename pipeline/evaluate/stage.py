"""Score the hypotheses of a mission against its truth, beside the rivals on the same windows.

Reads hypotheses, windows, detections and truth (*.parquet); writes scores.json (everything), scores.csv (the same rows
for a spreadsheet) and scores.md (what a person reads first). `evaluate_folder` pools the missions of a folder; a folder of
logs is evaluated with a forecasting checkpoint (`pipeline.forecast.stage`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import torch
from torch import Tensor

from cadence.constraints.checker import segments_in_collision, states_in_collision
from cadence.errors import CadenceError, InputError, UsageError
from cadence.types import Estimator, HypothesisSet, WindowBatch
from pipeline.associations import Association, Sources, build_way_windows
from pipeline.estimators.fitting import FittingData
from pipeline.evaluate.joint import JointCells, JointScorer
from pipeline.evaluate.matching import match_to_truth, matched_windows
from pipeline.evaluate.motion import MotionLaws, true_motion
from pipeline.evaluate.rivals import RIVALS
from pipeline.evaluate.scores import Cells, Draw, IsInside, score_in_chunks
from pipeline.evaluate.tables import OWN_NAME, ScoredMission, as_csv, as_json, as_markdown, headline, pool, verdict
from pipeline.files import write_atomic
from pipeline.forecast.stage import ForecastConfig, evaluate_forecasts
from pipeline.manifest import StageResult, check_chain, manifest_path, read_manifest, run_stage
from pipeline.missions import is_mission_directory
from pipeline.obstacle_file import OBSTACLES_NAME, read_obstacles
from pipeline.progress import Progress
from pipeline.results import MissionHypotheses, read_hypothesis_tables
from pipeline.tables import read_table
from pipeline.tracks import UNKNOWN_AGENT
from pipeline.windows import Grid, MissionWindows, build_windows, truth_on_grid

LABELS_NAME = "labels.parquet"
_TRUTH_GAP_STEPS = 2.0
_CUTOFF_STEPS = 16.0
_LEAST_PROBABILITY = 0.5


@dataclass(frozen=True)
class EvaluateConfig:
    """What is scored, and beside whom.

    rivals           out of `pipeline.evaluate.rivals.RIVALS`, fitted to the mission's detections; empty: the hypotheses alone
    max_truth_gap_s  truth is interpolated between samples at most this far apart; by default two steps, or twice the median
                     time between truth samples where that is longer
    gospa_cutoff_m   from this distance on an agent counts as missed and as false; by default the way that agents typically go
                     between two detections
    num_resamples    bootstrap resamples of an interval
    seed             of the rivals' samples and of the bootstrap
    forecast         how a checkpoint is evaluated on a folder of logs
    """

    rivals: tuple[str, ...] = ("bank", "cv", "ou", "linear", "hold")
    max_truth_gap_s: float | None = None
    gospa_cutoff_m: float | None = None
    num_resamples: int = 1000
    seed: int = 0
    forecast: ForecastConfig = field(default_factory=ForecastConfig)

    def __post_init__(self) -> None:
        unknown = [name for name in self.rivals if name not in RIVALS]
        if unknown:
            raise ValueError(f"rival {unknown[0]!r} is not known; known rivals: {', '.join(RIVALS)}")
        for name in ("max_truth_gap_s", "gospa_cutoff_m"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"{name} must be positive, got {value}")
        if self.num_resamples < 1:
            raise ValueError(f"num_resamples must be at least 1, got {self.num_resamples}")


def evaluate_any(
    path: Path, checkpoint: str | None, out: Path | None, config: EvaluateConfig, progress: Progress, force: bool = False
) -> StageResult:
    """Score what is at `path`: a mission directory, a folder of them, or with a checkpoint a folder of logs.

    Raises `UsageError` where path and checkpoint do not go together.
    """
    is_mission = is_mission_directory(path)
    if checkpoint is not None:
        if is_mission or (path.is_file() and path.suffix == ".mcap"):
            raise UsageError(
                f"{path}: --checkpoint is for a folder of logs (MCAP) with truth; leave it out, or give the folder"
            )
        return evaluate_forecasts(path, checkpoint, out or path, config.forecast, progress, force)
    if out is not None:
        raise UsageError("--out is for --checkpoint; the scores of missions are written beside them")
    if is_mission:
        return evaluate(path, config, progress, force)
    if not any(path.glob("*/hypotheses.parquet")) and any(path.glob("*.mcap")):
        raise UsageError(
            f"{path}: holds logs, not missions; forecast with --checkpoint NAME, or call cadence run on them first"
        )
    return evaluate_folder(path, config, progress)


def evaluate(directory: Path, config: EvaluateConfig, progress: Progress, force: bool = False) -> StageResult:
    """Score one mission directory; writes scores.json, scores.csv and scores.md."""
    inputs = [directory / f"{name}.parquet" for name in ("hypotheses", "windows", "detections", "truth")]
    if not inputs[-1].is_file():
        raise InputError(
            f"{inputs[-1]}: not found, so there is nothing to score against; name a truth channel in [[extract.truth]] "
            "or thin a dense one (extract.thinning), then run extract and infer again"
        )
    more = (directory / OBSTACLES_NAME, directory / LABELS_NAME, manifest_path("infer", directory))
    inputs += [path for path in more if path.is_file()]

    def body(work: Path) -> Mapping[str, Any]:
        scored = score_mission(directory, config, progress)
        return _write_scores([scored], work, config)

    return run_stage("evaluate", directory, config=config, inputs=inputs, body=body, force=force)


def evaluate_folder(folder: Path, config: EvaluateConfig, progress: Progress) -> StageResult:
    """Pooled scores of all mission directories in `folder`, written there; intervals over logs where there are six or more.

    A mission that cannot be scored (no truth, say) is named and left out; raises where none can be.
    """
    directories = sorted(path.parent for path in folder.glob("*/hypotheses.parquet"))
    if not directories:
        raise InputError(f"{folder}: holds no mission directory with hypotheses.parquet; run cadence run --out {folder} first")
    scored, failures = [], []
    with progress.bar(len(directories), "evaluate", "log") as bar:
        for directory in directories:
            try:
                check_chain("evaluate", directory, {})
                scored.append(score_mission(directory, config, progress))
            except CadenceError as error:
                failures.append(error)
                progress.warn(str(error))
            bar.update(1)
    if not scored:
        raise failures[0]
    summary = _write_scores(scored, folder, config) | {"num_failed": len(failures)}
    outputs = tuple(folder / f"scores.{suffix}" for suffix in ("csv", "json", "md"))
    return StageResult("evaluate", "done", outputs, summary)


def score_mission(directory: Path, config: EvaluateConfig, progress: Progress) -> ScoredMission:
    """Cells of one mission directory, for the stored hypotheses and for the rivals of `config`."""
    stored = read_hypothesis_tables(directory)
    case = _case(directory, stored, config)
    windows, scored = case.windows, case.scored
    num_hypotheses = max(len(window.hypothesis) for window in stored.windows)

    def own_draw(index: Tensor) -> HypothesisSet:
        return _stored_hypotheses(stored, windows, index, num_hypotheses)

    collides = _collision_test(directory, windows)
    truth = true_motion(scored, case.truth_m, case.is_known)
    with progress.bar(windows.batch.num_windows * (1 + len(config.rivals)), "evaluate", "window") as bar:

        def score(draw: Draw, is_known: Tensor) -> tuple[Cells, JointCells, MotionLaws]:
            scorer, motion = case.scorer(), truth.fresh()
            watched = motion.watch(scorer.watch(draw) if case.is_joint else draw)
            cells = score_in_chunks(
                watched, scored, case.truth_m, is_known, num_hypotheses, collides, bar.update, truth.fastest_m
            )
            return cells, scorer.cells(), motion.laws()

        own_scored = score(own_draw, case.is_known)
        own = own_scored[0]
        if not len(own):
            raise InputError(
                f"{directory}: no step has both hypotheses and truth (truth samples at most {case.max_truth_gap_s:g} s apart); "
                "check that the truth channel overlaps the detections in time, or set evaluate.max_truth_gap_s"
            )
        is_scored = torch.zeros(case.is_known.shape[:2], dtype=torch.bool)
        is_scored[torch.from_numpy(own.window.astype(np.int64)), torch.from_numpy(own.agent.astype(np.int64))] = True
        found: dict[str, tuple[Cells, JointCells, MotionLaws]] = {OWN_NAME: own_scored}
        for name in config.rivals:
            draw = _rival_draw(RIVALS[name](case.fitting), windows.batch, num_hypotheses)
            found[name] = score(draw, case.is_known & is_scored[..., None])
            if len(found[name][0]) != len(own):
                raise ValueError(f"{name} scored {len(found[name][0])} cells where {OWN_NAME} scored {len(own)}")
    is_asked = case.is_known.any(dim=-1) & scored.is_active
    return ScoredMission(
        log_id=next((window.log_id for window in stored.windows), directory.name),
        step_s=case.fitting.grid.step_s,
        num_windows=windows.batch.num_windows,
        agent_ids=case.names,
        num_hypotheses=num_hypotheses,
        max_truth_gap_s=case.max_truth_gap_s,
        num_unscored=int((is_asked & ~is_scored).sum()),
        cells={name: cells for name, (cells, _, _) in found.items()},
        joint={name: joint for name, (_, joint, _) in found.items()} if case.is_joint else {},
        motion={name: laws for name, (_, _, laws) in found.items()},
        true_motion=truth.laws(),
        gospa_cutoff_m=case.cutoff_m if case.is_joint else None,
        is_matched=case.is_matched,
    )


def _rival_draw(rival: Estimator, windows: WindowBatch, num_hypotheses: int) -> Draw:
    return lambda index: rival.sample(windows[index], num_hypotheses)


@dataclass(frozen=True, eq=False)
class _Case:
    """What is compared with what.

    windows     what rivals see: every agent's detections, those of unknown origin under the likeliest way
    fitting     what rivals are fitted to
    is_counted  [B, A] agents that are said to be there
    names       of the J agents of the truth that are compared; match [B, J] which of the A each one is, -1: none
    is_matched  whether they had to be matched, as the origin of detections is unknown
    truth_m     [B, J, T, 2] about the datum, is_known [B, J, T]
    """

    windows: MissionWindows
    fitting: FittingData
    is_counted: Tensor
    names: tuple[str, ...]
    match: Tensor
    is_matched: bool
    truth_m: Tensor
    is_known: Tensor
    max_truth_gap_s: float
    cutoff_m: float

    @cached_property
    def scored(self) -> WindowBatch:
        """The windows by the agents of the truth."""
        return matched_windows(self.windows.batch, self.match) if self.is_matched else self.windows.batch

    @property
    def is_joint(self) -> bool:
        """Whether there is something to say of all agents together."""
        return len(self.names) > 1 or self.is_matched

    def scorer(self) -> JointScorer:
        """What one estimator is scored with."""
        return JointScorer(
            self.windows.batch, self.is_counted, self.scored, self.match, self.truth_m, self.is_known, self.cutoff_m
        )


def _case(directory: Path, stored: MissionHypotheses, config: EvaluateConfig) -> _Case:
    detections, _ = read_table(directory / "detections.parquet", "detections")
    truth, _ = read_table(directory / "truth.parquet", "truth")
    told = _Told.of(directory)
    grid = _stored_grid(stored, directory, told.context_steps)
    path = directory / LABELS_NAME
    is_matched = path.is_file()
    labels = read_table(path, "labels")[0] if is_matched else None
    windows, fitting = _seen(detections, grid, told.default_sigma_m, config.seed, labels)
    if not is_matched:
        truth = _named_like(truth, windows.agent_ids, directory)
    names = tuple(sorted(pc.unique(truth["agent_id"]).to_pylist())) if is_matched else windows.agent_ids
    max_gap_s = config.max_truth_gap_s or default_truth_gap_s(truth, grid.step_s)
    truth_m, is_known = truth_on_grid(truth, replace(windows, agent_ids=names), max_gap_s)
    cutoff_m = config.gospa_cutoff_m or _default_cutoff_m(truth_m, is_known)
    match = torch.arange(len(names)).expand(len(truth_m), -1)
    if is_matched:
        match = match_to_truth(windows, truth, names, max_gap_s, cutoff_m)
    is_counted = _is_counted(stored, windows.agent_ids)
    return _Case(windows, fitting, is_counted, names, match, is_matched, truth_m, is_known, max_gap_s, cutoff_m)


def _seen(
    detections: pa.Table, grid: Grid, sigma_m: float, seed: int, labels: pa.Table | None
) -> tuple[MissionWindows, FittingData]:
    """Windows as they were inferred from, detections of unknown origin under the likeliest way, and what to fit rivals to."""
    if labels is None:
        windows = build_windows(detections, grid, seed, sigma_m)
        return windows, FittingData.of(detections, grid, windows, sigma_m)
    found = Association.of_labels(detections, labels, grid, sigma_m)
    sources = Sources(found.named(detections), grid, found)
    windows = build_way_windows(detections, sources, seed, 1, sigma_m).windows
    named = build_windows(sources.named, grid, seed, sigma_m)
    return windows, FittingData.of(sources.named, grid, named, sigma_m)


def _is_counted(stored: MissionHypotheses, agent_ids: tuple[str, ...]) -> Tensor:
    """Agents [B, A] that are rather there than not; those of known origin are."""
    is_counted = torch.ones(len(stored.windows), len(agent_ids), dtype=torch.bool)
    for b, window in enumerate(stored.windows):
        for agent in window.agents:
            if agent.agent_id in agent_ids and agent.probability is not None:
                is_counted[b, agent_ids.index(agent.agent_id)] = agent.probability > _LEAST_PROBABILITY
    return is_counted


def _default_cutoff_m(truth_m: Tensor, is_known: Tensor) -> float:
    """The way that agents typically go in the gap between two detections: sixteen steps at their mean speed, at least 1 m."""
    step_m = torch.linalg.vector_norm(truth_m.diff(dim=2), dim=-1)[is_known[..., 1:] & is_known[..., :-1]]
    return max(1.0, _CUTOFF_STEPS * float(step_m.mean())) if len(step_m) else 1.0


def default_truth_gap_s(truth: pa.Table, step_s: float) -> float:
    """Two steps, or twice the median time between an agent's truth samples where that is longer."""
    order = truth.sort_by([("agent_id", "ascending"), ("time_ns", "ascending")])
    agent = order["agent_id"].combine_chunks().dictionary_encode()
    codes = pa.chunked_array([agent] if isinstance(agent, pa.Array) else agent.chunks).unify_dictionaries()
    index = np.concatenate([chunk.indices.to_numpy() for chunk in codes.chunks]) if truth.num_rows else np.zeros(0, np.int32)
    gaps = np.diff(order["time_ns"].to_numpy())[np.diff(index) == 0]
    median_s = float(np.median(gaps)) * 1e-9 if len(gaps) else 0.0
    return max(_TRUTH_GAP_STEPS * step_s, 2.0 * median_s)


def _stored_grid(stored: MissionHypotheses, directory: Path, context_steps: int | None) -> Grid:
    drawn = [window for window in stored.windows if len(window.hypothesis)]
    if not drawn:
        raise InputError(f"{directory}: there are no hypotheses to score; see windows.parquet (status, advice) for the reasons")
    origins_ns = np.array([window.origin_ns for window in stored.windows], dtype=np.int64)
    first = drawn[0]
    return Grid(
        first.step_ns, first.origin_index + 1, first.num_steps - first.origin_index - 1, origins_ns, context_steps
    )  # fmt: skip


def _collision_test(directory: Path, windows: MissionWindows) -> IsInside | None:
    """Which states touch an obstacle, themselves or on the straight way from the step before; None without obstacles."""
    path = directory / OBSTACLES_NAME
    obstacles = read_obstacles(path) if path.is_file() else None
    if obstacles is None or obstacles.count == 0:
        return None

    def collides(position_m: Tensor, index: Tensor) -> Tensor:
        offset_m = torch.from_numpy(windows.datum_m[index.numpy()])[:, None, None, None]
        hit = states_in_collision(position_m, obstacles, offset_m=offset_m)
        hit[..., 1:] |= segments_in_collision(position_m, obstacles, offset_m=offset_m)
        return hit

    return collides


@dataclass(frozen=True)
class _Told:
    """What infer was told of the detections: rivals get the same.

    default_sigma_m  accuracy of detections that state none
    context_steps    how far back they are read, which is for infer's checkpoint to say
    """

    default_sigma_m: float = 0.0
    context_steps: int | None = None

    @staticmethod
    def of(directory: Path) -> "_Told":
        """By infer's manifest; the defaults where there is none."""
        manifest = read_manifest("infer", directory) or {}
        config, summary = manifest.get("config") or {}, manifest.get("summary") or {}
        steps = summary.get("context_steps", (config.get("grid") or {}).get("context_steps"))
        return _Told(float(config.get("default_sigma_m") or 0.0), steps)


def _named_like(truth: pa.Table, agent_ids: tuple[str, ...], directory: Path) -> pa.Table:
    """The truth under the agents' names: detections of unknown origin belong to the only agent that there is."""
    names = pc.unique(truth["agent_id"]).to_pylist()
    if set(names) & set(agent_ids):
        return truth
    if agent_ids == (UNKNOWN_AGENT,) and len(names) == 1:
        column = pa.array([UNKNOWN_AGENT] * truth.num_rows, pa.string())
        return truth.set_column(truth.schema.get_field_index("agent_id"), truth.schema.field("agent_id"), column)
    raise InputError(
        f"{directory}: truth is of {', '.join(map(str, names[:5])) or 'nobody'}, detections are of {', '.join(agent_ids[:5])}; "
        "give both the same names (agent, agent_path or {agent} in [[extract.truth]] and [[extract.detections]])"
    )


def _stored_hypotheses(stored: MissionHypotheses, windows: MissionWindows, index: Tensor, num_hypotheses: int) -> HypothesisSet:
    """Hypotheses of some windows as one set; a window with fewer of them is filled up with weight zero."""
    shape = (len(index), num_hypotheses, len(windows.agent_ids), windows.batch.num_steps, 2)
    position = np.full(shape, np.nan)
    weight = np.zeros(shape[:2])
    for row, b in enumerate(index.tolist()):
        window = stored.windows[b]
        k = len(window.hypothesis)
        weight[row, :k] = window.weight if k else 0.0
        for agent in window.agents:
            if agent.is_live and agent.agent_id in windows.agent_ids:
                shift_m = np.array(agent.datum_m) - windows.datum_m[b]
                target = position[row, :, windows.agent_ids.index(agent.agent_id)]
                target[:k], target[k:] = agent.position_m + shift_m, agent.position_m[0] + shift_m
    weight[weight.sum(axis=1) == 0] = 1.0  # nothing was drawn: all NaN, any weight does
    weight /= weight.sum(axis=1, keepdims=True)
    status = tuple(tuple("ok" for _ in windows.agent_ids) for _ in range(len(index)))
    return HypothesisSet(torch.from_numpy(position), torch.from_numpy(weight), status)


def _write_scores(missions: Sequence[ScoredMission], folder: Path, config: EvaluateConfig) -> dict[str, Any]:
    """Write the three files into `folder`; returns the summary."""
    report = pool(missions, config.num_resamples, config.seed)
    write_atomic(folder / "scores.json", as_json(report))
    write_atomic(folder / "scores.csv", as_csv(report))
    write_atomic(folder / "scores.md", as_markdown(report))
    return {"num_logs": len(missions), "grouped_by": report.grouped_by, "verdict": verdict(report), "scores": headline(report)}
