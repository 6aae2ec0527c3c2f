"""Is the noise of detections found where messages do not state it?

Tracks of random kinematics (those that the general model is trained on: turns, circles, stops), seen all the time or in bursts,
with known noise, or with stamps in whole intervals. The noise is estimated from the detections alone.

    python -m benchmarks.measurement_noise --publish docs
"""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks import publishing
from benchmarks.publishing import Measurement
from cadence.arrays import Float64s
from cadence.measurement.noise import Track, measurement_noise
from cadence.worlds.kinematics import SUBSTEPS, draw_scenario, simulate_tracks

SIGMAS_M = (0.0, 1.0, 5.0, 20.0)
INTERVALS_S = (1.0, 5.0)
SEEN = ("all the time", "in bursts")
SPEED_MPS, NUM_DETECTIONS = 15.0, 300
MEAN_BURST, MEAN_GAP = 8, 24
"""Detections of a burst, and those that are left out between two."""


def track_of(seed: int, interval_s: float, is_in_bursts: bool, sigma_m: float, is_rounded: bool) -> Track:
    """Detections of one target; `is_rounded`: seen at any time, of which the nearest multiple of the interval remains."""
    rng = np.random.default_rng([20260, seed])
    num = NUM_DETECTIONS * (1 + MEAN_GAP // MEAN_BURST if is_in_bursts else 1)
    tracks = simulate_tracks(draw_scenario(rng), 1, num // SUBSTEPS, rng)
    position_m = tracks.position[0] * SPEED_MPS * interval_s * SUBSTEPS
    time_s = interval_s * np.arange(len(position_m))
    if is_rounded:
        at_s = time_s + rng.uniform(-0.5, 0.5, len(time_s)) * interval_s
        position_m = np.column_stack([np.interp(at_s, time_s, axis) for axis in position_m.T])
    position_m = position_m + rng.normal(0.0, 1.0, position_m.shape) * sigma_m
    is_seen = _bursts(len(time_s), rng) if is_in_bursts else np.ones(len(time_s), np.bool_)
    return Track(time_s[is_seen], position_m[is_seen])


def _bursts(num: int, rng: np.random.Generator) -> Float64s:
    lengths = np.stack([rng.geometric(1 / MEAN_BURST, num), rng.geometric(1 / MEAN_GAP, num)], 1).ravel()
    return np.repeat(np.tile([True, False], num), lengths)[:num]


def rows(num_seeds: int) -> Iterator[publishing.Row]:
    """One row a cell: how often the interval holds the truth, and the estimates."""
    cells = [(sigma_m, False) for sigma_m in SIGMAS_M] + [(1.0, True)]
    for seen in SEEN:
        for interval_s in INTERVALS_S:
            for sigma_m, is_rounded in cells:
                found = [
                    measurement_noise([track_of(seed, interval_s, seen == SEEN[1], sigma_m, is_rounded)])
                    for seed in range(num_seeds)
                ]
                told = [noise for noise in found if noise is not None]
                truth = interval_s / np.sqrt(12.0) if is_rounded else sigma_m
                values = [noise.timing_s if is_rounded else noise.sigma_m for noise in told]
                ranges = [noise.timing_interval_s if is_rounded else noise.sigma_interval_m for noise in told]
                low, middle, high = np.quantile(values, [0.1, 0.5, 0.9])
                yield {
                    "seen": seen, "interval_s": interval_s, "unit": "s" if is_rounded else "m", "truth": truth,
                    "num_logs": num_seeds, "num_told": len(told),
                    "num_held": sum(bool(one[0] <= truth <= one[1]) for one in ranges),
                    "num_timing": sum(noise.timing_interval_s[0] > 0 for noise in told),
                    "median": middle, "low_10": low, "high_90": high,
                }  # fmt: skip


def section(measured: Measurement) -> str:
    """A line for each true noise, over all ways to be seen."""
    heads = ["true noise", "medians found", "least 10 %", "greatest 90 %", "interval holds it", "errors in time found"]
    lines = []
    for truth, unit in dict.fromkeys((row["truth"], row["unit"]) for row in measured.rows()):
        rows = measured.rows(truth=truth, unit=unit)
        medians = [row["median"] for row in rows]
        held, told, timing = (sum(row[name] for row in rows) for name in ("num_held", "num_told", "num_timing"))
        lines.append(
            [
                f"{truth:.2g} {unit}", f"{min(medians):.2g} to {max(medians):.2g}", f"{min(row['low_10'] for row in rows):.2g}",
                f"{max(row['high_90'] for row in rows):.2g}", f"{held:g} of {told:g}", f"{timing:g}",
            ]
        )  # fmt: skip
    return publishing.table(heads, lines)


def main() -> int:
    """Measure, print and publish."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--publish", type=Path, metavar="DOCS", help="write numbers and section below this folder")
    arguments = parser.parse_args()
    found = {"measurement_noise": list(rows(arguments.seeds))}
    facts = publishing.facts_of("measurement_noise") | {"speed_mps": SPEED_MPS, "num_detections": NUM_DETECTIONS}
    publishing.publish(Measurement("measurement_noise", facts, found), section, arguments.publish)
    return 0


if __name__ == "__main__":
    sys.exit(main())
