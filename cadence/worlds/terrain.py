"""Ground that nobody passes: random islands and shoals, the clearance to them, who can see past them, smooth random fields."""

import math
from dataclasses import dataclass

import numpy as np
import shapely
from scipy import ndimage

from cadence.arrays import Bools, Float64s


@dataclass(frozen=True, eq=False)
class Terrain:
    """Obstacles in a map; x east, y north, metres; origin in the middle, in "prison" and "narco" in the south-west corner.

    side_m     length of the map's side, of the longer one if it is not square
    circles_m  [C, 3] x, y, radius
    polygons_m one array [V, 2] a polygon: vertices in order, the first not repeated
    """

    side_m: float
    circles_m: Float64s
    polygons_m: tuple[Float64s, ...]

    def __post_init__(self) -> None:
        if self.circles_m.ndim != 2 or self.circles_m.shape[1] != 3:
            raise ValueError(f"Terrain.circles_m has shape {self.circles_m.shape}, expected [C, 3]")
        if any(polygon.ndim != 2 or len(polygon) < 3 or polygon.shape[1] != 2 for polygon in self.polygons_m):
            raise ValueError("Terrain.polygons_m must hold arrays [V, 2] with at least 3 vertices each")

    def land(self) -> shapely.STRtree:
        """Spatial index of all obstacles as shapely polygons; circles as 64-gons around them."""
        # A regular n-gon *around* the circle: a path that keeps out of it keeps out of the circle.
        scale = 1.0 / math.cos(math.pi / 64)
        circles = [shapely.Point(x, y).buffer(radius * scale, quad_segs=16) for x, y, radius in self.circles_m]
        shapes = [shapely.Polygon(polygon) for polygon in self.polygons_m]
        shapely.prepare(shapes)
        return shapely.STRtree([*shapes, *circles])


def blocks_segment(land: shapely.STRtree, start_m: Float64s, end_m: Float64s) -> Bools:
    """Whether the straight segments from `start_m` [..., 2] to `end_m` [..., 2] touch any obstacle."""
    start, end = np.broadcast_arrays(start_m, end_m)
    lines = shapely.linestrings(np.stack([start, end], axis=-2).reshape(-1, 2, 2))
    hit = np.zeros(len(lines), dtype=bool)
    hit[land.query(lines, predicate="intersects")[0]] = True
    return hit.reshape(start.shape[:-1])


def smooth_polygon(
    centre_m: Float64s, radius_m: float, rng: np.random.Generator, num_vertices: int = 40, roughness: float = 1.3
) -> Float64s:
    """A random star-shaped island [V, 2] around `centre_m`, at most `radius_m` from it at any vertex.

    The radius is a random Fourier series of the bearing whose terms fall with the frequency, squeezed along a random axis.
    """
    bearing = np.linspace(0.0, 2 * np.pi, num_vertices, endpoint=False)
    frequency = np.arange(2, 8)
    amplitude = roughness * 0.32 * rng.standard_normal(len(frequency)) / frequency
    phase = rng.uniform(0.0, 2 * np.pi, len(frequency))
    radius = np.exp((amplitude * np.cos(frequency * bearing[:, None] + phase)).sum(axis=1))
    shape = radius[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], axis=1) * [1.0, rng.uniform(0.4, 1.0)]
    turn = rng.uniform(0.0, 2 * np.pi)
    shape = shape @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    polygon: Float64s = centre_m + shape * (radius_m / np.hypot(*shape.T).max())
    return polygon


def random_archipelago(
    rng: np.random.Generator, side_m: float, num_islands: int = 15, num_shoals: int = 3, channel_m: float = 1300.0
) -> Terrain:
    """Islands of all sizes and a few round shoals with channels of at least `channel_m` between them.

    Sizes fall from a sixth of the side to a fortieth, so that there are big islands with two ways around and small ones to
    hide behind. Islands which find no place are left out.
    """
    radii = np.geomspace(side_m / 6.5, side_m / 38.0, num_islands) * rng.uniform(0.8, 1.2, num_islands)
    radii = np.concatenate([radii, rng.uniform(side_m / 60.0, side_m / 35.0, num_shoals)])
    centres: list[Float64s] = []
    polygons: list[Float64s] = []
    circles: list[tuple[float, float, float]] = []
    shapes: list[shapely.Geometry] = []
    for index, radius in enumerate(radii):
        reach = side_m / 2 - 0.7 * radius
        for _ in range(40):
            centre = rng.uniform(-reach, reach, 2)
            polygon = smooth_polygon(centre, radius, rng)
            shape = shapely.Polygon(polygon) if index < num_islands else shapely.Point(*centre).buffer(radius)
            if all(shapely.distance(shape, other) >= channel_m for other in shapes):
                shapes.append(shape)
                centres.append(centre)
                if index < num_islands:
                    polygons.append(polygon)
                else:
                    circles.append((float(centre[0]), float(centre[1]), float(radius)))
                break
    return Terrain(side_m, np.array(circles, dtype=np.float64).reshape(-1, 3), tuple(polygons))


def smooth_field(rng: np.random.Generator, size: int, scale_cells: float, octaves: int = 3) -> Float64s:
    """A smooth random field [size, size] in 0..1: sums of blurred noise, halved in scale and in weight each octave."""
    field = np.zeros((size, size))
    for octave in range(octaves):
        sigma = max(scale_cells / 2**octave, 0.5)
        layer = ndimage.gaussian_filter(rng.standard_normal((size, size)), sigma, mode="reflect", truncate=3.0)
        field += layer / (layer.std() * 2**octave)
    low, high = field.min(), field.max()
    scaled: Float64s = (field - low) / (high - low)
    return scaled


@dataclass(frozen=True, eq=False)
class Clearance:
    """A raster of the distance to the next obstacle, good for a guarantee: it is never more than `error_m` above the truth.

    distance_m [H, W] distance of each cell's centre to the nearest land cell's centre; row = y, column = x
    """

    side_m: float
    cell_m: float
    distance_m: Float64s

    @classmethod
    def of(cls, terrain: Terrain, cell_m: float) -> "Clearance":
        """The raster of `terrain` with cells of about `cell_m`; land reaches half a diagonal beyond every obstacle."""
        size = round(terrain.side_m / cell_m)
        cell_m = terrain.side_m / size
        axis = (np.arange(size) + 0.5) * cell_m - terrain.side_m / 2
        is_land = np.zeros((size, size), dtype=bool)
        for shape in terrain.land().geometries:
            shape = shape.buffer(0.75 * cell_m, quad_segs=4)  # 0.75 > sqrt(1/2): the buffer's arcs are inscribed polygons
            shapely.prepare(shape)
            x0, y0, x1, y1 = shape.bounds
            columns = slice(*np.searchsorted(axis, [x0, x1]))
            rows = slice(*np.searchsorted(axis, [y0, y1]))
            x, y = np.meshgrid(axis[columns], axis[rows])
            is_land[rows, columns] |= shapely.contains_xy(shape, x, y)
        if not is_land.any():
            return cls(terrain.side_m, cell_m, np.full(is_land.shape, terrain.side_m))
        return cls(terrain.side_m, cell_m, ndimage.distance_transform_edt(~is_land) * cell_m)

    @property
    def error_m(self) -> float:
        """How far the raster can be above the true distance: half a diagonal at the point and half a diagonal at the shore."""
        return math.sqrt(2.0) * self.cell_m

    def at(self, x_m: float, y_m: float) -> float:
        """Raster distance of the cell that holds a point; 0 outside the map."""
        column = int((x_m + self.side_m / 2) // self.cell_m)
        row = int((y_m + self.side_m / 2) // self.cell_m)
        size = self.distance_m.shape[0]
        return float(self.distance_m[row, column]) if 0 <= row < size and 0 <= column < size else 0.0

    def at_points(self, position_m: Float64s) -> Float64s:
        """Raster distance [...] of points [..., 2]; 0 outside the map."""
        index = np.floor((position_m + self.side_m / 2) / self.cell_m).astype(int)
        size = self.distance_m.shape[0]
        is_inside = ((index >= 0) & (index < size)).all(axis=-1)
        index = index.clip(0, size - 1)
        return np.where(is_inside, self.distance_m[index[..., 1], index[..., 0]], 0.0)
