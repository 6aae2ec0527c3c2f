"""What does each input and output of the place preset bring, and how many training episodes does it need?

Variants of the preset are trained on the rebuilt Prison Escape (all three sets) at one small budget and evaluated on the same
windows: of simulated episodes with a seed of their own, and of episodes of the original simulator, which none has seen.
Everything is kept under --work: a killed run goes on where it was, and what is published is whatever is there.

    python -m benchmarks.place_ablations --reference ../shared/data/prison_reference --publish docs
    python -m benchmarks.place_ablations --only full,no_map --steps 1500 --seeds 0,1
    python -m benchmarks.place_ablations --page --publish docs
"""

import argparse
import dataclasses
import functools
import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from benchmarks import publishing
from benchmarks.leads import averaged, relative_lead
from benchmarks.publishing import Measurement
from benchmarks.table1_page import MINUTES
from cadence.diffusion.place_frame import PlaceConfig
from cadence.diffusion.settings import PlaceSampling
from cadence.errors import InputError
from cadence.metrics import Interval
from cadence.network.place import PlaceNetwork
from cadence.recordings import Recordings
from cadence.training.loop import OptimiserConfig, untrained
from cadence.worlds.prison_map import SIDE, prison_map
from pipeline.checkpoints import checkpoint_hash, read_info
from pipeline.episodes.pool import EpisodePool, EpisodeSource
from pipeline.episodes.recordings import RecordingsConfig, load_recordings, read_recordings
from pipeline.estimators.place import load_place_model
from pipeline.files import write_atomic
from pipeline.forecast.scores import HORIZONS, EpisodeScores
from pipeline.forecast.stage import ForecastConfig, ForecastRun, forecast_windows
from pipeline.forecast.tables import comparison, mean_interval
from pipeline.progress import Progress
from pipeline.train.config import PlaceTraining, TrainConfig
from pipeline.train.place import train_place_network

SETS = ("low", "med", "high")
KINDS = ("simulated", "original")
VALIDATION_SEED, NUM_VALIDATION = 1, 100
MEASURES = ("energy_score", "mean_error", "ade", "coverage_90")
SIDE_M = 2428 * 21.0
MAP_CELLS = 128
"""Of the true coverage map; a cell is about as large as the blocks on which fugitives plan their routes."""
NUM_RESAMPLES = 1000
SAMPLING = PlaceSampling(is_antithetic=False)
"""Of all variants: as it was when the first were scored, so that those which are kept compare with new ones."""


@dataclass(frozen=True)
class Variant:
    """One training: what is different in it, in words and in settings."""

    title: str
    model: PlaceConfig = dataclasses.field(default_factory=PlaceConfig)
    num_episodes: int = 4000
    path_weight: float = 1.0
    true_map: bool = False


def _with(title: str, **network: object) -> Variant:
    model = PlaceConfig()
    return Variant(title, dataclasses.replace(model, network=dataclasses.replace(model.network, **network)))  # type: ignore[arg-type]


_TRUE_MAP = _with("the true coverage map in place of the learned one", map_channels=1, map_cells=MAP_CELLS)

VARIANTS: dict[str, Variant] = {
    "full": Variant("full"),
    "no_map": _with("without the learned map", map_channels=0),
    "true_map": dataclasses.replace(_TRUE_MAP, true_map=True),
    "no_trackers": _with("without trackers", trackers=False),
    "no_goal": _with("without the known hideout", known_goal=False),
    "no_path_weight": Variant("loss of the pieces alone, not of the path", path_weight=0.0),
    "relative": _with("detections as offsets, places by the learned map alone", places="relative"),
    "relative_no_map": _with("nothing absolute (offsets, and no map)", places="relative", map_channels=0),
    "absolute": _with("detections as places on the map alone", places="absolute"),
}
CURVE = {"episodes_250": 250, "episodes_1000": 1000, "full": 4000, "episodes_16000": 16000}
ALL = VARIANTS | {
    name: Variant(f"{num} training episodes a set", num_episodes=num) for name, num in CURVE.items() if name != "full"
}

Scores = dict[str, EpisodeScores]
"""By the name of the set: "simulated low" and so on."""


@dataclass(frozen=True)
class Setup:
    """What the command line says."""

    work: Path
    data: Path | None
    reference: Path | None
    steps: int
    batch_size: int
    num_windows: int
    num_validation: int
    progress: Progress

    @property
    def cache(self) -> Path:
        """Of episodes."""
        return self.work / "episodes"

    def result(self, name: str, seed: int) -> Path:
        """Where the scores of a training are kept."""
        return self.work / "results" / f"{name}-{self.steps}x{self.batch_size}-s{seed}.json"


def training_episodes(name: str, num: int, setup: Setup) -> Recordings:
    """The first episodes of a set. `InputError` where the folder --data has fewer."""
    if setup.data is None:
        return load_recordings(RecordingsConfig(set=name, num_episodes=num), setup.cache, setup.progress).recordings  # type: ignore[arg-type]
    parts: list[Recordings] = []
    for path in sorted(setup.data.glob(f"prison_{name}_[0-9]*.npz")):
        if sum(len(part) for part in parts) < num:
            parts.append(read_recordings(path)[0])
    if sum(len(part) for part in parts) < num:
        raise InputError(f"{setup.data}: fewer than {num} episodes of the set {name}")
    return Recordings.concatenate(parts).select(slice(0, num))


def evaluation_runs(setup: Setup) -> dict[str, ForecastRun]:
    """Windows of every set; those of the original simulator where --reference says where it is."""
    sources = {
        f"simulated {name}": RecordingsConfig(set=name, num_episodes=setup.num_validation, seed=VALIDATION_SEED)  # type: ignore[arg-type]
        for name in SETS
    }
    if setup.reference is not None:
        for name in SETS:
            file = setup.reference / f"ref_{name}_val.npz"
            logs = RecordingsConfig(data=setup.reference / name, pattern="**/*_02[5-9][0-9].mcap")
            sources[f"original {name}"] = RecordingsConfig(data=file) if file.is_file() else logs
    config, runs = ForecastConfig(num_windows=setup.num_windows), {}
    for key, source in sources.items():
        episodes = load_recordings(source, setup.cache, setup.progress)
        windows = forecast_windows(episodes.recordings, config)
        scores = setup.work / "scores"
        runs[key] = ForecastRun(episodes, windows, config.num_hypotheses, scores, setup.progress, tells_obstacles=False)
    return runs


def train_config(variant: Variant, setup: Setup, seed: int) -> TrainConfig:
    """The training of a variant; everything that is not varied is the preset's default."""
    of = functools.partial(RecordingsConfig, data=setup.data, num_episodes=variant.num_episodes)
    sources = tuple(EpisodeSource(1.0, of(set=name)) for name in SETS)  # type: ignore[arg-type]
    place = PlaceTraining(variant.model, sources=sources, path_weight=variant.path_weight, num_validation_windows=200)
    warm_up = min(300, max(1, setup.steps // 5))
    optimiser = OptimiserConfig(learning_rate=1e-3, num_steps=setup.steps, warm_up_steps=warm_up, bf16=True)
    every = max(1, setup.steps // 3)
    return TrainConfig(
        "place", seed=seed, batch_size=setup.batch_size, validate_every=every, save_every=min(100, every), optimiser=optimiser,
        place=place,
    )  # fmt: skip


def build(variant: Variant, seed: int) -> PlaceNetwork:
    """The untrained network; the true map is fixed in it."""
    network = untrained(variant.model.build, seed)
    if variant.true_map:
        with torch.no_grad():
            network.map.copy_(coverage_cells())
        network.map.requires_grad_(False)
    return network


def coverage_cells() -> torch.Tensor:
    """The coverage as means over cells [1, 1, MAP_CELLS (y), MAP_CELLS (x)], about zero with a deviation of about one."""
    edges = np.round(np.linspace(0, SIDE, MAP_CELLS + 1)).astype(int)
    total = np.add.reduceat(np.add.reduceat(prison_map().coverage, edges[:-1], axis=0), edges[:-1], axis=1)
    mean = torch.from_numpy(total / np.outer(np.diff(edges), np.diff(edges))).T.float()
    return ((mean - mean.mean()) / mean.std())[None, None]


def run_variant(
    name: str, seed: int, setup: Setup, load: Callable[[int], EpisodePool], runs: Mapping[str, ForecastRun]
) -> None:
    """Train and evaluate, as far as that is not done."""
    path = setup.result(name, seed)
    if path.is_file():
        return
    variant, out = ALL[name], setup.work / "trainings" / path.stem
    simulated = [run.episodes.recordings for key, run in runs.items() if key.startswith("simulated")]
    held_out = EpisodePool(tuple(simulated), (1.0,) * len(simulated))
    config = train_config(variant, setup, seed)
    result = train_place_network(out, config, build(variant, seed), load(variant.num_episodes), held_out, setup.progress)
    weights = result.outputs[0]
    seconds = read_info(weights).training["cpu_seconds"]
    estimate = functools.partial(load_place_model, weights, SAMPLING)
    scores = {key: run.score(f"{name}-{key}", estimate, [checkpoint_hash(weights)]).as_json() for key, run in runs.items()}
    record = {"variant": name, "seed": seed, "steps": setup.steps, "cpu_seconds": seconds}
    write_atomic(path, json.dumps({**record, "validation_loss": result.summary["validation_loss"], "scores": scores}) + "\n")


def found_scores(setup: Setup, seeds: Sequence[int]) -> tuple[dict[str, Scores], dict[str, int]]:
    """Scores averaged over the trainings that are done, and the number of these, by variant."""
    results, counts = {}, {}
    for name in ALL:
        paths = [path for path in (setup.result(name, seed) for seed in seeds) if path.is_file()]
        records = [json.loads(path.read_text(encoding="utf-8"))["scores"] for path in paths]
        if records:
            keys = [key for key in records[0] if all(key in record for record in records)]
            results[name] = {key: averaged([EpisodeScores.from_json(record[key]) for record in records]) for key in keys}
            counts[name] = len(records)
    return results, counts


def lead_over_full(own: Scores, full: Scores, kind: str, measure: str) -> Interval | None:
    """How far ahead of the full variant, as a share of its score: mean over the sets of a kind and the horizons."""
    keys = [key for key in own if key.startswith(kind) and key in full]
    if not keys or own is full:
        return None
    rivals = [[full[key] for key in keys]]
    return relative_lead([own[key] for key in keys], rivals, measure, measure, HORIZONS, 0, NUM_RESAMPLES)


def cost_rows(results: Mapping[str, Scores]) -> Iterator[publishing.Row]:
    """What every variant costs against the full one, by kind of episodes, and the mean 90 % coverage."""
    for name, own in results.items():
        for kind in KINDS:
            values = [own[key].mean("coverage_90").mean() for key in own if key.startswith(kind)]
            if values:
                row: publishing.Row = {"variant": ALL[name].title, "episodes": kind}
                for measure in ("energy_score", "mean_error", "ade"):
                    found = lead_over_full(own, results["full"], kind, measure)
                    row |= publishing.columns(f"{measure}_cost_percent", found, -100)
                yield row | {"coverage_90_percent": 100 * float(np.mean(values))}


def curve_rows(results: Mapping[str, Scores]) -> Iterator[publishing.Row]:
    """By number of training episodes and set: the energy score's mean over the horizons, over the map side."""
    for name, num in CURVE.items():
        for key, scores in results.get(name, {}).items():
            found = mean_interval(scores.measure("energy_score").mean(axis=1) / SIDE_M, scores, 0, NUM_RESAMPLES)
            yield {"num_training_episodes": num, "set": key, **publishing.columns("energy_score", found)}


def error_rows(results: Mapping[str, Scores]) -> Iterator[publishing.Row]:
    """All measures at all horizons, over the map side, with the paired change against the full variant in per cent of it.

    Coverages are in per cent, and so is their change.
    """
    for name, scores in results.items():
        for key, own in scores.items():
            full = None if name == "full" else results["full"].get(key)
            for measure in MEASURES:
                for minutes, row in zip(MINUTES, _error_rows(own, full, measure), strict=True):
                    yield {"set": key, "variant": ALL[name].title, "measure": measure, "horizon_min": minutes, **row}


def _error_rows(own: EpisodeScores, full: EpisodeScores | None, measure: str) -> Iterator[publishing.Row]:
    is_share = measure.startswith("coverage")
    for step, value in zip(HORIZONS, own.mean(measure), strict=True):
        change = None
        if full is not None:
            found = comparison("own", "full", step, {"own": own, "full": full}, 0, NUM_RESAMPLES, measure)
            triple = (found.ratio - 1.0, found.ratio_low - 1.0, found.ratio_high - 1.0)
            if is_share:
                triple = (found.difference_m, found.difference_low_m, found.difference_high_m)
            change = Interval(*triple, 0, 0)
        yield {"value": 100 * value if is_share else value / SIDE_M, **publishing.columns("change_percent", change, 100)}


def section(measured: Measurement) -> str:
    """What leaving out a part, and more or fewer training episodes, cost in energy score, where that is certain of one kind."""
    heads = ["worse than the full network", *(f"{kind}, %" for kind in KINDS)]
    lines = []
    for variant in dict.fromkeys(row["variant"] for row in measured.rows()):
        rows = [row for kind in KINDS for row in measured.rows(variant=variant, episodes=kind)]
        if variant != "full" and any(_is_certain(row) for row in rows):
            lines.append([variant, *(publishing.interval(row, "energy_score_cost_percent", "z.0f") for row in rows)])
    return publishing.table(heads, lines)


def _is_certain(row: publishing.Row) -> bool:
    low, high = (row[f"energy_score_cost_percent_{bound}"] for bound in ("low", "high"))
    return low > 0 or high < 0


def publish(setup: Setup, seeds: Sequence[int], docs: Path | None) -> None:
    """Publish what is there."""
    results, counts = found_scores(setup, seeds)
    if "full" not in results:
        setup.progress.note("nothing to publish yet: the full variant is not done")
        return
    facts = publishing.facts_of("place_ablations") | {
        "num_trainings": min(counts.values()), "num_windows": setup.num_windows, "num_steps": setup.steps,
        "batch_size": setup.batch_size, "not_run": [variant.title for name, variant in ALL.items() if name not in results],
    }  # fmt: skip
    tables = {
        "place_ablations": list(cost_rows(results)),
        "place_ablations_curve": list(curve_rows(results)),
        "place_ablations_errors": list(error_rows(results)),
    }
    publishing.publish(Measurement("place_ablations", facts, tables), section, docs)


def main() -> int:
    """Run what is not done, variant by variant, and publish after each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("runs/ablations"))
    parser.add_argument("--data", type=Path, help="folder of prison_SET_NNN.npz to train on; without it they are simulated")
    parser.add_argument("--reference", type=Path, help="logs of the original simulator (low, med, high), or ref_SET_val.npz")
    parser.add_argument("--publish", type=Path, metavar="DOCS", help="write numbers and section below this folder")
    parser.add_argument("--only", default=",".join(ALL), help="variants, by name")
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--batch", type=int, default=256)
    parser.add_argument("--seeds", default="0", help="of training")
    parser.add_argument("--windows", type=int, default=500, help="of each set")
    parser.add_argument("--validation", type=int, default=NUM_VALIDATION, help="simulated episodes a set to evaluate on")
    parser.add_argument("--page", action="store_true", help="train nothing")
    args = parser.parse_args()
    unknown = [name for name in args.only.split(",") if name not in ALL]
    if unknown:
        parser.error(f"variant {unknown[0]!r} is not known; known: {', '.join(ALL)}")
    setup = Setup(args.work, args.data, args.reference, args.steps, args.batch, args.windows, args.validation, Progress())
    seeds = [int(text) for text in args.seeds.split(",")]
    torch.set_num_threads(1)

    @functools.lru_cache(maxsize=1)
    def load(num: int) -> EpisodePool:
        return EpisodePool(tuple(training_episodes(name, num, setup) for name in SETS), (1.0,) * len(SETS))

    runs = {} if args.page else evaluation_runs(setup)
    for seed in [] if args.page else seeds:
        for name in args.only.split(","):
            try:
                run_variant(name, seed, setup, load, runs)
            except InputError as error:
                setup.progress.warn(f"{name} left out: {error}")
            publish(setup, seeds, args.publish)
    if args.page:
        publish(setup, seeds, args.publish)
    return 0


if __name__ == "__main__":
    sys.exit(main())
