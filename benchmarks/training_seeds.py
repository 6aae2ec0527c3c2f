"""How much does the training seed decide? Table I's learned methods on the sets low of both worlds, three seeds each.

Every method is trained on the episodes of one set alone and sees as many windows as every other. The settings are those of the
shipped trainings (cadence/checkpoints, benchmarks/configs), but for sources, seeds and the number of steps: that of the shipped
ones would take some 14 hours of a core. Trainings and scores are kept under --work: a killed run goes on, and the page is
written from whatever is there.

    python benchmarks/training_seeds.py --publish docs/benchmarks
    python benchmarks/training_seeds.py --worlds narco --seeds 0,1
"""

import argparse
import dataclasses
import functools
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from table1 import EVALUATION_SEED
from table1_page import LATE, MINUTES, NAMES, measure_cells, worst

from cadence.errors import CadenceError
from cadence.recordings import Recordings
from cadence.training.place import untrained_network
from pipeline.checkpoints import checkpoint_hash, read_info, windows_seen
from pipeline.config import stage_config
from pipeline.episodes.pool import EpisodePool, EpisodeSource
from pipeline.episodes.recordings import RecordingsConfig, load_recordings
from pipeline.estimators.presets import load_forecaster
from pipeline.estimators.samplings import Samplings
from pipeline.files import write_atomic
from pipeline.forecast.leads import averaged, count, relative_lead, verdicts
from pipeline.forecast.scores import HORIZONS, EpisodeScores
from pipeline.forecast.stage import ForecastConfig, ForecastRun, forecast_windows
from pipeline.forecast.tables import TITLES, line, number, with_interval
from pipeline.progress import Progress
from pipeline.train.config import TrainConfig
from pipeline.train.rivals import train_rival
from pipeline.train.scene import train_scene_network

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
    scene = dataclasses.replace(config.scene, sources=tuple(EpisodeSource(1.0, source) for source in sources))
    every = max(1, steps // 5)
    return dataclasses.replace(
        config, seed=seed, batch_size=batch_size, optimiser=optimiser, rival=rival, scene=scene, validate_every=every,
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
    network = untrained_network(config.scene.model, seed)
    pools = [EpisodePool((part,), (1.0,)) for part in episodes]
    train_scene_network(out, config, network, *pools, setup.progress)


def evaluation_run(world: World, setup: Setup) -> ForecastRun:
    """The windows that all trainings are scored on; the hideout is not told."""
    of = RecordingsConfig(world=world, set="low", seed=EVALUATION_SEED, num_episodes=NUM_EVALUATION)
    episodes = load_recordings(of, setup.cache, setup.progress)
    windows = forecast_windows(episodes.recordings, setup.config)
    return ForecastRun(episodes, windows, setup.config.num_hypotheses, setup.work / "scores", setup.progress)


def scores_of(world: World, run: ForecastRun, setup: Setup) -> Scores:
    """Of every training that is done."""
    found: Scores = {}
    samplings = Samplings(paper=setup.config.paper, scene=setup.config.scene)
    for method in METHODS:
        for seed in setup.seeds:
            path = setup.training(method, world, seed) / "checkpoint.safetensors"
            if path.is_file():
                build = functools.partial(load_forecaster, str(path), samplings)
                score = run.score(f"{method}-{world}-s{seed}", build, [checkpoint_hash(path), samplings])
                found.setdefault(method, {})[seed] = score
    return found


def leads(own: EpisodeScores, rivals: Sequence[EpisodeScores], duel: str) -> list[str]:
    """Cells of a row: the mean lead over the better rival, that from 60 min on, and the cells won, tied and lost."""
    cells = []
    for horizons in (HORIZONS, LATE):
        found = relative_lead([own], [[rival] for rival in rivals], *DUELS[duel], horizons, BOOTSTRAP_SEED, NUM_RESAMPLES)
        cells.append(with_interval(100 * found.value, 100 * found.low, 100 * found.high))
    words = [verdicts({"": own}, {"": rival}, *DUELS[duel], BOOTSTRAP_SEED)[""] for rival in rivals]
    total = count({"": [worst(both) for both in zip(*words, strict=True)]})
    return [*cells, f"{total.won} / {total.tied} / {total.lost}"]


def lead_table(scores: Scores) -> Iterator[str]:
    """CADENCE against the better GrAMMI, seed by seed and for the mean over the seeds."""
    if any(name not in scores for name in ("cadence", *GRAMMIS)):
        return
    seeds = sorted(set(scores["cadence"]) & set(scores[GRAMMIS[0]]) & set(scores[GRAMMIS[1]]))
    yield line(["measure", "seeds", "mean lead %", "from 60 min on %", "cells won / tied / lost"])
    yield line(["---"] * 5)
    for duel in DUELS:
        for seed in seeds:
            rivals = [scores[name][seed] for name in GRAMMIS]
            yield line([duel, str(seed), *leads(scores["cadence"][seed], rivals, duel)])
        means = {name: averaged([scores[name][seed] for seed in seeds]) for name in ("cadence", *GRAMMIS)}
        yield line([duel, f"mean of {len(seeds)}", *leads(means["cadence"], [means[name] for name in GRAMMIS], duel)])
    yield ""
    pairs_of_rivals = [[[scores[name][seed]] for name in GRAMMIS] for seed in seeds]
    energy = DUELS["energy score"]
    pairs = [
        relative_lead([own], rival, *energy, HORIZONS, BOOTSTRAP_SEED, 1).value
        for own in scores["cadence"].values()
        for rival in pairs_of_rivals
    ]
    yield (
        f"Over all {len(pairs)} pairs of a seed of CADENCE with one of the GrAMMIs the mean lead in energy score lies between "
        f"{100 * min(pairs):.1f} and {100 * max(pairs):.1f} %."
    )
    yield ""


def spread_tables(scores: Scores, scale_m: float) -> Iterator[str]:
    """Every measure: the mean over the seeds with its interval over the episodes, and the deviation between seeds."""
    for measure in SHOWN:
        unit = 1.0 if measure.startswith("coverage") else scale_m
        yield from (f"### {TITLES[measure]}", "", line(["", *MINUTES]), line(["---"] * 6))
        for method, found in scores.items():
            if not all(np.isfinite(score.measure(measure)).all() for score in found.values()):
                continue
            values = np.array([score.mean(measure) for score in found.values()]) / unit
            spread = values.std(axis=0, ddof=1) if len(values) > 1 else [None] * values.shape[1]
            means = measure_cells(averaged(list(found.values())), measure, scale_m, BOOTSTRAP_SEED)
            both = [f"{mean} ± {number(sd, 2)}" for mean, sd in zip(means, spread, strict=True)]
            yield line([f"{NAMES[method]} ({len(found)})", *both])
        yield ""


def budget_table(world: World, scores: Scores, setup: Setup) -> Iterator[str]:
    """What the trainings cost."""
    yield line(["method", "seed", "steps", "windows", "CPU hours"])
    yield line(["---"] * 5)
    for method, found in scores.items():
        for seed in found:
            info = read_info(setup.training(method, world, seed) / "checkpoint.safetensors")
            seconds = info.training.get("cpu_seconds")
            numbers = [f"{value:,}" if value else "–" for value in (info.training.get("steps"), windows_seen(info.training))]
            hours = number(None if seconds is None else seconds / 3600.0, 2)
            yield line([NAMES[method], str(seed), *numbers, hours])
    yield ""


def page(found: Mapping[World, tuple[Scores, float]], setup: Setup, command: str) -> str:
    """training_seeds.md."""
    lines = [
        "# How much the training seed decides", "",
        f"`{command}`", "",
        "The learned methods of [table I](table1.md) on the sets low of both worlds, trained anew with seeds of their own for",
        f"weights, windows and noise, on the same {NUM_EPISODES - NUM_VALIDATION:,} episodes of that set alone, with",
        f"{setup.steps * setup.batch_size:,} windows each (GrAMMI a sixth more: it goes on from the one without). The shipped",
        "networks saw four to thirteen times as many, of all sets of their world; what this page is for is the spread. As many",
        "for every seed would take some 14 hours of a core more. The rest is as in table I:",
        f"{setup.config.num_windows} random moments of {NUM_EVALUATION} episodes with a seed of their own,",
        f"{setup.config.num_hypotheses} hypotheses, distances over the map's longer side, nobody told the hideout.", "",
        "Square brackets: 95 % interval, bootstrap over episodes. ±: standard deviation between the training seeds.", "",
    ]  # fmt: skip
    for world, (scores, _) in found.items():
        lines += [f"## {world} low: CADENCE against the better GrAMMI", "", *lead_table(scores)]
    for world, (scores, scale_m) in found.items():
        lines += [f"## {world} low: means over the seeds", "", *spread_tables(scores, scale_m)]
        lines += [f"### What the trainings cost: {world} low", "", *budget_table(world, scores, setup)]
    return "\n".join(lines).rstrip() + "\n"


def main() -> int:
    """Train and score what is not done, then write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("runs/training_seeds"))
    parser.add_argument("--worlds", default=",".join(WORLDS))
    parser.add_argument("--seeds", default="0,1,2", help="of training")
    parser.add_argument("--steps", type=int, default=1500, help="of CADENCE; the rivals take half of them, of twice the batch")
    parser.add_argument("--batch", type=int, default=256)
    parser.add_argument("--windows", type=int, default=1000)
    parser.add_argument("--hypotheses", type=int, default=30)
    parser.add_argument("--publish", type=Path, help="folder for training_seeds.md; without it the page is printed")
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
    shown = [word for word in sys.argv[1:] if word != "--page"]
    text = page(found, setup, shlex.join(["python", "benchmarks/training_seeds.py", *shown]))
    if args.publish is None:
        print(text)
    else:
        write_atomic(args.publish / "training_seeds.md", text)
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except CadenceError as error:
        sys.exit(f"{error}")
