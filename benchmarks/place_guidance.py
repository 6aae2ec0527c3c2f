"""Do forecasts keep out of the mountain, and what does it cost?

The prison world's only mountain, its keep-out circle by which the paper counts collisions: share of states and of straight ways
between states inside it without guidance, with the paper's algorithm 1 and with ours, on windows at random and on windows whose
true future passes near. Blocks of scores are kept (see place_samplers.py, whose blocks are shared).

    python -m benchmarks.place_guidance --publish docs
"""

import argparse
import dataclasses
import sys

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from benchmarks import publishing
from benchmarks.place_samplers import (
    DDPM,
    DEFAULT,
    PAPER,
    PLAIN,
    SIDE_M,
    THE_PAPERS,
    Task,
    block_of,
    cut_blocks,
    facts_of,
    load_sets,
    mountain,
    parser,
    ratio,
    sampled,
    score_all,
    started,
    truth_scores,
)  # fmt: skip
from benchmarks.publishing import Measurement
from cadence.arrays import Float64s
from cadence.constraints.checker import states_in_collision
from cadence.diffusion.place import PlaceModel
from cadence.diffusion.settings import PlaceSampling
from cadence.metrics import Interval, bootstrap_ratio
from cadence.recordings import ForecastWindows, Recordings, choose_windows
from cadence.worlds import prison_map
from pipeline.forecast.scores import EpisodeScores

NEAR_CELLS = 250.0
"""A window is near where its true future comes this close to the mountain's centre."""
PER_EPISODE = 60
"""Random moments of an episode among which those near are looked for."""
CLAIM, TOLERANCE = 0.00641, 1.01
UNGUIDED, GUIDED, BOTH = "unguided", "guidance on the clean estimate", "guidance on the clean estimate, and repair"
MOVED, REPAIRED = "default without repair", "repair alone"
MOUNTAIN_ONLY = "algorithm 1, mountain term only"
TRUTH = "the true tracks"
SHOWN = (TRUTH, UNGUIDED, DEFAULT, MOUNTAIN_ONLY, THE_PAPERS)
"""Rows of the page."""
MOMENTS = ("at random", "near the mountain")
_INK, _PATH, _SEEN, _ROCK = "#1d2733", "#2a6f97", "#e8a33d", "#8d8478"


def models_of(trained: dict[str, PlaceModel]) -> dict[str, PlaceModel]:
    """Every way of guiding, by name; the paper's needs DDPM, which needs weights that are not tuned for few steps."""
    ours = trained.get("tuned", trained["plain"])
    found = {
        name: dataclasses.replace(ours, sampling=sampling)
        for name, sampling in {
            UNGUIDED: PlaceSampling(guidance="none", is_repaired=False),
            DEFAULT: PlaceSampling(),
            GUIDED: PlaceSampling(guidance="clean", is_repaired=False),
            BOTH: PlaceSampling(guidance="clean"),
            MOVED: PlaceSampling(is_repaired=False),
            REPAIRED: PlaceSampling(guidance="none"),
        }.items()
    }
    theirs = {
        DDPM: dataclasses.replace(PLAIN, sampler="ddpm", num_steps=100),
        THE_PAPERS: PAPER,
        MOUNTAIN_ONLY: dataclasses.replace(PAPER, step_weight=0.0),
    }
    return found | {name: dataclasses.replace(trained["plain"], sampling=sampling) for name, sampling in theirs.items()}


REFERENCE = {THE_PAPERS: DDPM, MOUNTAIN_ONLY: DDPM}
"""What a row is compared with, where that is not `UNGUIDED`."""


def near_blocks(sets: dict[str, Recordings], num_windows: int, size: int, seed: int) -> dict[str, ForecastWindows]:
    """Windows whose true future passes near the mountain, of every set, in blocks."""
    centre = mountain().circles[0, :2]
    blocks = {}
    for number, (name, recordings) in enumerate(sets.items()):
        rng = np.random.default_rng([seed, number, 1])
        episode, step = choose_windows(recordings, PER_EPISODE * len(recordings), rng)
        pool = block_of(recordings, number, episode, step, seed)
        track = pool.truth_m[:, 0] + pool.context.datum_m[:, None]
        near = torch.nonzero((track - centre).norm(dim=-1).amin(dim=1) < NEAR_CELLS * prison_map.CELL_M)[:, 0]
        wanted = torch.from_numpy(rng.permutation(near.numpy())[: -(-num_windows // len(sets))])
        for begin in range(0, len(wanted), size):
            blocks[f"near-{name}-{begin:05d}"] = pool[wanted[begin : begin + size]]
    return blocks


def share_of(found: EpisodeScores, name: str) -> Interval:
    """A share of the hypotheses' states or segments, with its interval over episodes."""
    return bootstrap_ratio(found.share(name), found.count.astype(np.float64), found.episode, np.random.default_rng(0))


def rows_of(moments: str, scores: dict[str, EpisodeScores], truth: EpisodeScores) -> list[publishing.Row]:
    """A row a way of guiding, and one of the true tracks."""
    rows = []
    for name, found in ({TRUTH: truth} | scores).items():
        row: publishing.Row = {"moments": moments, "guidance": name}
        for what in ("states", "segments"):
            row |= publishing.columns(f"{what}_inside_percent", share_of(found, f"{what}_in_obstacles"), 100)
        reference = scores[REFERENCE.get(name, UNGUIDED)]
        for column, measure in (("ade_ratio", "ade"), ("energy_ratio", "energy_score")):
            row |= publishing.columns(column, None if found is truth else ratio(found, reference, measure))
        means = {measure: found.mean(measure).mean() / SIDE_M for measure in ("ade", "energy_score")}
        means["time_ratio"] = found.seconds / reference.seconds
        rows.append(row | (dict.fromkeys(means) if found is truth else means))
    return rows


def section(measured: Measurement) -> str:
    """What lies inside the mountain, and what keeping out of it costs."""
    lines = []
    for name in SHOWN:
        far, near = (measured.rows(moments=moments, guidance=name)[0] for moments in MOMENTS)
        inside = [f"{row['states_inside_percent']:.2f}" for row in (far, near)]
        ratios = [publishing.interval(far, column, ".3f") for column in ("ade_ratio", "energy_ratio")]
        lines.append([name, *inside, *ratios])
    counts = [measured.facts[name] for name in ("num_windows", "num_near_windows")]
    heads = [f"{counts[0]} moments", "states inside, %", f"in {counts[1]} near it", "ADE ratio", "energy score ratio"]
    return publishing.table(heads, lines)


def draw(trained: dict[str, PlaceModel], task: Task) -> Figure:
    """The window that unguided hypotheses take into the mountain most often, three ways."""
    models = models_of(trained)
    block = _worst(models[UNGUIDED], task)
    rows = (UNGUIDED, MOUNTAIN_ONLY, DEFAULT)
    titles = ("unguided", "the paper's algorithm 1 (mountain term)", "default")
    figure, panels = plt.subplots(1, 3, figsize=(13.0, 4.9), layout="constrained", sharex=True, sharey=True)
    for axes, name, title in zip(panels, rows, titles, strict=True):
        drawn = sampled(models[name], block, task)[0].position_m
        hit = states_in_collision(drawn, task.obstacles, offset_m=block.context.datum_m[:, None, None, None])
        _panel(axes, block, drawn[0, :, 0].numpy(), f"{title}: {100 * float(hit.double().mean()):.1f} % of the states inside")
    panels[0].legend(loc="best", fontsize=8)
    panels[0].set_ylabel("north [cells of 21 m]")
    return figure


def _worst(model: PlaceModel, task: Task) -> ForecastWindows:
    found, share = None, -1.0
    for block in task.blocks.values():
        drawn = sampled(model, block, task)[0].position_m
        hit = states_in_collision(drawn, task.obstacles, offset_m=block.context.datum_m[:, None, None, None])
        mean = hit.double().flatten(1).mean(dim=1)
        if float(mean.max()) > share:
            share, row = float(mean.max()), int(mean.argmax())
            found = block[torch.tensor([row])]
    assert found is not None
    return found


def _panel(axes: Axes, block: ForecastWindows, drawn: Float64s, title: str) -> None:
    cell, datum = prison_map.CELL_M, block.context.datum_m[0].numpy()
    axes.add_patch(Circle(prison_map.MOUNTAIN, prison_map.KEEP_OUT, color=_ROCK, alpha=0.6, lw=0))
    for track in (drawn + datum) / cell:
        axes.plot(*track.T, color=_PATH, lw=0.8, alpha=0.6)
    axes.plot([], [], color=_PATH, lw=1, label=f"{len(drawn)} hypotheses, two hours")
    axes.plot(*((block.truth_m[0, 0].numpy() + datum) / cell).T, color=_INK, lw=1.6, label="the true track")
    seen = block.windows.detections
    places = seen.position_m[0, 0][seen.is_observed[0, 0]].numpy()
    axes.plot(*((places + datum) / cell).T, "o", color=_SEEN, ms=4, mec=_INK, mew=0.4, label="detections")
    both = np.concatenate([drawn.reshape(-1, 2), block.truth_m[0, 0].numpy()]) + datum
    low, high = both.min(axis=0) / cell, both.max(axis=0) / cell
    centre = np.array(prison_map.MOUNTAIN)
    low, high = np.minimum(low, centre - 180) - 30, np.maximum(high, centre + 180) + 30
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), title=title, xlabel="east [cells of 21 m]")
    axes.set_aspect("equal")
    axes.title.set_fontsize(10)


def main() -> int:
    """Numbers and a picture; 1 where the default misses the claim."""
    made = parser()
    made.description = __doc__
    made.formatter_class = argparse.RawDescriptionHelpFormatter
    made.add_argument("--near-windows", type=int, default=150, help="in all sets")
    options = made.parse_args()
    trained = started(options)
    if trained is None:
        return 0
    sets = load_sets(options.data, options.work)
    tasks = [
        Task(blocks, mountain(), options.hypotheses, options.work / "scores")
        for blocks in (
            cut_blocks(sets, options.windows, options.block, options.seed),
            near_blocks(sets, options.near_windows, options.block, options.seed),
        )
    ]
    models = models_of(trained)
    results = [score_all(task, models) for task in tasks]
    rows = [
        row
        for moments, task, scores in zip(MOMENTS, tasks, results, strict=True)
        for row in rows_of(moments, scores, truth_scores(task))
    ]
    facts = facts_of("place_guidance", options, tasks[0]) | {"num_near_windows": tasks[1].num_windows}
    publishing.publish(Measurement("place_guidance", facts, {"place_guidance": rows}), section, options.publish)
    if options.publish is not None:
        draw(trained, tasks[1]).savefig(options.publish / "images" / "guidance.png", dpi=90)
    return 0 if _holds(results[0]) else 1


def _holds(scores: dict[str, EpisodeScores]) -> bool:
    own = scores[DEFAULT]
    is_clear = all(share_of(own, f"{what}_in_obstacles").value <= CLAIM for what in ("states", "segments"))
    return is_clear and all(ratio(own, scores[UNGUIDED], measure).value <= TOLERANCE for measure in ("ade", "energy_score"))


if __name__ == "__main__":
    sys.exit(main())
