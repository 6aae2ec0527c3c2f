"""The sea of the world "narco": coast, waves, and the ways over its cells.

The map is the authors': 71 by 32 cells of one degree, 145 to 74 degrees west and 12 degrees south to 20 north (the eastern
Pacific off Central America), taken as a plane of 7884.467 by 3538.368 km. Coverage is the significant wave height over 15,
0 on land; the wave charts, three hours (180 steps) apart, take turns, and every episode begins with the first.

Ours, because the authors' wave charts are not public: the coast is drawn from some forty points of it, so single cells may
differ from the authors' mask (like theirs it closes the Atlantic side); the waves are a fixed random field: a mean height
of 1.7 to 2.3 m in the open sea and half of it at the coast, under swell systems that travel to the north-east at the speed
of real swell.
"""

import functools
import math
from dataclasses import dataclass, field

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse import csgraph

from cadence.arrays import Bools, Float64s, Int64s

COLUMNS, ROWS = 71, 32
SIZE = np.array([COLUMNS * 111.32 * math.cos(math.radians(4.0)), ROWS * 110.574])
"""Width and height in kilometres."""

CELL = SIZE / [COLUMNS, ROWS]
STEPS_PER_CHART = 180
NUM_CHARTS = 25
_CHART_SEED = 20230101
_WEST, _SOUTH = -145.0, -12.0
_SNAP = 0.001
"""Share of a cell within which a point on a border belongs to the cell behind it, as in the authors' code."""

_SEARCHERS_WAVE_COST = 1000.0

_COAST = np.array(
    [
        [-105.7, 20.4], [-104.3, 19.05], [-102.2, 17.95], [-99.9, 16.85], [-97.1, 15.85], [-95.2, 16.17], [-93.8, 15.9],
        [-92.25, 14.55], [-90.8, 13.9], [-89.3, 13.48], [-87.7, 13.2], [-87.2, 12.5], [-85.9, 11.25], [-85.9, 10.35],
        [-85.1, 9.6], [-84.2, 9.4], [-83.7, 8.45], [-82.9, 8.05], [-80.9, 7.2], [-80.0, 7.5], [-79.5, 8.95], [-78.2, 8.2],
        [-77.9, 7.2], [-77.5, 5.5], [-77.3, 3.9], [-78.8, 1.8], [-79.7, 1.0], [-80.1, 0.6], [-80.5, -0.4], [-80.7, -0.95],
        [-81.0, -2.2], [-79.9, -2.9], [-80.3, -3.4], [-81.3, -4.7], [-81.1, -5.8], [-79.95, -6.8], [-79.1, -8.1],
        [-78.6, -9.1], [-77.6, -11.1], [-77.15, -12.05], [-73.0, -12.05], [-73.0, 21.0], [-105.7, 21.0],
    ]
)  # fmt: skip
_GALAPAGOS = np.array([[-91.4, -1.0], [-90.2, -1.0], [-90.2, 0.1], [-91.4, 0.1]])
"""Longitude and latitude in degrees."""


def _land() -> Bools:
    """Which cells [COLUMNS, ROWS] are land: their middles are, or no way over water leads there."""
    column, row = np.meshgrid(np.arange(COLUMNS), np.arange(ROWS), indexing="ij")
    ground = shapely.union_all([shapely.Polygon(_COAST), shapely.Polygon(_GALAPAGOS)])
    is_land = shapely.contains_xy(ground, column + 0.5 + _WEST, row + 0.5 + _SOUTH)
    label, _ = ndimage.label(~is_land)
    open_sea: Bools = label == np.argmax(np.bincount(label.ravel())[1:]) + 1
    return ~open_sea


def _waves(is_land: Bools) -> Float64s:
    """Wave heights [NUM_CHARTS, COLUMNS, ROWS] in metres; 0 on land."""
    rng = np.random.default_rng(_CHART_SEED)
    x, y = np.meshgrid((np.arange(COLUMNS) + 0.5) * CELL[0], (np.arange(ROWS) + 0.5) * CELL[1], indexing="ij")
    offshore = ndimage.distance_transform_edt(~is_land, sampling=CELL)
    mean = (2.36 - 0.62 * y / SIZE[1]) * (1.0 - 0.5 * np.exp(-offshore / 450.0))
    num_swells = 24
    length = np.exp(rng.uniform(np.log(1000.0), np.log(4000.0), num_swells))
    course = rng.normal(np.radians(45.0), np.radians(35.0), num_swells)
    phase = rng.uniform(0.0, 2 * np.pi, num_swells)
    # Swell of 12 s period travels in the open sea at about 34 km/h.
    hours = np.arange(NUM_CHARTS) * STEPS_PER_CHART / 60.0
    field = np.zeros((NUM_CHARTS, COLUMNS, ROWS))
    for wave, angle, start in zip(length, course, phase, strict=True):
        along = x * np.cos(angle) + y * np.sin(angle)
        field += np.cos(2 * np.pi * (along - 34.0 * hours[:, None, None]) / wave + start)
    height: Float64s = np.where(is_land, 0.0, mean * np.exp(0.22 * field * np.sqrt(2.0 / num_swells)))
    return height


@dataclass(frozen=True, eq=False)
class Ocean:
    """Sea and land, and what a world tells its searchers (see `Ground` in `cadence.worlds.pursuit`). Points in km.

    is_land  [COLUMNS, ROWS]
    wave     [NUM_CHARTS, COLUMNS, ROWS] significant wave height in metres
    """

    is_land: Bools
    wave: Float64s
    size: Float64s = field(default_factory=SIZE.copy)

    def cell_of(self, point: Float64s) -> Int64s:
        """Column and row of the cell that holds each point [..., 2]."""
        share = point / CELL
        near = np.rint(share)
        cell = np.where(np.abs(share - near) < _SNAP, near, np.floor(share)).astype(np.int64)
        return np.clip(cell, 0, [COLUMNS - 1, ROWS - 1])

    def coverage(self, point: Float64s, step: int) -> Float64s:
        """The coverage c [...] at points [..., 2]."""
        cell = self.cell_of(point)
        height: Float64s = self.wave[min(step // STEPS_PER_CHART, NUM_CHARTS - 1), cell[..., 0], cell[..., 1]]
        return height / 15.0

    def is_outside(self, point: Float64s) -> Bools:
        """Off the map, or within a kilometre of its edge."""
        outside: Bools = np.any((point < 1.0) | (point > self.size - 1.0), axis=-1)
        return outside

    def is_closed(self, point: Float64s) -> Bools:
        """On land."""
        cell = self.cell_of(point)
        closed: Bools = self.is_land[cell[..., 0], cell[..., 1]]
        return closed

    def ends_spiral(self, point: Float64s) -> Bools:
        """Off the map or on land."""
        return self.is_outside(point) | self.is_closed(point)

    def ends_line(self, point: Float64s, ahead: Float64s, speed: Float64s) -> Bools:
        """Within a full step of the edge, or before land."""
        edge: Bools = np.any((point <= speed[:, None]) | (point >= self.size - speed[:, None]), axis=-1)
        return np.logical_or(edge, self.is_closed(ahead))

    def settle(self, point: Float64s, heading: Float64s, otherwise: Float64s) -> Float64s:
        """A point on land moves on along its heading in steps of 10 km, 2000 km at most; failing that, `otherwise`."""
        settled = point.copy()
        dry = np.flatnonzero(self.is_closed(point))
        if len(dry):
            trial = point[dry, None] + heading[dry, None] * (10.0 * np.arange(1, 201))[:, None]
            fits: Bools = np.logical_not(self.ends_spiral(trial))
            first = trial[np.arange(len(dry)), fits.argmax(axis=1)]
            settled[dry] = np.where(np.any(fits, axis=1, keepdims=True), first, otherwise[dry])
        return settled

    def aim(self, position: Float64s, goal: Float64s) -> Float64s:
        """The goal where it lies in the same cell, else the corner of the next cell on the searchers' way to it."""
        here, there = self._node(self.cell_of(position)), self._node(self.cell_of(goal))
        onward = self.next_cell[there, here].astype(np.int64)
        corner = np.stack([onward // ROWS, onward % ROWS], axis=-1) * CELL
        return np.where(((here == there) | (onward < 0))[:, None], goal, corner)

    def move(self, position: Float64s, direction: Float64s, speed: Float64s) -> Float64s:
        """One step; nobody goes on land or off the map."""
        moved = position + direction * speed[:, None]
        moved = np.where(self.is_outside(moved)[:, None], np.clip(moved, 0.0, self.size - 1.0), moved)
        return np.where(self.is_closed(moved)[:, None], position, moved)

    def graph(self, wave_cost: float) -> sparse.csr_matrix:
        """Directed graph over all cells [column * ROWS + row]: a move costs its length and `wave_cost` times the waves.

        Moves go to the eight neighbours, to a diagonal one only where both cells beside the move are water; the waves are
        those of the first chart in the cell that is entered.
        """
        column, row = np.nonzero(~self.is_land)
        begins, ends, costs = [], [], []
        for dx, dy in [(1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (1, -1), (-1, 1), (-1, -1)]:
            is_open = self._is_water(column + dx, row + dy)
            is_open &= self._is_water(column + dx, row) & self._is_water(column, row + dy)
            x, y = column[is_open], row[is_open]
            begins.append(x * ROWS + y)
            ends.append((x + dx) * ROWS + y + dy)
            costs.append(math.hypot(dx, dy) + wave_cost * self.wave[0, x + dx, y + dy])
        arcs = (np.concatenate(costs), (np.concatenate(begins), np.concatenate(ends)))
        return sparse.csr_matrix(arcs, shape=(COLUMNS * ROWS, COLUMNS * ROWS))

    def way(self, start: Float64s, goal: Float64s, wave_cost: float) -> Float64s:
        """Way-points [P, 2] of the cheapest way between two points: start, corners of the cells between, goal."""
        first, last = (int(self._node(self.cell_of(point))) for point in (start, goal))
        before = csgraph.dijkstra(self.graph(wave_cost), indices=np.array([first]), return_predecessors=True)[1][0]
        nodes = []
        while last != first:
            if last < 0:
                raise ValueError(f"no way over water leads from {start} to {goal}")
            nodes.append(last)
            last = int(before[last])
        cells = np.array(nodes[::-1], dtype=np.int64).reshape(-1, 1)
        return np.concatenate([[start], np.concatenate([cells // ROWS, cells % ROWS], axis=1) * CELL, [goal]])

    @functools.cached_property
    def next_cell(self) -> NDArray[np.int16]:
        """[goal, here] the next cell on the searchers' cheapest way, -1 where there is none or it is reached."""
        water = np.flatnonzero(~self.is_land.ravel())
        onward = np.full((self.is_land.size, self.is_land.size), -1, dtype=np.int16)
        back = self.graph(_SEARCHERS_WAVE_COST).T.tocsr()
        before = csgraph.dijkstra(back, indices=water, return_predecessors=True)[1]
        onward[water] = np.maximum(before, -1)
        return onward

    def _is_water(self, column: Int64s, row: Int64s) -> Bools:
        inside: Bools = (column >= 0) & (column < COLUMNS) & (row >= 0) & (row < ROWS)
        wet: Bools = inside & ~self.is_land[np.clip(column, 0, COLUMNS - 1), np.clip(row, 0, ROWS - 1)]
        return wet

    @staticmethod
    def _node(cell: Int64s) -> Int64s:
        node: Int64s = cell[..., 0] * ROWS + cell[..., 1]
        return node


@functools.cache
def eastern_pacific() -> Ocean:
    """The sea of the world; the same for every caller."""
    is_land = _land()
    return Ocean(is_land, _waves(is_land))
