"""Latitude and longitude under the mouse: a polynomial that the page's script can evaluate without a geodesy library."""

from dataclasses import dataclass

import numpy as np

from cadence.arrays import Float64s
from pipeline.frames import to_geodetic
from pipeline.tables import Frame

DEGREE = 4
EXPONENTS = tuple((i, j) for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i))


@dataclass(frozen=True, eq=False)
class GeodesyFit:
    """latitude, longitude = polynomials in (x - centre) / half_m, (y - centre) / half_m of the mission frame, degrees."""

    centre_m: Float64s
    half_m: float
    latitude: Float64s
    longitude: Float64s

    def as_json(self) -> dict[str, object]:
        """For the page's script."""
        return {
            "centre_m": self.centre_m.tolist(),
            "half_m": self.half_m,
            "exponents": [list(pair) for pair in EXPONENTS],
            "latitude": [float(f"{value:.12g}") for value in self.latitude],
            "longitude": [float(f"{value:.12g}") for value in self.longitude],
        }


def fit_geodesy(frame: Frame, low_m: Float64s, high_m: Float64s) -> GeodesyFit | None:
    """A fit over the square around [low_m, high_m] and half as much again.

    None where the frame has no datum, or where the fit would be wrong by over a metre (areas of a continent's size).
    """
    if frame.latitude_deg is None or frame.longitude_deg is None:
        return None
    centre_m = (low_m + high_m) / 2
    half_m = max(float((high_m - low_m).max()) * 0.75, 500.0)
    line = np.cos(np.linspace(0, np.pi, 2 * DEGREE + 3))
    u, v = (grid.ravel() for grid in np.meshgrid(line, line))
    latitude, longitude = to_geodetic(frame, centre_m[0] + u * half_m, centre_m[1] + v * half_m)
    # Counted from the datum, so that a mission across 180° has no jump in it; the script folds it back.
    longitude = frame.longitude_deg + np.mod(longitude - frame.longitude_deg + 180, 360) - 180
    basis = np.stack([u**i * v**j for i, j in EXPONENTS], axis=1)
    fits = []
    for values in (latitude, longitude):
        if not np.isfinite(values).all() or np.ptp(values) > 90:
            return None
        solution = np.linalg.lstsq(basis, values, rcond=None)[0]
        if np.abs(basis @ solution - values).max() > 1e-5:
            return None
        fits.append(solution)
    return GeodesyFit(centre_m, half_m, fits[0], fits[1])
