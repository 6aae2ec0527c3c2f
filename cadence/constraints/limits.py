"""All limits of a track together: obstacles, the map's edge and speed, each kept in turn, as one may undo the other."""

from dataclasses import dataclass

import torch
from torch import Tensor

from cadence.constraints.obstacles import Obstacles
from cadence.constraints.repair import repair
from cadence.constraints.speed import exceeds, limit_steps

_ROUNDS = 4
_ROUNDING_M = 1e-6


@dataclass(frozen=True, eq=False)
class KeepOut:
    """Where R rows of tracks may not be.

    obstacles  may be none
    margin_m   distance to keep from them
    offset_m   [R, 1, 1, 2] datum of the rows in the obstacles' frame
    edge_m     [R, 1, 1, 2] lowest and highest corner of the map about the rows' datum, where one is known
    """

    obstacles: Obstacles
    margin_m: float
    offset_m: Tensor
    edge_m: tuple[Tensor, Tensor] | None = None

    def inside(self, position_m: Tensor) -> Tensor:
        """Tracks [R, K, T, 2] with every state brought onto the map. No step becomes longer by it."""
        return position_m if self.edge_m is None else position_m.clamp(*self.edge_m)

    def is_inside(self, position_m: Tensor) -> Tensor:
        """Which tracks [R, K] stay on the map."""
        is_on_map: Tensor = (self.inside(position_m) - position_m).abs().amax(dim=(-2, -1)) <= _ROUNDING_M
        return is_on_map


def within_limits(
    position_m: Tensor, keep_out: KeepOut, is_pinned: Tensor, longest_m: float | Tensor | None, is_held: Tensor
) -> tuple[Tensor, Tensor]:
    """Tracks [R, K, T, 2] slowed down, brought onto the map and led around obstacles, in turns as often as helps.

    Args:
        position_m: the tracks.
        keep_out: where they may not be.
        is_pinned: [R, K, T] steps that a way round an obstacle leaves exactly where they are.
        longest_m: how long a step may be, each [T - 1], each of a track [K, 1] or all, or None.
        is_held: [R, K, T] steps that stay where they are when a track is slowed down; at least one a track.

    Returns:
        The tracks, and which of them are where they may be [R, K]; ask `exceeds` whether they are slow enough.
    """
    moved, is_clear = position_m, torch.ones(position_m.shape[:2], dtype=torch.bool)
    limit_m = longest_m
    if isinstance(longest_m, Tensor) and longest_m.ndim == 2:
        limit_m = longest_m.repeat(len(moved), 1)
    has_turns = keep_out.obstacles.count and not (longest_m is None and keep_out.edge_m is None)
    for _ in range(_ROUNDS if has_turns else 1):
        if limit_m is not None:
            slowed, _ = limit_steps(moved.flatten(0, 1), is_held.flatten(0, 1), limit_m)
            moved = slowed.view_as(moved)
        moved = keep_out.inside(moved)
        if keep_out.obstacles.count:
            moved, is_clear = repair(moved, keep_out.obstacles, is_pinned, keep_out.margin_m, offset_m=keep_out.offset_m)
            is_clear = is_clear & keep_out.is_inside(moved)
        if bool(is_clear.all()) and (longest_m is None or not bool(exceeds(moved, longest_m).any())):
            break
    return moved, is_clear
