"""The occupancy grid: how likely each place is to be visited."""

from dataclasses import dataclass

import numpy as np

from cadence.arrays import Float64s
from pipeline.export.playback import LiveAgent

_CELLS_OF_A_FUTURE = 96
_LEVELS = 128.0
"""Of probability: thirty hypotheses tell fewer apart, and what stands behind them is noise that takes room."""


@dataclass(frozen=True, eq=False)
class Occupancy:
    """Probability [H, W] of being visited by any agent; cell [0, 0] begins at (x_m, y_m), rows go north."""

    x_m: float
    y_m: float
    cell_m: float
    probability: Float64s


def future_occupancy(live: tuple[LiveAgent, ...], max_cells: int) -> Occupancy | None:
    """How likely each place is to be visited between the origin and the end of the future; None without a live agent.

    Cells are fine enough to show the future of an agent of middling reach, at most `max_cells` along the longer side.
    """
    futures = [agent.position_m[:, agent.window.origin_index :] for agent in live]
    if not futures:
        return None
    corners = np.concatenate([future.reshape(-1, 2) for future in futures])
    low, high = corners.min(axis=0), corners.max(axis=0)
    reach_m = float(np.median([np.ptp(future, axis=(0, 1)).max() for future in futures]))
    wanted_m = max(float(np.max(high - low)) / max(max_cells - 2, 1), reach_m / _CELLS_OF_A_FUTURE, 1e-5)
    # Powers of two: the same cells from window to window. Snapping to them may cost two cells.
    cell_m = 2.0 ** np.ceil(np.log2(wanted_m))
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
    probability = _levelled(np.clip(weight @ is_visited, 0.0, 1.0)).reshape(height, width)
    return Occupancy(float(first[0] * cell_m), float(first[1] * cell_m), float(cell_m), probability)


def _levelled(probability: Float64s) -> Float64s:
    """Rounded to levels; what is possible at all stays so."""
    level = np.maximum(np.round(probability * _LEVELS), 1.0) / _LEVELS
    return np.where(probability > 0.0, level, 0.0)


def _dense(track_m: Float64s, spacing_m: float) -> Float64s:
    """Tracks [K, F, 2] with points added on straight lines, at most about `spacing_m` apart (and 32 to a step)."""
    if track_m.shape[1] < 2:
        return track_m
    longest = float(np.max(np.linalg.norm(np.diff(track_m, axis=1), axis=-1)))
    parts = int(np.clip(np.ceil(longest / spacing_m), 1, 32))
    share = (np.arange(parts) / parts)[:, None]
    between = track_m[:, :-1, None] * (1.0 - share) + track_m[:, 1:, None] * share
    return np.concatenate([between.reshape(len(track_m), -1, 2), track_m[:, -1:]], axis=1)
