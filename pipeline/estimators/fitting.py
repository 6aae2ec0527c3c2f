"""What estimators are fitted to: the detections of one log, never its truth."""

import dataclasses
import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import torch
from torch import Tensor

from cadence.bank.bank import Bank
from cadence.bank.hindsight import Test, withhold
from cadence.bank.pool import BankPool, pool_as_told, pool_by_hindsight
from cadence.height.bank import HeightBank
from cadence.types import Detections, WindowBatch
from pipeline.grids import Grid
from pipeline.windows import MissionWindows, build_windows, fit_tracks, later_detections

_NUM_TESTS = 32
"""So many tracks are tried of each kind: choices by hindsight cost what they draw."""
_LEAST_GATE_TESTS = 8
"""The network is tried on half as many tracks as are to be drawn, not fewer than these: it costs more than all else."""
_MOST_WINDOWS = 8
"""So many times as many windows as a log has, at most."""


@dataclass(frozen=True, eq=False)
class FittingData:
    """The detections of a log, as a table, as windows and as stretches [R, 1, N].

    told_bank  what `BankPool.about` said of the bank that was fitted to the same log, grid and windows, where that is known:
               it is not found again
    """

    detections: pa.Table
    grid: Grid
    windows: MissionWindows
    tracks: Detections
    default_sigma_m: float
    told_bank: Mapping[str, Any] | None = None

    @staticmethod
    def of(
        detections: pa.Table, grid: Grid, windows: MissionWindows, default_sigma_m: float = 0.0,
        told_bank: Mapping[str, Any] | None = None,
    ) -> "FittingData":  # fmt: skip
        """The data with its stretches cut."""
        tracks = fit_tracks(detections, grid, default_sigma_m)
        return FittingData(detections, grid, windows, tracks, default_sigma_m, told_bank)

    def fitted_heights(self, told: Mapping[str, Any] | None = None) -> HeightBank:
        """The bank of height fitted to the log, which has heights; as is `told` of the same log and grid, if it is."""
        found = None if told is None else HeightBank().as_told(told, self.grid.step_s)
        return found or HeightBank().fit(self.tracks, self.grid.step_s)

    def bank_for_gaps(self, told: Mapping[str, Any] | None) -> BankPool:
        """The bank fitted to the log, pooled as is `told` of the same log and grid, else by hindsight for gaps alone."""
        pool = None if told is None else pool_as_told(self._bank, told)
        return pool or pool_by_hindsight(self._bank, self._past_test, None)

    def fitted_bank(self) -> BankPool:
        """The bank fitted to the log: weights by likelihood, its settings pooled by hindsight."""
        return self._pool

    @functools.cached_property
    def _pool(self) -> BankPool:
        pool = None if self.told_bank is None else pool_as_told(self._bank, self.told_bank)
        return pool or pool_by_hindsight(self._bank, *self.tests)

    @functools.cached_property
    def _bank(self) -> Bank:
        return Bank().fit(self.tracks, self.grid.step_s)

    @functools.cached_property
    def tests(self) -> tuple[Test, Test]:
        """What the choices by hindsight are made on: bursts withheld from windows, and what was detected after windows.

        Every row is one agent's window; where the log has few windows, others between them join.
        """
        windows = self._many_windows
        grid = dataclasses.replace(self.grid, origins_ns=windows.origins_ns)
        later = later_detections(self.detections, grid, windows, self.default_sigma_m)
        is_later = windows.batch.is_active & later.is_observed.any(-1)
        return self._past_test, _rows(windows.batch, later, is_later)

    @property
    def _past_test(self) -> Test:
        kept, withheld = withhold(self._many_windows.batch, 0)
        return _rows(kept, withheld, withheld.is_observed.any(-1))

    @property
    def gate_tests(self) -> tuple[Test, Test]:
        """Some of the tests, evenly spread: what the network's part in the hypotheses is chosen on."""
        num = max(_LEAST_GATE_TESTS, int(self.windows.batch.is_active.sum()) // 2)
        past, future = (_some(*test, num) for test in self.tests)
        return past, future

    @functools.cached_property
    def _many_windows(self) -> MissionWindows:
        """The windows, or so many between them that they hold enough agents to test on."""
        num = int(self.windows.batch.is_active.sum())
        factor = min(_MOST_WINDOWS, math.ceil(2.0 * _NUM_TESTS / max(num, 1)))
        origins_ns = self.grid.origins_ns
        if factor < 2 or len(origins_ns) < 2:
            return self.windows
        first, stride_ns = origins_ns[0], (origins_ns[1] - origins_ns[0]) // factor
        dense = dataclasses.replace(self.grid, origins_ns=first + stride_ns * np.arange(factor * len(origins_ns)))
        return build_windows(self.detections, dense, 0, self.default_sigma_m)

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


def _rows(windows: WindowBatch, unseen: Detections, is_tested: Tensor) -> Test:
    """Evenly spread tests [B, A] as windows of one agent each, and what is unseen of it."""
    pairs = is_tested.nonzero()
    chosen = pairs[torch.linspace(0, len(pairs) - 1, min(_NUM_TESTS, len(pairs))).round().long()]
    row, agent = chosen[:, 0], chosen[:, 1]
    shown = windows.detections
    seen, missing = (
        Detections(*(value[row, agent][:, None] for value in (d.time_s, d.position_m, d.covariance_m2, d.is_observed)))
        for d in (shown, unseen)
    )
    seeds = windows.seeds[row] + agent
    return WindowBatch(windows.time_s, seen, seeds, windows.origin_index), missing


def _some(windows: WindowBatch, unseen: Detections, num: int) -> Test:
    chosen = torch.linspace(0, windows.num_windows - 1, min(num, windows.num_windows)).round().long()
    return windows[chosen], unseen[chosen]
