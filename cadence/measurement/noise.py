"""The noise of a source's detections: the one of greatest likelihood, whatever the target did, and how sure that is.

Two numbers: the standard deviation of a position's axis, and that of the time at which it holds. A stamp in whole seconds is
off by up to half of one, and the position by as much as the target moved: 16 m at 55 m/s, all of it along the course.

Tracks are cut into stretches. Each may follow any process, all as likely beforehand, and the noise is common to all. Intervals
hold where the profile of the likelihood falls by 1.92 from its peak, the profile made flatter where stretches differ
more than it allows (Chandler and Bate, "Inference for clustered data using the independence loglikelihood", 2007).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.interpolate import Akima1DInterpolator

from cadence.arrays import Float64s, Int64s
from cadence.measurement.courses import begins_burst, velocities
from cadence.measurement.likelihood import Stretches, log_likelihoods
from cadence.measurement.processes import Processes, all_processes

_MIN_ROWS, _MIN_STRETCHES, _MAX_STRETCHES = 4, 4, 36
_FEW_ROWS, _MANY_ROWS, _WANTED = 6, 24, 18
"""Rows of a stretch: many tell more of slow motion, but so many stretches are wanted to see how they differ."""
_EVERY: Final = 3
"""Where to look, and among which processes, a third of the stretches tells."""
_MAX_TURN: Final = np.deg2rad(45.0)
_MAX_MPS2: Final = 4.0
"""No vehicle changes its velocity by this much, at random, from each position to the next. Where one could, and turns further
from one position to the next than above, its turns cannot be told from noise."""
_MAX_TIMING: Final = 0.35
"""Errors in time, in typical gaps: more, and detections would change places."""
_NOISES: Final = np.array([1e-3, 0.05, 0.15, 0.4, 0.8, 1.3, 2.0])
_LINE: Final = np.concatenate([[1e-3], np.geomspace(0.02, 3.0, 26)])
"""Noises that are tried, in units: at first, and along a line."""
_NUM_ROUNDS: Final = 2
_NEAR: Final = 10.0
"""Of a process that explains no stretch under any noise whose log likelihood is so near to the best one, nothing is lost."""
_LEAST_SHARE: Final = 0.05
_DROP: Final = 1.92
"""Half the 95 % quantile of chi squared with one degree of freedom."""
_CERTAIN_DROP: Final = 5.4
"""Half the 99.9 % quantile: errors in time are assumed where they are certain, as turns differ from changes of speed, too."""
_FEW: Final = 4.0
"""So many stretches would make intervals (on the scale of the logarithm of the likelihood) twice as wide as very many."""
_MODEL_ERROR: Final = 0.06
"""Processes are not quite those of real targets: simulated noise comes out up to so much too small, or too large."""
_LEAST_STEP_SHARE: Final = 0.01
"""Noise below this share of a step is no noise: no model of motion is that exact."""
_LEAST_ACROSS: Final = 0.02
"""A position is never said to be more exact across the course than this share of what it is along it."""


@dataclass(frozen=True, eq=False)
class Track:
    """Detections of one target: times [N] in seconds, not decreasing, and positions [N, 2]."""

    time_s: Float64s
    position_m: Float64s


@dataclass(frozen=True)
class MeasurementNoise:
    """Noise of a source's detections, with intervals of 95 %.

    sigma_m      standard deviation of a position's axis
    timing_s     standard deviation of the time at which a position holds; the target's own speed makes metres of it
    speed_mps    root mean square speed
    gap_s        typical time between two detections
    num_stretches  of the tracks that were looked at: few tell little, whatever the intervals say
    """

    sigma_m: float
    sigma_interval_m: tuple[float, float]
    timing_s: float
    timing_interval_s: tuple[float, float]
    speed_mps: float
    gap_s: float
    num_stretches: int

    @property
    def is_sure(self) -> bool:
        """Whether detections without noise are ruled out."""
        return self.sigma_interval_m[0] > 0 or self.timing_interval_s[0] > 0

    @property
    def sure(self) -> tuple[float, float]:
        """Standard deviations of position in metres and of time in seconds, each zero where it may as well be none."""
        sigma_m = self.sigma_m if self.sigma_interval_m[0] > 0 else 0.0
        return sigma_m, self.timing_s if self.timing_interval_s[0] > 0 else 0.0

    @property
    def along_m(self) -> float:
        """Standard deviation along the course at the typical speed."""
        sigma_m, timing_s = self.sure
        return float(np.hypot(sigma_m, timing_s * self.speed_mps))


def measurement_noise(tracks: Sequence[Track]) -> MeasurementNoise | None:
    """The noise that all tracks of a source have in common; None where they hold too little to tell."""
    tracks = [track for track in map(_of_different_times, tracks) if len(track.time_s) >= _MIN_ROWS]
    if not tracks:
        return None
    gap_s, unit_m = float(np.median(np.concatenate([np.diff(track.time_s) for track in tracks]))), roughness_m(tracks)
    num_rows = min(max(sum(len(track.time_s) for track in tracks) // _WANTED, _FEW_ROWS), _MANY_ROWS)
    cut = [(track, rows) for track in tracks for rows in _cut(track, gap_s, num_rows)]
    if np.sqrt(6.0) * unit_m < _MAX_MPS2 * gap_s**2:
        cut = [(track, rows) for track, rows in cut if _is_resolved(track.position_m[rows])]
    if len(cut) < _MIN_STRETCHES:
        return None
    speed_mps = _typical_speed(tracks, gap_s)
    if unit_m <= _LEAST_STEP_SHARE * speed_mps * gap_s or not unit_m > 0:
        return MeasurementNoise(0.0, (0.0, unit_m), 0.0, (0.0, unit_m / max(speed_mps, 1e-12)), speed_mps, gap_s, len(cut))
    chosen = np.linspace(0, len(cut) - 1, min(len(cut), _MAX_STRETCHES)).round().astype(int)
    stretches = _stretches([cut[index] for index in chosen], gap_s, unit_m, speed_mps)
    step = speed_mps * gap_s / unit_m
    sigma, timing = _profiles(stretches, _MAX_TIMING * step)
    if sigma.best < _LEAST_STEP_SHARE * step:
        sigma = Estimate(sigma.best, 0.0, sigma.high)
    if timing.best < _LEAST_STEP_SHARE * step:
        timing = Estimate(timing.best, 0.0, timing.high)
    to_s = unit_m / max(speed_mps, 1e-12)
    return MeasurementNoise(
        sigma.best * unit_m, (sigma.low * unit_m, sigma.high * unit_m),
        timing.best * to_s, (timing.low * to_s, timing.high * to_s), speed_mps, gap_s,
        len(cut),
    )  # fmt: skip


def covariances_m2(track: Track, noise: MeasurementNoise) -> Float64s:
    """Covariances [N, 2, 2] of a track's detections: those in time along the velocity between neighbours, where it has any."""
    sigma_m, timing_s = noise.sure
    velocity, base_s = velocities(track.time_s, track.position_m, noise.gap_s)
    speed2 = (velocity**2).sum(-1)
    doubt2 = 4.0 * sigma_m**2 / np.where(base_s > 0, base_s, np.inf) ** 2
    kept = np.maximum(1.0 - doubt2 / np.where(speed2 > 0, speed2, np.inf), 0.0)
    moved = timing_s**2 * kept[:, None, None] * velocity[:, :, None] * velocity[:, None, :]
    moved[base_s <= 0] = 0.5 * (timing_s * noise.speed_mps) ** 2 * np.eye(2)
    sigma2 = np.maximum(sigma_m**2, _LEAST_ACROSS**2 * np.trace(moved, axis1=1, axis2=2))
    return np.asarray(moved + sigma2[:, None, None] * np.eye(2))


def roughness_m(tracks: Sequence[Track]) -> float:
    """Standard deviation of an axis if all that is not straight between neighbours were noise; never less than the noise is."""
    found = []
    for track in map(_of_different_times, tracks):
        before_s, after_s = np.diff(track.time_s)[:-1], np.diff(track.time_s)[1:]
        share = (after_s / (before_s + after_s))[:, None]
        position = track.position_m
        offset = position[1:-1] - share * position[:-2] - (1.0 - share) * position[2:]
        is_near = np.maximum(before_s, after_s) <= 4.0 * np.median(np.diff(track.time_s)) if len(before_s) else slice(None)
        found.append(np.abs(offset / np.sqrt(1.0 + share**2 + (1.0 - share) ** 2))[is_near].ravel())
    offset = np.concatenate([*found, np.zeros(0)])
    return float(np.sqrt(np.mean(np.minimum(offset, 5.0 * np.quantile(offset, 0.8)) ** 2))) if len(offset) else 0.0


def _of_different_times(track: Track) -> Track:
    is_new = np.diff(track.time_s, prepend=-np.inf) > 0
    return Track(track.time_s[is_new], track.position_m[is_new])


def _cut(track: Track, gap_s: float, num_rows: int) -> list[Int64s]:
    """Rows of stretches of about `num_rows`, none over a long gap."""
    bursts = np.split(np.arange(len(track.time_s)), np.flatnonzero(begins_burst(track.time_s, gap_s))[1:])
    parts = [part for burst in bursts for part in np.array_split(burst, max(1, round(len(burst) / num_rows)))]
    return [part for part in parts if len(part) >= _MIN_ROWS]


def _is_resolved(position_m: Float64s) -> bool:
    """Whether the course goes on from one position to the next, as a rule."""
    way = np.diff(position_m, axis=0)
    length = np.hypot(*way.T)
    cosine = (way[1:] * way[:-1]).sum(1) / np.maximum(length[1:] * length[:-1], 1e-30)
    return bool(np.median(cosine) > np.cos(_MAX_TURN))


def _typical_speed(tracks: Sequence[Track], gap_s: float) -> float:
    found = [velocities(track.time_s, track.position_m, gap_s)[0] for track in tracks]
    return float(np.sqrt((np.concatenate(found) ** 2).sum(1).mean()))


def _stretches(cut: Sequence[tuple[Track, Int64s]], gap_s: float, unit_m: float, speed_mps: float) -> Stretches:
    shape = (len(cut), max(len(rows) for _, rows in cut))
    time, speed2, doubt2, is_seen = np.zeros(shape), np.zeros(shape), np.zeros(shape), np.zeros(shape, np.bool_)
    position, course = np.zeros((*shape, 2)), np.zeros((*shape, 2))
    squares = []
    for place, (track, rows) in enumerate(cut):
        num, time_s = len(rows), track.time_s[rows]
        velocity, base_s = (value[rows] for value in velocities(track.time_s, track.position_m, gap_s))
        speed = np.hypot(*velocity.T)
        time[place] = np.append(time_s, np.full(shape[1] - num, time_s[-1])) / gap_s
        is_seen[place, :num] = True
        position[place, :num] = (track.position_m[rows] - track.position_m[rows[0]]) / unit_m
        course[place, :num] = np.where(speed[:, None] > 0, velocity / np.maximum(speed, 1e-30)[:, None], [1.0, 0.0])
        speed2[place, :num] = (speed / max(speed_mps, 1e-30)) ** 2
        doubt2[place, :num] = 4.0 * (unit_m / np.where(base_s > 0, base_s, np.inf) / max(speed_mps, 1e-30)) ** 2
        squares.append((np.diff(track.position_m[rows], axis=0) / np.diff(time_s)[:, None] * gap_s / unit_m) ** 2)
    return Stretches(time, is_seen, position, course, speed2, doubt2, float(np.sqrt(np.concatenate(squares).mean())))


@dataclass(frozen=True)
class Estimate:
    """A value and its interval."""

    best: float
    low: float
    high: float


def _profiles(stretches: Stretches, most_along: float) -> tuple[Estimate, Estimate]:
    """Noise of position and what errors in time add along the course, in units: by turns, each with the other at its best."""
    processes = all_processes()
    of_along = np.concatenate([[0.0], _NOISES[1:]])
    sigma, along = (grid.ravel() for grid in np.meshgrid(_NOISES, of_along[of_along <= max(most_along, 0.0)], indexing="ij"))
    found = log_likelihoods(stretches[::_EVERY], sigma, along, processes)
    total = _over_processes(found, len(processes)).sum(0)
    share = np.exp(found - found.max(-1, keepdims=True))
    share = (share / share.sum(-1, keepdims=True)).max(0)[total > total.max() - _NEAR].max(0)
    likely: Processes = processes[np.flatnonzero(share > _LEAST_SHARE)]
    best = int(total.argmax())
    at = {"sigma": float(sigma[best]), "along": float(along[best])}
    line = {"sigma": _LINE, "along": np.concatenate([[0.0], _LINE[1:] * min(max(most_along, 1e-3) / _LINE[-1], 1.0)])}
    estimates: dict[str, Estimate] = {}
    for name in ("along", "sigma") * _NUM_ROUNDS:
        values = {key: np.full(len(line[name]), value) for key, value in at.items()} | {name: line[name]}
        found = log_likelihoods(stretches, values["sigma"], values["along"], likely)
        drop = _DROP if name == "sigma" else _CERTAIN_DROP
        estimates[name] = _estimate(line[name], _over_processes(found, len(processes)), drop)
        at[name] = max(estimates[name].best, float(line[name][0]))
    return estimates["sigma"], estimates["along"]


def _over_processes(found: Float64s, num_processes: int) -> Float64s:
    """Log likelihood of stretches under each noise, all processes as likely beforehand."""
    peak = found.max(-1)
    return np.asarray(np.log(np.exp(found - peak[..., None]).sum(-1) / num_processes) + peak)


def _estimate(line: Float64s, found: Float64s, drop: float) -> Estimate:
    """The value of greatest likelihood on a line [G] of values whose first stands for none, by log likelihoods [S, G].

    The interval begins at none unless the likelihood of none is lower by `drop`.
    """
    place = np.log(np.append(line[1] / 4.0, line[1:]))
    total = found.sum(0)
    fine = np.linspace(place[0], place[-1], 600)
    profile = Akima1DInterpolator(place, total)(fine)
    best = int(profile.argmax())
    fall = _flatness(place, found) * (profile - profile[best]) / (1.0 + _FEW / len(found))
    inside = np.flatnonzero(fall > -_DROP)
    is_none = total.argmax() == 0
    low = 0.0 if fall[0] > -drop else float(np.exp(fine[inside[0]] - _MODEL_ERROR))
    return Estimate(0.0 if is_none else float(np.exp(fine[best])), low, float(np.exp(fine[inside[-1]] + _MODEL_ERROR)))


def _flatness(place: Float64s, found: Float64s) -> float:
    """By how much the profile is too steep at its peak: its curvature over the variance of stretches' slopes, one at most."""
    total = found.sum(0)
    peak = int(total.argmax())
    if not 1 < peak < len(place) - 1:
        return 1.0
    slope = (found[:, peak + 1] - found[:, peak - 1]) / (place[peak + 1] - place[peak - 1])
    curvature = (2.0 * total[peak] - total[peak + 1] - total[peak - 1]) / (place[peak + 1] - place[peak]) ** 2
    variance = float(((slope - slope.mean()) ** 2).sum())
    return min(1.0, float(curvature) / variance) if variance > 0 else 1.0
