"""What a log's own detections let one believe of how fast its targets are."""

import torch
from torch import Tensor

from cadence.types import Detections

_QUANTILE = 0.99
_ROOM = 1.25
"""Of 14 aircraft, a drone, ships and fire-fighting aircraft, seen 5 to 30 % of the time, the quantile lies at .5 to 1.08 of the
speed that one true step of the grid in a thousand exceeds, in most logs at .75 to .97."""

_MAX_STEPS = 20.0
"""Over longer gaps the straight way says little of the speed."""

_LEAST_PAIRS = 16
_FEW = 1.5
"""Room where fewer pairs than that speak."""


def plausible_speed(tracks: Detections, step_s: float) -> float | None:
    """A speed that the targets of a log hardly exceed over one step of the grid, m/s; None where no two detections tell.

    The 99 % quantile of the mean speed between detections a step or more apart, less what their noise may add, with room.

    Args:
        tracks: stretches of one agent's detections each, [R, 1, N].
        step_s: of the grid.
    """
    speed = _pair_speeds(tracks, step_s)
    if not len(speed):
        return None
    room = _ROOM if len(speed) >= _LEAST_PAIRS else _FEW
    found = float(speed.quantile(_QUANTILE)) if len(speed) < 2**24 else float(speed.max())
    return room * found if found > 0.0 else None


def _pair_speeds(tracks: Detections, step_s: float) -> Tensor:
    """Speeds [P] from each detection to the first one that is a step or more later."""
    time_s = torch.where(tracks.is_observed, tracks.time_s, torch.inf)[:, 0].double().contiguous()
    later = torch.searchsorted(time_s, (time_s + step_s * (1.0 - 1e-6)).contiguous())
    later = later.clamp(max=time_s.shape[1] - 1)
    gap_s = time_s.gather(1, later) - time_s
    row, first = ((gap_s >= step_s * (1.0 - 1e-6)) & (gap_s <= _MAX_STEPS * step_s)).nonzero(as_tuple=True)
    second = later[row, first]
    place, noise = tracks.position_m[:, 0].double(), tracks.covariance_m2[:, 0].double().diagonal(dim1=-2, dim2=-1).mean(-1)
    way_m = (place[row, second] - place[row, first]).norm(dim=-1)
    doubt_m = (noise[row, second] + noise[row, first]).sqrt()
    speed: Tensor = (way_m - doubt_m).clamp_min(0.0) / gap_s[row, first]
    return speed
