"""Synthetic kinematics for training the general model: many ways of moving, in units of steps and step lengths.

A scenario draws how its targets behave — cruising, turning, circling, stopping, heading for points, keeping to an area —
and how they are detected; its tracks share that behaviour like the targets of one log. Nothing here resembles a
particular data set.
"""

from dataclasses import dataclass

import numpy as np

from cadence.arrays import Bools, Float64s, Int64s

SUBSTEPS = 4
"""Samples per step: detections lie between the steps of the window grid."""

_STRAIGHT, _TURN, _CIRCLE, _STOP, _GOTO = range(5)
_NUM_MODES = 5


@dataclass(frozen=True, eq=False)
class Scenario:
    """Behaviour of one log's targets and how they are seen; times in steps, lengths in step lengths.

    mode_share     [5] how often each mode is entered: straight, turn, circle, stop, go to a point
    mode_duration  [5] mean duration of each mode
    turn_rate      typical turn rate of a turn, rad per step
    turn_noise     strength of the random change of the turn rate
    turn_memory    time over which the turn rate follows its command
    speed_spread   log standard deviation of the speed between targets, and half of it between modes
    speed_memory   time over which the speed follows its command
    arena_radius   targets steer back into this radius; infinite in the open
    gap            mean time between bursts of detections
    burst          mean duration of a burst
    interval       time between detections in a burst
    sigma          standard deviation of a detection, an axis
    """

    mode_share: Float64s
    mode_duration: Float64s
    turn_rate: float
    turn_noise: float
    turn_memory: float
    speed_spread: float
    speed_memory: float
    arena_radius: float
    gap: float
    burst: float
    interval: float
    sigma: float


@dataclass(frozen=True, eq=False)
class SyntheticTracks:
    """Tracks of one scenario: positions [N, L * SUBSTEPS + 1, 2] and where they were detected (bool [N, L * SUBSTEPS + 1])."""

    position: Float64s
    is_detected: Bools
    scenario: Scenario


def draw_scenario(rng: np.random.Generator) -> Scenario:
    """A scenario at random; ranges wide enough to hold ships, aircraft, vehicles and people."""
    share = rng.dirichlet(np.array([0.8, 0.5, 0.4, 0.4, 0.7]))
    duration = _log_uniform(rng, np.array([6.0, 1.0, 6.0, 2.0, 4.0]), np.array([120.0, 12.0, 80.0, 40.0, 60.0]))
    in_open = rng.random() < 0.6
    exact = rng.random() < 0.35
    return Scenario(
        mode_share=share,
        mode_duration=duration,
        turn_rate=float(_log_uniform(rng, 0.03, 1.0)),
        turn_noise=float(_log_uniform(rng, 0.002, 0.6)),
        turn_memory=float(_log_uniform(rng, 0.3, 6.0)),
        speed_spread=float(rng.uniform(0.0, 0.6)),
        speed_memory=float(_log_uniform(rng, 0.3, 12.0)),
        arena_radius=np.inf if in_open else float(_log_uniform(rng, 2.0, 40.0)),
        gap=float(_log_uniform(rng, 3.0, 24.0)),
        burst=float(_log_uniform(rng, 0.2, 5.0)),
        interval=float(_log_uniform(rng, 0.25, 2.0)),
        sigma=1e-3 if exact else float(_log_uniform(rng, 3e-3, 1.0)),
    )


def simulate_tracks(scenario: Scenario, num_tracks: int, num_steps: int, rng: np.random.Generator) -> SyntheticTracks:
    """`num_tracks` tracks of `num_steps` steps and their detections; mean speed about one step length a step."""
    state = _Targets.start(scenario, num_tracks, rng)
    dt = 1.0 / SUBSTEPS
    # a lead-in, so that tracks do not begin at the start of a mode
    for _ in range(16 * SUBSTEPS):
        state.advance(dt, rng)
    positions = [state.position.copy()]
    for _ in range(num_steps * SUBSTEPS):
        state.advance(dt, rng)
        positions.append(state.position.copy())
    position = np.stack(positions, axis=1)
    return SyntheticTracks(position, _detect(scenario, num_tracks, num_steps, rng), scenario)


def _log_uniform(rng: np.random.Generator, low: float | Float64s, high: float | Float64s) -> Float64s:
    return np.exp(rng.uniform(np.log(low), np.log(high)))


@dataclass(eq=False)
class _Targets:
    """Moving state of all targets of a scenario [N, ...]."""

    scenario: Scenario
    position: Float64s
    heading: Float64s
    turn: Float64s
    speed: Float64s
    cruise: Float64s
    mode: Int64s
    time_left: Float64s
    turn_command: Float64s
    speed_command: Float64s
    goal: Float64s

    @classmethod
    def start(cls, scenario: Scenario, num_tracks: int, rng: np.random.Generator) -> "_Targets":
        cruise = np.exp(rng.normal(0.0, scenario.speed_spread, num_tracks))
        zero = np.zeros(num_tracks)
        return cls(
            scenario, rng.normal(0.0, 1.0, (num_tracks, 2)), rng.uniform(-np.pi, np.pi, num_tracks), zero.copy(), cruise.copy(),
            cruise, np.zeros(num_tracks, dtype=np.int64), zero.copy(), zero.copy(), cruise.copy(), np.zeros((num_tracks, 2)),
        )  # fmt: skip

    def advance(self, dt: float, rng: np.random.Generator) -> None:
        s = self.scenario
        self._enter_modes(np.flatnonzero(self.time_left <= 0.0), rng)
        self.time_left -= dt
        command = np.where(self.mode == _GOTO, self._steer(self.goal), self.turn_command)
        if np.isfinite(s.arena_radius):
            is_out = (self.position**2).sum(-1) > s.arena_radius**2
            command = np.where(is_out, self._steer(np.zeros_like(self.goal)), command)
        n = len(self.turn)
        follow = 1.0 - np.exp(-dt / s.turn_memory)
        self.turn += follow * (command - self.turn) + s.turn_noise * np.sqrt(dt) * rng.normal(size=n)
        self.speed += (1.0 - np.exp(-dt / s.speed_memory)) * (self.speed_command - self.speed)
        self.heading += self.turn * dt
        step = (self.speed * dt)[:, None] * np.stack([np.cos(self.heading), np.sin(self.heading)], axis=-1)
        self.position += step

    def _steer(self, goal: Float64s) -> Float64s:
        """Turn rate towards a point, at most three times the scenario's."""
        offset = goal - self.position
        error = np.arctan2(offset[:, 1], offset[:, 0]) - self.heading
        error = (error + np.pi) % (2.0 * np.pi) - np.pi
        limit = max(2.0 * self.scenario.turn_rate, 2.0 / self.scenario.arena_radius)
        return np.clip(error, -limit, limit)

    def _enter_modes(self, which: Int64s, rng: np.random.Generator) -> None:
        if len(which) == 0:
            return
        s, n = self.scenario, len(which)
        mode = rng.choice(_NUM_MODES, size=n, p=s.mode_share)
        self.mode[which] = mode
        self.time_left[which] = rng.exponential(s.mode_duration[mode]) + 1e-6
        sign = rng.choice([-1.0, 1.0], size=n)
        turn = sign * s.turn_rate * np.exp(rng.normal(0.0, 0.4, n))
        self.turn_command[which] = np.where((mode == _TURN) | (mode == _CIRCLE), turn, 0.0)
        speed = self.cruise[which] * np.exp(rng.normal(0.0, 0.5 * s.speed_spread, n))
        self.speed_command[which] = np.where(mode == _STOP, 0.02 * speed, speed)
        reach = np.where(np.isfinite(s.arena_radius), min(s.arena_radius, 1e6), 25.0)
        centre = np.zeros((n, 2)) if np.isfinite(s.arena_radius) else self.position[which]
        self.goal[which] = centre + reach * rng.normal(0.0, 0.7, (n, 2))


def _detect(scenario: Scenario, num_tracks: int, num_steps: int, rng: np.random.Generator) -> Bools:
    """Alternating exponential gaps and bursts; within a burst a detection every interval, at least one a burst."""
    length = num_steps * SUBSTEPS + 1
    detected = np.zeros((num_tracks, length), dtype=bool)
    every = max(1, round(scenario.interval * SUBSTEPS))
    for track in range(num_tracks):
        now = rng.exponential(scenario.gap) * SUBSTEPS
        while now < length:
            end = now + rng.exponential(scenario.burst) * SUBSTEPS
            detected[track, int(now) : min(int(end) + 1, length) : every] = True
            now = end + rng.exponential(scenario.gap) * SUBSTEPS
    return detected
