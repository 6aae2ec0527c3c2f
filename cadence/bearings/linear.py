"""Measurements made linear: positions of unequal noise that stand for bearings and ranges near a supposed track.

A bearing says where a target is across the line of sight, a range where along it. About a supposed place both are linear
(extended Kalman filter); what was not measured is left open by a wide noise.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from cadence.evidence.measurements import Measurements

WIDE = 20.0
"""Noise of what was not measured, in distances from the observer."""
_MOST_TURN = 0.4
"""Radians from the supposed bearing beyond which the measured one, not the supposed one, is the line of sight."""


@dataclass(frozen=True, eq=False)
class Sights:
    """What bearings and ranges tell in the plane; NaN where there is none.

    time_s            [M] not decreasing
    observer_m        [M, 2]
    bearing_rad       [M]
    bearing_sigma_rad [M]
    ground_m          [M] range in the plane
    ground_sigma_m    [M]
    """

    time_s: Tensor
    observer_m: Tensor
    bearing_rad: Tensor
    bearing_sigma_rad: Tensor
    ground_m: Tensor
    ground_sigma_m: Tensor

    def __len__(self) -> int:
        return len(self.time_s)

    def __getitem__(self, rows: Tensor) -> "Sights":
        """Some of the rows."""
        return Sights(*(value[rows] for value in vars(self).values()))


def sights_of(measurements: Measurements) -> Sights:
    """The rows with a bearing or a range; ranges are projected by the elevation where it is measured."""
    names = ("time_s", "observer_m", "bearing_rad", "bearing_sigma_rad", "range_m", "range_sigma_m", "elevation_rad")
    columns = (torch.from_numpy(getattr(measurements, name).copy()) for name in names)
    time_s, observer_m, bearing, sigma, slant_m, slant_sigma_m, elevation = columns
    flat = torch.where(elevation.isfinite(), elevation.cos(), 1.0)
    is_told = bearing.isfinite() | slant_m.isfinite()
    found = (time_s, observer_m, bearing, sigma, slant_m * flat, slant_sigma_m * flat)
    return Sights(*(value[is_told] for value in found))


def pseudo_positions(sights: Sights, supposed_m: Tensor) -> tuple[Tensor, Tensor]:
    """Positions [..., M, 2] and their covariances that stand for what was measured.

    About the supposed line of sight, not the measured one: a target farther away than supposed would else be further off every
    bearing, by what the noise has turned it.

    Args:
        sights: M rows.
        supposed_m: [..., M, 2] where the target is supposed.
    """
    apart = supposed_m - sights.observer_m
    has_bearing, has_range = sights.bearing_rad.isfinite(), sights.ground_m.isfinite()
    away_m = torch.linalg.vector_norm(apart, dim=-1).clamp_min(1e-6)
    expected = torch.atan2(apart[..., 1], apart[..., 0])
    error = turned(sights.bearing_rad - expected)
    is_near = ~has_bearing | (error.abs() < _MOST_TURN)
    direction = torch.where(is_near, expected, sights.bearing_rad)
    along = torch.stack([direction.cos(), direction.sin()], -1)
    across = torch.stack([-direction.sin(), direction.cos()], -1)
    # far off the line of sight the supposed place is first brought onto it, no nearer than a tenth of its distance
    ahead_m = torch.where(is_near, away_m, torch.maximum((apart * along).sum(-1), 0.1 * away_m))
    ahead_m = torch.where(has_range, sights.ground_m.clamp_min(1e-6), ahead_m)
    across_m = torch.where(has_bearing & is_near, ahead_m * error, 0.0)
    along_sigma_m = torch.where(has_range, sights.ground_sigma_m, WIDE * ahead_m)
    across_sigma_m = torch.where(has_bearing, ahead_m * sights.bearing_sigma_rad, WIDE * ahead_m)
    position_m = sights.observer_m + ahead_m[..., None] * along + across_m[..., None] * across
    return position_m, spread(along, along_sigma_m) + spread(across, across_sigma_m)


def spread(direction: Tensor, sigma_m: Tensor) -> Tensor:
    """Covariance [..., 2, 2] of a deviation [...] along a unit vector [..., 2]."""
    scaled = sigma_m[..., None] * direction
    return scaled[..., :, None] * scaled[..., None, :]


def turned(angle: Tensor) -> Tensor:
    """The same angle between -pi and pi."""
    return torch.remainder(angle + math.pi, 2.0 * math.pi) - math.pi
