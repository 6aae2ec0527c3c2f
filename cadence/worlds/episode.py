"""What a simulated world returns: one mission, complete, as arrays."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cadence.worlds.terrain import Array, Terrain


@dataclass(frozen=True, eq=False)
class SensorReports:
    """Detections of one episode, ordered by step, then agent, then sensor.

    step          [N] index into the episode's steps
    agent, sensor [N] indices: which agent caused the detection (-1: none, clutter), which sensor made it (-1: none is told)
    position_m    [N, 2] measured position
    covariance_m2 [N, 2, 2] covariance of its noise
    """

    step: NDArray[np.int64]
    agent: NDArray[np.int64]
    sensor: NDArray[np.int64]
    position_m: Array
    covariance_m2: Array

    def __len__(self) -> int:
        return len(self.step)


@dataclass(frozen=True, eq=False)
class Episode:
    """One mission in a world. Frame: x east, y north, metres; the origin is the terrain's.

    time_s    [T] seconds since the beginning
    truth_m   [A, T, 2] true positions of the agents
    mode      [A, T] what each agent was doing: index into `mode_names`
    sensors_m [S, T, 2] positions of the sensors
    is_active [S, T] whether a sensor was looking
    goals_m   per agent [G, 2] the places it went for, in order
    """

    world: str
    time_s: Array
    agent_ids: tuple[str, ...]
    truth_m: Array
    mode_names: tuple[str, ...]
    mode: NDArray[np.int8]
    goals_m: tuple[Array, ...]
    sensor_ids: tuple[str, ...]
    sensors_m: Array
    is_active: NDArray[np.bool_]
    detections: SensorReports
    terrain: Terrain

    def __post_init__(self) -> None:
        agents, sensors, steps = len(self.agent_ids), len(self.sensor_ids), len(self.time_s)
        expected = {
            "truth_m": (agents, steps, 2),
            "mode": (agents, steps),
            "sensors_m": (sensors, steps, 2),
            "is_active": (sensors, steps),
        }
        for name, want in expected.items():
            if getattr(self, name).shape != want:
                raise ValueError(f"Episode.{name} has shape {getattr(self, name).shape}, expected {want}")

    def is_detected(self) -> NDArray[np.bool_]:
        """Steps of each agent [A, T] that hold at least one detection."""
        seen = np.zeros(self.mode.shape, dtype=bool)
        is_caused = self.detections.agent >= 0
        seen[self.detections.agent[is_caused], self.detections.step[is_caused]] = True
        return seen


def gaps_s(is_detected: NDArray[np.bool_], step_s: float) -> Array:
    """Lengths of the gaps between consecutive detections of one agent [T], where they are longer than one step."""
    between = np.diff(np.flatnonzero(is_detected))
    lengths: Array = between[between > 1] * step_s
    return lengths
