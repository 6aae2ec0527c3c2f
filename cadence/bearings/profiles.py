"""Supposed tracks: straight from one of several places on the first line of sight to one of several on the last.

Ranges that a bearing does not tell are spaced evenly in their logarithm (range-parameterised tracking: Peach, "Bearings-only
tracking using a set of range-parameterised extended Kalman filters", 1995), here at both ends; directions that a range does
not tell are spaced evenly. Each place has a kernel about as wide as what it stands for, of peak one: together they are nearly
the same everywhere, so that no place is preferred.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from cadence.bearings.linear import WIDE, Sights, spread

_NUM_DIRECTIONS = 10
_WIDTH = 0.6
"""Deviation of a kernel, in distances to its neighbours."""


@dataclass(frozen=True, eq=False)
class Profiles:
    """P supposed tracks, and the kernels at their ends.

    supposed_m [P, M, 2] at the sights
    anchor_row [E] at which sights there are kernels: where bearing or range is missing
    anchor_m   [P, E, 2], anchor_m2 [P, E, 2, 2] the kernels
    """

    supposed_m: Tensor
    anchor_row: Tensor
    anchor_m: Tensor
    anchor_m2: Tensor

    @staticmethod
    def about(supposed_m: Tensor) -> "Profiles":
        """Tracks [P, M, 2] that positions hold where they are: no kernel is needed."""
        nothing = supposed_m.new_zeros(len(supposed_m), 0, 2)
        return Profiles(supposed_m, torch.zeros(0, dtype=torch.int64), nothing, nothing.new_zeros(len(supposed_m), 0, 2, 2))


def supposed_tracks(sights: Sights, nearest_m: float, farthest_m: float, ratio: float) -> Profiles:
    """All supposed tracks from the first to the last sight.

    Args:
        sights: one or more.
        nearest_m: ranges supposed reach from here
        farthest_m: to here,
        ratio: of one to the next at most.
    """
    rows = sorted({0, len(sights) - 1})
    ends = [_places(sights, row, nearest_m, farthest_m, ratio) for row in rows]
    pick = torch.cartesian_prod(*(torch.arange(len(places)) for places, _ in ends)).reshape(-1, len(rows))
    place_m = torch.stack([places[pick[:, end]] for end, (places, _) in enumerate(ends)], 1)
    time_s = sights.time_s
    share = ((time_s - time_s[0]) / (time_s[-1] - time_s[0]).clamp_min(1e-9))[:, None]
    supposed_m = place_m[:, :1] + share * (place_m[:, -1:] - place_m[:, :1])
    open_ends = [end for end, (_, kernels) in enumerate(ends) if kernels is not None]
    anchor_m2 = [kernels[pick[:, end]] for end, (_, kernels) in enumerate(ends) if kernels is not None]
    return Profiles(
        supposed_m,
        torch.tensor([rows[end] for end in open_ends], dtype=torch.int64),
        place_m[:, open_ends],
        torch.stack(anchor_m2, 1) if anchor_m2 else torch.zeros(len(pick), 0, 2, 2, dtype=torch.float64),
    )


def _places(sights: Sights, row: int, nearest_m: float, farthest_m: float, most_ratio: float) -> tuple[Tensor, Tensor | None]:
    """Places [Q, 2] that one sight allows, and their kernels [Q, 2, 2]; none where it tells the place."""
    bearing, ground_m = sights.bearing_rad[row], sights.ground_m[row]
    if bool(bearing.isfinite()):
        unit = torch.stack([bearing.cos(), bearing.sin()])
        if bool(ground_m.isfinite()):
            return (sights.observer_m[row] + ground_m * unit)[None], None
        num = max(4, math.ceil(math.log(farthest_m / nearest_m) / math.log(most_ratio)) + 1)
        range_m = torch.logspace(math.log10(nearest_m), math.log10(farthest_m), num, dtype=torch.float64)
        ratio = float(range_m[1] / range_m[0])
        units = unit.expand(num, 2)
        along_m, across_m = _WIDTH * 0.5 * (ratio - 1.0 / ratio) * range_m, WIDE * range_m
    else:
        angle = torch.arange(_NUM_DIRECTIONS, dtype=torch.float64) * (2.0 * math.pi / _NUM_DIRECTIONS)
        units = torch.stack([angle.cos(), angle.sin()], -1)
        range_m = ground_m.clamp_min(1e-6).expand(_NUM_DIRECTIONS)
        along_m, across_m = WIDE * range_m, _WIDTH * (2.0 * math.pi / _NUM_DIRECTIONS) * range_m
    normal = torch.stack([-units[:, 1], units[:, 0]], -1)
    return sights.observer_m[row] + range_m[:, None] * units, spread(units, along_m) + spread(normal, across_m)
