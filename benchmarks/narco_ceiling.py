"""How good can a forecast in the world narco be?

A smuggler there takes one of sixteen ways, always at the same speed. So what detections and the time say of it can be written
down: of all recorded episodes those that were where the target was seen, when it was seen, and that are still under way. No
forecast knows more that does not read the trackers' positions, or what it means not to be seen. Thirty of them, drawn evenly,
are scored on windows like those of table I, beside the rivals and CADENCE. Scores are kept under --work: a killed run goes on.

    python -m benchmarks.narco_ceiling --publish docs
"""

import argparse
import functools
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Self

import numpy as np
import torch

from benchmarks import publishing
from benchmarks.leads import relative_lead
from benchmarks.publishing import Measurement
from benchmarks.table1 import EVALUATION_SEED
from benchmarks.table1_page import LATE, NAMES, measure_rows
from cadence.bank.rows import active_rows, scatter_hypotheses
from cadence.diffusion.settings import PlaceSampling
from cadence.errors import CadenceError
from cadence.recordings import Recordings
from cadence.types import Detections, Estimator, HypothesisSet, WindowBatch
from pipeline.checkpoints import checkpoint_hash, find_checkpoint
from pipeline.episodes.recordings import RecordingsConfig, load_recordings
from pipeline.estimators.presets import load_forecaster
from pipeline.estimators.samplings import Samplings
from pipeline.forecast.rivals import FORECAST_RIVALS
from pipeline.forecast.scores import HORIZONS, EpisodeScores
from pipeline.forecast.stage import ForecastConfig, ForecastRun, forecast_windows
from pipeline.progress import Progress

SETS: tuple[Literal["low", "high"], ...] = ("low", "high")
TRAINING_SEED = 1
"""Of the episodes; that of table I's rivals in narco."""
NUM_LIBRARY = 300
MIXTURES = ("grammi_without_mi", "grammi")
SAME_M = 100.0
"""Ways that are nearer to each other than this at the time of a detection cannot be told apart by it."""
SHOWN = ("energy_score", "displacement_error", "mean_error", "min_ade", "coverage_90")
NUM_RESAMPLES = 2_000


@dataclass(frozen=True, eq=False)
class SameSoFar:
    """An estimator: the episodes that were where the target was seen, when it was seen, and are not over."""

    recordings: Recordings
    name: str = "same so far"

    def fit(self, tracks: Detections) -> Self:
        """The recordings themselves: nothing is fitted."""
        return self

    def sample(self, windows: WindowBatch, num_hypotheses: int) -> HypothesisSet:
        """Continuations [B, K, 1, T, 2] of such episodes, drawn evenly in the order of where they are and go."""
        context, recordings = windows.required_context("SameSoFar"), self.recordings
        assert context.elapsed_s is not None
        steps = np.rint(windows.time_s.double().numpy() / recordings.step_s).astype(np.int64)
        window = windows.is_active.nonzero(as_tuple=True)[0].numpy()
        nodes, seeds = active_rows(windows)
        drawn_m = np.empty((len(window), num_hypotheses, len(steps), 2))
        for row in range(len(window)):
            count = int(nodes.is_observed[row].sum())
            datum_m = context.datum_m[window[row]].double().numpy()
            now = round(float(context.elapsed_s[window[row]]) / recordings.step_s)
            at = now + np.rint(nodes.time_s[row, :count].numpy() / recordings.step_s).astype(np.int64)
            found = self._alike(now, at, nodes.position_m[row, :count].double().numpy() + datum_m)
            rng = np.random.default_rng(int(seeds[row]))
            place = ((np.arange(num_hypotheses) + rng.random()) / num_hypotheses * len(found)).astype(np.int64)
            begin, end = recordings.offset[found[place]], recordings.offset[found[place] + 1] - 1
            drawn_m[row] = recordings.position_m[np.minimum(begin[:, None] + now + steps, end[:, None])] - datum_m
        return scatter_hypotheses(torch.from_numpy(drawn_m), windows)

    def _alike(self, now: int, at: np.ndarray, position_m: np.ndarray) -> np.ndarray:
        """Episodes that last beyond step `now` and were at position_m [N, 2] at the steps `at` [N], sorted by their ways."""
        begin, place_m = self.recordings.offset[:-1], self.recordings.position_m
        found = np.flatnonzero(self.recordings.length > now)
        for step, seen_m in zip(at[::-1], position_m[::-1], strict=True):
            distance = np.linalg.norm(place_m[begin[found] + step] - seen_m, axis=1)
            found = found[distance <= max(SAME_M, float(distance.min(initial=0.0)))]
        here = place_m[begin[found] + now]
        there = place_m[self.recordings.offset[found + 1] - 1]
        order: np.ndarray = found[np.lexsort((*there.T, *here.T))]
        return order


@dataclass(frozen=True)
class Setup:
    """What the command line says."""

    work: Path
    num_episodes: int
    num_training: int
    config: ForecastConfig
    progress: Progress


def rows_of(name: Literal["low", "high"], setup: Setup) -> tuple[dict[str, EpisodeScores], float]:
    """Scores of every row of a set, and what distances are divided by."""
    of = functools.partial(RecordingsConfig, world="narco", set=name)
    cache = setup.work / "recordings"
    episodes = load_recordings(of(seed=EVALUATION_SEED, num_episodes=setup.num_episodes), cache, setup.progress)
    windows = forecast_windows(episodes.recordings, setup.config)
    run = ForecastRun(episodes, windows, setup.config.num_hypotheses, setup.work / "scores", setup.progress)
    samplings = Samplings(paper=setup.config.paper, place=setup.config.place)

    def training(num: int) -> Recordings:
        return load_recordings(of(seed=TRAINING_SEED, num_episodes=num), cache, setup.progress).recordings

    def same_so_far() -> Estimator:
        return SameSoFar(training(setup.num_training))

    found = {
        f"same so far, of {setup.num_training:,} episodes": run.score(
            f"same-narco-{name}", same_so_far, ["same so far", setup.num_training, TRAINING_SEED, SAME_M]
        ),
        f"library of {NUM_LIBRARY} episodes": run.score(
            f"library-narco-{name}",
            lambda: FORECAST_RIVALS["library"](training(NUM_LIBRARY)),
            ["library", NUM_LIBRARY, TRAINING_SEED],
        ),
    }
    paths = {NAMES[kind]: Path(__file__).parent / "checkpoints" / f"{kind}-narco.safetensors" for kind in MIXTURES}
    for title, path in {"CADENCE": find_checkpoint("narco"), **paths}.items():
        build = functools.partial(load_forecaster, str(path), samplings)
        found[title] = run.score(f"{title}-narco-{name}", build, [title, checkpoint_hash(path), samplings])
    assert episodes.scale_m is not None  # the simulator says it
    return found, episodes.scale_m


def tables(found: Mapping[str, tuple[dict[str, EpisodeScores], float]], seed: int) -> dict[str, list[publishing.Row]]:
    """How far every row is behind the best possible, and all measures."""
    leads, errors = [], []
    for name, (rows, scale_m) in found.items():
        best = next(iter(rows.values()))
        for title, scores in rows.items():
            if scores is not best:
                lead, late = (
                    relative_lead([best], [[scores]], "energy_score", "energy_score", horizons, seed, NUM_RESAMPLES)
                    for horizons in (HORIZONS, LATE)
                )
                row = publishing.columns("lead_percent", lead, 100) | publishing.columns("lead_from_60_min_percent", late, 100)
                leads.append({"set": f"narco {name}", "against": title, **row})
            for measure in SHOWN:
                errors += [
                    {"set": f"narco {name}", "method": title, "measure": measure, **row}
                    for row in measure_rows(scores, measure, scale_m, seed)
                ]
    return {"narco_ceiling_leads": leads, "narco_ceiling_errors": errors}


SHOWN = ("library of 300 episodes", "CADENCE", "GrAMMI")
"""Rows of the page."""


def section(measured: Measurement) -> str:
    """How far the best possible forecast is ahead."""
    sets = list(dict.fromkeys(row["set"] for row in measured.rows("leads")))
    lines = []
    for against in SHOWN:
        rows = [measured.rows("leads", set=name, against=against)[0] for name in sets]
        lines.append([against, *(publishing.interval(row, "lead_percent", ".1f") for row in rows)])
    heads = ["“same so far” ahead of", *(f"{name}, %" for name in sets)]
    return publishing.table(heads, lines)


def main() -> int:
    """Score what is not kept, and publish."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("runs/narco_ceiling"))
    parser.add_argument("--windows", type=int, default=1000)
    parser.add_argument("--episodes", type=int, default=200, help="to evaluate on")
    parser.add_argument("--training-episodes", type=int, default=15_000)
    parser.add_argument("--publish", type=Path, metavar="DOCS", help="write numbers and section below this folder")
    args = parser.parse_args()
    torch.set_num_threads(1)
    config = ForecastConfig(args.windows, place=PlaceSampling(precision="bfloat16"))
    setup = Setup(args.work, args.episodes, args.training_episodes, config, Progress())
    found = {name: rows_of(name, setup) for name in SETS}
    facts = publishing.facts_of("narco_ceiling") | {
        "num_windows": args.windows, "num_episodes": args.episodes, "episodes_seed": EVALUATION_SEED,
    }  # fmt: skip
    publishing.publish(Measurement("narco_ceiling", facts, tables(found, config.seed)), section, args.publish)
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except CadenceError as error:
        sys.exit(f"{error}")
