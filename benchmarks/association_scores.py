"""How far an estimate of `association.py` is from the truth: sets of positions, labels, what is said of them, energy scores."""

import itertools
from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment

from benchmarks.association_logs import Estimate, Log
from cadence.arrays import Bools, Float64s, Int64s
from cadence.association.types import CLUTTER
from cadence.metrics import energy_score, gospa, ospa

ORDER = 2.0


@dataclass(frozen=True, eq=False)
class Scores:
    """Of one estimate, at the scored moments T.

    distances [T, 5]  GOSPA, its parts to the power of the order (localisation, missed, false), and OSPA
    right, linked     share of labels that are right, of successive detections with one label; NaN without labels
    energy [A, T]     energy score of the track that lies nearest to each target; NaN where there is none within the cut-off
    """

    distances: Float64s
    right: float
    linked: float
    energy: Float64s


def scores_of(estimate: Estimate, log: Log) -> Scores:
    """All scores of one estimate."""
    right, linked = np.nan, np.nan
    if estimate.label is not None:
        right, linked = label_scores(estimate.label, log.origin, log.time_s >= log.scored_from_s)
    return Scores(gospas(estimate.position_m, log), right, linked, _energies(estimate, log))


def gospas(position_m: Float64s, log: Log) -> Float64s:
    """GOSPA, its three parts and OSPA at the scored moments [T, 5]."""
    rows = []
    for index in np.flatnonzero(log.grid_s >= log.scored_from_s):
        sets = [torch.from_numpy(tracks[:, index][np.isfinite(tracks[:, index, 0])]) for tracks in (position_m, log.truth_m)]
        found = gospa(*sets, log.cutoff_m, ORDER)
        rows.append((found.distance, found.localisation, found.missed, found.false, ospa(*sets, log.cutoff_m, ORDER)))
    return np.array(rows)


def _energies(estimate: Estimate, log: Log) -> Float64s:
    """Energy score [A, T] of the tracks assigned to the targets at each moment, as GOSPA assigns them; NaN where none is."""
    scored = np.flatnonzero(log.grid_s >= log.scored_from_s)
    out = np.full((len(log.truth_m), len(scored)), np.nan)
    if estimate.sample_m is None:
        return out
    for column, index in enumerate(scored):
        apart = np.linalg.norm(log.truth_m[:, None, index] - estimate.position_m[None, :, index], axis=-1)
        cost = np.minimum(np.nan_to_num(apart, nan=np.inf), log.cutoff_m)
        target, track = linear_sum_assignment(cost)
        is_near = cost[target, track] < log.cutoff_m
        target, track = target[is_near], track[is_near]
        samples = torch.from_numpy(estimate.sample_m[:, track, index])[None, :, :, None]  # [1, K, A, 1, 2]
        weight = torch.full((1, samples.shape[1]), 1.0 / samples.shape[1], dtype=torch.float64)
        truth = torch.from_numpy(log.truth_m[target, index])[None, :, None]
        out[target, column] = energy_score(samples, weight, truth, is_fair=True)[0, :, 0].numpy()
    return out


def label_scores(label: Int64s, origin: Int64s, is_scored: Bools) -> tuple[float, float]:
    """Share of labels that are right (names matched once a log), and of an agent's successive detections with one label."""
    name = _matched(label, origin)
    linked = []
    for agent in np.unique(origin):
        rows = np.flatnonzero((origin == agent) & is_scored)
        linked.append((label[rows][1:] == label[rows][:-1]) & (label[rows][1:] >= 0))
    return float((name == origin)[is_scored].mean()), float(np.concatenate(linked).mean())


def _matched(label: Int64s, origin: Int64s) -> Int64s:
    """Labels renamed to the agents that they overlap most with, one to one; -1 for what matches nobody."""
    table = np.zeros((int(label.max(initial=0)) + 1, int(origin.max()) + 1))
    np.add.at(table, (label[label >= 0], origin[label >= 0]), 1)
    rows, columns = linear_sum_assignment(-table)
    name = np.full(len(table) + 1, CLUTTER)
    name[rows] = columns
    return name[label]


def told(probability: Float64s, origin: Int64s) -> tuple[Float64s, Bools]:
    """P(detection -> agent) of every detection and agent, flat, and whether it came true; names as they overlap most."""
    table = np.stack([probability[origin == agent, :-1].sum(0) for agent in range(int(origin.max()) + 1)], axis=1)
    pairs = list(zip(*linear_sum_assignment(-table), strict=True))
    said = np.concatenate([probability[:, row] for row, _ in pairs])
    return said, np.concatenate([origin == column for _, column in pairs])


def calibration(said: Float64s, came: Float64s) -> list[dict[str, float]]:
    """How often what is said comes true, in five bins."""
    rows = []
    for low, high in itertools.pairwise((0.0, 0.1, 0.5, 0.9, 0.99, 1.0 + 1e-9)):
        inside = (said >= low) & (said < high)
        if inside.any():
            means = {"mean_said": said[inside].mean(), "came_true": came[inside].mean()}
            rows.append({"said_from": low, "said_to": min(high, 1.0), "num_cases": int(inside.sum()), **means})
    return rows
