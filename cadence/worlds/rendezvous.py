"""World "rendezvous": several agents who meet at a site and go on to a goal together, or go straight there.

The paper's multi-target setting: several mountains, ways that prefer cover, half of the episodes with a meeting, goals of a
discrete set, detections of 10 to 12 % of the steps drawn once and kept, nobody who searches. What the paper leaves open is
decided here. The place is fixed (`cadence.worlds.rendezvous_map`). An episode draws one goal and one site, whether the agents
meet, and for each agent a start (uniform over free ground, 5 km from the goal at least; the agents are not all within 3 km)
and a speed, which it keeps. A group leaves the site 2 to 10 steps after the last has come, each at its own speed; in half of
these episodes all take the same way then, side by side, in the others each its own. Who has arrived stays; the episode ends
when the last has. One step is a minute; the mission frame has its origin in the map's middle.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cadence.arrays import Bools, Float64s, Int64s
from cadence.recordings import Recordings
from cadence.worlds.draws import Draws
from cadence.worlds.episode import Episode, SensorReports
from cadence.worlds.joint import JointRecordings
from cadence.worlds.rendezvous_map import (
    GOALS_M,
    MAX_SHIFT_M,
    MAX_STRIDE_M,
    NUM_MOODS,
    SIDE_M,
    SITES_M,
    SPOT_M,
    ground,
    way,
)

STEP_S = 60.0
MAX_AGENTS = 32

_MIN_STRIDE_M = 110.0
_FROM_GOAL_M, _APART_M = 5000.0, 3000.0
_WAIT_STEPS = (2, 10)
_SHARE_COMMON = 0.5
_STREAM_EPISODE, _STREAM_START, _STREAM_AGENT, _STREAM_SEEN = 11, 12, 13, 14
_NOISE_STREAM = 15
_SIGMA_M = 1.0
"""Detections are exact; covariances must not be zero."""
_MAX_STEPS = 1 << 16

_TO_SITE, _WAITING, _TO_GOAL, _ARRIVED = range(4)
_MODES = ("to the site", "waiting", "to the goal", "arrived")


@dataclass(frozen=True)
class RendezvousConfig:
    """Settings of the world.

    num_agents         agents of every episode, 1 ... 32
    share_meeting      probability that the agents of an episode meet before the goal
    detection_rate     least and greatest share of an agent's steps that hold a detection; drawn an agent
    detection_sigma_m  standard deviation of a detection's noise in each direction, in logs; 0: exact, as in the paper
    clutter_per_step   mean number of detections a step that no agent caused, anywhere on the map; logs of unknown origin only
    is_origin_known    whether logs say which agent a detection is of
    """

    num_agents: int = 3
    share_meeting: float = 0.5
    detection_rate: tuple[float, float] = (0.10, 0.12)
    detection_sigma_m: float = 0.0
    clutter_per_step: float = 0.0
    is_origin_known: bool = True

    def __post_init__(self) -> None:
        if not 1 <= self.num_agents <= MAX_AGENTS:
            raise ValueError(f"num_agents is {self.num_agents}; it must lie in 1..{MAX_AGENTS}")
        if not 0.0 <= self.share_meeting <= 1.0:
            raise ValueError(f"share_meeting {self.share_meeting} must lie in 0..1")
        if not 0.0 < self.detection_rate[0] <= self.detection_rate[1] <= 1.0:
            raise ValueError(f"detection_rate {self.detection_rate} must be two rising shares above 0, at most 1")
        if not (0.0 <= self.detection_sigma_m <= SIDE_M and 0.0 <= self.clutter_per_step <= 1000.0):
            raise ValueError("detection_sigma_m and clutter_per_step must not be negative, nor beyond the map and 1000")
        if self.clutter_per_step and self.is_origin_known:
            raise ValueError("clutter_per_step must be 0 where is_origin_known: a detection of known origin is no clutter")


@dataclass(frozen=True, eq=False)
class _Plans:
    """What B episodes draw before they begin, for A agents; legs are to the site and to the goal.

    goal, site, wait [B], is_meeting [B], start_m [B, A, 2], stride_m, rate [B, A], mood [B, A, 2 legs],
    spot_m, shift_m [B, A, 2 legs, 2]: where beside the place an agent stops, how far beside the way it walks
    """

    goal: Int64s
    site: Int64s
    wait: Int64s
    is_meeting: Bools
    start_m: Float64s
    stride_m: Float64s
    rate: Float64s
    mood: Int64s
    spot_m: Float64s
    shift_m: Float64s

    @classmethod
    def draw(cls, config: RendezvousConfig, draws: Draws) -> "_Plans":
        """The plans of all episodes; each depends on its own address alone."""
        rows, num_agents = np.arange(len(draws)), config.num_agents
        share = [draws.uniform(rows, _STREAM_EPISODE, 0, choice) for choice in range(6)]
        goal = _pick(share[0], len(GOALS_M))
        each, agent = np.repeat(rows, num_agents), np.tile(np.arange(num_agents), len(rows))

        def of_agents(purpose: int) -> Float64s:
            return draws.uniform(each, _STREAM_AGENT, purpose, agent).reshape(-1, num_agents)

        mood = _pick(np.stack([of_agents(0), of_agents(1)], axis=-1), NUM_MOODS)
        is_common = share[4] < _SHARE_COMMON
        mood[is_common, :, 1] = _pick(share[5], NUM_MOODS)[is_common, None]
        radius = np.array([[SPOT_M, SPOT_M], [MAX_SHIFT_M, MAX_SHIFT_M]])
        disc = radius[..., None] * _disc(np.stack([of_agents(number) for number in range(4, 12)], axis=-1))
        return cls(
            goal=goal,
            site=_pick(share[1], len(SITES_M)),
            wait=_WAIT_STEPS[0] + _pick(share[2], _WAIT_STEPS[1] - _WAIT_STEPS[0] + 1),
            is_meeting=share[3] < config.share_meeting,
            start_m=_starts(draws, GOALS_M[goal], num_agents),
            stride_m=_MIN_STRIDE_M + (MAX_STRIDE_M - _MIN_STRIDE_M) * of_agents(2),
            rate=config.detection_rate[0] + (config.detection_rate[1] - config.detection_rate[0]) * of_agents(3),
            mood=mood,
            spot_m=disc[:, :, 0],
            shift_m=disc[:, :, 1],
        )


def _pick(share: Float64s, count: int) -> Int64s:
    """Numbers 0 ... count - 1 out of uniform shares."""
    return (share * count).astype(np.int64)


def _disc(share: Float64s) -> Float64s:
    """Points [..., 2, 2, 2] uniform in the unit disc, out of uniform shares [..., 8]."""
    share = share.reshape(*share.shape[:-1], 2, 2, 2)
    bearing = 2 * np.pi * share[..., 1]
    points: Float64s = np.sqrt(share[..., :1]) * np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)
    return points


def _starts(draws: Draws, goal_m: Float64s, num_agents: int) -> Float64s:
    """Starts [B, A, 2] of episodes with these goals [B, 2]."""
    place = ground()
    start = np.zeros((len(draws), num_agents, 2))
    is_missing = np.ones(start.shape[:2], dtype=bool)
    attempt = 0
    while is_missing.any():
        row, agent = np.nonzero(is_missing)
        point = (draws.point(row, _STREAM_START, attempt, agent) - 0.5) * SIDE_M
        start[row, agent] = point
        is_missing[row, agent] = ~place.is_free(point) | (np.hypot(*(point - goal_m[row]).T) < _FROM_GOAL_M)
        far = np.hypot(*np.moveaxis(start - start[:, :1], -1, 0)).max(axis=1)
        is_missing |= (~is_missing.any(axis=1) & (num_agents > 1) & (far < _APART_M))[:, None]
        attempt += 1
    return start


@dataclass(frozen=True, eq=False)
class _Roll:
    """One episode: truth_m [A, T, 2], mode [A, T], left_step (-1: direct), is_detected [A, T]."""

    truth_m: Float64s
    mode: NDArray[np.int8]
    left_step: int
    is_detected: Bools


class _Walk:
    """A way with its length, walked in equal strides; the agent waits at both ends."""

    def __init__(self, points_m: Float64s, stride_m: float) -> None:
        self._points_m = points_m
        self._at_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points_m, axis=0).T))])
        self._stride_m = stride_m
        self.num_steps = int(np.ceil(self._at_m[-1] / stride_m))

    def positions(self, step: Int64s) -> Float64s:
        """Where the agent is [T, 2] so many steps [T] after it set out."""
        walked = step * self._stride_m
        return np.stack([np.interp(walked, self._at_m, self._points_m[:, axis]) for axis in (0, 1)], axis=-1)


def _roll(plans: _Plans, draws: Draws, row: int) -> _Roll:
    """Episode `row` of the plans."""
    goal, site = int(plans.goal[row]), int(plans.site[row])
    spots = [GOALS_M[goal] + plans.spot_m[row, :, 1], SITES_M[site] + plans.spot_m[row, :, 0]]
    begins, first, left = plans.start_m[row], [], -1
    if plans.is_meeting[row]:
        first = _walks(plans, row, 0, begins, len(GOALS_M) + site, spots[1])
        left, begins = max(walk.num_steps for walk in first) + int(plans.wait[row]), spots[1]
    second = _walks(plans, row, 1, begins, goal, spots[0])
    steps = np.arange(max(left, 0) + max(walk.num_steps for walk in second) + 1)
    truth = np.stack([walk.positions(steps - max(left, 0)) for walk in second])
    arrives = max(left, 0) + np.array([walk.num_steps for walk in second])
    mode = np.where(steps >= arrives[:, None], _ARRIVED, _TO_GOAL).astype(np.int8)
    for agent, walk in enumerate(first):
        truth[agent, :left] = walk.positions(steps[:left])
        mode[agent, :left] = np.where(steps[:left] >= walk.num_steps, _WAITING, _TO_SITE)
    return _Roll(truth, mode, left, _seen(draws, row, plans.rate[row], len(steps)))


def _walks(plans: _Plans, row: int, leg: int, begins_m: Float64s, place: int, ends_m: Float64s) -> list[_Walk]:
    """The walks of all agents of an episode on one leg."""
    mood, shift, stride = plans.mood[row, :, leg].tolist(), plans.shift_m[row, :, leg], plans.stride_m[row].tolist()
    ways = (way(*leg_of) for leg_of in zip(begins_m, [place] * len(mood), mood, ends_m, shift, strict=True))
    return [_Walk(points, pace) for points, pace in zip(ways, stride, strict=True)]


def _seen(draws: Draws, row: int, rate: Float64s, num_steps: int) -> Bools:
    """Which steps [A, T] hold a detection: of each agent its share, drawn without replacement, one at least."""
    num_agents = len(rate)
    address = (np.arange(num_agents)[:, None] * _MAX_STEPS + np.arange(num_steps)).ravel()
    lot = draws.uniform(np.full(address.shape, row), _STREAM_SEEN, 0, address).reshape(num_agents, num_steps)
    count = np.maximum(np.rint(rate * num_steps), 1)
    rank = lot.argsort(axis=1).argsort(axis=1)
    is_seen: Bools = rank < count[:, None]
    return is_seen


def simulate_rendezvous_batch(config: RendezvousConfig, seed: int, indices: Sequence[int] | Int64s) -> JointRecordings:
    """The episodes `indices` [E] of `seed`; each depends on nothing but its index, the seed and the settings.

    Positions are the true ones: noise and clutter exist in logs only.
    """
    draws = Draws(seed, indices)
    plans = _Plans.draw(config, draws)
    rolls = [_roll(plans, draws, row) for row in range(len(draws))]
    length = np.repeat([roll.truth_m.shape[1] for roll in rolls], config.num_agents)
    place = np.concatenate([roll.truth_m.reshape(-1, 2) for roll in rolls]).astype(np.float32)
    recordings = Recordings(
        STEP_S,
        np.concatenate([[0], np.cumsum(length)]),
        place,
        np.concatenate([roll.is_detected.ravel() for roll in rolls]),
        np.zeros((len(place), 0, 2), dtype=np.float32),
        np.full((len(length), 2), np.nan, dtype=np.float32),
        config.num_agents,
    )
    return JointRecordings(
        recordings,
        plans.is_meeting,
        GOALS_M[plans.goal],
        SITES_M[plans.site],
        np.array([roll.left_step for roll in rolls]),
    )


def simulate_rendezvous(config: RendezvousConfig, seed: int, index: int) -> Episode:
    """One episode with all that happened in it. Its goals are the site, where the agents meet, and the goal."""
    draws = Draws(seed, [index])
    plans = _Plans.draw(config, draws)
    roll = _roll(plans, draws, 0)
    num_agents, num_steps = roll.mode.shape
    goals = [SITES_M[plans.site], GOALS_M[plans.goal]] if plans.is_meeting[0] else [GOALS_M[plans.goal]]
    return Episode(
        world="rendezvous",
        time_s=np.multiply(np.arange(num_steps), STEP_S, dtype=np.float64),
        agent_ids=tuple(f"agent_{number + 1}" for number in range(num_agents)),
        truth_m=roll.truth_m,
        mode_names=_MODES,
        mode=roll.mode,
        goals_m=(np.concatenate(goals),) * num_agents,
        sensor_ids=(),
        sensors_m=np.zeros((0, num_steps, 2)),
        is_active=np.zeros((0, num_steps), dtype=bool),
        detections=_reports(config, roll, np.random.default_rng([seed, index, _NOISE_STREAM])),
        terrain=ground().terrain,
    )


def _reports(config: RendezvousConfig, roll: _Roll, rng: np.random.Generator) -> SensorReports:
    """The detections with their noise, and clutter behind those of the same step."""
    step, agent = np.nonzero(roll.is_detected.T)
    clutter = np.repeat(np.arange(roll.mode.shape[1]), rng.poisson(config.clutter_per_step, roll.mode.shape[1]))
    seen = roll.truth_m[agent, step] + config.detection_sigma_m * rng.standard_normal((len(step), 2))
    nowhere = rng.uniform(-SIDE_M / 2, SIDE_M / 2, (len(clutter), 2))
    order = np.argsort(np.concatenate([step, clutter]), kind="stable")
    variance = max(config.detection_sigma_m, _SIGMA_M) ** 2
    return SensorReports(
        np.concatenate([step, clutter])[order],
        np.concatenate([agent, np.full(len(clutter), -1)])[order],
        np.full(len(order), -1),
        np.concatenate([seen, nowhere])[order],
        np.tile(variance * np.eye(2), (len(order), 1, 1)),
    )
