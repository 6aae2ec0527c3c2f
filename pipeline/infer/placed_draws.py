"""Hypotheses of estimators that are told where their windows are, drawn chunk by chunk."""

from collections.abc import Iterator
from typing import Protocol

import torch
from torch import Tensor

from cadence.constraints.obstacles import Obstacles
from cadence.types import Context, Estimator, WindowBatch

_WINDOWS_AT_ONCE = 32


class Forecaster(Protocol):
    """An estimator that may want to know where its windows are, and what is in the way there."""

    @property
    def name(self) -> str:
        """What it is called."""
        ...

    def placed(self, context: Context, obstacles: Obstacles | None = None) -> Estimator:
        """The estimator for the windows of a context."""
        ...


def draw_placed(
    model: Forecaster, windows: WindowBatch, context: Context, num_hypotheses: int, obstacles: Obstacles
) -> Iterator[tuple[Tensor, Tensor, Tensor, list[list[str]]]]:
    """Windows in chunks: their indices, positions [B', K, A, T, 2] about the datum, weights [B', K], status [B'][A]."""
    for begin in range(0, windows.num_windows, _WINDOWS_AT_ONCE):
        part = torch.arange(begin, min(begin + _WINDOWS_AT_ONCE, windows.num_windows))
        drawn = model.placed(context[part], obstacles).sample(windows[part], num_hypotheses)
        yield part, drawn.position_m.double(), drawn.weight.double(), [list(row) for row in drawn.status]
