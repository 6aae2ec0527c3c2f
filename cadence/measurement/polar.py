"""Range, bearing and elevation as positions: without bias, with the covariance that such a position has.

A position made of noisy angles lies, on average, too near: the mean of a cosine is less than the cosine of the mean. Divided by
that factor it is unbiased, and its covariance is known in closed form for normal noise: the modified unbiased converted
measurement of Mo Longbin, Song Xiaoquan, Zhou Yiyu, Sun Zhong Kang and Bar-Shalom, "Unbiased converted measurements for
tracking", IEEE Transactions on Aerospace and Electronic Systems 34 (3), 1998, 1023-1027: the square error about the
position, expected over what is true given what was measured. It takes up the debiased conversion of Lerro and Bar-Shalom,
"Tracking with debiased consistent converted measurements versus EKF", same transactions 29 (3), 1993, 1015-1022.
"""

from typing import Final

import numpy as np

from cadence.arrays import Bools, Float64s

MOST_BEND: Final = 0.4
"""Of range · sigma² of the bearing over the sigma of the range, up to which what was measured is as good as a normal position:
Lerro and Bar-Shalom's bound for conversions without correction. Beyond it the likelihood bends around the sensor."""


def cartesian(
    range_m: Float64s, bearing_rad: Float64s, elevation_rad: Float64s, range_sigma_m: Float64s, bearing_sigma_rad: Float64s,
    elevation_sigma_rad: Float64s,
) -> tuple[Float64s, Float64s]:  # fmt: skip
    """Positions [N, 3] in metres and their covariances [N, 3, 3], in the axes of the sensor.

    Args:
        range_m: [N] straight to the target.
        bearing_rad: [N] from x towards y.
        elevation_rad: [N] from the plane of x and y towards z; zero, with a sigma of zero, where it is not measured.
        range_sigma_m: [N] standard deviation, as are the two of the angles.
        bearing_sigma_rad: [N]
        elevation_sigma_rad: [N]
    """
    less_bearing, less_elevation = np.exp(-0.5 * bearing_sigma_rad**2), np.exp(-0.5 * elevation_sigma_rad**2)
    flat = range_m * np.cos(elevation_rad)
    measured = np.stack([flat * np.cos(bearing_rad), flat * np.sin(bearing_rad), range_m * np.sin(elevation_rad)], axis=-1)
    less = np.stack([less_bearing * less_elevation, less_bearing * less_elevation, less_elevation], axis=-1)
    position, mean = measured / less, measured * less
    squares = _mean_squares(range_m, bearing_rad, elevation_rad, range_sigma_m, bearing_sigma_rad, elevation_sigma_rad)
    cross = position[:, :, None] * mean[:, None, :]
    covariance = position[:, :, None] * position[:, None, :] - cross - cross.transpose(0, 2, 1) + squares
    return position, covariance


def _mean_squares(
    range_m: Float64s, bearing_rad: Float64s, elevation_rad: Float64s, range_sigma_m: Float64s, bearing_sigma_rad: Float64s,
    elevation_sigma_rad: Float64s,
) -> Float64s:  # fmt: skip
    """The mean of p p' [N, 3, 3] over true positions p, given what was measured."""
    square = range_m**2 + range_sigma_m**2
    cos2_b, sin2_b, both_b = _second_moments(bearing_rad, bearing_sigma_rad)
    cos2_e, sin2_e, both_e = _second_moments(elevation_rad, elevation_sigma_rad)
    less = np.exp(-0.5 * bearing_sigma_rad**2)
    xx, xy, yy = square * cos2_b * cos2_e, square * both_b * cos2_e, square * sin2_b * cos2_e
    xz, yz = square * less * np.cos(bearing_rad) * both_e, square * less * np.sin(bearing_rad) * both_e
    rows = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, square * sin2_e], axis=-1)
    return rows.reshape(-1, 3, 3)


def _second_moments(angle_rad: Float64s, sigma_rad: Float64s) -> tuple[Float64s, Float64s, Float64s]:
    """Means of cos², sin² and cos · sin [N] of normal angles."""
    less = np.exp(-2.0 * sigma_rad**2)
    cosine, sine = less * np.cos(2.0 * angle_rad), less * np.sin(2.0 * angle_rad)
    return (1.0 + cosine) / 2.0, (1.0 - cosine) / 2.0, sine / 2.0


def is_nearly_normal(range_m: Float64s, range_sigma_m: Float64s, bearing_sigma_rad: Float64s) -> Bools:
    """Which positions [N] of a range and a bearing say all that was measured (`MOST_BEND`)."""
    found: Bools = range_m * bearing_sigma_rad**2 <= MOST_BEND * range_sigma_m
    return found
