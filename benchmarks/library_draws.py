"""What would recorded tracks add to the network? Its forecasts beside those of the trajectory library, and both together.

The library needs no training, so that it shows what a network could still learn: for every set of validation episodes, the
energy score of the library with a growing number of simulated tracks, of the shipped network, and of forecasts of which a
share is drawn from the library. Kept under --work: a killed run goes on.

    python -m benchmarks.library_draws --reference ../shared/data/prison_reference --publish docs
"""

import argparse
import dataclasses
import functools
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import torch

from benchmarks import publishing
from benchmarks.leads import relative_lead
from benchmarks.publishing import Measurement
from cadence.diffusion.settings import PlaceSampling
from cadence.types import Detections, Estimator, HypothesisSet, WindowBatch
from pipeline.checkpoints import checkpoint_hash, find_checkpoint
from pipeline.episodes.recordings import RecordingsConfig, RecordingSet, load_recordings
from pipeline.estimators.place import load_place_model
from pipeline.forecast.rivals import FORECAST_RIVALS
from pipeline.forecast.scores import HORIZONS, EpisodeScores
from pipeline.forecast.stage import ForecastConfig, ForecastRun, forecast_windows
from pipeline.forecast.tables import mean_interval
from pipeline.progress import Progress

FIRST_TRACK = 500
"""Narco's checkpoint was chosen on the episodes before it, which are evaluated on here."""
MEASURES = {"mean_error": "mean_error", "ade": "ade", "min_ade": "min_ade_at"}
NUM_RESAMPLES = 1000


@dataclass(frozen=True)
class Case:
    """A set of validation episodes, the checkpoint that forecasts it and the world and set of the library's tracks."""

    name: str
    episodes: RecordingsConfig
    world: str
    set: str


def all_cases(reference: Path | None) -> list[Case]:
    """The recorded sets first, where --reference says where they are."""
    found = []
    for name in ("low", "med", "high"):
        if reference is not None:
            logs = RecordingsConfig(data=reference / name, pattern="**/*_02[5-9][0-9].mcap")
            found.append(Case(f"recorded {name}", logs, "prison", name))
        own = RecordingsConfig(set=name, num_episodes=100, seed=1)  # type: ignore[arg-type]
        found.append(Case(f"prison {name}", own, "prison", name))
    for name in ("low", "high"):
        own = RecordingsConfig(world="narco", set=name, num_episodes=100, seed=0)  # type: ignore[arg-type]
        found.append(Case(f"narco {name}", own, "narco", name))
    return sorted(found, key=lambda case: not case.name.startswith("recorded"))


@dataclass(frozen=True, eq=False)
class Together:
    """A share of every window's hypotheses is drawn from the library, the others by the network."""

    network: Any
    library: Any
    share: float
    name: str = "together"

    def fit(self, tracks: Detections) -> Self:
        """Both as they are: neither adapts."""
        return self

    def sample(self, windows: WindowBatch, num_hypotheses: int) -> HypothesisSet:
        """Hypotheses [B, K, A, T, 2], the network's first, all with the same weight."""
        num_library = round(self.share * num_hypotheses)
        drawn = self.network.sample(windows, num_hypotheses - num_library)
        more = self.library.sample(windows, num_library)
        positions = torch.cat([drawn.position_m, more.position_m.to(drawn.position_m)], dim=1)
        weight = torch.full(positions.shape[:2], 1.0 / num_hypotheses, dtype=drawn.weight.dtype)
        return dataclasses.replace(drawn, position_m=positions, weight=weight)


def score_case(case: Case, episodes: RecordingSet, options: argparse.Namespace, progress: Progress) -> dict[str, EpisodeScores]:
    """Scores of every row."""
    config = ForecastConfig(options.windows, options.hypotheses, rivals=(), known_goal=False)
    windows = forecast_windows(episodes.recordings, config)
    run = ForecastRun(episodes, windows, options.hypotheses, options.work / "scores", progress, tells_obstacles=False)
    weights, sampling = find_checkpoint(case.world), PlaceSampling(precision="bfloat16")
    trained = [checkpoint_hash(weights), sampling]

    @functools.cache
    def network() -> Estimator:
        return load_place_model(weights, sampling)

    @functools.cache
    def library(count: int) -> Estimator:
        tracks = RecordingsConfig(world=case.world, set=case.set, first_index=FIRST_TRACK, num_episodes=count)  # type: ignore[arg-type]
        return FORECAST_RIVALS["library"](load_recordings(tracks, options.work / "episodes", progress).recordings)

    def together(count: int, share: float) -> Estimator:
        return Together(network(), library(count), share)

    found = {"CADENCE": run.score(f"cadence-{case.name}", network, list(trained))}
    for count in options.tracks:
        known = ["library", count, FIRST_TRACK]
        title = f"{count:,} tracks".replace(",", " ")
        found[f"library of {title}"] = run.score(f"library-{case.name}", functools.partial(library, count), known)
        for share in options.shares:
            build = functools.partial(together, count, share)
            found[f"CADENCE, {share:.0%} of {title}"] = run.score(f"together-{case.name}", build, [*trained, *known, share])
    return found


def row(key: str, name: str, own: EpisodeScores, first: EpisodeScores, unit_m: float) -> publishing.Row:
    """Energy score, what it is worse than CADENCE's by in per cent, and the other measures; means over the horizons."""
    value = mean_interval(own.measure("energy_score").mean(axis=1) / unit_m, own, 0, NUM_RESAMPLES)
    lead = None
    if own is not first:
        lead = relative_lead([own], [[first]], "energy_score", "energy_score", HORIZONS, 0, NUM_RESAMPLES)
    return {
        "set": key, "forecast": name, **publishing.columns("energy_score", value),
        **publishing.columns("worse_than_cadence_percent", lead, -100),
        **{column: own.mean(measure).mean() / unit_m for column, measure in MEASURES.items()},
        "coverage_90_percent": 100 * own.mean("coverage_90").mean(),
    }  # fmt: skip


def section(measured: Measurement) -> str:
    """What the library with the most tracks is worth, by itself and as a share of the hypotheses."""
    words = []
    for kind in (measured.rows()[index]["forecast"] for index in (-2, -1)):
        rows = sorted(measured.rows(forecast=kind), key=lambda row: row["worse_than_cadence_percent"])
        least, greatest = (publishing.interval(row, "worse_than_cadence_percent", "z.0f") for row in (rows[0], rows[-1]))
        worse, better = (
            sum(sign * row[f"worse_than_cadence_percent_{bound}"] > 0 for row in rows)
            for sign, bound in ((1, "low"), (-1, "high"))
        )
        words.append(
            f"{kind}: worse by {least} % ({rows[0]['set']}) to {greatest} % ({rows[-1]['set']}), "
            f"with certainty in {worse} of {len(rows)} sets, better in {better}."
        )
    return "\n".join(f"* {line[0].upper()}{line[1:]}" for line in words)


def main(arguments: Sequence[str] | None = None) -> int:
    """Score, print and publish."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--reference", type=Path, help="folder of recorded logs: low, med, high")
    parser.add_argument("--work", type=Path, default=Path("runs/library_draws"))
    parser.add_argument("--windows", type=int, default=400)
    parser.add_argument("--hypotheses", type=int, default=30)
    parser.add_argument("--tracks", type=int, nargs="+", default=[300, 3500])
    parser.add_argument("--shares", type=float, nargs="+", default=[0.5])
    parser.add_argument("--publish", type=Path, metavar="DOCS", help="write numbers and section below this folder")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    progress, scores = Progress(), {}
    for case in all_cases(options.reference):
        progress.note(case.name)
        episodes = load_recordings(case.episodes, options.work / "episodes", progress)
        assert episodes.scale_m is not None
        scores[case.name] = (score_case(case, episodes, options, progress), episodes.scale_m)
    rows = [
        row(key, title, own, found["CADENCE"], unit_m)
        for key, (found, unit_m) in scores.items()
        for title, own in found.items()
    ]
    facts = publishing.facts_of("library_draws", arguments)
    facts |= {"num_windows": options.windows, "num_hypotheses": options.hypotheses}
    publishing.publish(Measurement("library_draws", facts, {"library_draws": rows}), section, options.publish)
    return 0


if __name__ == "__main__":
    sys.exit(main())
