"""A checkpoint as the stages see it, whatever its preset: how it is fitted to a log, and which grid it takes."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from cadence.types import Estimator
from pipeline.estimators.fitting import FittingData
from pipeline.grids import GridConfig


@dataclass(frozen=True, eq=False)
class Fitted:
    """An estimator adapted to one log, and what a summary says of it."""

    estimator: Estimator
    about: Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Loaded:
    """The estimator of a checkpoint before it has seen a log.

    preset         of the checkpoint
    estimator      what samples; of presets that `fit` adapts to a log, as it is before
    grid           the grid that it takes, out of the configured one; `ConfigError` where it takes another one only
    fit            adapts it to a log; None: nothing adapts
    is_apart       it draws every agent by itself, whatever the others of a window do
    knows_standing it was trained where sensors stood that stand in its place for ever, so that their silence is in its tracks
                   already; only that of moving ones may count
    num_past       so many steps before the first one of its grid it can draw as well, for evidence to be heard there
    """

    preset: str
    estimator: Estimator
    grid: Callable[[GridConfig], GridConfig]
    fit: Callable[[FittingData], Fitted] | None = None
    is_apart: bool = False
    num_past: int = 0
    knows_standing: bool = False

    def fitted(self, data: FittingData) -> Fitted:
        """The estimator for one log."""
        return Fitted(self.estimator, {"preset": self.preset}) if self.fit is None else self.fit(data)
