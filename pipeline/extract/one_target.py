"""Whether detections without a name may all be one target's."""

from typing import Final

import numpy as np

from cadence.arrays import Float64s, Int64s

_NEIGHBOURS: Final = (-2, -1, 1, 2)
_MAX_GAPS: Final = 3.0
"""Rows whose neighbours are further apart than so many median gaps say nothing."""
_MIN_RESIDUALS: Final = 20
_MIN_ROWS: Final = 48
_WHITE: Final = (0.7, 1.3)
"""Residuals of twice the stride, in those of the stride: 1 for white noise, 1.4 for a random walk, more for manoeuvres."""
_MAX_ELONGATION: Final = 3.0
_MIN_NEAREST: Final = 0.7
_REACH: Final = 4
_MEDIAN: Final = 0.6745
"""Of the absolute values of a standard normal number."""


def is_one_target(time_s: Float64s, position_m: Float64s) -> bool:
    """Whether rows by time [N], positions [N, 2], may be one target's with noise: what scatters is white, round, and its own.

    Of several targets each row would fit far better between some two of its neighbours than between the nearest. What white
    noise of one target would give there is drawn, with a fixed seed, at the same times.
    """
    if len(time_s) < _MIN_ROWS:
        return False
    near, far = (_residuals(time_s, position_m, stride) for stride in (1, 2))
    if min(len(near), len(far)) < _MIN_RESIDUALS or not _scale(near) > 0:
        return False
    low, high = np.linalg.eigvalsh(np.cov(near.T))
    drawn = np.sqrt(np.mean(near**2)) * np.random.default_rng(0).standard_normal(position_m.shape)
    is_noise = _WHITE[0] < _scale(far) / _scale(near) < _WHITE[1] and high < _MAX_ELONGATION * low
    return bool(is_noise and _nearest(time_s, position_m) > _MIN_NEAREST * _nearest(time_s, drawn))


def _scale(residuals_m: Float64s) -> float:
    return float(np.median(np.abs(residuals_m))) / _MEDIAN


def _residuals(time_s: Float64s, position_m: Float64s, stride: int) -> Float64s:
    """Residuals [M, 2] about the cubic through two neighbours on either side, as large as the noise of one position is."""
    offsets = np.array(_NEIGHBOURS) * stride
    at = np.arange(2 * stride, len(time_s) - 2 * stride)
    times = time_s[at[:, None] + offsets]
    span_s = times[:, -1] - times[:, 0]
    is_near = span_s <= 4 * stride * _MAX_GAPS * float(np.median(np.diff(time_s)))
    return _about(time_s, position_m, at[is_near], offsets)


def _about(time_s: Float64s, position_m: Float64s, at: Int64s, offsets: Int64s) -> Float64s:
    """Residuals [M, 2] of rows `at` [M] about the polynomial through those at `offsets`, over the root of their variance."""
    places = at[:, None] + offsets
    times = time_s[places]
    weights = np.ones(places.shape)
    for one in range(len(offsets)):
        for other in range(len(offsets)):
            if one != other:
                weights[:, one] *= (time_s[at] - times[:, other]) / (times[:, one] - times[:, other])
    residuals = position_m[at] - np.einsum("mj,mjd->md", weights, position_m[places])
    return np.asarray(residuals / np.sqrt(1 + (weights**2).sum(axis=1))[:, None])


def _nearest(time_s: Float64s, position_m: Float64s) -> float:
    """Median distance of rows from the nearest of the lines between one of some rows before and one of some after."""
    at = np.arange(_REACH, len(time_s) - _REACH)
    reach = range(1, _REACH + 1)
    lines = [_about(time_s, position_m, at, np.array([-before, after])) for before in reach for after in reach]
    return float(np.median(np.min([np.hypot(*line.T) for line in lines], axis=0)))
