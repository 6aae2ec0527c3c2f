"""The hypotheses of one agent in one window summed up at every step: middle, principal axes, bands.

Letters of the shapes: K hypothesis, T time step, D space (2).
"""

from dataclasses import dataclass

import numpy as np

from cadence.arrays import Float64s
from pipeline.report.mission import Fan

LEVELS = (0.5, 0.9)
"""Shares of the weight that the two bands hold."""

SMALL_M2 = 1e-6
"""Added to variances (1 mm²): exact detections leave no spread, and a point must still have an inside."""


@dataclass(frozen=True, eq=False)
class FanShape:
    """Hypotheses summed up.

    mean_m [T, 2] weighted mean; axes_m [T, 2] and angle_rad [T]: standard deviations along the principal axes and the
    direction of the first; radius [2, T]: how many of them the bands of `LEVELS` reach
    """

    mean_m: Float64s
    axes_m: Float64s
    angle_rad: Float64s
    radius: Float64s

    @property
    def spread_m(self) -> Float64s:
        """Root mean square distance to the mean [T]."""
        return np.asarray(np.hypot(self.axes_m[:, 0], self.axes_m[:, 1]))

    def __getitem__(self, steps: slice) -> "FanShape":
        """The same of some steps."""
        return FanShape(self.mean_m[steps], self.axes_m[steps], self.angle_rad[steps], self.radius[:, steps])


def shape_of(fan: Fan) -> FanShape:
    """Weighted mean, principal axes and the empirical bands of a fan.

    A band is, at every step, the smallest ellipse with the axes of the weighted covariance that holds the share of the
    weight.
    """
    offset_m = fan.offset_m.astype(np.float64)
    mean_m = np.tensordot(fan.weight, offset_m, 1)
    centred = offset_m - mean_m
    axes_m, angle_rad = _principal_axes(centred, fan.weight)
    along, across = turned(centred, angle_rad)
    distance = np.sqrt(along**2 / (axes_m[:, 0] ** 2 + SMALL_M2) + across**2 / (axes_m[:, 1] ** 2 + SMALL_M2))
    order = np.argsort(distance, axis=0, kind="stable")
    held = np.cumsum(fan.weight[order], axis=0)
    ranked = np.take_along_axis(distance, order, 0)
    # The first hypothesis at which the share is reached; the small number forgives the rounding of the sum.
    radius = [np.take_along_axis(ranked, (held >= level - 1e-9).argmax(0)[None], 0)[0] for level in LEVELS]
    return FanShape(mean_m + fan.datum_m, axes_m, angle_rad, np.stack(radius))


def spread_at(fan: Fan, steps: list[int]) -> Float64s:
    """Root mean square distance to the mean at some steps only."""
    offset_m = fan.offset_m[:, steps].astype(np.float64)
    centred = offset_m - np.tensordot(fan.weight, offset_m, 1)
    return np.asarray(np.sqrt(np.tensordot(fan.weight, (centred**2).sum(axis=-1), 1)))


def turned(centred: Float64s, angle_rad: Float64s) -> tuple[Float64s, Float64s]:
    """Components [K, T] of [K, T, 2] along directions [T] and across them."""
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    return centred[..., 0] * cos + centred[..., 1] * sin, centred[..., 1] * cos - centred[..., 0] * sin


def _principal_axes(centred: Float64s, weight: Float64s) -> tuple[Float64s, Float64s]:
    """Standard deviations along the axes of the weighted covariance [T, 2], largest first, and the angle of the first [T]."""
    xx, yy = (np.tensordot(weight, centred[..., axis] ** 2, 1) for axis in (0, 1))
    xy = np.tensordot(weight, centred[..., 0] * centred[..., 1], 1)
    half, turn = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    variance = np.maximum(np.stack([half + turn, half - turn], axis=1), 0.0)
    return np.sqrt(variance), np.arctan2(2 * xy, xx - yy) / 2
