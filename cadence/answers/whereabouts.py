"""Where an agent was at a moment: areas that hold a stated share of belief, and the grid of its probability (POA).

The density is that of the stories' positions, each spread by a normal kernel as wide and as long as its neighbours lie: one
width for all would fill the space between two ways, or blur a thin cloud (manifold Parzen windows, Vincent and Bengio 2003).
An area is where the density exceeds that of all but 1 - level of the stories, each judged by the others alone, so that it holds
what it says whatever the width (the conformal rank of `cadence.metrics.calibration`).
"""

import itertools
from dataclasses import dataclass
from typing import Any

import contourpy
import numpy as np
import shapely

from cadence.answers.estimates import Probability, probability, wilson
from cadence.arrays import Float64s
from cadence.resampling import effective_number

LEVELS = (0.5, 0.9, 0.95)
_MAX_PAIRS = 4_000_000
_REACH = 4.0
"""The grid ends this many widths of a kernel beyond the outermost story."""
_FINE_CELLS = 400


@dataclass(frozen=True, eq=False)
class Grid:
    """Probability of area: cell (i, j) of probability [H, W] reaches from (west_m + j cell_m, south_m + i cell_m) one cell on.

    Rows go north. The cells sum to one.
    """

    west_m: float
    south_m: float
    cell_m: float
    probability: Float64s

    def __post_init__(self) -> None:
        if self.probability.ndim != 2 or not self.cell_m > 0:
            raise ValueError(f"Grid.probability has shape {self.probability.shape}, cells of {self.cell_m} m")

    @property
    def centres_m(self) -> tuple[Float64s, Float64s]:
        """Middles of the columns, x [W], and of the rows, y [H]."""
        num_rows, num_columns = self.probability.shape
        x = self.west_m + (np.arange(num_columns, dtype=np.float64) + 0.5) * self.cell_m
        y = self.south_m + (np.arange(num_rows, dtype=np.float64) + 0.5) * self.cell_m
        return x, y


@dataclass(frozen=True, eq=False)
class HoldingArea:
    """The densest area that holds `level` of the belief, a shapely geometry in metres, and its size.

    low_m2, high_m2  sizes at the ends of the 95 % Monte Carlo interval of the level
    """

    level: float
    shape: Any
    area_m2: float
    low_m2: float
    high_m2: float


@dataclass(frozen=True, eq=False)
class Whereabouts:
    """Where an agent was: how likely it is part of the story at that time, areas by level, and the grid.

    centre_m  the story in the middle of all: the one nearest to the others in the mean; a mean may lie where nobody is
    spread_m  weighted mean distance to it
    """

    presence: Probability
    areas: tuple[HoldingArea, ...]
    grid: Grid
    centre_m: tuple[float, float]
    spread_m: float


def whereabouts(
    position_m: Float64s, weight: Float64s, levels: tuple[float, ...] = LEVELS, num_cells: int = 192, floor_m: float = 0.1
) -> Whereabouts:
    """Where an agent is whose stories have positions [K, 2] (NaN: it is not there) and weights [K].

    Args:
        position_m: of the stories, metres.
        weight: of the stories.
        levels: shares of belief that areas are to hold.
        num_cells: cells along the longer side of the grid.
        floor_m: least width of a kernel, metres: stories that agree to the millimetre are no more certain than that.

    Returns:
        Areas, grid and middle; ValueError where no story has the agent.
    """
    is_there = np.isfinite(position_m).all(axis=1) & (weight > 0)
    presence = probability(weight, is_there)
    if not is_there.any():
        raise ValueError("no story has the agent at that time")
    point, share = position_m[is_there], weight[is_there] / weight[is_there].sum()
    cloud, num = _Cloud(point, share, _kernels(point, floor_m)), effective_number(share)
    fine = _Map.of(cloud, floor_m, max(num_cells, _FINE_CELLS))
    areas = []
    for level in levels:
        low, high = wilson(level, num)
        shapes = [fine.denser_than(_threshold(fine.others, share, at, num)) for at in (level, low, high)]
        sizes = [float(shape.area) for shape in shapes]
        areas.append(HoldingArea(level, shapes[0], *sizes))
    middle, spread_m = medoid(point, share)
    return Whereabouts(
        presence, tuple(areas), _grid(cloud, num_cells), (float(point[middle, 0]), float(point[middle, 1])), spread_m
    )


def medoid(point: Float64s, weight: Float64s) -> tuple[int, float]:
    """Which of the points [K, 2] is nearest to the others in the weighted mean, and that mean distance."""
    rows = max(1, _MAX_PAIRS // len(point))
    parts = [point[first : first + rows] for first in range(0, len(point), rows)]
    distance = np.concatenate([np.hypot(*(part[:, None] - point).transpose(2, 0, 1)) @ weight for part in parts])
    middle = int(distance.argmin())
    return middle, float(distance[middle] / weight.sum())


def _threshold(density: Float64s, weight: Float64s, level: float, num: float) -> float:
    """The density that `level` of the stories exceed, the truth counted as one more of `num` of them."""
    order = np.argsort(-density)
    held = np.cumsum(weight[order]) * num / (num + 1.0)
    place = int(np.searchsorted(held, level))
    # beyond the last story lies as much as the truth weighs: there the area is a little larger than all of them
    return float(density[order[place]]) if place < len(order) else 0.5 * float(density.min())


@dataclass(frozen=True, eq=False)
class _Cloud:
    """Points [K, 2] of weights [K] that sum to one, each spread by a kernel of covariance [K, 2, 2]."""

    point: Float64s
    weight: Float64s
    covariance: Float64s

    def spread(self, more: Float64s) -> "_Cloud":
        """The same with a covariance [2, 2] added to each kernel."""
        return _Cloud(self.point, self.weight, self.covariance + more)

    def ends(self, axes: Float64s) -> tuple[Float64s, Float64s]:
        """Lowest and highest coordinates [2] along axes (columns [2, 2]) that kernels reach."""
        place = self.point @ axes
        reach = _REACH * np.sqrt(np.einsum("as,kab,bs->ks", axes, self.covariance, axes))
        return (place - reach).min(axis=0), (place + reach).max(axis=0)

    def on_grid(self, low: Float64s, cell: Float64s, shape: tuple[int, int], axes: Float64s) -> Float64s:
        """Density [H, W] at the middles of cells: column j and row i begin at low + (j, i) * cell, along `axes`."""
        place = self.point @ axes
        covariance = axes.T @ self.covariance @ axes
        precision, height = np.linalg.inv(covariance), self.weight * _heights(covariance)
        reach = 6.0 * np.sqrt(np.stack([covariance[:, 0, 0], covariance[:, 1, 1]], axis=1))
        first = np.clip(np.floor((place - reach - low) / cell), 0, shape[::-1]).astype(int)
        last = np.clip(np.ceil((place + reach - low) / cell), 0, shape[::-1]).astype(int)
        density = np.zeros(shape)
        for k, ((left, below), (right, above)) in enumerate(zip(first.tolist(), last.tolist(), strict=True)):
            dx = low[0] + (np.arange(left, right) + 0.5) * cell[0] - place[k, 0]
            dy = (low[1] + (np.arange(below, above) + 0.5) * cell[1] - place[k, 1])[:, None]
            (a, b), (_, d) = precision[k]
            density[below:above, left:right] += height[k] * np.exp(-0.5 * (a * dx * dx + 2.0 * b * dx * dy + d * dy * dy))
        return density

    def left_out(self, place: Float64s) -> Float64s:
        """Density [K] at a place for each point [K, 2], by the others alone; by the only one where there is one."""
        precision, height = np.linalg.inv(self.covariance), self.weight * _heights(self.covariance)
        found = np.empty(len(place))
        rows = max(1, _MAX_PAIRS // len(self.point))
        for first in range(0, len(place), rows):
            part = slice(first, first + rows)
            delta = place[part, None] - self.point
            exponent = np.einsum("nks,kst,nkt->nk", delta, precision, delta)
            density = np.exp(-0.5 * exponent) * height
            if len(self.point) > 1:
                own = np.arange(len(density))
                density[own, first + own] = 0.0
            found[part] = density.sum(axis=1)
        return found / (1.0 - self.weight if len(self.point) > 1 else 1.0)


@dataclass(frozen=True, eq=False)
class _Map:
    """Density [H, W] on a fine grid along the cloud's own axes: a thin cloud needs cells as thin as it is.

    threshold densities come from the stories, each moved by about a cell, so that what is narrower than a cell counts as that.
    """

    low: Float64s
    cell: Float64s
    axes: Float64s
    density: Float64s
    others: Float64s

    @staticmethod
    def of(cloud: _Cloud, floor_m: float, num_cells: int) -> "_Map":
        centred = cloud.point - cloud.weight @ cloud.point
        axes = np.linalg.eigh((centred * cloud.weight[:, None]).T @ centred)[1]
        low, high = cloud.ends(axes)
        cell = (high - low) / num_cells
        least = floor_m**2 * np.eye(2) + axes @ np.diag(cell**2) @ axes.T
        wide = cloud.spread(least)
        low, high = wide.ends(axes)
        shape = (num_cells + 16, num_cells + 16)
        cell = (high - low) / np.array(shape[::-1])
        moved = cloud.point + _normal_places(len(cloud.point)) @ np.linalg.cholesky(least).T
        return _Map(low, cell, axes, wide.on_grid(low, cell, shape, axes), wide.left_out(moved))

    def denser_than(self, threshold: float) -> Any:
        """Where the density is at least `threshold`: polygons in metres."""
        x, y = (self.low[axis] + (np.arange(self.density.shape[1 - axis]) + 0.5) * self.cell[axis] for axis in (0, 1))
        contours = contourpy.contour_generator(x, y, self.density, fill_type=contourpy.FillType.OuterOffset)
        polygons = []
        for points, offsets in zip(*contours.filled(threshold, np.inf), strict=True):
            rings = [points[first:last] @ self.axes.T for first, last in itertools.pairwise(offsets.tolist())]
            polygons.append(shapely.Polygon(rings[0], rings[1:]))
        return shapely.union_all(shapely.make_valid(np.array(polygons, dtype=object)))


def _normal_places(num: int) -> Float64s:
    """Places [num, 2] spread evenly over a standard normal: radii by rank, angles by the golden section, in no order."""
    rank = (np.arange(num) * 0.6180339887498949 + 0.5) % 1.0
    radius, angle = (
        np.sqrt(-2.0 * np.log1p(-np.clip(rank, 0.0, 1.0 - 1e-6))),
        2.399963229728653 * np.arange(num) ** 2 % (2 * np.pi),
    )
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def _heights(covariance: Float64s) -> Float64s:
    """Density of normal kernels [K, 2, 2] at their middles [K]."""
    height: Float64s = 1.0 / (2.0 * np.pi * np.sqrt(np.linalg.det(covariance)))
    return height


def _grid(cloud: _Cloud, num_cells: int) -> Grid:
    """Probability on a grid of square cells, north up."""
    low, high = cloud.ends(np.eye(2))
    cell_m = float((high - low).max()) / num_cells
    low = low - cell_m
    num_columns, num_rows = (np.ceil((high + cell_m - low) / cell_m).astype(int)).tolist()
    # a kernel narrower than a cell would fall between the cells' middles
    wide = cloud.spread((0.6 * cell_m) ** 2 * np.eye(2))
    mass = wide.on_grid(low, np.full(2, cell_m), (num_rows, num_columns), np.eye(2))
    return Grid(float(low[0]), float(low[1]), cell_m, mass / mass.sum())


def _kernels(point: Float64s, floor_m: float) -> Float64s:
    """Covariances [K, 2, 2] of the kernels of points [K, 2]: half that of the sixth of all points that lie nearest."""
    num = len(point)
    floor = floor_m**2 * np.eye(2)
    if num < 3:
        return np.tile(floor, (num, 1, 1))
    num_near = min(num, max(6, num // 6))
    found = np.empty((num, 2, 2))
    rows = max(1, _MAX_PAIRS // num)
    for first in range(0, num, rows):
        delta = point[None] - point[first : first + rows, None]
        near = np.argpartition((delta * delta).sum(-1), num_near - 1, axis=1)[:, :num_near]
        chosen = np.take_along_axis(delta, near[..., None], axis=1)
        found[first : first + rows] = np.einsum("nks,nkt->nst", chosen, chosen) / num_near
    return 0.5 * found + floor
