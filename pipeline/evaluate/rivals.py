"""The rivals by name, each fitted to the detections of one log — never to its truth."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import pyarrow as pa

from cadence.baselines.interpolation import Hold, LinearInterpolation
from cadence.baselines.kalman import ConstantVelocityKalman, OrnsteinUhlenbeckKalman
from cadence.types import Detections, Estimator
from pipeline.infer.stage import fitted_bank
from pipeline.windows import Grid, MissionWindows, fit_tracks


@dataclass(frozen=True, eq=False)
class FittingData:
    """What estimators may be fitted to: the detections of a log, as a table, as windows and as stretches [R, 1, N]."""

    detections: pa.Table
    grid: Grid
    windows: MissionWindows
    tracks: Detections
    default_sigma_m: float

    @staticmethod
    def of(detections: pa.Table, grid: Grid, windows: MissionWindows, default_sigma_m: float = 0.0) -> "FittingData":
        """The data with its stretches cut."""
        return FittingData(detections, grid, windows, fit_tracks(detections, grid, default_sigma_m), default_sigma_m)


def _bank(data: FittingData) -> Estimator:
    return fitted_bank(data.tracks, data.detections, data.grid, data.windows, data.default_sigma_m)


RIVALS: Mapping[str, Callable[[FittingData], Estimator]] = {
    "bank": _bank,
    "cv": lambda data: ConstantVelocityKalman().fit(data.tracks, data.grid.step_s),
    "ou": lambda data: OrnsteinUhlenbeckKalman().fit(data.tracks, data.grid.step_s),
    "linear": lambda data: LinearInterpolation().fit(data.tracks),
    "hold": lambda data: Hold().fit(data.tracks),
}
"""bank: the bank of motion models that the diffusion model starts from; cv, ou: Kalman + RTS with constant velocity and with
Ornstein-Uhlenbeck velocity; linear, hold: interpolation."""
