"""How much does the training seed decide? Table I's learned methods on the sets low of both worlds, three seeds each.

Every method is trained on the episodes of one set alone and sees as many windows as every other. The settings are those of the
shipped trainings (cadence/checkpoints, benchmarks/configs), but for sources, seeds and the number of steps: that of the shipped
ones would take some 14 hours of a core. Trainings and scores are kept under --work: a killed run goes on, and what is published
is whatever is there.

    python -m benchmarks.training_seeds --publish docs
    python -m benchmarks.training_seeds --worlds narco --seeds 0,1
"""

import argparse
import dataclasses
import functools
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from benchmarks import publishing
from benchmarks.leads import averaged, count, relative_lead, verdicts
from benchmarks.publishing import Measurement
from benchmarks.table1 import EVALUATION_SEED
from benchmarks.table1_page import LATE, NAMES, measure_rows, worst
from cadence.errors import CadenceError
from cadence.recordings import Recordings
from cadence.training.loop import untrained
from pipeline.checkpoints import checkpoint_hash, read_info, windows_seen
from pipeline.config import stage_config
from pipeline.episodes.pool import EpisodePool, EpisodeSource
from pipeline.episodes.recordings import RecordingsConfig, load_recordings
from pipeline.estimators.presets import load_forecaster
from pipeline.estimators.samplings import Samplings
from pipeline.forecast.scores import HORIZONS, EpisodeScores
from pipeline.forecast.stage import ForecastConfig, ForecastRun, forecast_windows
from pipeline.progress import Progress
from pipeline.train.config import TrainConfig
from pipeline.train.place import train_place_network
from pipeline.train.rivals import train_rival

World = Literal["prison", "narco"]
WORLDS: tuple[World, ...] = ("prison", "narco")
GRAMMIS = ("grammi_without_mi", "grammi")
METHODS = ("cadence", "vrnn", *GRAMMIS)
TRAINING_SEED: Mapping[str, int] = {"prison": 0, "narco": 1}
"""Of the episodes."""
NUM_EPISODES, NUM_VALIDATION, NUM_EVALUATION = 15_000, 300, 200
NUM_RESAMPLES, BOOTSTRAP_SEED = 2_000, 0
RATES = {"vrnn": 5e-3, "grammi_without_mi": 4e-3}
"""Learning rates of the first trainings, which the configurations of the last ones name in words."""
HERE = Path(__file__).parent
DUELS = {
    "energy score": ("energy_score", "energy_score"),
    "30 samples": ("displacement_error", "displacement_error"),
    "the paper's measure": ("displacement_error", "paper_error"),
}
"""What is compared: a measure of CADENCE, and one of the rivals."""
SHOWN = ("displacement_error", "paper_error", "ade", "min_ade", "mean_error", "energy_score", "coverage_90")

Scores = dict[str, dict[int, EpisodeScores]]
"""By method and training seed."""


@dataclass(frozen=True)
class Setup:
    """What the command line says."""

    work: Path
    steps: int
    batch_size: int
    seeds: tuple[int, ...]
    config: ForecastConfig
    progress: Progress

    @property
    def cache(self) -> Path:
        """Of episodes."""
        return self.work / "episodes"

    def training(self, method: str, world: World, seed: int) -> Path:
        """A training's folder."""
        return self.work / "trainings" / f"{self.steps}x{self.batch_size}" / f"{method}-{world}-low-s{seed}"


def train_config(method: str, world: World, seed: int, setup: Setup) -> TrainConfig:
    """A shipped training's configuration with this budget and seed, and begun anew."""
    if method == "cadence":
        file = HERE.parent / "cadence" / "checkpoints" / ("prison_first.toml" if world == "prison" else "narco_diffusion.toml")
        share, batch_size = 1, setup.batch_size
    else:
        file, share, batch_size = HERE / "configs" / f"{method}_{world}.toml", 2, 2 * setup.batch_size
    config = stage_config(TrainConfig, "train", file)
    steps = setup.steps // share
    rate = RATES.get(method, config.optimiser.learning_rate)
    optimiser = dataclasses.replace(
        config.optimiser, num_steps=steps, learning_rate=rate, warm_up_steps=min(config.optimiser.warm_up_steps, steps // 5)
    )
    start = setup.training("grammi_without_mi", world, seed) / "checkpoint.safetensors" if method == "grammi" else None
    sources = (training_source(world),)
    rival = dataclasses.replace(config.rival, start=start, sources=sources, tuning_steps=max(1, steps // 6))
    place = dataclasses.replace(config.place, sources=tuple(EpisodeSource(1.0, source) for source in sources))
    every = max(1, steps // 5)
    return dataclasses.replace(
        config, seed=seed, batch_size=batch_size, optimiser=optimiser, rival=rival, place=place, validate_every=every,
        save_every=min(100, every),
    )  # fmt: skip


def training_source(world: World) -> RecordingsConfig:
    """Where the episodes to train on come from."""
    return RecordingsConfig(world=world, set="low", seed=TRAINING_SEED[world], num_episodes=NUM_EPISODES)


def training_episodes(world: World, setup: Setup) -> tuple[Recordings, Recordings]:
    """Those to learn from, and those to validate on."""
    recordings = load_recordings(training_source(world), setup.cache, setup.progress).recordings.apart()
    cut = len(recordings) - NUM_VALIDATION
    return recordings.select(slice(0, cut)), recordings.select(slice(cut, None))


def train(method: str, world: World, seed: int, setup: Setup, episodes: tuple[Recordings, Recordings]) -> None:
    """One training, from where it was."""
    out, config = setup.training(method, world, seed), train_config(method, world, seed, setup)
    if method != "cadence":
        train_rival(out, config, *episodes, setup.progress)
        return
    network = untrained(config.place.model.build, seed)
    pools = [EpisodePool((part,), (1.0,)) for part in episodes]
    train_place_network(out, config, network, *pools, setup.progress)


def evaluation_run(world: World, setup: Setup) -> ForecastRun:
    """The windows that all trainings are scored on; the hideout is not told."""
    of = RecordingsConfig(world=world, set="low", seed=EVALUATION_SEED, num_episodes=NUM_EVALUATION)
    episodes = load_recordings(of, setup.cache, setup.progress)
    windows = forecast_windows(episodes.recordings, setup.config)
    return ForecastRun(episodes, windows, setup.config.num_hypotheses, setup.work / "scores", setup.progress)


def scores_of(world: World, run: ForecastRun, setup: Setup) -> Scores:
    """Of every training that is done."""
    found: Scores = {}
    samplings = Samplings(paper=setup.config.paper, place=setup.config.place)
    for method in METHODS:
        for seed in setup.seeds:
            path = setup.training(method, world, seed) / "checkpoint.safetensors"
            if path.is_file():
                build = functools.partial(load_forecaster, str(path), samplings)
                score = run.score(f"{method}-{world}-s{seed}", build, [checkpoint_hash(path), samplings])
                found.setdefault(method, {})[seed] = score
    return found


def leads(own: EpisodeScores, rivals: Sequence[EpisodeScores], duel: str) -> publishing.Row:
    """The mean lead over the better rival, that from 60 min on, and the cells won, tied and lost."""
    row: publishing.Row = {}
    for column, horizons in (("lead_percent", HORIZONS), ("lead_from_60_min_percent", LATE)):
        found = relative_lead([own], [[rival] for rival in rivals], *DUELS[duel], horizons, BOOTSTRAP_SEED, NUM_RESAMPLES)
        row |= publishing.columns(column, found, 100)
    words = [verdicts({"": own}, {"": rival}, *DUELS[duel], BOOTSTRAP_SEED)[""] for rival in rivals]
    total = count({"": [worst(both) for both in zip(*words, strict=True)]})
    return row | {"won": total.won, "tied": total.tied, "lost": total.lost}


def lead_rows(key: str, scores: Scores) -> Iterator[publishing.Row]:
    """CADENCE against the better GrAMMI, seed by seed and for the mean over the seeds."""
    if any(name not in scores for name in ("cadence", *GRAMMIS)):
        return
    seeds = sorted(set(scores["cadence"]) & set(scores[GRAMMIS[0]]) & set(scores[GRAMMIS[1]]))
    means = {name: averaged([scores[name][seed] for seed in seeds]) for name in ("cadence", *GRAMMIS)}
    for duel in DUELS:
        for seed in seeds:
            rivals = [scores[name][seed] for name in GRAMMIS]
            yield {"set": key, "measure": duel, "seed": seed, **leads(scores["cadence"][seed], rivals, duel)}
        yield {
            "set": key, "measure": duel, "seed": "mean", **leads(means["cadence"], [means[name] for name in GRAMMIS], duel)
        }  # fmt: skip


def pair_row(key: str, scores: Scores) -> publishing.Row:
    """The least and the greatest mean lead in energy score over all pairs of a seed of CADENCE with one of the GrAMMIs."""
    seeds = sorted(set(scores[GRAMMIS[0]]) & set(scores[GRAMMIS[1]]))
    energy = DUELS["energy score"]
    pairs = [
        100 * relative_lead([own], [[scores[name][seed]] for name in GRAMMIS], *energy, HORIZONS, BOOTSTRAP_SEED, 1).value
        for own in scores["cadence"].values()
        for seed in seeds
    ]
    return {
        "set": key, "num_pairs": len(pairs), "lead_percent_least": min(pairs), "lead_percent_greatest": max(pairs)
    }  # fmt: skip


def error_rows(key: str, scores: Scores, scale_m: float) -> Iterator[publishing.Row]:
    """Every measure: the mean over the seeds with its interval over the episodes, and the deviation between seeds."""
    for method, found in scores.items():
        for measure in SHOWN:
            if not all(np.isfinite(score.measure(measure)).all() for score in found.values()):
                continue
            unit = 1.0 if measure.startswith("coverage") else scale_m
            values = np.array([score.mean(measure) for score in found.values()]) / unit
            deviations = values.std(axis=0, ddof=1) if len(values) > 1 else np.full(values.shape[1], np.nan)
            rows = measure_rows(averaged(list(found.values())), measure, scale_m, BOOTSTRAP_SEED)
            for row, deviation in zip(rows, deviations, strict=True):
                yield {
                    "set": key, "method": NAMES[method], "num_seeds": len(found), "measure": measure, **row,
                    "deviation_of_seeds": deviation,
                }  # fmt: skip


def budget_rows(key: str, world: World, scores: Scores, setup: Setup) -> Iterator[publishing.Row]:
    """What the trainings cost."""
    for method, found in scores.items():
        for seed in found:
            training = read_info(setup.training(method, world, seed) / "checkpoint.safetensors").training
            seconds = training.get("cpu_seconds")
            yield {
                "set": key, "method": NAMES[method], "seed": seed, "steps": training.get("steps"),
                "num_windows": windows_seen(training), "cpu_hours": None if seconds is None else seconds / 3600.0,
            }  # fmt: skip


def tables(found: Mapping[World, tuple[Scores, float]], setup: Setup) -> dict[str, list[publishing.Row]]:
    """All numbers."""
    rows: dict[str, list[publishing.Row]] = {kind: [] for kind in ("leads", "pairs", "errors", "budgets")}
    for world, (scores, scale_m) in found.items():
        key = f"{world} low"
        rows["leads"] += (compared := list(lead_rows(key, scores)))
        rows["pairs"] += [pair_row(key, scores)] if compared else []
        rows["errors"] += error_rows(key, scores, scale_m)
        rows["budgets"] += budget_rows(key, world, scores, setup)
    return {f"training_seeds_{kind}": part for kind, part in rows.items() if part}


def section(measured: Measurement) -> str:
    """The mean lead over the seeds, and what pairs of them make of it."""
    words = []
    for pair in measured.rows("pairs"):
        (mean,) = measured.rows("leads", set=pair["set"], measure="energy score", seed="mean")
        lead, rest = publishing.interval(mean, "lead_percent", ".0f").split(" ", 1)
        pairs = f"{pair['lead_percent_least']:.1f} to {pair['lead_percent_greatest']:.1f}"
        words.append(f"{pair['set']} {lead} % {rest}, by pair of seeds {pairs}")
    return f"Lead over the better GrAMMI: {'; '.join(words)}."


def main() -> int:
    """Train and score what is not done, and publish what is there."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("runs/training_seeds"))
    parser.add_argument("--worlds", default=",".join(WORLDS))
    parser.add_argument("--seeds", default="0,1,2", help="of training")
    parser.add_argument("--steps", type=int, default=1500, help="of CADENCE; the rivals take half of them, of twice the batch")
    parser.add_argument("--batch", type=int, default=256)
    parser.add_argument("--windows", type=int, default=1000)
    parser.add_argument("--hypotheses", type=int, default=30)
    parser.add_argument("--publish", type=Path, metavar="DOCS", help="write numbers and section below this folder")
    parser.add_argument("--page", action="store_true", help="train nothing")
    args = parser.parse_args()
    worlds = [world for world in WORLDS if world in args.worlds.split(",")]
    seeds = tuple(int(text) for text in args.seeds.split(","))
    config = ForecastConfig(args.windows, args.hypotheses, known_goal=False)
    setup = Setup(args.work, args.steps, args.batch, seeds, config, Progress())
    torch.set_num_threads(1)
    if not args.page:
        for world in worlds:
            episodes = training_episodes(world, setup)
            for seed in seeds:
                for method in METHODS:
                    setup.progress.note(f"{method}, {world}, seed {seed}")
                    train(method, world, seed, setup, episodes)
    found: dict[World, tuple[Scores, float]] = {}
    for world in worlds:
        run = evaluation_run(world, setup)
        scale_m = run.episodes.scale_m
        assert scale_m is not None  # the simulator says it
        found[world] = scores_of(world, run, setup), scale_m
    facts = publishing.facts_of("training_seeds") | {
        "num_windows": args.windows, "num_hypotheses": args.hypotheses, "num_episodes": NUM_EVALUATION,
        "num_training_episodes": NUM_EPISODES - NUM_VALIDATION, "num_training_windows": args.steps * args.batch,
    }  # fmt: skip
    publishing.publish(Measurement("training_seeds", facts, tables(found, setup)), section, args.publish)
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except CadenceError as error:
        sys.exit(f"{error}")
