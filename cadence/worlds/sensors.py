"""How sensors see and how they move: detection laws, measurement noise, search patterns."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from cadence.arrays import Bools, Float64s
from cadence.worlds.episode import BearingReports

FALSE_ALARM = 1e-4
"""Probability of false alarm that the detection law of a radar is set to."""


@dataclass(frozen=True)
class SensorKind:
    """What one make of sensor does.

    range_m      distance at which the echo of a target at cruising speed crosses the threshold in half of the scans
    scan_share   share of the steps in which it looks at a target at all: sea clutter, other work, the antenna elsewhere
    range_sigma_m, bearing_sigma_rad  noise along and, times the distance, across the line of sight
    needs_sight  whether land hides targets from it
    """

    name: str
    range_m: float
    scan_share: float
    range_sigma_m: float
    bearing_sigma_rad: float
    needs_sight: bool


def swerling_probability(distance_m: Float64s, half_range_m: Float64s) -> Float64s:
    """Detection probability of a fluctuating target in one scan, 0.5 at `half_range_m`, 0 beyond 2.5 times that.

    Swerling I: P = P_fa ** (1 / (1 + SNR)), SNR ~ distance ** -4 (Skolnik, Introduction to Radar Systems, chapter 2).
    """
    snr_at_half = math.log(FALSE_ALARM) / math.log(0.5) - 1.0
    ratio = np.maximum(distance_m, 1.0) / half_range_m
    probability = FALSE_ALARM ** (1.0 / (1.0 + snr_at_half * ratio**-4.0))
    return np.where(ratio <= 2.5, probability, 0.0)


def measurement_covariance(offset_m: Float64s, range_sigma_m: Float64s, bearing_sigma_rad: Float64s) -> Float64s:
    """Covariance [..., 2, 2] of a position measured in range and bearing along `offset_m` [..., 2] (target minus sensor).

    First order in the bearing's noise; never narrower across than a tenth of the noise along.
    """
    distance = np.hypot(offset_m[..., 0], offset_m[..., 1])
    along = offset_m / np.maximum(distance, 1.0)[..., None]
    across = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    across_sigma = np.maximum(distance * bearing_sigma_rad, 0.1 * range_sigma_m)
    near = (distance < 1.0)[..., None, None]
    covariance = (
        along[..., :, None] * along[..., None, :] * (range_sigma_m**2)[..., None, None]
        + across[..., :, None] * across[..., None, :] * (across_sigma**2)[..., None, None]
    )
    return np.where(near, np.eye(2) * (range_sigma_m**2)[..., None, None], covariance)


def draw_noise(covariance_m2: Float64s, rng: np.random.Generator) -> Float64s:
    """One normal draw [N, 2] of each covariance [N, 2, 2]."""
    white = rng.standard_normal((*covariance_m2.shape[:-2], 2))
    noise: Float64s = (np.linalg.cholesky(covariance_m2) @ white[..., None])[..., 0]
    return noise


@dataclass(frozen=True)
class Listening:
    """Direction finders on boats and masts, which hear agents when these use their radio: bearings without ranges.

    kind        which sensors listen: "boat", "mast", "both" or "none"
    radio_rate  share of the steps in which an agent uses its radio
    range_m     how far it is heard, over land as well
    sigma_deg   standard deviation of a bearing
    """

    kind: Literal["none", "boat", "mast", "both"] = "none"
    radio_rate: float = 0.1
    range_m: float = 20000.0
    sigma_deg: float = 2.0

    def __post_init__(self) -> None:
        if not (0 < self.radio_rate <= 1 and self.range_m > 0 and 0 < self.sigma_deg <= 45):
            raise ValueError("listening: radio_rate must lie in 0..1, range_m be above zero, and sigma_deg lie in 0..45")


def hear(
    listening: Listening, truth_m: Float64s, sensors_m: Float64s, does_listen: Bools, rng: np.random.Generator
) -> BearingReports:
    """What the sensors that listen [S] hear of agents: truth_m [A, T, 2], sensors_m [S, T, 2]."""
    speaks = rng.random(truth_m.shape[:2]) < listening.radio_rate
    offset = truth_m.transpose(1, 0, 2)[:, :, None] - sensors_m.transpose(1, 0, 2)[:, None]
    is_near = np.hypot(offset[..., 0], offset[..., 1]) <= listening.range_m
    step, agent, sensor = np.nonzero(speaks.T[:, :, None] & is_near & does_listen)
    sigma = np.full(len(step), np.radians(listening.sigma_deg))
    east, north = offset[step, agent, sensor].T
    return BearingReports(step, agent, sensor, np.arctan2(north, east) + sigma * rng.standard_normal(len(step)), sigma)


@dataclass(frozen=True)
class Sortie:
    """How an aircraft works: lanes across the map at `speed_mps`, `on_station_s` long, then `turnaround_s` on the ground."""

    speed_mps: float = 65.0
    lane_m: float = 6000.0
    on_station_s: float = 2000.0
    turnaround_s: float = 900.0


def sweep_track(rng: np.random.Generator, time_s: Float64s, side_m: float, sortie: Sortie) -> tuple[Float64s, Bools]:
    """Positions [T, 2] of an aircraft that sweeps the map in parallel lanes, and whether it is in the air [T].

    It starts at a base at the edge of the map at a random time of its cycle, flies lanes in a random direction each
    sortie, and goes home by the straight way.
    """
    base = side_m / 2 * _on_square(rng.uniform(0.0, 2 * np.pi))
    clock = -rng.uniform(0.0, sortie.on_station_s + sortie.turnaround_s)
    knots_s, knots_m = [clock - 1.0], [base]
    is_flying = np.zeros(len(time_s), dtype=bool)
    while clock < time_s[-1]:
        lanes = _lanes(rng, side_m, sortie.lane_m)
        if np.hypot(*(lanes[0] - base)) > np.hypot(*(lanes[-1] - base)):
            lanes = lanes[::-1]
        path = np.vstack([base, lanes])
        travelled = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
        far = min(travelled[-1], sortie.speed_mps * sortie.on_station_s)
        turning = np.array([np.interp(far, travelled, path[:, axis]) for axis in (0, 1)])
        path = np.vstack([path[travelled < far], turning, base])
        arrival = clock + np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))]) / sortie.speed_mps
        is_flying |= (time_s >= clock) & (time_s < arrival[-1])
        knots_s += [*arrival, arrival[-1] + sortie.turnaround_s]
        knots_m += [*path, base]
        clock = arrival[-1] + sortie.turnaround_s
    track = np.stack([np.interp(time_s, knots_s, np.array(knots_m)[:, axis]) for axis in (0, 1)], axis=-1)
    return track, is_flying


def square_search(centre_m: Float64s, spacing_m: float, num_legs: int = 12) -> Float64s:
    """Corners [P, 2] of an expanding square around a last known position (IAMSAR manual, pattern SS)."""
    directions = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    lengths = spacing_m * (1 + np.arange(num_legs) // 2)
    legs = directions[np.arange(num_legs) % 4] * lengths[:, None]
    return np.vstack([centre_m, centre_m + np.cumsum(legs, axis=0)])


def _on_square(bearing: float) -> Float64s:
    """The point [2] of the unit square's edge in a direction."""
    direction = np.array([np.cos(bearing), np.sin(bearing)])
    point: Float64s = direction / np.abs(direction).max()
    return point


def _lanes(rng: np.random.Generator, side_m: float, lane_m: float) -> Float64s:
    """Ends [P, 2] of parallel lanes over the whole map, to and fro, in a random direction and with a random offset."""
    offset = np.arange(-side_m / 2 + rng.uniform(0.2, 1.0) * lane_m, side_m / 2, lane_m)
    reach = 0.46 * side_m
    ends = np.stack([np.tile([-reach, reach, reach, -reach], len(offset))[: 2 * len(offset)], np.repeat(offset, 2)], axis=1)
    turn = 0.5 * np.pi * rng.integers(4) + rng.uniform(-0.25, 0.25)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    lanes: Float64s = np.clip(ends @ rotation.T, -side_m / 2, side_m / 2)
    return lanes
