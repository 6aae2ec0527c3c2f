"""How many targets are there, and how much is clutter, where a log states neither?

Simulated streams without identity (`clutter_logs`): four targets cross, go side by side, or appear and leave. Every stream is
told apart twice, with the share of clutter fitted and with the true one stated; the likeliest association is smoothed by the
bank.

    python -m benchmarks.clutter --publish docs
"""

import argparse
import itertools
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch

from benchmarks import publishing
from benchmarks.association import smoothed
from benchmarks.association_scores import gospas, label_scores
from benchmarks.clutter_logs import SCENES, Scene, clutter_log
from benchmarks.publishing import Measurement, Row
from cadence.association.associate import associate
from cadence.association.counts import stream_counts
from cadence.association.types import CLUTTER, AssociationConfig, without_unlikely
from cadence.metrics import bootstrap_mean

SHARES = (0.0, 0.1, 0.2, 0.4)
FIRST_SEED = 3
"""Seeds below were looked at while association was developed."""
WORSE = 1.05
"""Of the GOSPA error with the true share, what a fitted one may cost."""


@dataclass(frozen=True)
class Job:
    """One stream, and whether the true share of clutter is stated."""

    scene: Scene
    clutter: float
    seed: int
    is_stated: bool


def jobs(num_seeds: int) -> list[Job]:
    """Every stream with either knowledge."""
    seeds = range(FIRST_SEED, FIRST_SEED + num_seeds)
    return [Job(*one) for one in itertools.product(SCENES, SHARES, seeds, (False, True))]


def row_of(job: Job) -> Row:
    """What is found in one stream, beside what is true."""
    torch.set_num_threads(1)
    log = clutter_log(job.scene, job.clutter, job.seed)
    config = AssociationConfig(clutter_share=job.clutter if job.is_stated else None)
    covariance_m2 = np.broadcast_to(log.sigma_m**2 * np.eye(2), (len(log.time_s), 2, 2))
    (found,) = without_unlikely(associate(log.time_s, log.position_m, covariance_m2, log.time_s[-1:], config, seed=0))
    counts = stream_counts(found, log.time_s)
    tracks_m, _ = smoothed(log, found.label[:1], 1)
    is_target = log.origin != CLUTTER
    right, _ = label_scores(found.label[0], log.origin, is_target)
    return {
        "scene": job.scene, "clutter": job.clutter, "seed": job.seed, "share": "stated" if job.is_stated else "fitted",
        "num_detections": len(log.time_s), "num_targets": int(log.origin.max()) + 1, "num_found": counts.num_agents,
        "true_share": float(1.0 - is_target.mean()), "found_share": counts.clutter.value,
        "found_low": counts.clutter.low, "found_high": counts.clutter.high,
        "gospa_m": float(gospas(tracks_m[0], log)[:, 0].mean()), "labels": right,
    }  # fmt: skip


def section(measured: Measurement) -> str:
    """A line for each share, over kinds and seeds."""
    heads = ["clutter, %", "number of targets right", "share found, %", "interval holds it",
             "GOSPA, fitted, m", "stated, m", "labels, %"]  # fmt: skip
    lines = []
    for share in SHARES:
        fitted, stated = (measured.rows(clutter=share, share=known) for known in ("fitted", "stated"))
        right = sum(one["num_found"] == one["num_targets"] for one in fitted)
        held = sum(one["found_low"] <= one["true_share"] <= one["found_high"] for one in fitted)
        lines.append(
            [
                f"{100 * share:g}", f"{right} of {len(fitted)}",
                f"{100 * _mean(fitted, 'found_share'):.0f}", f"{held} of {len(fitted)}",
                *(f"{_mean(of, 'gospa_m'):.0f}" for of in (fitted, stated)), f"{100 * _mean(fitted, 'labels'):.0f}",
            ]
        )  # fmt: skip
    both = zip(measured.rows(share="fitted"), measured.rows(share="stated"), strict=True)
    ratios = [one["gospa_m"] / other["gospa_m"] for one, other in both]
    ratio = bootstrap_mean(np.log(ratios), np.arange(len(ratios)), np.random.default_rng(0))
    found = np.exp([ratio.value, ratio.low, ratio.high])
    told = (
        "GOSPA with a fitted share is "
        f"{found[0]:.2f} [{found[1]:.2f}, {found[2]:.2f}] times that with the true one (geometric mean), and more than "
        f"{WORSE:.2f} times in {sum(one > WORSE for one in ratios)} of {len(ratios)}."
    )
    return f"{publishing.table(heads, lines)}\n\n{told}"


def _mean(of: list[Row], column: str) -> float:
    return float(np.mean([row[column] for row in of]))


def main() -> int:
    """Measure, print and publish."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--publish", type=Path, metavar="DOCS", help="write numbers and section below this folder")
    arguments = parser.parse_args()
    with ProcessPoolExecutor(arguments.jobs, get_context("spawn")) as pool:
        found = {"clutter": list(pool.map(row_of, jobs(arguments.seeds)))}
    facts = publishing.facts_of("clutter") | {"first_seed": FIRST_SEED, "num_seeds": arguments.seeds}
    publishing.publish(Measurement("clutter", facts, found), section, arguments.publish)
    return 0


if __name__ == "__main__":
    sys.exit(main())
