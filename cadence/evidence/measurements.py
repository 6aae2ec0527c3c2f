"""Bearings, elevations, ranges and range rates that observers measured: where a track passes them, and how well.

An observer that moves saw a target from where it was at the time. Tracks are straight between two steps. Each value has noise
of its own, normal but for a small share of outliers, which may be anything: one wild value never rules out the truth.
"""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from cadence.arrays import Bools, Float64s, Int64s
from cadence.types import Tracks

KINDS = ("bearing_rad", "elevation_rad", "range_m", "range_rate_mps")
_LEVEL_OF_LENGTHS = 0.01
"""Density of an outlying range or range rate over that of a perfect one: spread over 250 standard deviations."""
_MOST_DEVIATIONS = 6.0
_MOST_NUMBERS = 4_000_000


@dataclass(frozen=True, eq=False)
class Measurements:
    """What observers measured, in the mission's frame and time; a value that was not measured is NaN, its sigma is not read.

    time_s                [M] seconds from the beginning of the mission, not decreasing
    observer_m            [M, 2] where the observer was
    observer_velocity_mps [M, 2] NaN where unknown: range rates say nothing there
    observer_height_m     [M] NaN where unknown, or where heights of tracks are: elevations say nothing there, ranges are
                          projected by the elevation, or lie in the plane
    bearing_rad           [M] from east towards north
    elevation_rad         [M] up from the horizontal
    range_m               [M] straight from observer to target (slant)
    range_rate_mps        [M] positive where the target recedes
    ..._sigma_rad, ..._m, ..._mps  [M] standard deviation of each
    agent_ids             [M] whom each is about; None: of the only agent where there is but one, of nobody else
    outlier_share         of the values that are no measurements of the target
    """

    time_s: Float64s
    observer_m: Float64s
    observer_velocity_mps: Float64s
    observer_height_m: Float64s
    bearing_rad: Float64s
    bearing_sigma_rad: Float64s
    elevation_rad: Float64s
    elevation_sigma_rad: Float64s
    range_m: Float64s
    range_sigma_m: Float64s
    range_rate_mps: Float64s
    range_rate_sigma_mps: Float64s
    agent_ids: tuple[str | None, ...]
    outlier_share: float = 0.01
    name: str = "measurements"

    def __post_init__(self) -> None:
        num = len(self.time_s)
        for name in _columns():
            want = (num, 2) if name in ("observer_m", "observer_velocity_mps") else (num,)
            if getattr(self, name).shape != want:
                raise ValueError(f"Measurements.{name} has shape {getattr(self, name).shape}, expected {want}")
        if len(self.agent_ids) != num:
            raise ValueError(f"Measurements: {len(self.agent_ids)} agents for {num} rows")
        if not np.isfinite(self.time_s).all() or (np.diff(self.time_s) < 0).any() or not np.isfinite(self.observer_m).all():
            raise ValueError("Measurements: times must be finite and not fall, and places of the observer be finite")
        for kind in KINDS:
            sigma = getattr(self, sigma_name(kind))[np.isfinite(getattr(self, kind))]
            if not (np.isfinite(sigma) & (sigma > 0)).all():
                raise ValueError(f"Measurements.{sigma_name(kind)} must be above zero wherever {kind} is measured")
        if (self.range_m < 0).any():
            raise ValueError(f"Measurements.range_m: {np.nanmin(self.range_m):g} is negative")
        if (np.abs(self.bearing_rad) > 2.0 * math.pi).any() or (np.abs(self.elevation_rad) > 0.5 * math.pi).any():
            raise ValueError("Measurements: bearings beyond 2 pi or elevations beyond pi / 2; are they degrees?")
        if not 0 < self.outlier_share < 1:
            raise ValueError(f"Measurements: outlier_share {self.outlier_share} must lie between 0 and 1")

    def __len__(self) -> int:
        return len(self.time_s)

    def __getitem__(self, rows: slice | Bools | Int64s) -> "Measurements":
        """Some of the measurements."""
        index = np.arange(len(self))[rows]
        columns = {name: getattr(self, name)[index] for name in _columns()}
        return dataclasses.replace(self, **columns, agent_ids=tuple(self.agent_ids[i] for i in index.tolist()))

    def is_about(self, agent: str | None, is_alone: bool) -> Bools:
        """Which rows [M] speak of an agent: those of its name, and where it is the only one those without a name."""
        return np.array([name == agent if name is not None else is_alone for name in self.agent_ids], dtype=bool)

    def touches(self, time_s: Tensor) -> Tensor:
        """Steps [B, T] next to which something was measured."""
        steps = time_s.double().numpy()
        before = np.searchsorted(self.time_s, np.pad(steps, ((0, 0), (1, 0)), mode="edge")[:, :-1], "left")
        after = np.searchsorted(self.time_s, np.pad(steps, ((0, 0), (0, 1)), mode="edge")[:, 1:], "right")
        return torch.from_numpy(after > before)

    def deviations(self, place_m: Float64s, velocity_mps: Float64s, height_m: Float64s | None = None) -> dict[str, Float64s]:
        """How far targets are from what was measured, in standard deviations: for each of `KINDS` [..., M].

        Args:
            place_m: [..., M, 2] where the target is at each measurement.
            velocity_mps: [..., M, 2] how it moves there.
            height_m: [..., M] NaN where unknown; None where it is nowhere known.

        Returns:
            Measured less expected, angles the shorter way round; NaN where nothing is measured or the target is NaN.
        """
        east, north = np.moveaxis(place_m - self.observer_m, -1, 0)
        ground_m = np.hypot(east, north)
        up_m = np.full(ground_m.shape, np.nan) if height_m is None else height_m - self.observer_height_m
        flat = np.where(np.isfinite(self.elevation_rad), np.cos(self.elevation_rad), 1.0)
        slant_m = np.where(np.isfinite(up_m), np.hypot(ground_m, up_m), ground_m / np.maximum(flat, 1e-6))
        closing = (velocity_mps - self.observer_velocity_mps) * np.stack([east, north], axis=-1)
        expected = {
            "bearing_rad": np.arctan2(north, east),
            "elevation_rad": np.arctan2(up_m, ground_m),
            "range_m": slant_m,
            "range_rate_mps": closing.sum(axis=-1) / np.maximum(slant_m, 1e-9),
        }
        apart = {kind: getattr(self, kind) - value for kind, value in expected.items()}
        apart["bearing_rad"] = np.remainder(apart["bearing_rad"] + math.pi, 2.0 * math.pi) - math.pi
        return {kind: value / getattr(self, sigma_name(kind)) for kind, value in apart.items()}

    def fits(self, place_m: Float64s, velocity_mps: Float64s, height_m: Float64s | None = None) -> Float64s:
        """Log likelihood [..., M] of each row over that of a perfect fit; arguments as for `deviations`."""
        total: Float64s = np.zeros(1)
        for kind, apart in self.deviations(place_m, velocity_mps, height_m).items():
            level = self.outlier_share / (1.0 - self.outlier_share) * self._outlier_level(kind)
            fit = np.log((np.exp(-0.5 * np.square(apart)) + level) / (1.0 + level))
            total = total + np.where(np.isfinite(apart), fit, 0.0)
        return total

    def _outlier_level(self, kind: str) -> Float64s:
        """Density [M] of outliers over that of a perfect measurement: angles point anywhere."""
        if kind not in ("bearing_rad", "elevation_rad"):
            return np.full(len(self), _LEVEL_OF_LENGTHS)
        whole = 2.0 * math.pi if kind == "bearing_rad" else math.pi
        peak: Float64s = math.sqrt(2.0 * math.pi) * getattr(self, sigma_name(kind))
        return np.minimum(peak / whole, 1.0)

    def log_likelihood(self, tracks: Tracks) -> Tensor:
        """Sum over the measurements between the first and the last step [B, K, A]."""
        total = np.zeros(tracks.position_m.shape[:3])
        for row, agent, rows in self._spoken(tracks):
            at_once = max(1, _MOST_NUMBERS // max(1, 8 * total.shape[1]))
            for begin in range(0, len(rows), at_once):
                part = self[rows[begin : begin + at_once]]
                total[row, :, agent] += part.fits(*part._passed(tracks, row, agent)).sum(axis=-1)
        return torch.from_numpy(total)

    def contradicts(self, tracks: Tracks, log_likelihood: Tensor) -> Tensor:
        """Where more values than outliers explain lie far outside of all that the tracks together reach [B, A].

        A value does where it is over six standard deviations from the tracks' mean, their own spread and its noise
        together. That none of few tracks fits contradicts nothing: one between them may.
        """
        is_odd = torch.zeros(tracks.position_m.shape[0], tracks.position_m.shape[2], dtype=torch.bool)
        for row, agent, rows in self._spoken(tracks):
            part = self[rows]
            apart = part.deviations(*part._passed(tracks, row, agent))
            apart["bearing_rad"] = _about_their_mean(apart["bearing_rad"], 2.0 * math.pi / part.bearing_sigma_rad)
            num_far = num_all = 0
            for value in apart.values():
                value = value[:, np.isfinite(value).all(axis=0)]
                far = np.abs(value.mean(axis=0)) > _MOST_DEVIATIONS * np.sqrt(1.0 + value.var(axis=0))
                num_far, num_all = num_far + int(far.sum()), num_all + far.size
            expected = self.outlier_share * num_all
            is_odd[row, agent] = num_far > expected + 1.0 + _MOST_DEVIATIONS * math.sqrt(expected)
        return is_odd

    def _spoken(self, tracks: Tracks) -> list[tuple[int, int, Int64s]]:
        """Window, agent, and the rows that speak of its tracks; only where there are any, and the agent is there."""
        num_agents = tracks.position_m.shape[2]
        names = tracks.agent_ids or (None,) * num_agents
        about = [np.flatnonzero(self.is_about(name, num_agents == 1)) for name in names]
        found = []
        for row, time_s in enumerate(tracks.time_s.double().numpy()):
            for agent, rows in enumerate(about):
                first = np.searchsorted(self.time_s[rows], time_s[0], "left")
                some = rows[first : np.searchsorted(self.time_s[rows], time_s[-1], "right")]
                if len(some) and bool(tracks.position_m[row, :, agent].isfinite().any()):
                    found.append((row, agent, some))
        return found

    def _passed(self, tracks: Tracks, row: int, agent: int) -> tuple[Float64s, Float64s, Float64s | None]:
        """Place [K, M, 2], velocity and height [K, M] of an agent at the measurements, straight between two steps."""
        time_s = tracks.time_s[row].double().numpy()
        right = np.clip(np.searchsorted(time_s, self.time_s, "left"), min(1, len(time_s) - 1), len(time_s) - 1)
        left = np.maximum(right - 1, 0)
        gap_s = np.maximum(time_s[right] - time_s[left], 1e-9)
        share = np.clip((self.time_s - time_s[left]) / gap_s, 0.0, 1.0)
        position_m = tracks.position_m[row, :, agent].double().numpy()
        before, after = position_m[:, left], position_m[:, right]
        place_m = before + share[:, None] * (after - before)
        velocity_mps = (after - before) / gap_s[:, None]
        if tracks.height_m is None:
            return place_m, velocity_mps, None
        up_m = tracks.height_m[row, :, agent].double().numpy()
        return place_m, velocity_mps, up_m[:, left] + share * (up_m[:, right] - up_m[:, left])


def sigma_name(kind: str) -> str:
    """Which column of `Measurements` holds the standard deviation of one of `KINDS`."""
    quantity, _, unit = kind.rpartition("_")
    return f"{quantity}_sigma_{unit}"


def _columns() -> list[str]:
    named = [field.name for field in dataclasses.fields(Measurements)]
    return named[: named.index("agent_ids")]


def _about_their_mean(apart: Float64s, turn: Float64s) -> Float64s:
    """Deviations [K, M] of angles, brought to within half a turn of their mean direction, of which one turn is `turn` [M]."""
    # divided before it is complex: numpy warns of complex NaN, which stands for no angle, and of no real one
    angle = np.angle(np.exp(1j * (2.0 * math.pi * apart / turn)).mean(axis=0)) / (2.0 * math.pi) * turn
    return np.asarray(angle + np.remainder(apart - angle + 0.5 * turn, turn) - 0.5 * turn, dtype=np.float64)
