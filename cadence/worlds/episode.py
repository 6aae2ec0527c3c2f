"""What a simulated world returns: one mission, complete, as arrays."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cadence.arrays import Bools, Float64s, Int64s
from cadence.worlds.terrain import Terrain


@dataclass(frozen=True, eq=False)
class SensorReports:
    """Detections of one episode, ordered by step, then agent, then sensor.

    step          [N] index into the episode's steps
    agent, sensor [N] indices: which agent caused the detection (-1: none, clutter), which sensor made it (-1: none is told)
    position_m    [N, 2] measured position
    covariance_m2 [N, 2, 2] covariance of its noise
    """

    step: Int64s
    agent: Int64s
    sensor: Int64s
    position_m: Float64s
    covariance_m2: Float64s

    def __len__(self) -> int:
        return len(self.step)


@dataclass(frozen=True, eq=False)
class BearingReports:
    """Bearings of one episode, ordered by step, then agent, then sensor: someone was heard, and from where.

    step, agent, sensor  [N] indices
    bearing_rad          [N] measured, from east towards north
    sigma_rad            [N] standard deviation of its noise
    """

    step: Int64s
    agent: Int64s
    sensor: Int64s
    bearing_rad: Float64s
    sigma_rad: Float64s

    def __len__(self) -> int:
        return len(self.step)


@dataclass(frozen=True, eq=False)
class SensorLaw:
    """How surely a sensor detects a target that moves as targets here do, in one step.

    distance_m, probability  [M] straight between these points, nothing beyond the last
    is_hidden  land hides targets from it
    is_always  it looks whether or not it is active
    """

    distance_m: Float64s
    probability: Float64s
    is_hidden: bool = False
    is_always: bool = True


@dataclass(frozen=True, eq=False)
class Episode:
    """One mission in a world. Frame: x east, y north, metres; the origin is the terrain's.

    time_s    [T] seconds since the beginning
    truth_m   [A, T, 2] true positions of the agents
    mode      [A, T] what each agent was doing: index into `mode_names`
    sensors_m [S, T, 2] positions of the sensors
    is_active [S, T] whether a sensor was looking
    goals_m   per agent [G, 2] the places it went for, in order
    laws      of every sensor, P(detect) over distance; none where a world does not say
    bearings  of agents that were heard; None where nobody listens
    """

    world: str
    time_s: Float64s
    agent_ids: tuple[str, ...]
    truth_m: Float64s
    mode_names: tuple[str, ...]
    mode: NDArray[np.int8]
    goals_m: tuple[Float64s, ...]
    sensor_ids: tuple[str, ...]
    sensors_m: Float64s
    is_active: Bools
    detections: SensorReports
    terrain: Terrain
    laws: tuple[SensorLaw, ...] = ()
    bearings: BearingReports | None = None

    def __post_init__(self) -> None:
        agents, sensors, steps = len(self.agent_ids), len(self.sensor_ids), len(self.time_s)
        expected = {
            "truth_m": (agents, steps, 2),
            "mode": (agents, steps),
            "sensors_m": (sensors, steps, 2),
            "is_active": (sensors, steps),
        }
        if self.laws and len(self.laws) != sensors:
            raise ValueError(f"Episode: {len(self.laws)} laws of {sensors} sensors")
        for name, want in expected.items():
            if getattr(self, name).shape != want:
                raise ValueError(f"Episode.{name} has shape {getattr(self, name).shape}, expected {want}")

    def is_detected(self) -> Bools:
        """Steps of each agent [A, T] that hold at least one detection."""
        seen = np.zeros(self.mode.shape, dtype=bool)
        is_caused = self.detections.agent >= 0
        seen[self.detections.agent[is_caused], self.detections.step[is_caused]] = True
        return seen


def gaps_s(is_detected: Bools, step_s: float) -> Float64s:
    """Lengths of the gaps between consecutive detections of one agent [T], where they are longer than one step."""
    between = np.diff(np.flatnonzero(is_detected))
    lengths: Float64s = between[between > 1] * step_s
    return lengths
