"""The place of the world "rendezvous": mountains, cover, goals, meeting sites, and the ways between them.

All of it is ours: the paper names several mountains, cover and a discrete set of goals and says nothing more. The place is
the same in every episode, so that a network can learn it.

Ways are the cheapest over a grid of 250 m where open ground costs more than cover, seen in one of twelve moods: fixed random
fields on the price, so that agents with the same aim take different ways. Dijkstra once a place and mood gives them from
everywhere.
"""

import functools
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from cadence.arrays import Bools, Float64s
from cadence.worlds.perlin import fractal
from cadence.worlds.route import RouteField, RouteGrid, smooth_path
from cadence.worlds.terrain import Clearance, Terrain, smooth_field, smooth_polygon

SIDE_M = 30000.0
GOALS_M = 1000.0 * np.array([[-12.5, 11.5], [2.8, 13.0], [13.0, 10.5], [12.8, -11.0], [3.0, -12.8], [-11.5, -12.0]])
SITES_M = 1000.0 * np.array([[-1.0, 5.5], [-4.8, -0.5], [5.5, 1.0], [2.8, -6.5], [10.5, 4.0], [-11.0, 1.0]])
PLACES_M = np.concatenate([GOALS_M, SITES_M])
"""Goals, then sites."""

NUM_MOODS = 12
MAX_STRIDE_M = 157.0
MAX_SHIFT_M = 250.0
SPOT_M = 150.0
"""How far beside its way an agent may walk, and how far from the middle of a place it may stop."""

_MASSIFS_M = 1000.0 * np.array([[-6.5, 5.5, 3.0], [5.0, 7.0, 2.8], [0.5, -1.0, 2.6], [-7.0, -6.0, 2.8], [7.5, -5.0, 3.0]])
_PEAKS_M = 1000.0 * np.array([[-1.0, -10.0, 1.5], [-0.5, 11.3, 1.2]])
_SEED = 20230402
_CELL_M, _RASTER_M = 250.0, 50.0
_OPEN_COST, _MOOD_STRENGTH, _MOOD_CELLS = 2.0, 1.5, 12.0


@dataclass(frozen=True, eq=False)
class Ground:
    """The place, prepared for planning; row = y, column = x, the origin is in the map's middle.

    cover     [120, 120] 0 (open) ... 1 (dense) of the grid's cells
    graphs    the grid's ways in every mood
    keep_m    raster distance to mountains that every node of a way keeps
    """

    terrain: Terrain
    cover: Float64s
    clearance: Clearance
    grid: RouteGrid
    graphs: tuple[sparse.csr_matrix, ...]
    keep_m: float

    def is_free(self, position_m: Float64s) -> Bools:
        """Whether points [..., 2] of the map lie in cells that ways may use."""
        column, row = np.moveaxis(np.floor((position_m + SIDE_M / 2) / _CELL_M).astype(np.int64), -1, 0)
        free: Bools = self.grid.is_free[row, column]
        return free


@functools.cache
def ground() -> Ground:
    """The place; made once a process."""
    rng = np.random.default_rng(_SEED)
    massifs = tuple(smooth_polygon(np.array([x, y]), radius, rng) for x, y, radius in _MASSIFS_M)
    terrain = Terrain(SIDE_M, _PEAKS_M, massifs)
    clearance = Clearance.of(terrain, _RASTER_M)
    # Every point of a way is within half a diagonal of a node, and every point of a stride within half a stride of the way.
    keep = clearance.error_m + 0.5 * np.hypot(_CELL_M, _CELL_M) + 0.5 * MAX_STRIDE_M + 1.0
    grid = RouteGrid.of(clearance, _CELL_M, keep + MAX_SHIFT_M)
    size = len(grid.is_free)
    axis = (np.arange(size) / 24.0).astype(np.float32)
    noise = fractal(axis, axis, octaves=4, persistence=0.5, lacunarity=2.0, period=64.0, base=17).astype(np.float64)
    cover = (noise - noise.min()) / (noise.max() - noise.min())
    price = 1.0 + _OPEN_COST * (1.0 - cover)
    moods = [np.exp(_MOOD_STRENGTH * smooth_field(rng, size, _MOOD_CELLS, octaves=2)) for _ in range(NUM_MOODS)]
    return Ground(terrain, cover, clearance, grid, tuple(grid.graph(price * mood) for mood in moods), keep)


@functools.cache
def _field(place: int, mood: int) -> RouteField:
    return RouteField.to(ground().grid, ground().graphs[mood], PLACES_M[place])


def way(start_m: Float64s, place: int, mood: int, end_m: Float64s, shift_m: Float64s) -> Float64s:
    """Points [P, 2] of the way from `start_m` to `end_m`, a spot at the place of that number (`PLACES_M`).

    The way is led beside the cheapest one by `shift_m` [2] (at most `MAX_SHIFT_M` long), except near its ends, and never
    nearer to a mountain than half a stride: a walk along it in strides of up to `MAX_STRIDE_M` touches none.
    """
    nodes = _field(place, mood).path_from(start_m)
    path = np.concatenate([[start_m], nodes[1:-1], [end_m]])
    to_end = np.minimum(np.arange(len(path)), np.arange(len(path))[::-1])
    path += np.minimum(to_end / 8.0, 1.0)[:, None] * shift_m
    return smooth_path(path, ground().clearance, ground().keep_m)
