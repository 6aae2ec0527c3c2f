"""Which sampler draws forecasts fastest without making them worse, and how far is it from the paper's procedure?

Every variant draws the same number of hypotheses for the same windows of the prison world with one network. Scores are kept in
blocks of windows in the work folder: a killed run goes on where it was, and more windows can be added. Speeds are ratios of
processor times on one thread, all variants one after the other in every round, the order reversed in every other round.

    python -m benchmarks.place_samplers --publish docs
"""

import argparse
import dataclasses
import hashlib
import statistics
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from benchmarks import publishing
from benchmarks.publishing import Measurement
from cadence.arrays import Int64s
from cadence.constraints.obstacles import Obstacles
from cadence.diffusion.place import PlaceModel
from cadence.diffusion.settings import PlaceSampling
from cadence.errors import CadenceError
from cadence.metrics import Interval, bootstrap_ratio
from cadence.recordings import ForecastWindows, Recordings, choose_windows, cut_windows
from cadence.types import HypothesisSet
from cadence.worlds import prison_map
from pipeline.checkpoints import checkpoint_hash, find_checkpoint
from pipeline.episodes.recordings import RecordingsConfig, load_recordings
from pipeline.estimators.place import load_place_model
from pipeline.files import write_atomic
from pipeline.forecast.scores import HORIZONS, EpisodeScores, score_forecasts, step_quantiles
from pipeline.progress import Progress

DATA = Path(__file__).resolve().parents[1].parent / "shared" / "data" / "prison_reference"
SETS = ("low", "med", "high")
VALIDATION = "*_02[5-9]?.mcap"
"""Episodes 250 to 299 of each set."""
WORK = Path("out/benchmarks/place")
STEPS = (5, 8, 15, 25)
LEVELS = (0.05, 0.25, 0.5, 0.75, 0.95, 0.99)
SIDE_M = prison_map.SIDE * prison_map.CELL_M
CLAIM, TOLERANCE = 20.0, 1.02

PLAIN = PlaceSampling(guidance="none", is_repaired=False, is_antithetic=False)
PAPER = PlaceSampling(sampler="ddpm", num_steps=100, guidance="paper", is_repaired=False)


@dataclass(frozen=True)
class Variant:
    """A row: how it samples, for its scores and for its speed, and whether with the tuned weights."""

    name: str
    sampling: PlaceSampling
    timed: PlaceSampling | None = None
    is_tuned: bool = False


@dataclass(frozen=True, eq=False)
class Task:
    """Windows in blocks, by name, and what they are in."""

    blocks: dict[str, ForecastWindows]
    obstacles: Obstacles
    num_hypotheses: int
    work: Path

    @property
    def num_windows(self) -> int:
        """In all blocks."""
        return sum(len(block) for block in self.blocks.values())


DDPM = "DDPM, 100 steps"
THE_PAPERS = "the paper's procedure"
DEFAULT = "default: mirrored noise, led around the mountain"
INDEPENDENT = "default, but for independent noise"
TUNED = "few steps, tuned weights, otherwise as the default"
SHOWN = (DEFAULT, INDEPENDENT, TUNED, "DDIM, 5 steps")
"""Rows of the page."""
MEASURES = {
    "energy_score": ("energy_score", SIDE_M), "mean_error": ("mean_error", SIDE_M),
    "displacement_error": ("displacement_error", SIDE_M), "ade": ("ade", SIDE_M), "min_ade": ("min_ade_at", SIDE_M),
    "coverage_90": ("coverage_90", 1.0),
}  # fmt: skip
"""What is published of a measure, and what it is divided by."""


def variants(has_tuned: bool) -> list[Variant]:
    """The paper's procedure first, the default last."""
    rows = [Variant(THE_PAPERS, PAPER, dataclasses.replace(PAPER, encode_each_step=True))]
    rows.append(Variant(DDPM, dataclasses.replace(PLAIN, sampler="ddpm", num_steps=100)))
    rows += [Variant(f"DDIM, {n} steps", dataclasses.replace(PLAIN, sampler="ddim", num_steps=n)) for n in STEPS]
    rows += [Variant(f"DPM-Solver++, {n} steps", dataclasses.replace(PLAIN, sampler="dpmpp", num_steps=n)) for n in STEPS]
    rounded = dataclasses.replace(PLAIN, precision="bfloat16")
    rows.append(Variant("default in bfloat16", rounded))
    if has_tuned:
        rows.append(Variant("few steps, tuned weights", dataclasses.replace(PLAIN, sampler="few"), is_tuned=True))
        rows.append(Variant(TUNED, PlaceSampling(sampler="few"), is_tuned=True))
    rows.append(Variant(INDEPENDENT, PlaceSampling(is_antithetic=False)))
    rows.append(Variant(DEFAULT, PlaceSampling()))
    return rows


def mountain() -> Obstacles:
    """The prison world's only one: its keep-out circle, by which the paper counts collisions."""
    x, y = prison_map.MOUNTAIN
    circle = [x * prison_map.CELL_M, y * prison_map.CELL_M, prison_map.KEEP_OUT * prison_map.CELL_M]
    return Obstacles(torch.tensor([circle], dtype=torch.float64))


def load_sets(data: Sequence[Path], work: Path) -> dict[str, Recordings]:
    """Episodes by the name of their folder or file."""
    found = {}
    for path in data:
        config = RecordingsConfig(data=path, pattern=VALIDATION)
        found[path.stem] = load_recordings(config, work / "episodes", Progress()).recordings
    return found


def cut_blocks(sets: dict[str, Recordings], num_windows: int, size: int, seed: int) -> dict[str, ForecastWindows]:
    """Windows at random, as many of every set, in blocks of `size`; more windows leave the first ones as they are."""
    blocks = {}
    for number, (name, recordings) in enumerate(sets.items()):
        for begin in range(0, -(-num_windows // len(sets)), size):
            rng = np.random.default_rng([seed, number, begin])
            blocks[f"{name}-{begin:05d}"] = block_of(recordings, number, *choose_windows(recordings, size, rng), seed)
    return dict(sorted(blocks.items(), key=lambda item: item[0].rsplit("-", 1)[1]))


def block_of(recordings: Recordings, number: int, episode: Int64s, step: Int64s, seed: int) -> ForecastWindows:
    """Windows of one set, whose episodes are numbered apart from those of other sets."""
    cut = cut_windows(recordings, episode, step, seed=seed)
    return dataclasses.replace(cut, episode=cut.episode + 10_000 * number)


def sampled(model: PlaceModel, block: ForecastWindows, task: Task) -> tuple[HypothesisSet, float]:
    """Hypotheses of a block and the processor time they took."""
    begin = time.process_time()
    context = dataclasses.replace(block.context, obstacles=task.obstacles)
    drawn = model.sample(block.windows.with_context(context), task.num_hypotheses)
    return drawn, time.process_time() - begin


def score(block: ForecastWindows, drawn: HypothesisSet, task: Task, seconds: float) -> EpisodeScores:
    """Scores of one block."""
    return score_forecasts(drawn, block.truth_m, block.episode, block.context.datum_m, task.obstacles, seconds=seconds)


def score_all(task: Task, models: dict[str, PlaceModel]) -> dict[str, EpisodeScores]:
    """Every model on every block; what is in the work folder is not done again."""
    parts: dict[str, list[EpisodeScores]] = {name: [] for name in models}
    with Progress().bar(len(task.blocks) * len(models), "score", "block") as bar:
        for number, (key, block) in enumerate(task.blocks.items()):
            names = list(models) if number % 2 == 0 else list(models)[::-1]
            for name in names:
                parts[name].append(_kept_score(models[name], key, block, task))
                bar.update()
    return {name: EpisodeScores.add(rows) for name, rows in parts.items()}


def _kept_score(model: PlaceModel, key: str, block: ForecastWindows, task: Task) -> EpisodeScores:
    what = repr((model.sampling, task.num_hypotheses, block.windows.seeds.tolist(), _digest(model)))
    path = task.work / f"{key}-{hashlib.sha256(what.encode()).hexdigest()[:24]}.json"
    if path.is_file():
        return EpisodeScores.from_json(path.read_text(encoding="utf-8"))
    drawn, seconds = sampled(model, block, task)
    found = score(block, drawn, task, seconds)
    write_atomic(path, found.as_json())
    return found


def _digest(model: PlaceModel) -> str:
    total = hashlib.sha256(repr(model.config).encode())
    for value in model.network.state_dict().values():
        total.update(value.numpy().tobytes())
    return total.hexdigest()


def truth_scores(task: Task) -> EpisodeScores:
    """The true tracks as if they were the only hypothesis: their steps, and where they are."""
    parts = []
    for block in task.blocks.values():
        size = len(block)
        drawn = HypothesisSet(block.truth_m[:, None], torch.ones(size, 1, dtype=torch.float64), (("ok",),) * size)
        parts.append(score(block, drawn, task, 0.0))
    return EpisodeScores.add(parts)


def time_all(task: Task, models: dict[str, PlaceModel], num_windows: int, rounds: int) -> dict[str, list[float]]:
    """Processor seconds of every model on the first windows of the first blocks, round by round."""
    keys = list(task.blocks)[: min(len(task.blocks), len(SETS))]
    some = [task.blocks[key][: max(1, num_windows // len(keys))] for key in keys]
    seconds: dict[str, list[float]] = {name: [] for name in models}
    for number in range(-1, rounds):  # the first round warms up and is not counted
        for name in list(models)[:: -1 if number % 2 else 1]:
            if number < 0 and models[name].sampling.sampler == "ddpm":
                # what is loaded at the first call needs no hundred steps
                sampled(dataclasses.replace(models[name], sampling=_short(models[name].sampling)), some[0], task)
                continue
            spent = sum(sampled(models[name], block, task)[1] for block in some)
            if number >= 0:
                seconds[name].append(spent)
            sys.stderr.write(".")
            sys.stderr.flush()
    sys.stderr.write("\n")
    return seconds


def _short(sampling: PlaceSampling) -> PlaceSampling:
    return dataclasses.replace(sampling, num_steps=1)


def spread_of(column: str, ratios: Sequence[float]) -> publishing.Row:
    """Median, least and greatest."""
    return {column: statistics.median(ratios), f"{column}_low": min(ratios), f"{column}_high": max(ratios)}


def ratio(own: EpisodeScores, reference: EpisodeScores, measure: str, seed: int = 0) -> Interval:
    """A measure, mean over the horizons, over that of another sampler on the same windows; bootstrap over episodes."""
    top, bottom = own.measure(measure).sum(axis=1), reference.measure(measure).sum(axis=1)
    return bootstrap_ratio(top, bottom, own.episode, np.random.default_rng(seed))


def horizon_rows(scores: dict[str, EpisodeScores]) -> list[publishing.Row]:
    """Every measure at every horizon, distances over the map's side."""
    return [
        {"measure": name, "sampler": sampler, "horizon_step": step, "value": value / unit}
        for name, (measure, unit) in MEASURES.items()
        for sampler, found in scores.items()
        for step, value in zip(HORIZONS, found.mean(measure), strict=True)
    ]


def step_rows(scores: dict[str, EpisodeScores]) -> list[publishing.Row]:
    """Lengths of steps in cells: the mean, and lengths that a share of the steps does not exceed."""
    rows = []
    for name, found in scores.items():
        quantiles = step_quantiles(found.steps.sum(axis=0), LEVELS) / prison_map.CELL_M
        mean = found.share("step_length").sum() / found.count.sum() / prison_map.CELL_M
        shares = {f"quantile_{100 * level:.0f}_cells": value for level, value in zip(LEVELS, quantiles, strict=True)}
        rows.append({"sampler": name, "mean_cells": mean, **shares})
    return rows


def main_rows(scores: dict[str, EpisodeScores], seconds: dict[str, list[float]]) -> list[publishing.Row]:
    """A row a variant: speed, and the mean of every measure over the horizons, distances over the map's side."""
    rows = []
    for name, found in scores.items():
        speed = [paper / own for paper, own in zip(seconds[THE_PAPERS], seconds[name], strict=True)]
        shown = ("energy_score", "mean_error", "ade", "min_ade")
        means = {column: found.mean(MEASURES[column][0]).mean() / SIDE_M for column in shown}
        rows.append({
            "sampler": name, **spread_of("speed", speed),
            **publishing.columns("energy_ratio", ratio(found, scores[DDPM], "energy_score")), **means,
            "coverage_90_percent": 100 * found.mean("coverage_90").mean(),
        })  # fmt: skip
    return rows


def section(measured: Measurement) -> str:
    """The claim, and speed and scores of some samplers."""
    (claim,) = measured.rows("claim")
    lines = []
    for name in SHOWN:
        for row in measured.rows(sampler=name):
            speed, quality = publishing.interval(row, "speed", ".1f"), publishing.interval(row, "energy_ratio", ".3f")
            lines.append([name, speed, quality, f"{row['coverage_90_percent']:.0f}"])
    heads = ["sampler", "speed", "energy score ratio", "in 90 %"]
    return "\n\n".join([
        f"On {claim['num_windows']} windows the default draws {publishing.interval(claim, 'speed', '.1f')} times as fast, at "
        f"{publishing.interval(claim, 'energy_ratio', '.3f')} times the energy score of {DDPM}; on the first "
        f"{measured.facts['num_windows']}:",
        publishing.table(heads, lines),
    ])  # fmt: skip


def parser() -> argparse.ArgumentParser:
    """What the place benchmarks have in common."""
    made = argparse.ArgumentParser(formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--checkpoint", default="prison", help="trained by diffusion: a file or a shipped name")
    made.add_argument("--tuned", help="the same, tuned for few steps: two rows more")
    made.add_argument("--data", type=Path, nargs="+", default=[DATA / name for name in SETS], help="folders of logs, or npz")
    made.add_argument("--windows", type=int, default=300, help="in all sets")
    made.add_argument("--block", type=int, default=25, help="windows sampled at once")
    made.add_argument("--hypotheses", type=int, default=30)
    made.add_argument("--seed", type=int, default=0)
    made.add_argument("--work", type=Path, default=WORK)
    made.add_argument("--publish", type=Path, metavar="DOCS", help="write numbers and section below this folder")
    return made


def started(options: argparse.Namespace) -> dict[str, PlaceModel] | None:
    """The models of the checkpoints, "plain" and "tuned"; None, with the reason printed, where something is not here."""
    torch.set_num_threads(1)
    try:
        names = {"plain": options.checkpoint} | ({"tuned": options.tuned} if options.tuned else {})
        models = {kind: load_place_model(find_checkpoint(name)) for kind, name in names.items()}
    except CadenceError as error:
        print(f"skipped: {error}")
        return None
    missing = [path for path in options.data if not path.exists()]
    if missing:
        print(f"skipped: {missing[0]} is not here")
        return None
    return models


def facts_of(name: str, options: argparse.Namespace, task: Task) -> dict[str, object]:
    """How the windows were drawn, and by which networks."""
    names = [options.checkpoint, *([options.tuned] if options.tuned else [])]
    return publishing.facts_of(name) | {
        "checkpoints": [checkpoint_hash(find_checkpoint(name)) for name in names], "num_windows": task.num_windows,
        "num_episodes": len({int(e) for block in task.blocks.values() for e in block.episode}),
        "num_hypotheses": task.num_hypotheses,
    }  # fmt: skip


def main() -> int:
    """Measured, printed and published; 1 where the default misses the claim."""
    made = parser()
    made.description = __doc__
    made.add_argument("--rounds", type=int, default=5, help="of the timing")
    made.add_argument("--timed-windows", type=int, default=6)
    made.add_argument("--claim-windows", type=int, default=0, help="of the default against DDPM; by default --windows")
    options = made.parse_args()
    trained = started(options)
    if trained is None:
        return 0
    sets = load_sets(options.data, options.work)
    blocks = cut_blocks(sets, options.windows, options.block, options.seed)
    task = Task(blocks, mountain(), options.hypotheses, options.work / "scores")
    chosen = variants("tuned" in trained)
    base = {v.name: trained["tuned" if v.is_tuned else "plain"] for v in chosen}
    timed = {v.name: dataclasses.replace(base[v.name], sampling=v.timed or v.sampling) for v in chosen}
    seconds = time_all(task, timed, options.timed_windows, options.rounds)
    models = {v.name: dataclasses.replace(base[v.name], sampling=v.sampling) for v in chosen}
    scores = score_all(task, models)
    more = cut_blocks(sets, max(options.windows, options.claim_windows), options.block, options.seed)
    claim = dataclasses.replace(task, blocks=more)
    claimed = score_all(claim, {name: models[name] for name in (DDPM, DEFAULT)})
    speed = [p / own for p, own in zip(seconds[THE_PAPERS], seconds[DEFAULT], strict=True)]
    quality = ratio(claimed[DEFAULT], claimed[DDPM], "energy_score")
    found = {**spread_of("speed", speed), **publishing.columns("energy_ratio", quality), "num_windows": claim.num_windows}
    tables = {
        "place_samplers": main_rows(scores, seconds), "place_samplers_claim": [found],
        "place_samplers_steps": step_rows({"the true tracks": truth_scores(task)} | scores),
        "place_samplers_horizons": horizon_rows(scores),
    }  # fmt: skip
    facts = facts_of("place_samplers", options, task)
    facts |= {"num_rounds": options.rounds, "num_timed_windows": options.timed_windows}
    publishing.publish(Measurement("place_samplers", facts, tables), section, options.publish)
    return 0 if statistics.median(speed) >= CLAIM and quality.value <= TOLERANCE else 1


if __name__ == "__main__":
    sys.exit(main())
