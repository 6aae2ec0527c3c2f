"""Silence as evidence: where sensors looked and did not detect an agent, its track hardly was.

A look at time t that misses has probability 1 - P(detect | distance). Looks are not independent: what hid a target at one
moment hides it at the next. So their log likelihood is multiplied by an exponent, one for all, which is stated or chosen where
withheld detections tell (`cadence.evidence.exponents`).
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import shapely
import torch
from torch import Tensor

from cadence.arrays import Bools, Float64s, Int64s
from cadence.constraints.obstacles import Obstacles
from cadence.evidence.footprints import Area, DetectionCurve, detection_probability
from cadence.evidence.ground import WIDTH, Ground, without_beyond
from cadence.types import Tracks

_MOST_NUMBERS = 4_000_000
_LEAST_PROBABILITY = 1e-3
"""That the best of many tracks stayed undetected by chance; above it nothing is contradicted."""
_MOST_DEVIATIONS = 4.0


@dataclass(frozen=True, eq=False)
class Looks:
    """Looks of sensors that share a curve and an area, in the mission's frame and time.

    time_s      [L] seconds from the beginning of the mission, not decreasing
    position_m  [L, 2] where the sensor stood
    range_m     [L] unit of the curve's distances: 1 for metres, else a range that differs from look to look
    heading_rad [L] which way the sensor faced, from east to north; used by areas only
    curve, area see `footprints`; area None: all around
    seen        [L] names of the agents that this look detected, which it is not silent about; None stands for nobody knows
                whom, and is silent about nobody
    trust       share of the log likelihood that counts, below 1 where the footprint contradicts detections
    """

    time_s: Float64s
    position_m: Float64s
    range_m: Float64s
    heading_rad: Float64s
    curve: DetectionCurve
    area: Area | None = None
    seen: Sequence[frozenset[str | None]] = ()
    trust: float = 1.0

    def __post_init__(self) -> None:
        num = len(self.time_s)
        shapes = {"position_m": (num, 2), "range_m": (num,), "heading_rad": (num,)}
        for name, want in shapes.items():
            if getattr(self, name).shape != want:
                raise ValueError(f"Looks.{name} has shape {getattr(self, name).shape}, expected {want}")
        if (np.diff(self.time_s) < 0).any() or not (self.range_m >= 0).all() or not np.isfinite(self.position_m).all():
            raise ValueError("Looks: times must not fall, ranges not be negative, positions be finite")
        if self.seen and len(self.seen) != num:
            raise ValueError(f"Looks: {len(self.seen)} entries of who was seen for {num} looks")

    def __len__(self) -> int:
        return len(self.time_s)

    def __getitem__(self, rows: slice | Bools | Int64s) -> "Looks":
        """Some of the looks."""
        index = np.arange(len(self))[rows]
        seen = tuple(self.seen[i] for i in index.tolist()) if self.seen else ()
        columns = {name: getattr(self, name)[index] for name in ("time_s", "position_m", "range_m", "heading_rad")}
        return dataclasses.replace(self, **columns, seen=seen)

    def probability(self, position_m: Float64s) -> Float64s:
        """P(detect) [..., L] of agents at positions [..., L, 2], one a look."""
        return detection_probability(self.curve, self.area, position_m, self.position_m, self.heading_rad, self.range_m)

    def is_silent(self, agent: str | None) -> Bools:
        """Which looks [L] saw neither this agent nor somebody whom nobody knows."""
        if not self.seen:
            return np.ones(len(self), dtype=bool)
        return np.array([not (agent in names or None in names) for names in self.seen], dtype=bool)


@dataclass(frozen=True, eq=False)
class Silence:
    """Evidence of looks that missed.

    looks      of all sensors, those that share curve and area together
    exponent   of the likelihood, 0 (silence says nothing) to 1 (looks are independent)
    most_sure  no look is believed to detect more surely than this: footprints are never known so well
    obstacles  that hide what is behind them; none: nothing does
    ground     beyond which silence says nothing; None: it speaks of every place
    """

    looks: tuple[Looks, ...]
    exponent: float = 1.0
    most_sure: float = 0.98
    obstacles: Obstacles = field(default_factory=Obstacles.none)
    ground: Ground | None = None
    name: str = "silence"

    def __post_init__(self) -> None:
        if not 0 <= self.exponent <= 1 or not 0 < self.most_sure < 1:
            raise ValueError(f"Silence: exponent {self.exponent} from 0 to 1, most_sure {self.most_sure} between 0 and 1")

    def touches(self, time_s: Tensor) -> Tensor:
        """Steps [B, T] next to which a sensor looked."""
        steps = time_s.double().numpy()
        found = np.zeros(steps.shape, dtype=bool)
        if self.exponent > 0:
            for looks in self.looks:
                before = np.searchsorted(looks.time_s, np.pad(steps, ((0, 0), (1, 0)), mode="edge")[:, :-1], "left")
                after = np.searchsorted(looks.time_s, np.pad(steps, ((0, 0), (0, 1)), mode="edge")[:, 1:], "right")
                found |= after > before
        return torch.from_numpy(found)

    def contradicts(self, tracks: Tracks, log_likelihood: Tensor) -> Tensor:
        """Where many more looks missed than can be, wherever the agent was [B, A].

        Every look detects with the least P of all tracks at least. Of the looks that do, so many should have missed; that
        more did by over four standard deviations (Poisson binomial) has no chance.
        """
        is_odd = log_likelihood.amax(1) < self.exponent * math.log(_LEAST_PROBABILITY)
        position_m, time_s = tracks.position_m.double().numpy(), tracks.time_s.double().numpy()
        names = tracks.agent_ids or (None,) * position_m.shape[2]
        for row, agent in is_odd.nonzero().tolist():
            missed = expected = variance = 0.0
            for looks in self.looks:
                some, least = self._least_probability(looks, position_m[row, :, agent], time_s[row])
                missed += float(np.count_nonzero(some.is_silent(names[agent]) & (least > 0)))
                expected += float((1.0 - least)[least > 0].sum())
                variance += float((least * (1.0 - least)).sum())
            is_odd[row, agent] = missed - expected - 0.5 > _MOST_DEVIATIONS * math.sqrt(variance)
        return is_odd

    def _least_probability(self, looks: Looks, position_m: Float64s, time_s: Float64s) -> tuple[Looks, Float64s]:
        """The looks near the tracks [K, T, 2] of an agent, and the least P of any of them [L]; zero where one is hidden."""
        some = _within_reach(looks, position_m[:, None], time_s)
        if not len(some):
            return some, np.zeros(0)
        place_m = _places(some, position_m[:, None], time_s)
        found = np.minimum(some.probability(place_m), self.most_sure)
        if self.obstacles.count:
            found = np.where(self._is_hidden(some, place_m, found > 0), 0.0, found)
        return some, np.nan_to_num(found, nan=0.0)[:, 0].min(axis=0)

    def log_likelihood(self, tracks: Tracks) -> Tensor:
        """Sum over the looks of log(1 - P) at the places between two steps, times the exponent [B, K, A]."""
        return self.log_likelihoods(tracks, (self.exponent,))[0]

    def log_likelihoods(self, tracks: Tracks, exponents: Sequence[float]) -> tuple[Tensor, ...]:
        """`log_likelihood` with each of the exponents in turn."""
        position_m, time_s = tracks.position_m.double().numpy(), tracks.time_s.double().numpy()
        names = tracks.agent_ids or (None,) * position_m.shape[2]
        total = np.zeros((len(exponents), *position_m.shape[:3]))
        for row in range(len(position_m)):
            ground = None if self.ground is None else self.ground.until(float(time_s[row, -1]))
            for looks in self.looks:
                total[:, row] += self._missed(looks, position_m[row], time_s[row], names, exponents, ground)
        return tuple(torch.from_numpy(one) for one in total)

    def _missed(
        self, looks: Looks, position_m: Float64s, time_s: Float64s, names: Sequence[str | None], exponents: Sequence[float],
        ground: shapely.Geometry | None,
    ) -> Float64s:  # fmt: skip
        """Log probability, times each exponent, that the looks within `time_s` [T] miss the tracks [K, A, T, 2]: [E, K, A]."""
        total = np.zeros((len(exponents), *position_m.shape[:2]))
        some = _within_reach(looks, position_m, time_s)
        at_once = max(1, _MOST_NUMBERS // max(1, 2 * total[0].size))
        for begin in range(0, len(some), at_once):
            part = some[begin : begin + at_once]
            silent = np.stack([part.is_silent(name) for name in names])
            place_m = _places(part, position_m, time_s)
            missed = np.log1p(-np.minimum(part.probability(place_m), self.most_sure))
            if self.obstacles.count:
                missed = np.where(self._is_hidden(part, place_m, missed < 0), 0.0, missed)
            missed = looks.trust * np.where(silent & np.isfinite(missed), missed, 0.0)
            if ground is None:
                total += np.multiply.outer(exponents, missed.sum(axis=-1))
                continue
            tells = (missed < 0).any(axis=0)
            agent = np.nonzero(tells)[0]
            for each, exponent in zip(total, exponents, strict=True):
                counted = without_beyond(exponent * missed[:, tells], place_m[:, tells], ground)
                for number in np.unique(agent).tolist():
                    each[:, number] += counted[:, agent == number].sum(axis=1)
        return total

    def _is_hidden(self, looks: Looks, place_m: Float64s, is_asked: Bools) -> Bools:
        """Where an obstacle lies between sensor and agent, of those [K, A, L] that are asked for."""
        hidden = np.zeros(is_asked.shape, dtype=bool)
        where = np.nonzero(is_asked)
        ends = np.stack([looks.position_m[where[-1]], place_m[where]], axis=1)
        if not len(ends):
            return hidden
        lines = shapely.linestrings(ends)
        found = np.zeros(len(ends), dtype=bool)
        for shape in _shapes(self.obstacles):
            shapely.prepare(shape)
            found |= shapely.intersects(shape, lines)
        hidden[where] = found
        return hidden


def ground_of(looks: Sequence[Looks], seen_s: Float64s, seen_m: Float64s) -> Ground | None:
    """The ground between the sensors of looks and the places [D, 2] where agents were seen at `seen_s` [D]; None without looks.

    It is as wide as the sensors see that see farthest, where seeing is half of what they detect at best.
    """
    used = [some for some in looks if len(some)]
    if not used:
        return None
    time_s = np.concatenate([seen_s, *(some.time_s for some in used)])
    position_m = np.concatenate([seen_m, *(some.position_m for some in used)])
    order = np.argsort(time_s, kind="stable")
    sees_m = max(some.curve.half * float(np.median(some.range_m)) for some in used)
    return Ground(time_s[order], position_m[order], WIDTH * sees_m)


def _shapes(obstacles: Obstacles) -> list[shapely.Geometry]:
    circles = [shapely.Point(x, y).buffer(radius) for x, y, radius in obstacles.circle_array.tolist()]
    return [*circles, *obstacles.shapes]


def _within_reach(looks: Looks, position_m: Float64s, time_s: Float64s) -> Looks:
    """The looks within `time_s` [T] that may reach any of the tracks [K, A, T, 2]."""
    first, stop = np.searchsorted(looks.time_s, time_s[0], "left"), np.searchsorted(looks.time_s, time_s[-1], "right")
    some = looks[first:stop]
    if not len(some):
        return some
    flat = position_m.reshape(-1, *position_m.shape[2:])
    low = np.where(np.isnan(flat), np.inf, flat).min(axis=0)
    high = np.where(np.isnan(flat), -np.inf, flat).max(axis=0)
    left, right = _between(some, time_s)
    lowest, highest = np.minimum(low[left], low[right]), np.maximum(high[left], high[right])
    away = np.maximum(np.maximum(lowest - some.position_m, some.position_m - highest), 0.0)
    return some[np.hypot(away[:, 0], away[:, 1]) <= some.curve.reach * some.range_m]


def _between(looks: Looks, time_s: Float64s) -> tuple[Int64s, Int64s]:
    """The steps [L] before and after each look."""
    right = np.clip(np.searchsorted(time_s, looks.time_s, "left"), min(1, len(time_s) - 1), len(time_s) - 1)
    return np.maximum(right - 1, 0), right


def _places(looks: Looks, position_m: Float64s, time_s: Float64s) -> Float64s:
    """Where tracks [K, A, T, 2] are at the looks [K, A, L, 2], straight between two steps."""
    left, right = _between(looks, time_s)
    gap_s = time_s[right] - time_s[left]
    share = (np.where(gap_s > 0, looks.time_s - time_s[left], 0.0) / np.where(gap_s > 0, gap_s, 1.0))[:, None]
    before, after = position_m[:, :, left], position_m[:, :, right]
    # at a step itself the other one, where an agent may be absent, does not count
    return np.where(share == 1.0, after, np.where(share == 0.0, before, before + share * (after - before)))
