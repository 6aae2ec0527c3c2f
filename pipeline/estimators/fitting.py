"""What estimators are fitted to: the detections of one log, never its truth."""

import functools
from dataclasses import dataclass

import pyarrow as pa
import torch

from cadence.bank.bank import Bank
from cadence.bank.hindsight import choose_by_hindsight
from cadence.types import Detections, WindowBatch
from pipeline.grids import Grid
from pipeline.windows import MissionWindows, fit_tracks, later_detections

_HINDSIGHT_ROWS = 64
"""So many tracks are tried: the choice among settings of a bank and the network's part in it cost what they draw."""


@dataclass(frozen=True, eq=False)
class FittingData:
    """The detections of a log, as a table, as windows and as stretches [R, 1, N]."""

    detections: pa.Table
    grid: Grid
    windows: MissionWindows
    tracks: Detections
    default_sigma_m: float

    @staticmethod
    def of(detections: pa.Table, grid: Grid, windows: MissionWindows, default_sigma_m: float = 0.0) -> "FittingData":
        """The data with its stretches cut."""
        return FittingData(detections, grid, windows, fit_tracks(detections, grid, default_sigma_m), default_sigma_m)

    def fitted_bank(self) -> Bank:
        """The bank fitted to the log: weights by likelihood, the choice among its settings by hindsight on later detections."""
        bank = Bank().fit(self.tracks, self.grid.step_s)
        return choose_by_hindsight(bank, *self.hindsight_windows)

    @functools.cached_property
    def hindsight_windows(self) -> tuple[WindowBatch, Detections]:
        """What the choices by hindsight are made on: see `later_known`."""
        return self.later_known(_HINDSIGHT_ROWS)

    def later_known(self, num_rows: int) -> tuple[WindowBatch, Detections]:
        """Evenly spread windows in which something was detected before the origin and after it, and what was after it.

        They hold about `num_rows` tracks.
        """
        later = later_detections(self.detections, self.grid, self.windows, self.default_sigma_m)
        useful = (self.windows.batch.is_active & later.is_observed.any(-1)).sum(1)
        order = torch.nonzero(useful)[:, 0]
        num = max(1, int(num_rows / float(useful[order].double().mean()))) if len(order) else 0
        chosen = order[torch.linspace(0, len(order) - 1, min(num, len(order))).round().long()]
        return self.windows.batch[chosen], later[chosen]
