"""Ways around obstacles: the grown obstacles as a zone, and shortest routes along its corners (a visibility graph).

Everything is planned against two growths of the obstacles: routes must not touch the `core` (obstacles plus margin), and
their waypoints are corners of the `outline` (a little larger), so that rounding never decides whether a route is free.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import shapely

from cadence.arrays import Bools, Float64s, Indices, Objects
from cadence.constraints.obstacles import Obstacles
from cadence.constraints.outlines import convex_bends, cross, grow_round, grow_sharp, loose_bends, polygon_parts

_Parts = frozenset[int]
"""Components of the outline."""
_Box = tuple[float, int, int]
"""A part of the world: half its side in metres, and its middle in units of that."""

_MAX_BENDS = 160
"""Corners that take part in one search; where there are more, outlines are simplified, outwards."""
_REACHES = (1.0, 4.0, 32.0)
"""Where no route is found near the components in the way, one is sought farther out."""
MAX_CORNERS = 24
"""The most corners of one route."""
_CHUNK = 4_000_000
"""Ways over a corner that are compared at once."""
_FEW_SHAPES = 64
"""Up to here, comparing boxes one shape after the other is quicker than a search tree."""


@dataclass(frozen=True)
class Growth:
    """How far the core and the outline lie from the obstacles, and how finely circles are drawn."""

    margin_m: float
    clearance_m: float
    core_sides: int = 64
    outline_sides: int = 12


@dataclass(frozen=True, eq=False)
class Request:
    """One route to find: from start to end [2] with at most max_waypoints corners; every corner costs hop_cost_m extra.

    parts are the components in the way; barrier, when given, is a segment [2, 2] that the route must not cross.
    """

    start: Float64s
    end: Float64s
    max_waypoints: int
    hop_cost_m: float
    parts: tuple[int, ...]
    barrier: Float64s | None = None


class Zone:
    """The grown obstacles: which points and segments are free, where the nearest free point is, which way leads around."""

    def __init__(self, obstacles: Obstacles, growth: Growth) -> None:
        self.growth = growth
        outer = growth.margin_m + growth.clearance_m
        self.core = _Index(polygon_parts(grow_round(obstacles, growth.margin_m, growth.core_sides)))
        # The corners of round cores stick out by 1 / cos: the outline has to stay clear of them.
        stretch = 2 / np.cos(np.pi / growth.core_sides) - 1
        self.outline = _Index(polygon_parts(grow_sharp(obstacles, outer, growth.outline_sides, stretch)))
        holes = [shapely.Polygon(ring) for part in self.core.shapes for ring in part.interiors]
        # Largest first, so that the innermost of nested holes names the region.
        self.holes = _Index(np.array(sorted(holes, key=lambda hole: -hole.area), dtype=object))
        self._known_shapes: dict[tuple[int, int], Any] = {}
        self._known_bends: dict[tuple[int, int], Float64s] = {}
        self._graphs: dict[_Parts | _Box, _Graph] = {}

    def near(self, low: Float64s, high: Float64s) -> Indices:
        """Indices of the boxes from low to high [N, 2] that meet the box of a component."""
        boxes = shapely.box(low[:, 0], low[:, 1], high[:, 0], high[:, 1])
        return np.unique(self.core.tree.query(boxes)[0])

    def size(self, part: int) -> float:
        """Diagonal in metres of the box of a component of the outline."""
        west, south, east, north = shapely.bounds(self.outline.shapes[part])
        return float(np.hypot(east - west, north - south))

    def hits(self, start: Float64s, end: Float64s) -> Indices:
        """For segments from start to end [N, 2], a component of the outline in the way [N]; -1 where the core is clear."""
        found = np.full(len(start), -1)
        near = self.core.may_touch(np.minimum(start, end), np.maximum(start, end))
        segment, part = self.core.touching(shapely.linestrings(np.stack([start[near], end[near]], axis=1)))
        found[near[segment]] = self._outline_of_core[part]
        return found

    def blocks(self, start: Float64s, end: Float64s) -> Bools:
        """Whether the core touches segments from start to end [..., 2]; the quick form of `hits`."""
        blocked = np.zeros(start.shape[:-1], dtype=bool)
        start, end = start.reshape(-1, 2), end.reshape(-1, 2)
        near = self.core.may_touch(np.minimum(start, end), np.maximum(start, end))
        lines = shapely.linestrings(np.stack([start[near], end[near]], axis=1))
        blocked.reshape(-1)[near] = shapely.intersects(self._whole, lines)
        return blocked

    def regions(self, point: Float64s) -> Indices:
        """The region of free space of points [N, 2]: 0 outside everything, 1 + hole inside a hole, -1 in the core."""
        region = np.zeros(len(point), dtype=np.intp)
        near = self.core.may_touch(point, point)  # holes lie in the core's boxes as well
        points = shapely.points(point[near])
        index, hole = self.holes.touching(points)
        order = np.argsort(hole, kind="stable")
        region[near[index[order]]] = 1 + hole[order]
        region[near[self.core.touching(points)[0]]] = -1
        return region

    def exits(self, point: Float64s, region: int) -> Float64s | None:
        """The points on the outline [N, 2] nearest to `point` [N, 2] in a region of free space; None where it has no border."""
        border = self._borders.get(region)
        if border is None:
            return None
        lines = shapely.shortest_line(border, shapely.points(point))
        nearest: Float64s = shapely.get_coordinates(lines).reshape(-1, 2, 2)[:, 0]
        return nearest

    def hull_holds(self, part: int, point: Float64s) -> bool:
        """Whether all points [N, 2] lie in the convex hull of a component of the outline."""
        return bool(shapely.intersects_xy(self._hulls[part], point[:, 0], point[:, 1]).all())

    def routes(self, requests: Sequence[Request]) -> list[Float64s | None]:
        """The shortest route of each request as its waypoints [m, 2] (start and end left out); None where there is none."""
        found: list[Float64s | None] = [None] * len(requests)
        for reach in _REACHES:
            groups: dict[_Parts | _Box, list[int]] = {}
            for index, request in enumerate(requests):
                if found[index] is None:
                    parts = self._neighbourhood(request.parts, reach)
                    is_simple = sum(len(self._bends(part, 0)) for part in parts) <= _MAX_BENDS
                    groups.setdefault(parts if is_simple else self._box(request, reach), []).append(index)
            for key, members in groups.items():
                graph = self._graph(key)
                for index, route in zip(members, graph.search(self, [requests[m] for m in members]), strict=True):
                    found[index] = route
        return found

    def _neighbourhood(self, parts: tuple[int, ...], reach: float) -> "_Parts":
        """The components in the way and those no farther from them than a quarter of `reach` times their size."""
        near = set(parts)
        for part in parts:
            west, south, east, north = shapely.bounds(self.outline.shapes[part])
            far = 0.25 * reach * self.size(part)
            near.update(self.outline.tree.query(shapely.box(west - far, south - far, east + far, north + far)).tolist())
        return frozenset(near)

    def _box(self, request: Request, reach: float) -> "_Box":
        """A box about the ends of a request; rounded, so that requests that are near each other share it."""
        ends = np.stack([request.start, request.end])
        span = float(np.hypot(*(ends[1] - ends[0]))) + self.growth.clearance_m
        size = max([span, *(min(self.size(part), 4 * span) for part in request.parts)])
        side = reach * 2.0 ** float(np.ceil(np.log2(size)))
        column, row = np.round(ends.mean(axis=0) / side).tolist()
        return side, int(column), int(row)

    def _graph(self, key: "_Parts | _Box") -> "_Graph":
        if key not in self._graphs:
            if isinstance(key, frozenset):
                bends = _joined(self._bends(part, 0) for part in sorted(key))
            else:
                bends = self._local_bends(key)
            bends = bends[self.regions(bends[:, 1]) >= 0]
            self._graphs[key] = _Graph.build(self, bends, is_taut=not isinstance(key, frozenset))
        return self._graphs[key]

    def _local_bends(self, box: "_Box") -> Float64s:
        """Bends [V, 3, 2] in a box, from simplified outlines where there are too many; the middle ones if all else fails."""
        side, column, row = box
        middle = side * np.array([column, row])
        parts = self.outline.tree.query(shapely.box(*(middle - side), *(middle + side))).tolist()
        # A tenth of the box is the coarsest that still shows a way through it, and an eightieth the finest that matters.
        coarsest = max(0, int(np.log2(0.1 * side / self.growth.clearance_m)))
        for level in range(max(0, coarsest - 3), coarsest + 1):
            bends = _joined(self._bends(part, level) for part in parts)
            bends = bends[(np.abs(bends[:, 1] - middle) <= side).all(axis=1)]
            if len(bends) <= _MAX_BENDS:
                return bends
        distance = np.abs(bends[:, 1] - middle).max(axis=1)
        nearest: Float64s = bends[np.sort(np.argsort(distance, kind="stable")[:_MAX_BENDS])]
        return nearest

    def _bends(self, part: int, level: int) -> Float64s:
        """Bends of a component whose outline was simplified by clearance · 2^level (level 0: not at all)."""
        if (part, level) not in self._known_bends:
            clearance = self.growth.clearance_m
            if level == 0:
                bends = _joined([*convex_bends(self.outline.shapes[part]), loose_bends(self.outline.shapes[part], clearance)])
            elif self.size(part) > 4 * clearance * 2.0**level:
                bends = _joined(convex_bends(self._simplified(part, level)))
            else:
                # What is small in this search is gone around by its box.
                bends = loose_bends(self.outline.shapes[part], clearance)[:4]
            self._known_bends[part, level] = bends
        return self._known_bends[part, level]

    def _simplified(self, part: int, level: int) -> Any:
        if level <= 0:
            return self.outline.shapes[part]
        if (part, level) not in self._known_shapes:
            # From a shape that is simplified already: large outlines are gone through once, not once a level.
            base = level - 4
            tolerance = self.growth.clearance_m * (2.0**level - (2.0**base if base > 0 else 0.0))
            # A line simplified by less than it was moved out still lies outside of where it came from.
            grown = self._simplified(part, base).buffer(tolerance, join_style="mitre", mitre_limit=2.5)
            self._known_shapes[part, level] = grown.simplify(0.9 * tolerance)
        return self._known_shapes[part, level]

    @cached_property
    def _whole(self) -> Any:
        whole = shapely.MultiPolygon(self.core.shapes.tolist())
        shapely.prepare(whole)
        return whole

    @cached_property
    def _outline_of_core(self) -> Indices:
        inner = shapely.point_on_surface(self.core.shapes)
        owner = np.zeros(len(inner), dtype=np.intp)
        index, part = self.outline.touching(inner)
        owner[index] = part
        return owner

    @cached_property
    def _hulls(self) -> Objects:
        hulls: Objects = shapely.convex_hull(self.outline.shapes)
        shapely.prepare(hulls)
        return hulls

    @cached_property
    def _borders(self) -> dict[int, Any]:
        rings = [ring for part in self.outline.shapes for ring in (part.exterior, *part.interiors)]
        if not rings:
            return {}
        region = self.regions(np.array([ring.coords[0] for ring in rings]))
        borders = {}
        for name in np.unique(region[region >= 0]).tolist():
            borders[name] = shapely.MultiLineString([ring for ring, its in zip(rings, region, strict=True) if its == name])
            shapely.prepare(borders[name])
        return borders


class _Index:
    """Prepared shapes with a search tree."""

    def __init__(self, shapes: Objects) -> None:
        self.shapes = shapes
        shapely.prepare(shapes)
        self.tree = shapely.STRtree(shapes)

    def may_touch(self, low: Float64s, high: Float64s) -> Indices:
        """Which boxes from low to high [N, 2] meet the box of a shape: a quick look, before geometry is made of them.

        All of them where there are many shapes: then the search tree is quicker.
        """
        if len(self.shapes) > _FEW_SHAPES:
            return np.arange(len(low))
        is_near = np.zeros(len(low), dtype=bool)
        (x_low, y_low), (x_high, y_high) = low.T, high.T
        for west, south, east, north in shapely.bounds(self.shapes):
            is_near |= (x_low <= east) & (x_high >= west) & (y_low <= north) & (y_high >= south)
        return np.flatnonzero(is_near)

    def touching(self, geometry: Objects) -> tuple[Indices, Indices]:
        """All pairs (index into geometry, index into shapes) that touch."""
        query, shape = self.tree.query(geometry)
        # Element by element with the prepared shape first: the tree's own predicate would prepare the many small queries.
        touch = shapely.intersects(self.shapes[shape], geometry[query])
        return query[touch], shape[touch]


@dataclass(frozen=True, eq=False)
class _Graph:
    """Bends [V, 3, 2]: corners of routes between their neighbours on the outline; lengths [V, V] of free segments, else inf.

    from_end holds the same from ends of routes that were asked for to all corners: they are often asked for again.
    """

    bends: Float64s
    length: Float64s
    from_end: dict[tuple[float, float], Float64s] = field(default_factory=dict)

    @property
    def corners(self) -> Float64s:
        """The corners themselves [V, 2]."""
        return self.bends[:, 1]

    @staticmethod
    def build(zone: Zone, bends: Float64s, is_taut: bool = False) -> "_Graph":
        row, column = np.triu_indices(len(bends), k=1)
        if is_taut:
            useful = _touches_lightly(bends[row, 1], bends[column]) & _touches_lightly(bends[column, 1], bends[row])
            row, column = row[useful], column[useful]
        length = np.full((len(bends), len(bends)), np.inf)
        length[row, column] = length[column, row] = _free_lengths(zone, bends[row, 1], bends[column, 1])
        return _Graph(bends, length)

    def search(self, zone: Zone, requests: Sequence[Request]) -> list[Float64s | None]:
        """The shortest route of every request."""
        start, end = np.stack([r.start for r in requests]), np.stack([r.end for r in requests])
        ends = self._to_corners(zone, start), self._to_corners(zone, end)
        direct = _free_lengths(zone, start, end)
        routes: list[Float64s | None] = [None] * len(requests)
        free = [index for index, request in enumerate(requests) if request.barrier is None]
        rows = max(1, _CHUNK // max(1, len(self.corners) ** 2))
        for first in range(0, len(free), rows):
            some = free[first : first + rows]
            found = self._shortest([requests[i] for i in some], direct[some], ends[0][some], ends[1][some], self.length)
            for index, route in zip(some, found, strict=True):
                routes[index] = route
        for index, request in enumerate(requests):
            if request.barrier is not None:
                bar = request.barrier
                one = [
                    np.where(_crosses(request.start[None], request.end[None], bar), np.inf, direct[index]),
                    np.where(_crosses(request.start, self.corners, bar), np.inf, ends[0][index])[None],
                    np.where(_crosses(request.end, self.corners, bar), np.inf, ends[1][index])[None],
                    np.where(_crosses(self.corners[:, None], self.corners, bar), np.inf, self.length),
                ]
                routes[index] = self._shortest([request], *one)[0]
        return routes

    def _to_corners(self, zone: Zone, point: Float64s) -> Float64s:
        """Lengths [R, V] of the segments from points [R, 2] to all corners; infinite where the core is in the way."""
        keys = list(map(tuple, point.tolist()))
        new = list(dict.fromkeys(key for key in keys if key not in self.from_end))
        if new:
            shape = (len(new), len(self.bends), 2)
            begin = np.broadcast_to(np.array(new)[:, None], shape)
            self.from_end.update(zip(new, _free_lengths(zone, begin, np.broadcast_to(self.corners, shape)), strict=True))
        return np.stack([self.from_end[key] for key in keys])

    def _shortest(
        self, requests: Sequence[Request], best: Float64s, first: Float64s, last: Float64s, between: Float64s
    ) -> list[Float64s | None]:
        """Shortest paths by dynamic programming over the number of corners: best [R] holds the straight ways."""
        hop = np.array([r.hop_cost_m for r in requests])[:, None]
        allowed = np.array([r.max_waypoints for r in requests])
        row, to_corner = np.arange(len(requests)), np.ascontiguousarray(between.T)
        hops, corner = np.zeros_like(allowed), np.zeros_like(allowed)
        reach, came_from = first + hop, []
        for level in range(1, min(int(allowed.max()), MAX_CORNERS) + 1):
            if not reach.size or bool((reach.min(axis=1) >= best).all()):
                break
            total = np.where(allowed[:, None] >= level, reach + last, np.inf)
            candidate = total.argmin(axis=1)
            is_better = total[row, candidate] < best
            best = np.where(is_better, total[row, candidate], best)
            hops, corner = np.where(is_better, level, hops), np.where(is_better, candidate, corner)
            # where every corner is farther than the best way is long, further corners lead nowhere
            useful = np.flatnonzero((reach.min(axis=1) < best) & (allowed > level))
            through = reach[useful, None, :] + to_corner
            before = np.zeros(reach.shape, dtype=np.intp)
            before[useful] = through.argmin(axis=2)
            came_from.append(before)
            reach = np.full_like(reach, np.inf)
            reach[useful] = np.take_along_axis(through, before[useful][..., None], 2)[..., 0] + hop[useful]
        routes: list[Float64s | None] = []
        for index in row:
            chain = [int(corner[index])] if hops[index] else []
            for level in range(int(hops[index]) - 2, -1, -1):
                chain.append(int(came_from[level][index, chain[-1]]))
            routes.append(self.corners[chain[::-1]].reshape(-1, 2) if np.isfinite(best[index]) else None)
        return routes


def _free_lengths(zone: Zone, start: Float64s, end: Float64s) -> Float64s:
    """Lengths [...] of the segments from start to end [..., 2]; infinite where the core is in the way."""
    delta = end - start
    length: Float64s = np.hypot(delta[..., 0], delta[..., 1])
    return np.where(zone.blocks(start, end), np.inf, length)


def _touches_lightly(point: Float64s, bend: Float64s) -> Bools:
    """Whether segments from point [..., 2] pass bends [..., 3, 2] with the outline on one side: only such can be shortest.

    Bends with NaN for neighbours belong to no outline and are always passed lightly.
    """
    corner = bend[..., 1, :]
    before, after = (cross(corner - point, bend[..., side, :] - corner) for side in (0, 2))
    light: Bools = ~(before * after < 0)
    return light


def _crosses(start: Float64s, end: Float64s, barrier: Float64s) -> Bools:
    """Whether segments [..., 2] properly cross the barrier [2, 2]."""
    base, tip = barrier
    sides = cross(tip - base, start - base) * cross(tip - base, end - base)
    ends = cross(end - start, base - start) * cross(end - start, tip - start)
    crosses: Bools = (sides < 0) & (ends < 0)
    return crosses


def _joined(bends: Iterable[Float64s]) -> Float64s:
    return np.concatenate([np.full((0, 3, 2), np.nan), *bends])
