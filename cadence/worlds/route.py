"""Ways around obstacles: cheapest paths on a grid of 8 neighbours, smoothed, and motion along them with limited agility."""

import math
from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse import csgraph

from cadence.arrays import Bools, Float64s, Int32s
from cadence.worlds.terrain import Clearance

# Half of the 8 neighbours (row, column); the graph is undirected.
_NEIGHBOURS = ((0, 1), (1, 0), (1, 1), (1, -1))


@dataclass(frozen=True, eq=False)
class RouteGrid:
    """A grid of navigable cells joined to their 8 neighbours.

    is_free [H, W] cells that a path may use; row = y, column = x; the map's origin is in its middle
    """

    side_m: float
    cell_m: float
    is_free: Bools

    @classmethod
    def of(cls, clearance: Clearance, cell_m: float, keep_out_m: float) -> "RouteGrid":
        """Cells of about `cell_m` whose centre keeps `keep_out_m` of raster distance; only the largest connected water."""
        size = round(clearance.side_m / cell_m)
        cell_m = clearance.side_m / size
        axis = (np.arange(size) + 0.5) * cell_m - clearance.side_m / 2
        free = clearance.at_points(np.stack(np.meshgrid(axis, axis), axis=-1)) >= keep_out_m
        free[[0, -1]] = free[:, [0, -1]] = False  # tracks stay inside the map
        label, count = ndimage.label(free, structure=np.ones((3, 3)))
        if count == 0:
            raise ValueError("no navigable water: the obstacles and their keep-out cover the map")
        return cls(clearance.side_m, cell_m, label == 1 + np.argmax(np.bincount(label.ravel())[1:]))

    @property
    def centres_m(self) -> Float64s:
        """Centres [H, W, 2] of all cells."""
        axis = (np.arange(len(self.is_free)) + 0.5) * self.cell_m - self.side_m / 2
        return np.stack(np.meshgrid(axis, axis), axis=-1)

    def cell_of(self, position_m: Float64s) -> int:
        """Flat index of the free cell nearest to a point."""
        row, column = np.floor((position_m[::-1] + self.side_m / 2) / self.cell_m).astype(int).clip(0, len(self.is_free) - 1)
        if not self.is_free[row, column]:
            rows, columns = np.nonzero(self.is_free)
            nearest = np.argmin((rows - row) ** 2 + (columns - column) ** 2)
            row, column = rows[nearest], columns[nearest]
        return int(row * len(self.is_free) + column)

    def graph(self, cost: Float64s) -> sparse.csr_matrix:
        """The undirected graph of free cells; the length of an edge is metres times the mean `cost` [H, W] of its ends."""
        size = len(self.is_free)
        index = np.arange(size * size).reshape(size, size)
        tails, heads, lengths = [], [], []
        for down, right in _NEIGHBOURS:
            here = (slice(0, size - down), slice(max(-right, 0), size - max(right, 0)))
            there = (slice(down, size), slice(max(right, 0), size + min(right, 0)))
            both = self.is_free[here] & self.is_free[there]
            tails.append(index[here][both])
            heads.append(index[there][both])
            lengths.append(0.5 * (cost[here] + cost[there])[both] * self.cell_m * math.hypot(down, right))
        ends = (np.concatenate(tails), np.concatenate(heads))
        return sparse.csr_matrix((np.concatenate(lengths), ends), shape=(size * size, size * size))


@dataclass(frozen=True, eq=False)
class RouteField:
    """The cheapest way to one goal from everywhere (Dijkstra 1959): replanning after a detour costs nothing.

    With one goal and many starts this is cheaper than an A* search a start, and gives the same paths.
    """

    grid: RouteGrid
    goal_m: Float64s
    goal_cell: int
    next_cell: Int32s

    @classmethod
    def to(cls, grid: RouteGrid, graph: sparse.csr_matrix, goal_m: Float64s) -> "RouteField":
        """The field of `graph` (see `RouteGrid.graph`) towards the free cell nearest to `goal_m`."""
        goal = grid.cell_of(goal_m)
        _, previous = csgraph.dijkstra(graph, directed=False, indices=[goal], return_predecessors=True)
        return cls(grid, grid.centres_m.reshape(-1, 2)[goal], goal, previous[0])

    def path_from(self, position_m: Float64s) -> Float64s:
        """Cell centres [P, 2] from the cell of a point to the goal; the point itself is not part of it."""
        cells = [self.grid.cell_of(position_m)]
        while cells[-1] != self.goal_cell:
            cells.append(int(self.next_cell[cells[-1]]))
        rows, columns = np.divmod(cells, len(self.grid.is_free))
        return (np.stack([columns, rows], axis=-1) + 0.5) * self.grid.cell_m - self.grid.side_m / 2


def smooth_path(path_m: Float64s, clearance: Clearance, keep_out_m: float, sigma_cells: float = 3.0) -> Float64s:
    """A path [P, 2] of evenly spaced points without the corners of the grid, its ends kept.

    Points are averaged along the path. Around places where that would come nearer than `keep_out_m` to an obstacle (raster
    distance) the path fades into what it was; where even that does not help, it is returned as it was.
    """
    if len(path_m) < 3:
        return path_m
    average = ndimage.gaussian_filter1d(path_m, sigma_cells, axis=0, mode="nearest")
    to_end = np.minimum(np.arange(len(path_m)), np.arange(len(path_m))[::-1])
    share = np.minimum(to_end / (3 * sigma_cells), 1.0)
    for reach in (4, 8, 16):
        smoothed: Float64s = path_m + share[:, None] * (average - path_m)
        is_near = clearance.at_points(smoothed) < keep_out_m
        if not is_near.any():
            return smoothed
        around = ndimage.binary_dilation(is_near, iterations=reach)
        share = np.minimum(share, 1.0 - ndimage.gaussian_filter1d(around.astype(np.float64), reach / 3.0))
    return path_m


@dataclass(frozen=True)
class Agility:
    """What a craft can do: `max_turn_degps` at any speed, speed changes up to `max_accel_mps2`, `max_speed_mps`."""

    max_speed_mps: float
    max_accel_mps2: float
    max_turn_degps: float


@dataclass
class Craft:
    """A surface craft under way: the one mutable value of a simulation, stepped by `follow`.

    route_m is what it follows; `route_index` the next point of it. A craft never enters raster distances under
    `keep_out_m`: it turns or slows down for them, and stops where nothing else is left.
    """

    agility: Agility
    clearance: Clearance
    keep_out_m: float
    x_m: float
    y_m: float
    heading_rad: float
    speed_mps: float = 0.0
    route_m: Float64s = field(default_factory=lambda: np.zeros((0, 2)))
    route_index: int = 0

    @property
    def position_m(self) -> Float64s:
        """The present position [2]."""
        return np.array([self.x_m, self.y_m])

    @property
    def has_arrived(self) -> bool:
        """Whether the route is used up."""
        return self.route_index >= len(self.route_m)

    def take(self, route_m: Float64s) -> None:
        """Follow a new route from its beginning."""
        self.route_m, self.route_index = route_m, 0

    def follow(self, speed_mps: float, step_s: float, drift_rad: float = 0.0) -> None:
        """One step along the route at about `speed_mps`, or on along the heading where the route is used up.

        The heading turns towards the first point of the route that is further away than two steps (pure pursuit), plus
        `drift_rad`; turn and acceleration stay within `agility`, except in front of an obstacle.
        """
        wanted = self.heading_rad
        reach = max(2.0 * self.speed_mps * step_s, 150.0)
        while self.route_index < len(self.route_m):
            dx = float(self.route_m[self.route_index, 0]) - self.x_m
            dy = float(self.route_m[self.route_index, 1]) - self.y_m
            if dx * dx + dy * dy > reach * reach:
                wanted = math.atan2(dy, dx)
                break
            self.route_index += 1
        limit = math.radians(self.agility.max_turn_degps) * step_s
        turn = min(max(_wrap(wanted + drift_rad - self.heading_rad), -limit), limit)
        change = self.agility.max_accel_mps2 * step_s
        speed = min(max(min(speed_mps, self.agility.max_speed_mps), self.speed_mps - change), self.speed_mps + change)
        self._advance(speed, turn, limit, step_s)

    def _advance(self, speed: float, turn: float, limit: float, step_s: float) -> None:
        """Move with the turn nearest to the wanted one that keeps clear of obstacles; slower, then turning hard, as needed."""
        for factor, reach in ((1.0, limit), (0.6, limit), (0.3, math.pi)):
            for offset in (0.0, 0.2, -0.2, 0.45, -0.45, 0.8, -0.8, 1.3, -1.3, 2.0, -2.0, 3.0):
                candidate = turn + offset
                if offset and abs(candidate) > reach:
                    continue
                heading = self.heading_rad + candidate
                x = self.x_m + factor * speed * step_s * math.cos(heading)
                y = self.y_m + factor * speed * step_s * math.sin(heading)
                if self.clearance.at(x, y) >= self.keep_out_m:
                    self.x_m, self.y_m, self.heading_rad, self.speed_mps = x, y, _wrap(heading), factor * speed
                    return
        self.heading_rad, self.speed_mps = _wrap(self.heading_rad + turn), 0.0


def keep_out_for(clearance: Clearance, max_speed_mps: float, step_s: float) -> float:
    """The raster distance at which every *segment* of a track is clear of obstacles, not only its ends.

    Every point of a segment is within half its length of one end, so true distances above that half are enough.
    """
    return clearance.error_m + 0.5 * max_speed_mps * step_s + 1.0


def _wrap(angle: float) -> float:
    """The angle in -pi..pi."""
    return math.remainder(angle, 2 * math.pi)
