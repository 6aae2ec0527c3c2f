"""Grown obstacles as polygons, and the places at which a shortest way around them can bend."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import shapely

from cadence.arrays import Float64s, Objects
from cadence.constraints.obstacles import Obstacles


def polygon_parts(shape: Any) -> Objects:
    """The polygons of a geometry, interiors to the left of every ring."""
    polygons = [part for part in shapely.get_parts(shape) if part.geom_type == "Polygon" and not part.is_empty]
    parts = np.empty(len(polygons), dtype=object)
    parts[:] = [shapely.geometry.polygon.orient(part) for part in polygons]
    return parts


def grow_round(obstacles: Obstacles, distance_m: float, sides: int) -> Any:
    """The union of everything nearer than distance_m to an obstacle, at most a trace larger, never smaller."""
    apothem = np.cos(np.pi / sides)
    return shapely.union_all(
        [*_discs(obstacles, distance_m, sides), *shapely.buffer(obstacles.shapes, distance_m / apothem, quad_segs=sides // 4)]
    )


def grow_sharp(obstacles: Obstacles, distance_m: float, sides: int, stretch: float) -> Any:
    """The same with few corners, sharp where the obstacles have corners; circles are `stretch` times as large."""
    grown = shapely.buffer(obstacles.shapes, distance_m, join_style="mitre", mitre_limit=2.5)
    return shapely.union_all([*_discs(obstacles, distance_m, sides, stretch), *grown])


def _discs(obstacles: Obstacles, distance_m: float, sides: int, stretch: float = 1.0) -> list[Any]:
    """Polygons around the circles, grown by distance_m."""
    angle = np.arange(sides) * (2 * np.pi / sides)
    unit = np.stack([np.cos(angle), np.sin(angle)], axis=1) / np.cos(np.pi / sides)
    return [shapely.Polygon(row[:2] + stretch * (row[2] + distance_m) * unit) for row in obstacles.circle_array]


def convex_bends(shape: Any) -> Iterator[Float64s]:
    """For every ring of polygons, its corners that stick out, between their neighbours [V, 3, 2]."""
    for part in polygon_parts(shape):
        for ring in (part.exterior, *part.interiors):
            corner = shapely.get_coordinates(ring)[:-1]
            bends = np.stack([np.roll(corner, 1, axis=0), corner, np.roll(corner, -1, axis=0)], axis=1)
            yield bends[cross(corner - bends[:, 0], bends[:, 2] - corner) > 0]


def loose_bends(part: Any, clearance_m: float) -> Float64s:
    """Ten bends [10, 3, 2] around a component for tracks with few steps: four close to it, six far out."""
    rectangle = shapely.minimum_rotated_rectangle(part)
    angle = np.arange(6) * (np.pi / 3)
    ring = 2 * shapely.minimum_bounding_radius(part) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    around = shapely.get_coordinates(rectangle.buffer(clearance_m, join_style="mitre"))[:-1]
    loose = np.concatenate([around, shapely.get_coordinates(shapely.centroid(rectangle)) + ring])
    # What stands alone has no neighbours on an outline.
    return np.stack([np.full_like(loose, np.nan), loose, np.full_like(loose, np.nan)], axis=1)


def cross(a: Float64s, b: Float64s) -> Float64s:
    """Cross product [...] of vectors [..., 2]: positive where b points to the left of a."""
    product: Float64s = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return product
