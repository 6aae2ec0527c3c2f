"""The prison's ground as its searchers see it: whole cells on a square map, and round mountains to keep out of."""

from dataclasses import dataclass, field

import numpy as np

from cadence.worlds.draws import Array, Indices
from cadence.worlds.pursuit import Mask

_INNER, _OUTER, _PLAN, _NEAR = 140.0, 160.0, 161.0, 170.0
"""Ranges around a mountain's middle: turn straight out, begin to turn, lead no plan, begin a spiral at once."""


@dataclass(frozen=True, eq=False)
class CellGround:
    """A map of `side` by `side` cells with mountains [K, 2], given by their middles.

    Movers turn off at 160 cells from a mountain's middle and straight out at 140; positions are whole cells (the original's
    rounding, which makes a party of 6.5 cells a step do 6.1 to 7.1).
    """

    side: int
    mountains: Array
    size: Array = field(init=False)
    detours_before_spiral: bool = True
    acts_on_arrival: bool = False

    def __post_init__(self) -> None:
        if self.mountains.ndim != 2 or self.mountains.shape[1] != 2:
            raise ValueError(f"CellGround.mountains has shape {self.mountains.shape}, expected [K, 2]")
        object.__setattr__(self, "size", np.array([float(self.side), float(self.side)]))

    def snap(self, point: Array) -> Array:
        """Whole cells."""
        cell: Array = np.rint(point)
        return cell

    def is_outside(self, point: Array) -> Mask:
        """Off the map or on its outermost cells."""
        outside: Mask = np.any((point < 1.0) | (point >= self.side - 1.0), axis=-1)
        return outside

    def is_closed(self, point: Array) -> Mask:
        """Within 161 cells of a mountain."""
        return self._within(point, _PLAN)

    def ends_spiral(self, point: Array) -> Mask:
        """Off the map."""
        return self.is_outside(point)

    def ends_line(self, point: Array, ahead: Array, speed: Array) -> Mask:
        """Within one step of the edge."""
        ends: Mask = np.any((point <= speed[:, None]) | (point >= self.side - speed[:, None]), axis=-1)
        return ends

    def is_near_obstacle(self, point: Array) -> Mask:
        """Within 170 cells of a mountain."""
        return self._within(point, _NEAR)

    def settle(self, point: Array, heading: Array, otherwise: Array) -> Array:
        """Left as it is: planning draws another point near it where it is not allowed."""
        return point

    def aim(self, position: Array, goal: Array) -> Array:
        """Straight on."""
        return goal

    def move(self, position: Array, direction: Array, speed: Array) -> Array:
        """One step, turned along or away from a mountain, rounded to cells, kept on the map."""
        moved = np.rint(position + direction * speed[:, None])
        index, distance = self._nearest(moved)
        turn = np.flatnonzero(distance <= _OUTER)
        if len(turn):
            here = position[turn]
            away = here - self.mountains[index[turn]]
            length = np.hypot(*away.T)
            away = np.where(length[:, None] > 0, away / np.where(length > 0, length, 1.0)[:, None], [1.0, 0.0])
            along = self._along(direction[turn], away)
            new = np.where((distance[turn] <= _INNER)[:, None], away, along)
            moved[turn] = here + np.rint(new * speed[turn][:, None])
        return np.where(self.is_outside(moved)[:, None], np.clip(moved, 0.0, self.side - 1.0), moved)

    @staticmethod
    def _along(direction: Array, away: Array) -> Array:
        """The direction, or across the mountain where it leads towards it."""
        across = np.stack([-away[:, 1], away[:, 0]], axis=-1)
        side = np.where((direction * across).sum(axis=-1) < 0, -1.0, 1.0)
        towards = (direction * away).sum(axis=-1) < 0
        return np.where(towards[:, None], side[:, None] * across, direction)

    def _nearest(self, point: Array) -> tuple[Indices, Array]:
        """The nearest mountain of each point [N], and the distance to its middle."""
        if not len(self.mountains):
            return np.zeros(len(point), dtype=np.int64), np.full(len(point), np.inf)
        offset = point[:, None] - self.mountains
        square = (offset * offset).sum(axis=-1)
        return square.argmin(axis=1), np.sqrt(square.min(axis=1))

    def _within(self, point: Array, radius: float) -> Mask:
        near: Mask = self._nearest(point)[1] <= radius
        return near
