"""The bank of height: fitted to a log's own heights, drawn beside the hypotheses of whatever estimator draws the plane.

Given the detections, height is independent of the plane: a hypothesis is a draw of the one beside a draw of the other.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from cadence.arrays import Float64s
from cadence.height.draws import draw, random_numbers
from cadence.height.filtering import Nodes, Switching, filter_forward
from cadence.height.fitting import DIFFUSE_STEPS, FLOOR_STEPS, fit_weights, typical_rate
from cadence.height.modes import Modes, default_modes
from cadence.seeds import derived_seeds
from cadence.types import Detections, Estimator, HypothesisSet, WindowBatch

_ROWS_AT_ONCE = 256


@dataclass(frozen=True, eq=False)
class HeightTrack:
    """Heights of one agent: time_s [N] not decreasing, height_m [N], variance_m2 [N] (NaN: exact)."""

    time_s: Float64s
    height_m: Float64s
    variance_m2: Float64s


@dataclass(frozen=True, eq=False)
class HeightBank:
    """Weighted modes in the units of one log.

    modes, prior   C modes in units of steps and step lengths, and their weights [C] before a log is seen
    log_weight     [C]; the prior's where None
    rate_mps       typical vertical rate: one step length is rate_mps * step_s; None until fitted
    step_s         of the windows
    pseudo_count   how many detections' worth of evidence the prior holds against the log
    """

    modes: Modes = dataclasses.field(default_factory=lambda: default_modes()[0])
    prior: Tensor = dataclasses.field(default_factory=lambda: default_modes()[1])
    log_weight: Tensor | None = None
    rate_mps: float | None = None
    step_s: float = 1.0
    pseudo_count: float = 20.0

    def fit(self, tracks: Detections, step_s: float) -> "HeightBank":
        """The bank with rate and weights learned from stretches of detections [B, 1, N] with heights."""
        rows, _ = _rows(tracks)
        rate_mps = typical_rate(rows, step_s)
        found = dataclasses.replace(self, rate_mps=rate_mps, step_s=step_s)
        rows = _selected(rows, rows.is_observed.sum(1) > 1)
        if len(rows.time_s):
            modes, rows = self.modes.scaled(step_s, rate_mps), found._floored(rows)
            log_weight = fit_weights(modes, self.prior, rows, DIFFUSE_STEPS * found._length_m, self.pseudo_count)
            found = dataclasses.replace(found, log_weight=log_weight)
        return found

    def sample(self, windows: WindowBatch, num_hypotheses: int) -> Tensor:
        """Heights [B, K, A, T] in metres; NaN for agents without any. Deterministic in the windows' seeds."""
        rows, has_height = _rows(windows.detections)
        b, a = has_height.shape
        seeds = derived_seeds(windows.seeds.numpy()[:, None], "height", torch.arange(a).numpy())
        found = torch.full((b, a, num_hypotheses, windows.num_steps), math.nan, dtype=torch.float64)
        found[has_height] = self.sample_rows(rows, windows.time_s, torch.from_numpy(seeds)[has_height], num_hypotheses)
        return found.transpose(1, 2)

    def sample_rows(self, rows: Nodes, time_s: Tensor, seeds: Tensor, num_hypotheses: int) -> Tensor:
        """Heights [R, K, T] at times [T], increasing, of rows of detections [R, N]; each row by its own seed [R]."""
        nodes, step_index = _merged(self._floored(rows), time_s)
        switching = Switching(self.modes.scaled(self.step_s, self._rate()), self._log_weight())
        num_used, parts = len(time_s) + rows.is_observed.sum(1), []
        for begin in range(0, len(rows.time_s), _ROWS_AT_ONCE):
            chosen = torch.arange(begin, min(begin + _ROWS_AT_ONCE, len(rows.time_s)))
            some = _selected(nodes, chosen)
            filtered = filter_forward(switching, some, DIFFUSE_STEPS * self._length_m)
            numbers = random_numbers(seeds[chosen], num_used[chosen], num_hypotheses, some.time_s.shape[1])
            height, _ = draw(switching, some, filtered, numbers)
            parts.append(height.gather(2, step_index[chosen][:, None].expand(-1, num_hypotheses, -1)))
        return torch.cat(parts) if parts else torch.zeros(0, num_hypotheses, len(time_s), dtype=torch.float64)

    def on_times(self, tracks: Sequence[HeightTrack], time_s: Float64s, num_hypotheses: int, seed: int) -> Float64s:
        """Heights [K, A, T] of A agents at times [T] that increase and need not be even: joint over all times.

        What mission hypotheses carry beside their plane (`cadence.stories.Stories`). Agents without any height are NaN.
        """
        found = torch.full((len(tracks), num_hypotheses, len(time_s)), math.nan, dtype=torch.float64)
        seeds = torch.from_numpy(derived_seeds(seed, "height", torch.arange(len(tracks)).numpy()))
        for agent, track in enumerate(tracks):
            is_known = torch.from_numpy(track.height_m).isfinite()[None]
            if bool(is_known.any()):
                time, height_m, variance_m2 = (
                    torch.from_numpy(value)[None] for value in (track.time_s, track.height_m, track.variance_m2)
                )
                rows = Nodes(time, height_m.nan_to_num(), variance_m2.nan_to_num(), is_known)
                found[agent] = self.sample_rows(rows, torch.from_numpy(time_s), seeds[agent : agent + 1], num_hypotheses)[0]
        drawn: Float64s = found.transpose(0, 1).numpy()
        return drawn

    def about(self) -> dict[str, Any]:
        """What a summary says of it."""
        return {"rate_mps": self.rate_mps, "num_modes": len(self.modes), "log_weight": self._log_weight().tolist()}

    def as_told(self, about: Mapping[str, Any], step_s: float) -> "HeightBank | None":
        """The bank as what `about` said of it once fitted, for the same step; None where that is of another bank."""
        rate_mps, log_weight = about.get("rate_mps"), about.get("log_weight")
        if not isinstance(rate_mps, float) or not isinstance(log_weight, list) or len(log_weight) != len(self.modes):
            return None
        weight = torch.tensor(log_weight, dtype=torch.float64)
        return dataclasses.replace(self, rate_mps=rate_mps, step_s=step_s, log_weight=weight)

    def _floored(self, rows: Nodes) -> Nodes:
        return dataclasses.replace(rows, variance_m2=rows.variance_m2 + (FLOOR_STEPS * self._length_m) ** 2)

    @property
    def _length_m(self) -> float:
        """One step length."""
        return self._rate() * self.step_s

    def _rate(self) -> float:
        if self.rate_mps is None:
            raise ValueError("HeightBank: fit() it to the detections of a log first; it has no unit of rate")
        return self.rate_mps

    def _log_weight(self) -> Tensor:
        return self.prior.log() if self.log_weight is None else self.log_weight


@dataclass(frozen=True, eq=False)
class HeightBeside:
    """An estimator whose hypotheses have heights, drawn by the bank beside them."""

    plane: Estimator
    bank: HeightBank

    @property
    def name(self) -> str:
        """The plane's."""
        return self.plane.name

    def fit(self, tracks: Detections) -> "HeightBeside":
        """The plane's estimator fitted; the bank as it is."""
        return dataclasses.replace(self, plane=self.plane.fit(tracks))

    def sample(self, windows: WindowBatch, num_hypotheses: int) -> HypothesisSet:
        """The plane's hypotheses, each with a height of its own."""
        drawn = self.plane.sample(windows, num_hypotheses)
        return dataclasses.replace(drawn, height_m=self.bank.sample(windows, num_hypotheses))


def _rows(detections: Detections) -> tuple[Nodes, Tensor]:
    """Heights of every agent that has any, as rows [R, N], and which agents these are [B, A]; times never run backwards."""
    if detections.height_m is None or detections.height_variance_m2 is None:
        raise ValueError("HeightBank: the detections have no heights")
    is_known = detections.is_observed & detections.height_m.isfinite()
    has_height = is_known.any(-1)
    num = max(1, int(detections.count.max())) if has_height.any() else 1
    time_s, is_known = detections.time_s[has_height][:, :num].double(), is_known[has_height][:, :num]
    time_s = torch.where(is_known, time_s, -torch.inf).cummax(dim=1).values
    time_s = torch.where(time_s.isfinite(), time_s, torch.where(is_known, time_s, torch.inf).amin(1, keepdim=True))
    height_m = detections.height_m[has_height][:, :num].double().nan_to_num()
    variance_m2 = detections.height_variance_m2[has_height][:, :num].double().nan_to_num()  # not stated: exact
    return Nodes(time_s, height_m, variance_m2, is_known), has_height


def _merged(rows: Nodes, time_s: Tensor) -> tuple[Nodes, Tensor]:
    """Grid steps [T] and detections in one time order, and where the steps [R, T] ended up; padding lies behind the last."""
    num_rows, num_steps = len(rows.time_s), len(time_s)
    grid = time_s.double().expand(num_rows, num_steps)
    time, order = torch.cat([grid, torch.where(rows.is_observed, rows.time_s, grid[:, -1:])], 1).sort(dim=1, stable=True)

    def sorted_in(value: Tensor, fill: float | bool) -> Tensor:
        return torch.cat([torch.full((num_rows, num_steps), fill, dtype=value.dtype), value], 1).gather(1, order)

    nodes = Nodes(time, sorted_in(rows.height_m, 0.0), sorted_in(rows.variance_m2, 1.0), sorted_in(rows.is_observed, False))
    return nodes, torch.argsort(order, dim=1)[:, :num_steps]


def _selected(rows: Nodes, chosen: Tensor) -> Nodes:
    return Nodes(*(value[chosen] for value in vars(rows).values()))
