"""How much faster is the default sampler than the paper's procedure, on the same network, windows and bank?

The paper's procedure draws with 100 steps of DDPM, reads the detections again for every hypothesis and step, moves every
posterior mean by eight steps of Adam through autograd (algorithm 1) and overwrites the detection at the origin. Here it walks
in the residual's coordinates, because the shipped network does. Every variant draws the same number of hypotheses for the same
windows of the patrol simulator in one process on one thread, all variants one after the other in every round. A ratio is of the
processor times of two runs of the same round, so that the machine's speed, and what else it does, go out of it.

    python -m benchmarks.sampler_speed --publish docs
"""

import argparse
import dataclasses
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from benchmarks import publishing
from benchmarks.paper_procedure import Paper, bank_noise
from benchmarks.publishing import Measurement
from benchmarks.sampler_cases import Case, bank_context, build_case
from cadence.bank.rows import scatter_hypotheses
from cadence.constraints.checker import segments_in_collision
from cadence.constraints.limits import KeepOut
from cadence.diffusion.feasible import Feasibility
from cadence.metrics import bootstrap_ratio, energy_score, masked_mean
from cadence.types import HypothesisSet
from pipeline.checkpoints import checkpoint_hash, find_checkpoint
from pipeline.infer.draws import draw_windows

CLAIM = 10.0
DEFAULT, THE_PAPERS, BANK = "default: rotation, 6 steps", "the paper's procedure: DDPM, 100 steps", "the bank alone"
SHOWN = (DEFAULT, THE_PAPERS, BANK)
"""Rows of the page."""

Run = Callable[["Case"], HypothesisSet]


def default_path(case: Case, sampler: str = "rotation", num_steps: int = 6) -> HypothesisSet:
    """What `infer` does with these windows once its model is fitted: bank, sampler with guidance, repair and weights."""
    model = dataclasses.replace(case.model, sampler=sampler, num_steps=num_steps)
    windows = case.windows.located(int(case.windows.origins_ns[0]), case.obstacles)
    parts = [piece()[1] for piece in draw_windows(model, windows, case.num_hypotheses, is_apart=True)]
    position, weight = torch.cat([part.position_m for part in parts]), torch.cat([part.weight for part in parts])
    return HypothesisSet(position, weight, tuple(row for part in parts for row in part.status))


def unconstrained_path(case: Case) -> HypothesisSet:
    """Bank and sampler without guidance, repair and weights."""
    return case.model.sample(case.windows.batch, case.num_hypotheses)


def bank_path(case: Case) -> HypothesisSet:
    """The bank's samples, where every variant starts."""
    posterior = case.model.bank.posterior(case.windows.batch, case.num_hypotheses)
    return scatter_hypotheses(posterior.sample_m, case.windows.batch)


@dataclass(frozen=True)
class Variant:
    """A row of the table: what is drawn, and the processor seconds of its network part alone (with its guidance), if known."""

    name: str
    run: Run
    part: Callable[[Case], float] | None = None


def network_seconds(case: Case, sampler: str, num_steps: int) -> float:
    """Processor seconds of the default's sampling alone: no bank, no repair; guided as in `infer`."""
    posterior, context = bank_context(case)
    limits = Feasibility(KeepOut(case.obstacles, 0.0, case.datum_m), case.windows.batch.step_s)
    model = dataclasses.replace(case.model, sampler=sampler, num_steps=num_steps)
    begin = time.process_time()
    model._denoise(posterior, context, limits.guide)
    return time.process_time() - begin


def constrained(name: str, sampler: str, num_steps: int) -> Variant:
    """A variant of the default path."""
    return Variant(
        name, lambda case: default_path(case, sampler, num_steps), lambda case: network_seconds(case, sampler, num_steps)
    )


def ddpm(name: str, paper: Paper) -> Variant:
    """A variant of the paper's procedure."""
    return Variant(name, paper, lambda case: paper.seconds.pop())


def variants() -> list[Variant]:
    """The default first, the paper's procedure right after it; then what lies between."""
    return [
        constrained(DEFAULT, "rotation", 6),
        ddpm(THE_PAPERS, Paper()),
        ddpm("the same without guidance and overwriting", Paper(is_guided=False, overwrite=False)),
        ddpm("the same, detections read once", Paper(encode_each_step=False, is_guided=False, overwrite=False)),
        constrained("DDIM, 12 steps", "ddim", 12),
        constrained("DDIM, 10 steps", "ddim", 10),
        constrained("DPM-Solver++, 8 steps", "dpmpp", 8),
        constrained("rotation, 12 steps", "rotation", 12),
        constrained("rotation, 3 steps", "rotation", 3),
        Variant("rotation, 6 steps, no guidance, no repair", unconstrained_path),
        Variant(BANK, bank_path),
    ]


@dataclass
class Result:
    """What was measured of a variant: processor seconds of every round, and per window of the first visit its scores."""

    whole_s: list[float]
    part_s: list[float]
    past: list[float]
    future: list[float]
    hit: list[float]


def measure(cases: list[Case], chosen: list[Variant], rounds: int) -> dict[str, Result]:
    """All variants one after the other, on every case, `rounds` times; the first visit of a case is scored."""
    results = {variant.name: Result([], [], [], [], []) for variant in chosen}
    for case in cases:
        bank_noise(case)
        default_path(case)  # what is computed once an obstacle map is not counted
        for number in range(rounds):
            for variant in chosen:
                result = results[variant.name]
                begin = time.process_time()
                drawn = variant.run(case)
                result.whole_s.append(time.process_time() - begin)
                if number == 0:
                    score(drawn, case, result)
                if variant.part is not None:
                    result.part_s.append(variant.part(case))
                sys.stderr.write(".")
                sys.stderr.flush()
    sys.stderr.write("\n")
    return results


def score(drawn: HypothesisSet, case: Case, result: Result) -> None:
    """Energy score a window up to the origin and after it, and the share of hypotheses that touch land."""
    position, origin = drawn.position_m.nan_to_num(), case.windows.batch.origin_index
    energy = energy_score(position, drawn.weight, case.truth_m)
    past, future = slice(None, origin + 1), slice(origin + 1, None)
    for column, where in ((result.past, past), (result.future, future)):
        column += masked_mean(energy[..., where], case.is_known[..., where])[:, 0].tolist()
    offset = torch.from_numpy(case.windows.datum_m)[:, None, None, None]
    is_hit = segments_in_collision(position, case.obstacles, offset_m=offset).any(-1).any(-1)
    result.hit += (is_hit * drawn.weight).sum(1).tolist()


def spread_of(column: str, ratios: list[float]) -> publishing.Row:
    """Median, least and greatest; nothing of no ratios."""
    values = (statistics.median(ratios), min(ratios), max(ratios)) if ratios else (None, None, None)
    return dict(zip((column, f"{column}_low", f"{column}_high"), values, strict=True))


def rows_of(results: dict[str, Result], chosen: list[Variant], groups: list[int], seed: int) -> list[publishing.Row]:
    """A row a variant: how many times the speed of the paper's procedure, and scores over the bank's."""
    paper, bank = results[chosen[1].name], results[chosen[-1].name]
    rows = []
    for variant in chosen:
        result = results[variant.name]
        whole = [p / own for p, own in zip(paper.whole_s, result.whole_s, strict=True)]
        part = [p / own for p, own in zip(paper.part_s, result.part_s, strict=True)] if result.part_s else []
        row = {"sampler": variant.name, **spread_of("speed", whole), **spread_of("network_speed", part)}
        for name, own, reference in (("past", result.past, bank.past), ("future", result.future, bank.future)):
            ratio = bootstrap_ratio(own, reference, groups, np.random.default_rng(seed))
            row |= publishing.columns(f"energy_ratio_{name}", ratio)
        rows.append(row | {"touch_land_percent": 100 * statistics.fmean(result.hit)})
    return rows


def section(measured: Measurement) -> str:
    """Speed and scores of the default, the paper's procedure and what lies between."""
    lines = []
    for name in SHOWN:
        (row,) = measured.rows(sampler=name)
        scores = [f"{row[f'energy_ratio_{part}']:.2f}" for part in ("past", "future")]
        speed = publishing.interval(row, "speed", ".1f")
        lines.append([name, speed, *scores, f"{row['touch_land_percent']:.0f}"])
    heads = ["sampler", "speed", "energy score over the bank's: past", "future", "touch land, %"]
    facts = measured.facts
    reached = f"{facts['num_pairs_reaching_aim']} of {facts['num_pairs']}"
    text = f"{facts['num_windows']} windows; in {reached} pairs of runs the default is {CLAIM:.0f} times as fast."
    return f"{publishing.table(heads, lines)}\n\n{text}"


def main() -> int:
    """Measured, printed and published; 1 where the default is not `CLAIM` times as fast as the paper's procedure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--publish", type=Path, metavar="DOCS", help="write numbers and section below this folder")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--episodes", type=int, default=6)
    parser.add_argument("--windows", type=int, default=8, help="of each episode")
    parser.add_argument("--hypotheses", type=int, default=30)
    parser.add_argument("--rounds", type=int, default=1, help="times that every episode is visited")
    parser.add_argument("--checkpoint", default="general")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    weights = find_checkpoint(arguments.checkpoint)
    cases: list[Case] = []
    index = 0
    while len(cases) < arguments.episodes:
        case = build_case(arguments.seed, index, arguments.windows, arguments.hypotheses, weights)
        cases += [case] if case is not None else []
        index += 1
    chosen = variants()
    results = measure(cases, chosen, arguments.rounds)
    groups = [number for number, case in enumerate(cases) for _ in range(case.windows.batch.num_windows)]
    default, paper = results[chosen[0].name], results[chosen[1].name]
    ratios = [p / own for p, own in zip(paper.whole_s, default.whole_s, strict=True)]
    facts = publishing.facts_of("sampler_speed") | {
        "checkpoint": {arguments.checkpoint: checkpoint_hash(weights)}, "num_windows": len(groups), "num_pairs": len(ratios),
        "num_pairs_reaching_aim": sum(ratio >= CLAIM for ratio in ratios),
        "num_obstacles": max(case.obstacles.count for case in cases),
    }  # fmt: skip
    tables = {"sampler_speed": rows_of(results, chosen, groups, arguments.seed)}
    publishing.publish(Measurement("sampler_speed", facts, tables), section, arguments.publish)
    return 0 if statistics.median(ratios) >= CLAIM else 1


if __name__ == "__main__":
    sys.exit(main())
