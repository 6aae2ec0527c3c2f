"""Areas, and exactly when straight lines between two steps are inside them: a line can cross an area between two steps.

A line is cut where it crosses the area's border, and each piece is inside or outside as its middle is. That holds for circles,
polygons with holes, and several polygons, and there is no step length to choose.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import shapely

from cadence.arrays import Bools, Float64s, Indices


class Area(Protocol):
    """A closed part of the plane."""

    @property
    def bounds_m(self) -> tuple[float, float, float, float]:
        """West, south, east and north end, metres."""

    @property
    def area_m2(self) -> float:
        """Its size."""

    def holds(self, position_m: Float64s) -> Bools:
        """Which positions [N, 2] lie in it."""

    def crossings(self, start_m: Float64s, end_m: Float64s) -> tuple[Indices, Float64s]:
        """Where lines from start to end [N, 2] meet its border: which line [C], and at which share of its length [C]."""


@dataclass(frozen=True)
class Disc:
    """All places within radius_m of a centre (x, y)."""

    centre_m: tuple[float, float]
    radius_m: float

    def __post_init__(self) -> None:
        if not np.isfinite(self.centre_m).all() or not 0 < self.radius_m < np.inf:
            raise ValueError(f"Disc: centre {self.centre_m} and radius {self.radius_m} must be finite, the radius above zero")

    @property
    def bounds_m(self) -> tuple[float, float, float, float]:
        """West, south, east and north end, metres."""
        (x, y), r = self.centre_m, self.radius_m
        return x - r, y - r, x + r, y + r

    @property
    def area_m2(self) -> float:
        """Its size."""
        return float(np.pi * self.radius_m**2)

    def holds(self, position_m: Float64s) -> Bools:
        """Which positions [N, 2] lie in it."""
        offset = position_m - np.array(self.centre_m)
        held: Bools = np.hypot(offset[:, 0], offset[:, 1]) <= self.radius_m
        return held

    def crossings(self, start_m: Float64s, end_m: Float64s) -> tuple[Indices, Float64s]:
        """Where lines from start to end [N, 2] meet its border: which line [C], and at which share of its length [C]."""
        offset, along = start_m - np.array(self.centre_m), end_m - start_m
        squared = (along * along).sum(1)
        # the foot of the centre on the line, and half a chord: no difference of large squares
        with np.errstate(divide="ignore", invalid="ignore"):
            foot = -(offset * along).sum(1) / squared
            nearest = offset[:, 0] * along[:, 1] - offset[:, 1] * along[:, 0]
            half = np.sqrt(self.radius_m**2 * squared - nearest**2) / squared
        shares = np.stack([foot - half, foot + half], axis=1)
        with np.errstate(invalid="ignore"):
            line, side = np.nonzero((shares > 0) & (shares < 1))
        return line, shares[line, side]


@dataclass(frozen=True, eq=False)
class Region:
    """Polygons, with holes or without: `shape` is a valid shapely polygon or collection of polygons, in metres."""

    shape: Any

    def __post_init__(self) -> None:
        if self.shape.geom_type not in ("Polygon", "MultiPolygon") or self.shape.is_empty:
            raise ValueError(f"Region: expected polygons, got {self.shape.geom_type.lower()}")
        if not self.shape.is_valid:
            raise ValueError(f"Region: {shapely.is_valid_reason(self.shape)}")
        shapely.prepare(self.shape)

    @property
    def bounds_m(self) -> tuple[float, float, float, float]:
        """West, south, east and north end, metres."""
        west, south, east, north = self.shape.bounds
        return west, south, east, north

    @property
    def area_m2(self) -> float:
        """Its size."""
        return float(self.shape.area)

    def holds(self, position_m: Float64s) -> Bools:
        """Which positions [N, 2] lie in it."""
        held: Bools = shapely.intersects_xy(self.shape, position_m[:, 0], position_m[:, 1])
        return held

    def crossings(self, start_m: Float64s, end_m: Float64s) -> tuple[Indices, Float64s]:
        """Where lines from start to end [N, 2] meet its border: which line [C], and at which share of its length [C]."""
        return self._border.crossings(start_m, end_m)[:2]

    @cached_property
    def _border(self) -> "Path":
        rings = [ring for part in shapely.get_parts(self.shape) for ring in (part.exterior, *part.interiors)]
        return Path.of([np.asarray(ring.coords)[:, :2] for ring in rings])


@dataclass(frozen=True, eq=False)
class Path:
    """A broken line, or several: edges from start_m to end_m [E, 2] each, metres."""

    start_m: Float64s
    end_m: Float64s

    @staticmethod
    def of(lines_m: list[Float64s]) -> "Path":
        """The edges of lines through points [V, 2]; ValueError where there is none of any length."""
        start, end = (np.concatenate([line[part] for line in lines_m]) for part in (slice(None, -1), slice(1, None)))
        is_long = (start != end).any(axis=1)
        if not is_long.any():
            raise ValueError("a line needs two different points")
        return Path(start[is_long], end[is_long])

    @property
    def length_m(self) -> float:
        """Length of all edges."""
        return float(self._edge_m.sum())

    def crossings(self, start_m: Float64s, end_m: Float64s) -> tuple[Indices, Float64s, Indices, Float64s]:
        """Where lines from start to end [N, 2] meet it.

        Returns, for every crossing [C]: which line, at which share of its length, which edge, and at which share of that.
        Lines along an edge have none.
        """
        line, edge = self._tree.query(shapely.linestrings(np.stack([start_m, end_m], axis=1)), predicate=None)
        along, edge_along = end_m[line] - start_m[line], self.end_m[edge] - self.start_m[edge]
        apart = self.start_m[edge] - start_m[line]
        turn = _cross(along, edge_along)
        with np.errstate(divide="ignore", invalid="ignore"):
            share, edge_share = _cross(apart, edge_along) / turn, _cross(apart, along) / turn
        meets = (turn != 0) & (share >= 0) & (share <= 1) & (edge_share >= 0) & (edge_share <= 1)
        return line[meets], share[meets], edge[meets], edge_share[meets]

    def along_m(self, edge: Indices, share: Float64s) -> Float64s:
        """Metres from the beginning [C] at shares of edges [C]."""
        before: Float64s = (np.cumsum(self._edge_m) - self._edge_m)[edge] + share * self._edge_m[edge]
        return before

    @cached_property
    def _edge_m(self) -> Float64s:
        lengths: Float64s = np.hypot(*(self.end_m - self.start_m).T)
        return lengths

    @cached_property
    def _tree(self) -> shapely.STRtree:
        return shapely.STRtree(shapely.linestrings(np.stack([self.start_m, self.end_m], axis=1)))


def pieces_inside(start_m: Float64s, end_m: Float64s, area: Area) -> tuple[Indices, Float64s, Float64s]:
    """The parts of lines from start to end [N, 2] that lie in `area`.

    Returns, for every piece [P], in the order of lines and along them: which line, and from which to which share of it.
    """
    west, south, east, north = area.bounds_m
    low, high = np.minimum(start_m, end_m), np.maximum(start_m, end_m)
    is_near = (low[:, 0] <= east) & (high[:, 0] >= west) & (low[:, 1] <= north) & (high[:, 1] >= south)
    near = np.flatnonzero(is_near)
    line, share = area.crossings(start_m[near], end_m[near])
    lines = np.concatenate([np.arange(len(near)), line, np.arange(len(near))])
    shares = np.concatenate([np.zeros(len(near)), share, np.ones(len(near))])
    order = np.lexsort((shares, lines))
    lines, shares = lines[order], shares[order]
    is_piece = (lines[1:] == lines[:-1]) & (shares[1:] > shares[:-1])
    piece, first, last = lines[:-1][is_piece], shares[:-1][is_piece], shares[1:][is_piece]
    begin, end = start_m[near[piece]], end_m[near[piece]]
    is_inside = area.holds(begin + 0.5 * (first + last)[:, None] * (end - begin))
    return near[piece[is_inside]], first[is_inside], last[is_inside]


def _cross(one: Float64s, other: Float64s) -> Float64s:
    crossed: Float64s = one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]
    return crossed
