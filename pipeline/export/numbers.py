"""Numbers that describe weighted hypotheses: spread, agreement, modes, envelopes, occupancy."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from pipeline.arrays import Float64s

if TYPE_CHECKING:
    from pipeline.export.playback import LiveAgent


_MODE_SHARE = 0.1
"""Smaller groups of hypotheses are stragglers, not modes."""


@dataclass(frozen=True, eq=False)
class Occupancy:
    """Probability [H, W] of being visited by any agent; cell [0, 0] begins at (x_m, y_m), rows go north."""

    x_m: float
    y_m: float
    cell_m: float
    probability: Float64s


def spread_m(position_m: Float64s, weight: Float64s) -> float:
    """Root mean square distance of positions [K, 2] to their weighted mean."""
    return float(np.sqrt(weight @ np.sum((position_m - weight @ position_m) ** 2, axis=-1)))


def covariance_m2(position_m: Float64s, weight: Float64s) -> Float64s:
    """Weighted covariance [2, 2] of positions [K, 2]."""
    away = position_m - weight @ position_m
    return np.asarray(np.einsum("k,ki,kj->ij", weight, away, away))


def speed_mps(live: "LiveAgent", time_ns: int) -> float:
    """Weighted mean of the hypotheses' speeds in the step around a time; 0 without a second step."""
    window = live.window
    if window.num_steps < 2:
        return 0.0
    step = window.origin_index + (time_ns - window.origin_ns) // window.step_ns
    low = int(np.clip(step, 0, window.num_steps - 2))
    moved = np.linalg.norm(live.position_m[:, low + 1] - live.position_m[:, low], axis=-1)
    return float(live.weight @ moved) / (window.step_ns * 1e-9)


def weight_entropy(weight: Float64s) -> float:
    """Entropy of weights [K] over its largest value: 1 where all count the same, 0 where only one counts."""
    positive = weight[weight > 0]
    if len(weight) < 2:
        return 0.0
    return float(np.clip(-(positive @ np.log(positive)) / np.log(len(weight)), 0.0, 1.0))


def entropy_bits(probability: Float64s) -> float:
    """Entropy of probabilities [N] in bits: 0 where one is certain, 1 for a coin."""
    positive = probability[probability > 0]
    return max(float(-(positive @ np.log2(positive))), 0.0) if len(positive) else 0.0


def count_modes(position_m: Float64s, weight: Float64s) -> int:
    """Separate groups among positions [K, 2]: links up to three typical distances between neighbours, a tenth of the weight."""
    if len(position_m) < 3:
        return len(position_m) if len(position_m) < 2 else 1
    distance = np.linalg.norm(position_m[:, None] - position_m[None], axis=-1)
    # The distance to the third neighbour: pairs that happen to lie close say little about the density.
    neighbour = np.sort(distance, axis=1)[:, min(3, len(distance) - 1)]
    _, group = connected_components(csr_array(distance <= 3.0 * np.median(neighbour)), directed=False)
    return int(np.count_nonzero(np.bincount(group, weights=weight) >= _MODE_SHARE))


def weighted_quantile(value: Float64s, weight: Float64s, share: float) -> Float64s:
    """The smallest of the values [K, ...] below or at which lies at least `share` of the weight [K]."""
    order = np.argsort(value, axis=0, kind="stable")
    below = np.cumsum(weight[order], axis=0)
    index = np.argmax(below >= share - 1e-9, axis=0)
    return np.asarray(np.take_along_axis(np.take_along_axis(value, order, 0), index[None], 0)[0])


def future_occupancy(live: tuple["LiveAgent", ...], max_cells: int) -> Occupancy | None:
    """How likely each place is to be visited between the origin and the end of the future; None without a live agent."""
    futures = [agent.position_m[:, agent.window.origin_index :] for agent in live]
    if not futures:
        return None
    corners = np.concatenate([future.reshape(-1, 2) for future in futures])
    low, high = corners.min(axis=0), corners.max(axis=0)
    # Powers of two: the same cells from window to window. Snapping to them may cost two cells.
    cell_m = 2.0 ** np.ceil(np.log2(max(float(np.max(high - low)), 1e-3) / max(max_cells - 2, 1)))
    first = np.floor(low / cell_m).astype(np.int64)
    width, height = (np.floor(high / cell_m).astype(np.int64) - first + 1).tolist()
    rows = max(len(agent.window.weight) for agent in live)
    is_visited = np.zeros((rows, height * width), dtype=bool)
    for agent, future in zip(live, futures, strict=True):
        column, row = np.moveaxis(np.floor(_dense(future, cell_m / 2.0) / cell_m).astype(np.int64) - first, -1, 0)
        is_visited[agent.hypothesis[:, None], row * width + column] = True
    weight = np.zeros(rows)
    for agent in live:  # windows of one origin may differ in their hypotheses
        # An agent that is part of some hypotheses only has their weights among all of them.
        share = agent.weight if agent.agent.probability is None else agent.window.weight[agent.hypothesis]
        weight[agent.hypothesis] = np.maximum(weight[agent.hypothesis], share)
    probability = np.clip(weight @ is_visited, 0.0, 1.0).reshape(height, width)
    return Occupancy(float(first[0] * cell_m), float(first[1] * cell_m), float(cell_m), probability)


def _dense(track_m: Float64s, spacing_m: float) -> Float64s:
    """Tracks [K, F, 2] with points added on straight lines, at most about `spacing_m` apart (and 32 to a step)."""
    if track_m.shape[1] < 2:
        return track_m
    longest = float(np.max(np.linalg.norm(np.diff(track_m, axis=1), axis=-1)))
    parts = int(np.clip(np.ceil(longest / spacing_m), 1, 32))
    share = (np.arange(parts) / parts)[:, None]
    between = track_m[:, :-1, None] * (1.0 - share) + track_m[:, 1:, None] * share
    return np.concatenate([between.reshape(len(track_m), -1, 2), track_m[:, -1:]], axis=1)
