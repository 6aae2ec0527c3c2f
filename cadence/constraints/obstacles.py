"""Where nothing can be: circles and polygons, the signed distance to them, and the cost of being inside.

Distances and gradients are analytic and finite everywhere. Circles are torch arithmetic; polygons go through an
index of their edges on the CPU, so that a polygon of thousands of vertices (a coast, an occupancy grid) costs little.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import shapely
import torch
from torch import Tensor

from cadence.arrays import Bools, Float64s, Indices, Objects

_CHUNK = 4_000_000
"""Point-obstacle pairs evaluated at once: bounds the memory at some hundred MB."""
_FEW_POLYGONS = 100
"""Up to here, comparing every point with every polygon's box is quicker than a search tree."""


@dataclass(frozen=True, eq=False)
class Obstacles:
    """The union of circles and polygons in one metric frame.

    circles   [M, 3] float64 rows (x, y, radius) in metres
    polygons  one tuple of rings a polygon; ring [V, 2] float64 vertices in metres, first the exterior, then the holes;
              rings may be given open or closed, in either direction

    Raises ValueError for shapes, numbers or polygons that have no meaning (self-intersecting, fewer than 3 vertices).
    """

    circles: Tensor
    polygons: tuple[tuple[Tensor, ...], ...] = ()

    def __post_init__(self) -> None:
        if self.circles.ndim != 2 or self.circles.shape[1] != 3:
            raise ValueError(f"Obstacles.circles has shape {tuple(self.circles.shape)}, expected [M, 3]")
        if not bool(torch.isfinite(self.circles).all()) or bool((self.circles[:, 2] <= 0).any()):
            raise ValueError("Obstacles.circles must be finite, with radii above zero")
        for index, rings in enumerate(self.polygons):
            _check_rings(rings, f"Obstacles.polygons[{index}]")
        for index, shape in enumerate(self.shapes):
            if not shapely.is_valid(shape):
                raise ValueError(f"Obstacles.polygons[{index}]: {shapely.is_valid_reason(shape)}")

    @staticmethod
    def none() -> "Obstacles":
        """No obstacles at all: distances are infinite."""
        return Obstacles(torch.zeros(0, 3, dtype=torch.float64))

    @property
    def count(self) -> int:
        """Number of circles and polygons."""
        return len(self.circles) + len(self.polygons)

    @cached_property
    def circle_array(self) -> Float64s:
        """The circles as numpy [M, 3]."""
        return self.circles.detach().cpu().numpy().astype(np.float64)

    @cached_property
    def shapes(self) -> Objects:
        """The polygons as prepared shapely polygons [P], exterior counter-clockwise, holes clockwise."""
        rings = [[ring.detach().cpu().numpy().astype(np.float64) for ring in polygon] for polygon in self.polygons]
        shapes = np.empty(len(rings), dtype=object)
        shapes[:] = [shapely.geometry.polygon.orient(shapely.Polygon(r[0], r[1:])) for r in rings]
        shapely.prepare(shapes)
        return shapes

    def signed_distance(
        self, position_m: Tensor, *, offset_m: Tensor | None = None, limit_m: float = float("inf")
    ) -> tuple[Tensor, Tensor]:
        """Distance to the union of all obstacles, negative inside, and its unit gradient.

        position_m [..., 2]; offset_m, broadcastable to it, is added first (the datum of relative tracks). Beyond limit_m
        the distance is limit_m and the gradient zero, which saves most of the work where few points are near.
        Returns distance [...] and gradient [..., 2], of the positions' type. Inside several obstacles the deepest counts.
        Differentiable: autograd sees the returned gradient. NaN positions give limit_m and a zero gradient.
        """
        absolute = position_m.double() if offset_m is None else position_m.double() + offset_m.double()
        distance, gradient = _SignedDistance.apply(absolute, self, limit_m)  # type: ignore[no-untyped-call]
        return distance.to(position_m.dtype), gradient.to(position_m.dtype)

    def mountain_cost(self, position_m: Tensor, *, offset_m: Tensor | None = None) -> Tensor:
        """The paper's obstacle cost: mean over steps and obstacles of clamp(1 - d / r, 0), d from the centre.

        position_m [..., T, 2]; returns [...], differentiable. A polygon counts as the circle of its area about its
        centroid, as the paper's own (cross-shaped) mountain does.
        """
        disc = self._discs.to(position_m)
        if not len(disc):
            return position_m.sum(dim=(-2, -1)) * 0
        absolute = position_m if offset_m is None else position_m + offset_m.to(position_m)
        # vector_norm has gradient zero at the centre, where sqrt would give NaN.
        distance = torch.linalg.vector_norm(absolute[..., None, :] - disc[:, :2], dim=-1)
        cost: Tensor = (1 - distance / disc[:, 2]).clamp_min(0).mean(dim=(-2, -1))
        return cost

    @cached_property
    def _discs(self) -> Tensor:
        equal = [(*shapely.centroid(s).coords[0], float(np.sqrt(shapely.area(s) / np.pi))) for s in self.shapes]
        return torch.cat([self.circles.double().cpu(), torch.tensor(equal, dtype=torch.float64).reshape(-1, 3)])

    @cached_property
    def tree(self) -> shapely.STRtree:
        """A search tree of the boxes of `shapes`."""
        return shapely.STRtree(self.shapes)

    def _edges(self, polygon: int) -> "_EdgeIndex":
        if polygon not in self._edges_known:
            self._edges_known[polygon] = _EdgeIndex([self.shapes[polygon]])
        return self._edges_known[polygon]

    @cached_property
    def _edges_known(self) -> dict[int, "_EdgeIndex"]:
        return {}

    @cached_property
    def _all_edges(self) -> "_EdgeIndex":
        return _EdgeIndex(list(self.shapes))


@dataclass(frozen=True)
class ObstacleConstraint:
    """Keep `margin_m` away from every obstacle: half the squared hinge of (margin - distance), summed over the steps.

    The gradient of a violating step is the violation in metres, pointing inwards: one unit descent step ends on the margin.
    """

    obstacles: Obstacles
    margin_m: float = 0.0
    offset_m: Tensor | None = None

    def cost(self, position_m: Tensor) -> Tensor:
        """Cost [...] in m² of tracks position_m [..., T, 2]; differentiable."""
        return 0.5 * self._hinge(position_m)[0].square().sum(dim=-1)

    def gradient(self, position_m: Tensor) -> Tensor:
        """Analytic gradient of `cost`, like position_m, in metres."""
        hinge, gradient = self._hinge(position_m.detach())
        return -hinge[..., None] * gradient

    def at(self, chosen: Tensor) -> "ObstacleConstraint":
        """The constraint on the chosen positions [N, 2] alone, of all [...] that it is on."""
        if self.offset_m is None:
            return self
        return replace(self, offset_m=self.offset_m.expand(*chosen.shape, 2)[chosen])

    def _hinge(self, position_m: Tensor) -> tuple[Tensor, Tensor]:
        distance, gradient = self.obstacles.signed_distance(position_m, offset_m=self.offset_m, limit_m=self.margin_m)
        return (self.margin_m - distance).clamp_min(0), gradient


class _SignedDistance(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, position_m: Tensor, obstacles: Obstacles, limit_m: float) -> tuple[Tensor, Tensor]:
        flat = position_m.reshape(-1, 2)
        distance = torch.full_like(flat[:, 0], limit_m)
        gradient = torch.zeros_like(flat)
        rows = max(1, _CHUNK // max(1, len(obstacles.circles)))
        for first in range(0, len(flat), rows):
            part = slice(first, first + rows)
            _merge_circles(flat[part], obstacles.circles.to(flat), distance[part], gradient[part])
        if len(obstacles.polygons):
            _merge_polygons(flat, obstacles, limit_m, distance, gradient)
        gradient = gradient.reshape(position_m.shape)
        ctx.save_for_backward(gradient)
        ctx.mark_non_differentiable(gradient)
        return distance.reshape(position_m.shape[:-1]), gradient

    @staticmethod
    def backward(ctx: Any, *grad: Tensor) -> tuple[Tensor, None, None]:
        return grad[0][..., None] * ctx.saved_tensors[0], None, None


def _merge_circles(position_m: Tensor, circles: Tensor, distance: Tensor, gradient: Tensor) -> None:
    """Lower `distance` [N] and `gradient` [N, 2] in place where a circle is nearer than what they hold."""
    if not len(circles):
        return
    from_centre = torch.linalg.vector_norm(position_m[:, None] - circles[:, :2], dim=-1)
    nearest, index = (from_centre - circles[:, 2]).min(dim=1)
    is_nearer = nearest < distance
    chosen, index = position_m[is_nearer], index[is_nearer]
    delta = chosen - circles[index, :2]
    length = from_centre[is_nearer, index][:, None]
    # At the very centre every way out is as short: take east.
    east = torch.tensor([1.0, 0.0]).to(delta)
    gradient[is_nearer] = torch.where(length > 0, delta / length.clamp_min(torch.finfo(delta.dtype).tiny), east)
    distance[is_nearer] = nearest[is_nearer]


def _merge_polygons(position_m: Tensor, obstacles: Obstacles, limit_m: float, distance: Tensor, gradient: Tensor) -> None:
    """The same for polygons: first the points inside (the deepest polygon), then the nearest edge of all for the others."""
    point = position_m.detach().cpu().numpy()
    best, slope = distance.cpu().numpy().copy(), gradient.cpu().numpy().copy()
    is_free = np.isfinite(point).all(axis=1) & _may_be_near(point, shapely.bounds(obstacles.shapes), limit_m)
    inside = list(_inside(point, np.flatnonzero(is_free), obstacles))
    for number, its in inside:
        _lower(best, slope, its, *obstacles._edges(number).nearest(point[its], sign=-1.0))
    for _, its in inside:
        is_free[its] = False
    if limit_m > 0:
        outside = np.flatnonzero(is_free & (best > 0))
        near = obstacles._all_edges.near(point[outside], limit_m)
        _lower(best, slope, outside[near], *obstacles._all_edges.nearest(point[outside[near]], sign=1.0))
    distance.copy_(torch.from_numpy(best))
    gradient.copy_(torch.from_numpy(slope))


def _inside(point: Float64s, index: Indices, obstacles: Obstacles) -> Iterator[tuple[int, Indices]]:
    """Of the points [N, 2] at `index` those inside each polygon that holds any, by the polygon's number."""
    if len(obstacles.shapes) > _FEW_POLYGONS:
        near, polygon = obstacles.tree.query(shapely.points(point[index]))
        found = index[near]
        holds = shapely.contains_xy(obstacles.shapes[polygon], point[found, 0], point[found, 1])
        found, polygon = found[holds], polygon[holds]
        yield from ((number, found[polygon == number]) for number in np.unique(polygon).tolist())
        return
    x, y = point[index].T.copy()
    for number, (west, south, east, north) in enumerate(shapely.bounds(obstacles.shapes)):
        near = np.flatnonzero((x >= west) & (x <= east) & (y >= south) & (y <= north))
        near = near[shapely.contains_xy(obstacles.shapes[number], x[near], y[near])]
        if len(near):
            yield number, index[near]


def _may_be_near(point: Float64s, boxes: Float64s, limit_m: float) -> Bools:
    """A quick look at which points [N, 2] are within limit_m of a box [P, 4]; all of them where there are many boxes."""
    if len(boxes) > _FEW_POLYGONS or not np.isfinite(limit_m):
        return np.ones(len(point), dtype=bool)
    x, y = point.T.copy()
    is_near = np.zeros(len(point), dtype=bool)
    for west, south, east, north in boxes + limit_m * np.array([-1.0, -1.0, 1.0, 1.0]):
        is_near |= (x >= west) & (x <= east) & (y >= south) & (y <= north)
    return is_near


def _lower(
    best: Float64s,
    slope: Float64s,
    index: Indices,
    distance: Float64s,
    gradient: Float64s,
) -> None:
    nearer = distance < best[index]
    best[index[nearer]] = distance[nearer]
    slope[index[nearer]] = gradient[nearer]


class _EdgeIndex:
    """A search tree over the edges of some polygons."""

    def __init__(self, shapes: list[Any]) -> None:
        rings = [np.asarray(ring.coords) for shape in shapes for ring in (shape.exterior, *shape.interiors)]
        edges = np.concatenate([np.stack([ring[:-1], ring[1:]], axis=1) for ring in rings])  # [E, 2, 2]
        edges = edges[(edges[:, 0] != edges[:, 1]).any(axis=1)]
        self.start = edges[:, 0]
        self.along = edges[:, 1] - edges[:, 0]
        self.tree = shapely.STRtree(shapely.linestrings(edges))

    def near(self, point: Float64s, limit_m: float) -> Indices:
        """Indices of the points [N, 2] that may be nearer than limit_m to an edge."""
        if not np.isfinite(limit_m):
            return np.arange(len(point))
        low, high = (point - limit_m).T, (point + limit_m).T
        return np.unique(self.tree.query(shapely.box(*low, *high))[0])

    def nearest(self, point: Float64s, sign: float) -> tuple[Float64s, Float64s]:
        """Signed distance [N] to the nearest edge and its gradient [N, 2]; sign -1 for points inside."""
        if not len(point):
            return np.zeros(0), np.zeros((0, 2))
        edge = self.tree.nearest(shapely.points(point))
        start, along = self.start[edge], self.along[edge]
        fraction = np.clip(((point - start) * along).sum(1) / (along * along).sum(1), 0.0, 1.0)
        delta = point - (start + fraction[:, None] * along)
        distance = np.hypot(delta[:, 0], delta[:, 1])
        # Rings keep the inside on their left: on the edge itself the gradient is the normal to its right.
        normal = np.stack([along[:, 1], -along[:, 0]], axis=1) / np.hypot(along[:, 0], along[:, 1])[:, None]
        # Rounding of the foot point decides the direction of a shorter difference than this.
        is_off = distance > 1e-12 * (1.0 + np.abs(point).max(axis=1))
        safe = np.where(is_off, distance, 1.0)[:, None]
        return sign * distance, np.where(is_off[:, None], sign * delta / safe, normal)


def _check_rings(rings: tuple[Tensor, ...], where: str) -> None:
    if not rings:
        raise ValueError(f"{where} has no ring")
    for ring in rings:
        if ring.ndim != 2 or ring.shape[1] != 2:
            raise ValueError(f"{where} has a ring of shape {tuple(ring.shape)}, expected [V, 2]")
        if not bool(torch.isfinite(ring).all()):
            raise ValueError(f"{where} has a vertex that is not finite")
        if len(torch.unique(ring, dim=0)) < 3:
            raise ValueError(f"{where} has a ring of fewer than 3 different vertices")
