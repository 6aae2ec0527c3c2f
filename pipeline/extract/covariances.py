"""Covariances of positions: what messages state, and how they turn with their frame.

A covariance is six numbers: xx, xy, yy (what the tables keep) and xz, yz, zz (what a tilted sensor frame turns into those).
"""

import math
from typing import Any, Final

import numpy as np

from cadence.arrays import Bools, Float64s

Covariance = tuple[float, float, float, float, float, float]

NONE_COVARIANCE: Final[Covariance] = (math.nan,) * 6
MAX_SIGMA_M: Final = 1e4
"""A position that may be this far off says nothing about a mission; drivers write 1e8 m² or 1e308 for "unknown"."""

_MAX_SIGMAS: Final = 4.0
_PLACES: Final = {  # xx, xy, yy and xz, yz, zz among as many numbers; without heights: only the first three
    4: (0, 1, 3),
    6: (0, 1, 3, 2, 4, 5),
    9: (0, 1, 4, 2, 5, 8),
    21: (0, 1, 6, 2, 7, 11),
    36: (0, 1, 7, 2, 8, 14),
}


def isotropic(variance_m2: float) -> Covariance:
    """The same variance in all directions."""
    return (variance_m2, 0.0, variance_m2, 0.0, 0.0, variance_m2)


def stated_sigma(sigma_m: float) -> Covariance | None:
    """The covariance of a stated standard deviation; None where that says "unknown" (zero, negative, NaN, or huge)."""
    return isotropic(sigma_m**2) if 0 < sigma_m < MAX_SIGMA_M else None


def stated_covariance(matrix: Any) -> Covariance | None:
    """The covariance that a message states; None where it says "unknown": NaN, another number of them, zero, negative, or huge.

    1 (a variance), 4, 9 or 36 numbers are rows of a matrix, 6 or 21 its upper triangle, 3 its diagonal. `ValueError` where it
    is none.
    """
    if isinstance(matrix, int | float):
        matrix = (matrix, 0.0, 0.0, matrix)
    elif len(matrix) == 3:
        matrix = (matrix[0], 0.0, 0.0, matrix[1], 0.0, matrix[2])
    places = _PLACES.get(len(matrix))
    if places is None:
        return None
    xx, xy, yy, *rest = (float(matrix[place]) for place in places)
    if xx == yy == 0 or xx < 0 or yy < 0 or xx >= MAX_SIGMA_M**2 or yy >= MAX_SIGMA_M**2 or (xx != xx and yy != yy):
        return None
    if not (math.isfinite(xx) and math.isfinite(xy) and math.isfinite(yy) and xx * yy > xy * xy):
        raise ValueError("not positive definite")
    return (xx, xy, yy, *_heights(xx, xy, yy, rest))


def _heights(xx: float, xy: float, yy: float, stated: list[float]) -> tuple[float, float, float]:
    """xz, yz, zz; where they are unknown or no part of a covariance, the mean of the other variances alone.

    Without a height's variance a sensor that looks sideways would be taken as exact in one direction.
    """
    xz, yz, zz = stated or (0.0, 0.0, 0.0)
    if not (math.isfinite(xz) and math.isfinite(yz) and math.isfinite(zz) and zz > 0):
        return 0.0, 0.0, (xx + yy) / 2
    determinant = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    return (xz, yz, zz) if determinant > 0 else (0.0, 0.0, zz)


def stated_covariances(matrices: Float64s) -> tuple[Float64s, Bools, Bools]:
    """`stated_covariance` of N matrices [N, 4, 6, 9 or 36] at once: covariances [N, 6], which are stated, which are none.

    Covariances that are not stated mean nothing.
    """
    places = _PLACES[matrices.shape[1]]
    with np.errstate(all="ignore"):
        xx, xy, yy, *rest = (matrices[:, place] for place in places)
        is_unknown = ((xx == 0) & (yy == 0)) | (xx < 0) | (yy < 0) | (xx >= MAX_SIGMA_M**2) | (yy >= MAX_SIGMA_M**2)
        is_unknown |= np.isnan(xx) & np.isnan(yy)
        is_definite = np.isfinite(xx) & np.isfinite(xy) & np.isfinite(yy) & (xx * yy > xy * xy)
        xz, yz, zz = rest or [np.zeros_like(xx)] * 3
        has_height = np.isfinite(xz) & np.isfinite(yz) & np.isfinite(zz) & (zz > 0)
        determinant = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
        is_full = has_height & (determinant > 0)
        heights = (np.where(is_full, xz, 0.0), np.where(is_full, yz, 0.0), np.where(has_height, zz, (xx + yy) / 2))
    return np.column_stack([xx, xy, yy, *heights]), ~is_unknown & is_definite, ~is_unknown & ~is_definite


def rotated(covariance_m2: Float64s, rotation: Float64s) -> Float64s:
    """R C R' [N, 6] of covariances [N, 6] in a frame that is turned by R [N, 3, 3]."""
    full = covariance_m2[:, [0, 1, 3, 1, 2, 4, 3, 4, 5]].reshape(-1, 3, 3)
    turned = np.einsum("nij,njk,nlk->nil", rotation, full, rotation).reshape(-1, 9)
    return np.ascontiguousarray(turned[:, [0, 1, 4, 2, 5, 8]])


def are_apart(offset_m: Float64s, covariance_m2: Float64s, other_m2: Float64s) -> Bools:
    """Which of N pairs of positions, `offset_m` [N, 2] from each other, are not views of one place.

    Their covariances [N, 3] (xx, xy, yy; NaN: exact) allow for four standard deviations: more in one pair of 3000.
    """
    xx, xy, yy = (np.nan_to_num(covariance_m2) + np.nan_to_num(other_m2)).T
    x, y = offset_m.T
    determinant = xx * yy - xy * xy
    with np.errstate(all="ignore"):
        squared = (yy * x * x - 2 * xy * x * y + xx * y * y) / determinant
    apart: Bools = np.where(determinant > 0, squared > _MAX_SIGMAS**2, (x != 0) | (y != 0))
    return apart
