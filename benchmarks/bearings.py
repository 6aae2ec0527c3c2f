"""Does the 90 % region hold targets of whom bearings alone tell, as often as it says?

Own-prior check: targets are drawn from the sampler's own prior (the bank's steady models, the place about the observer),
bearings are made of them, and the posterior is asked where they were at the first, middle and last bearing. One observer that
turns once, one that stands, and two that stand apart and hear in turn. One row a target in a file a geometry: a killed run
goes on.

    python -m benchmarks.bearings --publish docs
"""

import argparse
import json
import math
import time
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks import publishing
from benchmarks.publishing import Measurement
from cadence.arrays import Float64s
from cadence.bank.bank import Bank
from cadence.bank.components import transition
from cadence.bank.smoother import Nodes, diffuse_start
from cadence.bearings.cells import Prior
from cadence.bearings.draws import Cloud, Known, posterior
from cadence.bearings.estimator import LEAST_SHARE, steady
from cadence.bearings.linear import sights_of
from cadence.evidence.measurements import KINDS, Measurements, sigma_name
from cadence.metrics import coverage
from cadence.resampling import systematic
from pipeline.files import write_atomic

WORK = Path("out/benchmarks/bearings")
GEOMETRIES = {"turns": "one that turns once", "stands": "one that stands", "two": "two that stand, in turn"}
PLACES = ("first", "middle", "last")
STEP_S, SPEED_MPS, REACH_M = 60.0, 4.0, 3000.0
NUM_BEARINGS, SIGMA_RAD = 30, math.radians(1.5)
_NUM_DRAWN, _NUM_SHOWN = 2000, 100


def main() -> None:
    """Measure, print, publish."""
    options = _options()
    torch.set_num_threads(1)
    found = {geometry: _measured(geometry, options) for geometry in GEOMETRIES}
    table = [_row(geometry, rows) for geometry, rows in found.items()]
    facts = publishing.facts_of("bearings") | {"seed": options.seed, "num_drawn": _NUM_DRAWN}
    targets = [{"geometry": geometry, **row} for geometry, rows in found.items() for row in rows]
    measured = Measurement("bearings", facts, {"bearings": table, "bearings_targets": targets})
    publishing.publish(measured, section, options.publish)


def section(measured: Measurement) -> str:
    """How often the region holds a target, by geometry."""
    rows = [
        [
            GEOMETRIES[row["geometry"]], f"{row['num_drawn']} of {row['num_targets']}",
            *(f"{100 * row[place]:.0f} %" for place in PLACES), f"{row['cpu_s']:.1f}",
        ]
        for row in measured.rows()
    ]  # fmt: skip
    return publishing.table(["observer", "drawn", "first", "middle", "last", "CPU-s a target"], rows)


def _row(geometry: str, rows: list[dict[str, float]]) -> dict[str, float | str]:
    drawn = [row for row in rows if row["share"] >= LEAST_SHARE]
    held = {place: float(np.mean([row[place] for row in drawn])) for place in PLACES}
    cpu_s = float(np.mean([row["cpu_s"] for row in rows]))
    return {"geometry": geometry, "num_targets": len(rows), "num_drawn": len(drawn), **held, "cpu_s": cpu_s}


def _measured(geometry: str, options: argparse.Namespace) -> list[dict[str, float]]:
    path = options.work / f"{geometry}_seed{options.seed}.json"
    rows = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else []
    for number in range(len(rows), options.targets):
        rows.append(_target(geometry, np.random.default_rng([options.seed, number]), number))
        options.work.mkdir(parents=True, exist_ok=True)
        write_atomic(path, json.dumps(rows))
    return rows[: options.targets]


def _target(geometry: str, rng: np.random.Generator, number: int) -> dict[str, float]:
    """One target: share of the samples that count, whether the region holds it, processor time."""
    models, _, log_weight = steady(Bank())
    prior = Prior(models.scaled(STEP_S, SPEED_MPS), log_weight, torch.zeros(2, dtype=torch.float64), REACH_M)
    time_s = torch.arange(NUM_BEARINGS, dtype=torch.float64) * STEP_S
    track_m = _track(prior, time_s, rng)
    observer_m = _observers(geometry, time_s.numpy())
    apart = track_m - observer_m
    heard = np.arctan2(apart[:, 1], apart[:, 0]) + SIGMA_RAD * rng.standard_normal(NUM_BEARINGS)
    begun = time.process_time()
    asked = [0, NUM_BEARINGS // 2, NUM_BEARINGS - 1]
    cloud = _posterior(prior, _bearings(time_s.numpy(), observer_m, heard), time_s[asked], number)
    row = {"share": cloud.num_effective / _NUM_DRAWN, "cpu_s": time.process_time() - begun}
    pick = torch.from_numpy(systematic(cloud.weight.numpy(), _NUM_SHOWN, 0.5))
    even = torch.full((1, _NUM_SHOWN), 1.0 / _NUM_SHOWN, dtype=torch.float64)
    for index, (place, step) in enumerate(zip(PLACES, asked, strict=True)):
        place_m, truth_m = cloud.state[pick, index, :2], torch.from_numpy(track_m[step])
        row[place] = float(coverage(place_m[None, :, None, None], even, truth_m[None, None, None], (0.9,)))
    return row


def _track(prior: Prior, time_s: Tensor, rng: np.random.Generator) -> Float64s:
    """A track [T, 2] of the prior: a model by its weight, a place and a velocity to begin with, then step by step."""
    chosen = int(rng.choice(len(prior.log_weight), p=prior.log_weight.exp().numpy()))
    model = prior.models[torch.tensor([chosen])]
    mean, covariance = diffuse_start(model, prior.begin_m[None], torch.tensor([prior.reach_m], dtype=torch.float64))
    state = mean[0].numpy() + _root(covariance[0]) @ rng.standard_normal(mean.shape[1])
    places = [state[:2]]
    for duration in time_s.diff():
        matrix, noise = transition(model, duration[None])
        state = matrix[0].numpy() @ state + _root(noise[0]) @ rng.standard_normal(len(state))
        places.append(state[:2])
    return np.stack(places)


def _root(covariance: Tensor) -> Float64s:
    """A matrix whose product with its transpose is the covariance, which may be singular."""
    values, vectors = np.linalg.eigh(covariance.numpy())
    root: Float64s = vectors * np.sqrt(np.maximum(values, 0.0))
    return root


def _observers(geometry: str, time_s: Float64s) -> Float64s:
    """Where it is heard from [T, 2]."""
    if geometry == "turns":
        half_s = 0.5 * time_s[-1]
        return np.stack([8.0 * np.minimum(time_s, half_s), 8.0 * np.maximum(time_s - half_s, 0.0)], -1)
    place_m = np.zeros((len(time_s), 2))
    if geometry == "two":
        place_m[1::2, 0] = 4000.0
    return place_m


def _bearings(time_s: Float64s, observer_m: Float64s, bearing_rad: Float64s) -> Measurements:
    num = len(time_s)
    columns = {kind: np.full(num, np.nan) for kind in KINDS} | {"bearing_rad": bearing_rad}
    columns |= {sigma_name(kind): np.full(num, SIGMA_RAD if kind == "bearing_rad" else np.nan) for kind in KINDS}
    return Measurements(time_s, observer_m, np.zeros((num, 2)), np.full(num, np.nan), **columns, agent_ids=(None,) * num)


def _posterior(prior: Prior, heard: Measurements, asked_s: Tensor, number: int) -> Cloud:
    def likelihood(state: Tensor) -> Tensor:
        at = state[:, len(asked_s) :].numpy()
        return torch.from_numpy(heard.fits(at[..., :2], at[..., 2:4]).sum(axis=-1))

    zero = torch.zeros(1, 1, dtype=torch.float64)
    nobody = Nodes(zero, torch.zeros(1, 1, 2).double(), torch.eye(2).double()[None, None], zero > 0)
    span_s = float(heard.time_s[-1] - heard.time_s[0])
    farthest_m = 3.0 * REACH_M + float(prior.models.initial_speed.max()) * span_s
    known = Known(prior, nobody, sights_of(heard), 0.005 * REACH_M, farthest_m, torch.zeros(1).double(), likelihood)
    heard_s = torch.from_numpy(heard.time_s.copy())
    return posterior(known, torch.cat([asked_s, heard_s]), _NUM_DRAWN, np.random.default_rng(number))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--targets", type=int, default=60, help="of each geometry")
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--work", type=Path, default=WORK)
    parser.add_argument("--publish", type=Path, metavar="DOCS", help="write numbers and section below this folder")
    return parser.parse_args()


if __name__ == "__main__":
    main()
