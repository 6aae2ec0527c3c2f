"""Exact test of tracks against obstacles: every state and every straight segment between states, nothing sampled.

Obstacles are closed: touching the boundary is a collision. Steps that are NaN collide with nothing.
"""

from collections.abc import Callable, Iterator

import numpy as np
import shapely
import torch
from torch import Tensor

from cadence.arrays import Bools, Float64s, Indices
from cadence.constraints.obstacles import Obstacles


def segments_in_collision(position_m: Tensor, obstacles: Obstacles, *, offset_m: Tensor | None = None) -> Tensor:
    """Which segments [..., T-1] bool of tracks [..., T, 2] touch an obstacle; offset_m is added to the positions first."""

    def circle(track: Float64s, row: Float64s) -> Bools:
        hit: Bools = segment_distance(track[:, :-1], track[:, 1:], row[:2]) <= row[2]
        return hit

    def polygon(track: Float64s, shape: object) -> Bools:
        return segments_intersect(shape, track[:, :-1], track[:, 1:])

    length = max(position_m.shape[-2] - 1, 0)
    return _check(position_m, obstacles, offset_m, length, circle, polygon)


def states_in_collision(position_m: Tensor, obstacles: Obstacles, *, offset_m: Tensor | None = None) -> Tensor:
    """Which states [..., T] bool of tracks [..., T, 2] lie in or on an obstacle; offset_m is added to the positions first."""

    def circle(track: Float64s, row: Float64s) -> Bools:
        hit: Bools = np.hypot(track[..., 0] - row[0], track[..., 1] - row[1]) <= row[2]
        return hit

    def polygon(track: Float64s, shape: object) -> Bools:
        hit: Bools = shapely.intersects_xy(shape, track[..., 0], track[..., 1])
        return hit

    return _check(position_m, obstacles, offset_m, position_m.shape[-2], circle, polygon)


def absolute_array(position_m: Tensor, offset_m: Tensor | None) -> Float64s:
    """The tracks as float64 numpy [H, T, 2] in the obstacles' frame."""
    absolute = position_m.detach().double()
    if offset_m is not None:
        absolute = absolute + offset_m.detach().to(absolute)
    return absolute.reshape(-1, *position_m.shape[-2:]).cpu().numpy()


def segment_distance(start: Float64s, end: Float64s, point: Float64s) -> Float64s:
    """Distance [...] of a point [2] from segments [..., 2]."""
    along = end - start
    squared = np.maximum((along * along).sum(-1), np.finfo(np.float64).tiny)
    fraction = np.clip(((point - start) * along).sum(-1) / squared, 0.0, 1.0)
    delta = start + fraction[..., None] * along - point
    distance: Float64s = np.hypot(delta[..., 0], delta[..., 1])
    return distance


def segments_intersect(shape: object, start: Float64s, end: Float64s) -> Bools:
    """Which segments [...] from start to end [..., 2] touch a (prepared) shapely geometry; only those near are looked at."""
    west, south, east, north = shapely.bounds(shape)
    low, high = np.minimum(start, end), np.maximum(start, end)
    hit: Bools = (low[..., 0] <= east) & (high[..., 0] >= west) & (low[..., 1] <= north) & (high[..., 1] >= south)
    lines = shapely.linestrings(np.stack([start[hit], end[hit]], axis=-2))
    hit[hit] = shapely.intersects(shape, lines)
    return hit


def _check(
    position_m: Tensor,
    obstacles: Obstacles,
    offset_m: Tensor | None,
    length: int,
    circle: Callable[[Float64s, Float64s], Bools],
    polygon: Callable[[Float64s, object], Bools],
) -> Tensor:
    track = absolute_array(position_m, offset_m)
    hit = np.zeros((len(track), length), dtype=bool)
    if track.size and length:
        for row, near in zip(obstacles.circle_array, _near(track, _circle_boxes(obstacles)), strict=True):
            hit[near] |= circle(track[near], row)
        for shape, near in zip(obstacles.shapes, _near(track, shapely.bounds(obstacles.shapes)), strict=True):
            hit[near] |= polygon(track[near], shape)
    return torch.from_numpy(hit).reshape(*position_m.shape[:-2], length).to(position_m.device)


def _circle_boxes(obstacles: Obstacles) -> Float64s:
    centre, radius = obstacles.circle_array[:, :2], obstacles.circle_array[:, 2:]
    return np.concatenate([centre - radius, centre + radius], axis=1)


def _near(track: Float64s, boxes: Float64s) -> Iterator[Indices]:
    """For each box (west, south, east, north), the tracks [H, T, 2] whose own box meets it."""
    low, high = np.fmin.reduce(track, axis=1), np.fmax.reduce(track, axis=1)
    for west, south, east, north in boxes:
        yield np.flatnonzero((low[:, 0] <= east) & (high[:, 0] >= west) & (low[:, 1] <= north) & (high[:, 1] >= south))
