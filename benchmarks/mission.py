"""Mission hypotheses, which know all detections, beside windows, which know those up to a moment: scores, regions, motion.

Recorded logs (../shared/data), thinned as for `real_logs`, and simulated patrols. Every step between an agent's first and last
detection counts once; the windows' answer is that of the window in which the step lies nearest to the middle of the past, as
in `cadence evaluate`. Both draw as many hypotheses. One file of cells a log, rate and seed in the work folder for each of the
two: a killed run goes on where it was, and the mission hypotheses alone can be drawn again (--again).

    python -m benchmarks.mission --publish docs
"""

import argparse
import json
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy.stats import ks_2samp
from torch import Tensor

from benchmarks import publishing
from benchmarks.publishing import Measurement
from benchmarks.real_logs import CASES, DATA, Setting, evenly_spread, prepare
from cadence.arrays import Bools, Float64s, Int32s, Int64s
from cadence.constraints.obstacles import Obstacles
from cadence.metrics import bootstrap_mean, bootstrap_ratio
from cadence.types import HypothesisSet
from pipeline.checkpoints import DEFAULT
from pipeline.estimators.fitting import FittingData
from pipeline.estimators.presets import load_estimator
from pipeline.estimators.samplings import Samplings
from pipeline.evaluate.whole import MissionDraws, told_once
from pipeline.extract.config import ExtractConfig
from pipeline.extract.stage import extract
from pipeline.files import write_atomic
from pipeline.grids import GridConfig, plan_grid
from pipeline.ingest.stage import IngestConfig, ingest
from pipeline.progress import Progress
from pipeline.results import MissionHypotheses
from pipeline.retrospect.config import RetrospectConfig
from pipeline.retrospect.sources import MissionSources, Share
from pipeline.retrospect.told import Told
from pipeline.retrospect.writing import drawn_stories
from pipeline.scoring.case import Case, default_truth_gap_s
from pipeline.scoring.motion import MOTION_METRICS, motion_rows, true_motion
from pipeline.scoring.scores import METRICS, Cells, Draw, detection_distances, groups_of, score_in_chunks
from pipeline.simulate.stage import SimulateConfig, simulate
from pipeline.stories import MissionStories
from pipeline.tables import read_table
from pipeline.tracks import agent_tracks
from pipeline.windows import build_windows, truth_on_grid

WORK = Path("out/benchmarks/mission")
RATES = (0.05, 0.12)
PATROL = "patrol"
LOGS = ("flight", "ships", "aircraft", PATROL)
WINDOWS, MISSION = "windows", "mission"
KEPT = ("energy_score_fair_m", "coverage_50", "coverage_90", "mean_error_m", "spread_m")
LONG_STEPS = 16.0
"""Gaps longer than that in which a random moment lies are long ones."""


_LONG = f"over {LONG_STEPS:.0f} steps"


@dataclass(frozen=True, eq=False)
class Prepared:
    """A log, what its estimators are fitted to, and the steps that count.

    found     the mission hypotheses
    draw_s    processor seconds that they took, models fitted
    borders   how they move at the borders of stretches, see `borders`
    is_asked  [B, A, T] each step once, in some of the windows
    """

    case: Case
    data: FittingData
    found: MissionStories
    draw_s: float
    borders: dict[str, float]
    is_asked: Tensor


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what is missing, print the table, and publish it where asked to."""
    options = _parser().parse_args(arguments)
    if not DATA.is_dir():
        print(f"skipped: {DATA} is not here")
        return 0
    progress = Progress(quiet=True)
    found: dict[tuple[str, int], list[dict[str, dict[str, object]]]] = {}
    for log in options.logs:
        for rate in options.rates if log != PATROL else (0.0,):
            for seed in options.seeds if log != PATROL else options.patrols:
                found.setdefault((log, round(100 * rate)), []).append(run(log, rate, seed, options, progress))
    facts = publishing.facts_of("mission", arguments) | {"num_hypotheses": options.hypotheses}
    publishing.publish(Measurement("mission", facts, {"mission": rows_of(found)}), section, options.publish)
    return 0


def run(log: str, rate: float, seed: int, options: argparse.Namespace, progress: Progress) -> dict[str, dict[str, object]]:
    """What windows and mission hypotheses scored on one log and seed; drawn only where that is not known."""
    directory = options.work / f"{log}{100 * rate:02.0f}_seed{seed}"
    paths = {name: directory / f"{name}_{options.hypotheses}.json" for name in (WINDOWS, MISSION)}
    missing = [name for name, path in paths.items() if not path.is_file() or (options.again and name == MISSION)]
    if missing:
        prepared = prepare_log(log, rate, seed, directory, options.hypotheses, options.most_tracks, progress)
        for name in missing:
            write_atomic(paths[name], json.dumps(measured(name, prepared, options.hypotheses, progress)))
            print(f"{directory.name}: {name}", file=sys.stderr)
    return {name: json.loads(path.read_text(encoding="utf-8")) for name, path in paths.items()}


def prepare_log(
    log: str, rate: float, seed: int, directory: Path, num_hypotheses: int, most_tracks: int, progress: Progress
) -> Prepared:
    """A log thinned or simulated, its windows, and which steps are asked for."""
    directory.mkdir(parents=True, exist_ok=True)
    config = GridConfig()
    if log == PATROL:
        simulate(directory / "logs", SimulateConfig(world="patrol", seed=seed), progress)
        (path,) = sorted((directory / "logs").glob("*.mcap"))
        ingest(path, directory, IngestConfig(), progress)
        extract(directory, ExtractConfig(), progress)
    else:
        (each,) = CASES[log]
        prepare(Setting(log, each, rate, seed), directory, progress)
        config = GridConfig(step_s=each.step_s(rate), stride_steps=each.stride_steps)
    detections, frame = read_table(directory / "detections.parquet", "detections")
    truth, _ = read_table(directory / "truth.parquet", "truth")
    grid = plan_grid(detections, config)
    windows = build_windows(detections, grid, seed)
    max_gap_s = default_truth_gap_s(truth, grid.step_s)
    truth_m, is_known = truth_on_grid(truth, windows, max_gap_s)
    names = windows.agent_ids
    stored = MissionHypotheses(frame, names, ())
    every = torch.ones(is_known.shape[:2], dtype=torch.bool)
    match = torch.arange(len(names)).expand(len(truth_m), -1)
    case = Case(
        stored, grid, 0.0, detections, windows, every, names, match, False, truth_m, is_known, max_gap_s, 1.0
    )  # fmt: skip
    data = FittingData.of(detections, grid, windows)
    shares = tuple(Share(names.index(name), track, np.arange(num_hypotheses)) for name, track in agent_tracks(detections, 0.0))
    sources = MissionSources(Told(), {}, frame, str(detections["log_id"][0]), detections, grid, names, shares)
    data.fitted_bank()
    begun_s = time.process_time()
    settings = RetrospectConfig(num_hypotheses=num_hypotheses, seed=seed)
    found, _ = drawn_stories(sources, data, settings, Obstacles.none(), progress, 1)
    draw_s = time.process_time() - begun_s
    block_steps = grid.history_steps
    other_steps = block_steps - block_steps // 4
    again = replace(settings, seed=seed + 1000, block_steps=other_steps)
    other, _ = drawn_stories(sources, data, again, Obstacles.none(), progress, 1)
    at_borders = borders(found, other, block_steps, other_steps)
    return Prepared(case, data, found, draw_s, at_borders, _asked(case, found, most_tracks))


def _asked(case: Case, found: MissionStories, most_tracks: int) -> Tensor:
    """Each step once, in the window that sees the most around it, of evenly spread windows [B, A, T]."""
    batch = case.windows.batch
    age, gap, nearest = detection_distances(batch)
    chosen = case.is_known & age.isfinite()
    window, agent, step = (index.numpy().astype(np.int32) for index in chosen.nonzero(as_tuple=True))
    distances = (side[chosen].numpy() for side in (age, gap, nearest))
    cells = Cells(window, agent, step - batch.origin_index, *distances, np.full((len(window), len(METRICS)), np.nan))
    used = told_once(case, found, cells) & np.isin(window, evenly_spread(batch.is_active, most_tracks).numpy())
    is_asked = torch.zeros_like(case.is_known)
    is_asked[window[used], agent[used], step[used]] = True
    return is_asked


def measured(name: str, prepared: Prepared, num_hypotheses: int, progress: Progress) -> dict[str, object]:
    """Scores of every cell, with what groups and gaps they belong to, and how the hypotheses move against the truth."""
    case, is_asked = prepared.case, prepared.is_asked
    batch = case.windows.batch
    if name == MISSION:
        draw: Draw = MissionDraws(case, prepared.found).draw
    else:
        estimator = load_estimator(DEFAULT, Samplings()).fitted(prepared.data).estimator

        def draw(index: Tensor) -> HypothesisSet:
            return estimator.sample(batch[index], num_hypotheses)

    truth = true_motion(batch, case.truth_m, is_asked)
    motion = truth.fresh()
    begun_s = time.process_time()
    cells = score_in_chunks(motion.watch(draw), batch, case.truth_m, is_asked, num_hypotheses)
    cost_s = time.process_time() - begun_s
    groups = groups_of(cells, batch.num_windows)
    time_ns = case.windows.origins_ns[cells.window] + cells.step.astype(np.int64) * case.windows.step_ns
    return {
        "group": groups.tolist(),
        "gap": gaps(case, cells.agent, time_ns).tolist(),
        **{metric: cells.column(metric).tolist() for metric in KEPT},
        "motion": {row.metric: row.value for row in motion_rows(name, motion.laws(), truth.laws()) if row.part == "past"},
        "cost_s": prepared.draw_s if name == MISSION else cost_s,
        "share_drawn": float(is_asked.any(-1).any(-1).double().mean()),
        **(prepared.borders if name == MISSION else {}),
    }


def gaps(case: Case, agent: Int32s, time_ns: Int64s) -> Float64s:
    """Steps between the detections around each cell, whatever windows hold."""
    found = np.full(len(time_ns), np.nan)
    for number, (_, track) in enumerate(agent_tracks(case.detections, 0.0)):
        own = agent == number
        edges = np.concatenate([track.time_ns[:1], track.time_ns, track.time_ns[-1:]])
        at = np.searchsorted(track.time_ns, time_ns[own], side="right")
        found[own] = (edges[at + 1] - edges[at]) / case.windows.step_ns
    return found


def borders(mission: MissionStories, other: MissionStories, block_steps: int, other_steps: int) -> dict[str, float]:
    """How far the laws of steps, bends and turns at borders of stretches are from those of the same steps inside.

    The same mission drawn again with borders elsewhere; distances of Kolmogorov and Smirnov, with their chances. Hypotheses
    that share a chain depend on each other, so that chances are too small rather than too great.
    """
    num_steps = len(mission.stories.time_s)
    at = np.arange(block_steps, num_steps - 1, block_steps)
    at = at[at % other_steps != 0]
    found = {}
    for law, border in _laws_of_motion(mission, at).items():
        inside = _laws_of_motion(other, at)[law]
        test = ks_2samp(border, inside) if len(border) and len(inside) else None
        found[f"border_{law}"] = float("nan") if test is None else float(test.statistic)
        found[f"border_{law}_p"] = float("nan") if test is None else float(test.pvalue)
    return found


def _laws_of_motion(mission: MissionStories, at: Int64s) -> dict[str, Float64s]:
    """Speeds into steps, and the bends and turns there, of all tracks that are there."""
    step_s = np.diff(mission.stories.time_s)
    velocity = np.diff(mission.stories.position_m, axis=2) / step_s[:, None]
    before, after = (velocity[:, :, at + shift].reshape(-1, 2) for shift in (-1, 0))
    is_there = np.isfinite(before + after).all(axis=1)
    before, after = before[is_there], after[is_there]
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    turn = np.arctan2(np.abs(cross), (before * after).sum(axis=1))
    return {"speed": np.hypot(*before.T), "acceleration": np.hypot(*(after - before).T), "turn": turn}


def rows_of(found: dict[tuple[str, int], list[dict[str, dict[str, object]]]]) -> list[publishing.Row]:
    """A row a log, rate and length of gaps."""
    rows = []
    for (log, percent), runs in found.items():
        group = np.concatenate([10_000_000 * seed + np.array(each[MISSION]["group"]) for seed, each in enumerate(runs)])
        column = {
            name: {key: np.concatenate([np.array(each[name][key], float) for each in runs]) for key in (*KEPT, "gap")}
            for name in (WINDOWS, MISSION)
        }
        for gap, is_in in _by_gap(column[MISSION]["gap"]):
            if not is_in.any():
                continue
            rng = np.random.default_rng(0)
            mission, windows = ({key: value[is_in] for key, value in column[name].items()} for name in (MISSION, WINDOWS))
            row = {"log": log, "detections_percent": percent, "gaps": gap, "num_cells": int(is_in.sum())}
            ratio = bootstrap_ratio(mission["energy_score_fair_m"], windows["energy_score_fair_m"], group[is_in], rng)
            row |= publishing.columns("ratio", ratio)
            for name, values in ((MISSION, mission), (WINDOWS, windows)):
                row |= publishing.columns(f"{name}_energy_m", bootstrap_mean(values["energy_score_fair_m"], group[is_in], rng))
                row |= publishing.columns(f"{name}_in_90", bootstrap_mean(values["coverage_90"], group[is_in], rng))
                row[f"{name}_in_50"] = float(np.mean(values["coverage_50"]))
                row[f"{name}_spread_m"] = float(np.mean(values["spread_m"]))
            if gap == "all":
                row |= _others(runs)
            else:
                row |= dict.fromkeys(_others(runs))
            rows.append(row)
    return rows


def _by_gap(gap: Float64s) -> Iterator[tuple[str, Bools]]:
    yield "all", np.ones(len(gap), dtype=bool)
    yield _LONG, gap > LONG_STEPS
    yield f"over {4 * LONG_STEPS:.0f} steps", gap > 4 * LONG_STEPS


def _others(runs: Sequence[dict[str, dict[str, object]]]) -> publishing.Row:
    """Motion against the truth's, steps at borders against those inside, and cost: means over the seeds."""
    row: publishing.Row = {}
    for name in (MISSION, WINDOWS):
        for metric in MOTION_METRICS:
            row[f"{name}_{metric}"] = _mean([each[name]["motion"].get(metric, np.nan) for each in runs])
    for law in MOTION_METRICS.values():
        for column in (f"border_{law}", f"border_{law}_p"):
            row[column] = _mean([each[MISSION][column] for each in runs])
    # windows that are scored are some of all; mission hypotheses are drawn of all
    windows_s = sum(each[WINDOWS]["cost_s"] / each[WINDOWS]["share_drawn"] for each in runs)
    return row | {"cost_ratio": sum(each[MISSION]["cost_s"] for each in runs) / windows_s}


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if np.isfinite(value)]
    return float(np.mean(known)) if known else float("nan")


def section(measured_: Measurement) -> str:
    """Ratios and regions by log and rate, in all gaps and in long ones."""
    heads = ["log", "detections", "gaps", "energy score over windows", "in 90 %: mission", "windows", "cells"]
    lines = [
        [
            row["log"], f"{row['detections_percent']} %" if row["detections_percent"] else "as simulated", row["gaps"],
            publishing.interval(row, "ratio", ".2f"), publishing.interval(row, "mission_in_90", ".2f"),
            publishing.interval(row, "windows_in_90", ".2f"), str(row["num_cells"]),
        ]
        for row in measured_.rows() if row["gaps"] in ("all", _LONG)
    ]  # fmt: skip
    return publishing.table(heads, lines)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=WORK, help="results so far (default %(default)s)")
    parser.add_argument("--logs", nargs="+", choices=LOGS, default=LOGS)
    parser.add_argument("--rates", nargs="+", type=float, default=list(RATES))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1])
    parser.add_argument("--patrols", nargs="+", type=int, default=[0, 1, 2, 3, 4, 5], help="seeds of the simulated patrols")
    parser.add_argument("--hypotheses", type=int, default=60, help="joint samples of each (default %(default)s)")
    parser.add_argument("--most-tracks", type=int, default=60, help="scored of a log, evenly spread (default %(default)s)")
    parser.add_argument("--again", action="store_true", help="draw mission hypotheses again though they have results")
    parser.add_argument("--publish", type=Path, metavar="DOCS", help="write numbers and section below this folder")
    return parser


if __name__ == "__main__":
    sys.exit(main())
