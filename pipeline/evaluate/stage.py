"""Score the hypotheses of a mission against its truth, beside the rivals on the same windows.

Reads hypotheses, windows, detections and truth (*.parquet); writes scores.json (everything), scores.csv (the same rows
for a spreadsheet) and scores.md (what a person reads first). `evaluate_folder` pools the missions of a folder; a folder of
logs is evaluated with a forecasting checkpoint (`pipeline.forecast.stage`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from cadence.errors import CadenceError, InputError, UsageError
from cadence.types import Estimator, WindowBatch
from pipeline.estimators.fitting import FittingData
from pipeline.evaluate.joint import JointCells, JointScorer
from pipeline.evaluate.maps import RING_NAME, MapCells, MapScorer
from pipeline.evaluate.rivals import RIVALS
from pipeline.evaluate.tables import OWN_NAME, ScoredMission, as_csv, as_json, as_markdown, headline, pool, verdict
from pipeline.evaluate.whole import WholeCells, score_whole
from pipeline.files import write_atomic
from pipeline.forecast.stage import ForecastConfig, evaluate_forecasts
from pipeline.manifest import StageResult, check_chain, manifest_path, read_manifest, run_stage
from pipeline.missions import is_mission_directory
from pipeline.obstacle_file import OBSTACLES_NAME
from pipeline.progress import Doing, Progress, RelayedProgress, Told
from pipeline.provenance import versions
from pipeline.results import read_hypothesis_tables
from pipeline.scoring.case import LABELS_NAME, Case, collision_test, mission_obstacles, read_case
from pipeline.scoring.motion import MotionLaws, true_motion
from pipeline.scoring.scores import Cells, Draw, IsInside, score_in_chunks
from pipeline.stories import MISSION_NAME, read_stories
from pipeline.windows import build_windows


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
    more = (directory / OBSTACLES_NAME, directory / LABELS_NAME, directory / MISSION_NAME, manifest_path("infer", directory))
    inputs += [path for path in more if path.is_file()]

    def body(work: Path) -> Mapping[str, Any]:
        scored = score_mission(directory, config, progress)
        return _write_scores([scored], work, config)

    return run_stage("evaluate", directory, config=config, inputs=inputs, body=body, force=force)


@dataclass(frozen=True, eq=False)
class _ShownIn:
    """One bar over all logs: what is told of one moves it."""

    bar: "tqdm[Any]"
    name: str
    progress: Progress

    def tell(self, told: Told) -> None:
        """A share of the whole, or a line; what a log is at is which it is."""
        if isinstance(told, float):
            self.bar.n = told
            self.bar.set_postfix_str(self.name)
        elif not isinstance(told, Doing):
            self.progress.note(told)


def evaluate_folder(folder: Path, config: EvaluateConfig, progress: Progress) -> StageResult:
    """Pooled scores of all mission directories in `folder`, written there; intervals over logs where there are six or more.

    A mission that cannot be scored (no truth, say) is named and left out; raises where none can be.
    """
    directories = sorted(path.parent for path in folder.glob("*/hypotheses.parquet"))
    if not directories:
        raise InputError(
            f"{folder}: holds no mission directory with hypotheses.parquet; `cadence run LOG --out results` makes one"
        )
    scored, failures = [], []
    with progress.percent("evaluate") as bar:
        for number, directory in enumerate(directories, 1):
            inner = _ShownIn(bar, f"{number} of {len(directories)}", progress)
            share = RelayedProgress(tell=inner.tell).part((number - 1) / len(directories), number / len(directories))
            try:
                check_chain("evaluate", directory, {})
                scored.append(score_mission(directory, config, share))
                progress.note(f"[{number}/{len(directories)}] {directory.name}: scored")
            except CadenceError as error:
                failures.append(error)
                progress.warn(str(error))
    if not scored:
        raise failures[0]
    summary = _write_scores(scored, folder, config) | {"num_failed": len(failures)}
    outputs = tuple(folder / f"scores.{suffix}" for suffix in ("csv", "json", "md"))
    return StageResult("evaluate", "done", outputs, summary)


def score_mission(directory: Path, config: EvaluateConfig, progress: Progress) -> ScoredMission:
    """Cells of one mission directory, for the stored hypotheses and for the rivals of `config`."""
    stored = read_hypothesis_tables(directory)
    case = read_case(directory, stored, config.max_truth_gap_s, config.gospa_cutoff_m, config.seed)
    windows, scored, num_hypotheses = case.windows, case.scored, case.num_hypotheses
    fitting = _fitting(case, config.seed, directory)
    obstacles = mission_obstacles(directory)
    collides = collision_test(obstacles, windows)
    truth = true_motion(scored, case.truth_m, case.is_known)
    maps = MapScorer.of(scored, case.truth_m, case.is_known, windows.datum_m)
    mapped: dict[str, MapCells] = {}
    with progress.bar(windows.batch.num_windows * (1 + len(config.rivals)), "evaluate", "window") as bar:

        def score(name: str, draw: Draw, is_known: Tensor) -> tuple[Cells, JointCells, MotionLaws]:
            scorer, motion, on_map = _scorer(case), truth.fresh(), maps.fresh()
            watched = on_map.watch(motion.watch(scorer.watch(draw) if case.is_joint else draw))
            cells = score_in_chunks(
                watched, scored, case.truth_m, is_known, num_hypotheses, collides, bar.update, truth.fastest_m,
                truth_height_m=case.truth_height_m,
            )  # fmt: skip
            mapped[name] = on_map.cells()
            return cells, scorer.cells(), motion.laws()

        own_scored = score(OWN_NAME, case.draw, case.is_known)
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
            draw = _rival_draw(RIVALS[name](fitting), windows.batch, num_hypotheses)
            found[name] = score(name, draw, case.is_known & is_scored[..., None])
            if len(found[name][0]) != len(own):
                raise ValueError(f"{name} scored {len(found[name][0])} cells where {OWN_NAME} scored {len(own)}")
    is_asked = case.is_known.any(dim=-1) & scored.is_active
    return ScoredMission(
        log_id=next((window.log_id for window in stored.windows), directory.name),
        step_s=case.grid.step_s,
        num_windows=windows.batch.num_windows,
        agent_ids=case.names,
        num_hypotheses=num_hypotheses,
        max_truth_gap_s=case.max_truth_gap_s,
        num_unscored=int((is_asked & ~is_scored).sum()),
        cells={name: cells for name, (cells, _, _) in found.items()},
        joint={name: joint for name, (_, joint, _) in found.items()} if case.is_joint else {},
        motion={name: laws for name, (_, _, laws) in found.items()},
        true_motion=truth.laws(),
        maps={**mapped, RING_NAME: maps.rings()},
        whole=_whole(directory, case, own, truth.fastest_m),
        gospa_cutoff_m=case.cutoff_m if case.is_joint else None,
        is_matched=case.is_matched,
        true_collision_share=_collision_share(collision_test(obstacles, windows, are_ways_straight=False), case),
    )


def _whole(directory: Path, case: Case, own: Cells, fastest_m: float) -> WholeCells | None:
    """Mission hypotheses, as many as a window has, as scores depend on their number; None in results without any."""
    if not (directory / MISSION_NAME).is_file():
        return None

    def score(draw: Draw, is_known: Tensor, num_stories: int) -> Cells:
        return score_in_chunks(draw, case.scored, case.truth_m, is_known, num_stories, fastest_m=fastest_m)

    return score_whole(case, read_stories(directory, case.num_hypotheses), own, score)


def _collision_share(collides: IsInside | None, case: Case) -> float | None:
    """Share of the known steps of the truth that lie in an obstacle; None without obstacles."""
    if collides is None:
        return None
    hit = collides(case.truth_m[:, None], torch.arange(len(case.truth_m)))[:, 0]
    return float(hit[case.is_known].double().mean()) if bool(case.is_known.any()) else 0.0


def _fitting(case: Case, seed: int, directory: Path) -> FittingData:
    """What rivals are fitted to."""
    windows = build_windows(case.detections, case.grid, seed, case.default_sigma_m) if case.is_matched else case.windows
    return FittingData.of(case.detections, case.grid, windows, case.default_sigma_m, _told_bank(directory, seed))


def _told_bank(directory: Path, seed: int) -> Mapping[str, Any] | None:
    """What infer said of the bank that it fitted, where the same program would find the same again; None elsewhere."""
    manifest = read_manifest("infer", directory) or {}
    config, summary = manifest.get("config"), manifest.get("summary")
    if not isinstance(config, dict) or not isinstance(summary, dict):
        return None
    is_same = config.get("seed") == seed and manifest.get("versions") == versions()
    found = summary.get("bank") if is_same else None
    return found if isinstance(found, dict) else None


def _scorer(case: Case) -> JointScorer:
    return JointScorer(case.windows.batch, case.is_counted, case.scored, case.match, case.truth_m, case.is_known, case.cutoff_m)


def _rival_draw(rival: Estimator, windows: WindowBatch, num_hypotheses: int) -> Draw:
    return lambda index: rival.sample(windows[index], num_hypotheses)


def _write_scores(missions: Sequence[ScoredMission], folder: Path, config: EvaluateConfig) -> dict[str, Any]:
    """Write the three files into `folder`; returns the summary."""
    report = pool(missions, config.num_resamples, config.seed)
    write_atomic(folder / "scores.json", as_json(report))
    write_atomic(folder / "scores.csv", as_csv(report))
    write_atomic(folder / "scores.md", as_markdown(report))
    return {"num_logs": len(missions), "grouped_by": report.grouped_by, "verdict": verdict(report), "scores": headline(report)}
