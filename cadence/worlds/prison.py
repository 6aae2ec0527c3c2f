"""World "prison" (Prison Escape): one fugitive runs to a hideout through the dark; cameras, parties and helicopters search.

After the authors' simulator, configuration `balance_game` (facts from its source, MIT, written anew). An episode has one
hideout that the trackers know and two that they do not; the fugitive starts in the far corner, makes for the nearest unknown
one by A*, hides when followed, and gives itself up to the known one when it cannot get away (`cadence.worlds.prison_fugitive`).
It ends within 50 cells of any of them; one that takes 2000 steps is stuck and another takes its place. Five parties and a
helicopter search (`cadence.worlds.prison_search`); they and 78 cameras detect by the law of `cadence.worlds.detection`, with
R = factor * coverage * k * speed (k: camera 1, party 0.75, helicopter 0.5). The fugitive sees trackers by the same law with
coverage where it stands itself, as if they were slow: 8 cells a step for helicopters, 3 for parties.

One cell is 21 m, one step a minute; positions are whole cells; the mission frame has its origin in the map's corner.

Given the recorded trackers' places, and what was seen, fugitive and trackers do cell by cell what the original's did; only
the random numbers are others. The published factors are 3, 4 and 7, the published mean rates 12.9, 44.0 and 63.1 %; with this
configuration these factors give other rates, and the sets' factors here are tuned to the rates.
"""

from dataclasses import dataclass
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from cadence.arrays import Bools, Float64s, Int64s
from cadence.recordings import Recordings
from cadence.worlds.detection import detect, mean_law
from cadence.worlds.draws import Draws
from cadence.worlds.episode import Episode, SensorLaw, SensorReports
from cadence.worlds.prison_fugitive import MAX_SPEED, MODE_NAMES, Fugitives, Sight, distance_between, stride
from cadence.worlds.prison_map import (
    CELL_M,
    HIDDEN_CAMERAS,
    KEEP_OUT,
    KNOWN_SITES,
    MOUNTAIN,
    SEEN_CAMERAS,
    SIDE,
    UNKNOWN_SITES,
    prison_map,
)
from cadence.worlds.prison_search import Search
from cadence.worlds.pursuit import HELICOPTER, PARTY, MoverKind, is_working
from cadence.worlds.terrain import Terrain

STEP_S = 60.0
DETECTION_FACTORS = {"low": 3.3, "med": 6.3, "high": 8.8}
STUCK_STEPS = 2000

_START_RANGE, _HIDEOUT_RADIUS = 350, 50.0
_CAMERA_K = 1.0
_SEEN_AS_IF = {HELICOPTER.name: 8.0, PARTY.name: 3.0}
"""Speeds of the trackers as the fugitive's own detection law takes them."""
_STREAM_PLACES, _STREAM_DETECT, _STREAM_SIGHT = 11, 12, 13
_NEXT_ATTEMPT = 1 << 40
"""Added to an episode's number where the one before got stuck."""
_SIGMA_M = 1.0
"""Detections are exact; covariances must not be zero."""
_Scalar = TypeVar("_Scalar", bound=np.generic)


@dataclass(frozen=True)
class PrisonConfig:
    """Settings of the world.

    set     "low", "med" or "high": 12.9, 44.0 or 63.1 % of the steps with a detection, means over episodes
    factor  detection factor, which scales all ranges; None: that which gives the set's rate
    num_parties, num_helicopters  searchers
    """

    set: Literal["low", "med", "high"] = "low"
    factor: float | None = None
    num_parties: int = 5
    num_helicopters: int = 1

    def __post_init__(self) -> None:
        if self.set not in DETECTION_FACTORS:
            raise ValueError(f'set "{self.set}" must be "low", "med" or "high"')
        if self.factor is not None and not self.factor >= 0.0:
            raise ValueError(f"factor {self.factor} must not be negative")
        if min(self.num_parties, self.num_helicopters) < 0:
            raise ValueError("num_parties and num_helicopters must not be negative")

    @property
    def kinds(self) -> tuple[MoverKind, ...]:
        """The searchers, helicopters first."""
        return (HELICOPTER,) * self.num_helicopters + (PARTY,) * self.num_parties

    @property
    def detection_factor(self) -> float:
        """The factor in use."""
        return DETECTION_FACTORS[self.set] if self.factor is None else self.factor


@dataclass(frozen=True, eq=False)
class _Places:
    """What is drawn before an episode begins, in cells: start [B, 2], goal [B, 2, 2], refuge [B, 2], camera [B, C, 2].

    Of the cameras the fugitive knows the first `num_known`; among them the one at the start and the one at the refuge.
    """

    start: Float64s
    goal: Float64s
    refuge: Float64s
    camera: Float64s
    num_known: int

    @classmethod
    def draw(cls, draws: Draws) -> "_Places":
        """Start, hideouts and cameras of every episode."""
        rows = np.arange(len(draws))
        share = [draws.uniform(rows, _STREAM_PLACES, 0, choice) for choice in range(5)]
        start = SIDE - _START_RANGE + np.floor(np.stack(share[:2], axis=-1) * _START_RANGE)
        refuge = KNOWN_SITES[(share[2] * len(KNOWN_SITES)).astype(np.int64)].astype(np.float64)
        one = (share[3] * len(UNKNOWN_SITES)).astype(np.int64)
        other = (one + 1 + (share[4] * (len(UNKNOWN_SITES) - 1)).astype(np.int64)) % len(UNKNOWN_SITES)
        goal = UNKNOWN_SITES[np.stack([one, other], axis=-1)].astype(np.float64)
        seen, hidden = (np.tile(camera, (len(rows), 1, 1)) for camera in (SEEN_CAMERAS, HIDDEN_CAMERAS))
        camera = np.concatenate([seen, start[:, None], refuge[:, None], hidden], axis=1)
        return cls(start, goal, refuge, camera, len(SEEN_CAMERAS) + 2)


@dataclass(frozen=True, eq=False)
class _Batch:
    """B episodes in lockstep, padded to T steps, in cells.

    last [B] index of the final step (-1: stuck), target [T, B, 2], mode [T, B], movers [T, B, M, 2], hits: step, episode,
    sensor [N] (cameras first)
    """

    places: _Places
    last: Int64s
    target: NDArray[np.int16]
    mode: NDArray[np.int8]
    movers: NDArray[np.int16]
    hits: Int64s


def _run(config: PrisonConfig, seed: int, numbers: Int64s) -> _Batch:
    """Simulate the episodes `numbers` [B] of `seed` together; what happens in one depends on no other."""
    draws = Draws(seed, numbers)
    places, search = _Places.draw(draws), Search(config.kinds, draws)
    fugitives = Fugitives(places.goal, places.refuge, places.camera[:, : places.num_known], config.num_helicopters, draws)
    hideouts = np.concatenate([places.goal, places.refuge[:, None]], axis=1)
    ground = prison_map()
    sensitivity = np.array([_CAMERA_K] * places.camera.shape[1] + [kind.sensitivity for kind in config.kinds])
    as_seen = np.array([kind.sensitivity * _SEEN_AS_IF[kind.name] for kind in config.kinds])
    here, speed = places.start.copy(), np.zeros(len(numbers))
    is_running, last = np.ones(len(numbers), dtype=bool), np.full(len(numbers), -1)
    targets, modes, movers, hits = [], [], [], []
    for step in range(STUCK_STEPS):
        sensors = np.concatenate([places.camera, search.position], axis=1)
        reach = config.detection_factor * _at(ground.coverage, sensors) * sensitivity * speed[:, None]
        hit: Bools = detect(draws, _STREAM_DETECT, step, sensors, here, reach) & is_running[:, None]
        sight = config.detection_factor * _at(ground.coverage, here)[:, None] * as_seen
        is_seen = detect(draws, _STREAM_SIGHT, step, search.position, here, sight)
        targets.append(here.astype(np.int16))
        modes.append(fugitives.mode.copy())
        movers.append(search.position.astype(np.int16))
        episode, sensor = np.nonzero(hit)
        hits.append(np.stack([np.full(len(episode), step), episode, sensor]))
        is_home = is_running & (distance_between(hideouts, here[:, None]) <= _HIDEOUT_RADIUS).any(axis=1)
        last[is_home] = step
        is_running &= ~is_home
        rows = np.flatnonzero(is_running)
        if not len(rows):
            break
        speed[rows], heading = fugitives.act(rows, Sight(step, here, speed, search.position, is_seen))
        search.notice(step, np.any(hit, axis=1), here)
        search.advance(step, is_running)
        moved = stride(here[rows], speed[rows], heading)
        is_blocked = _at(ground.is_mountain, moved)
        here[rows] = np.where(is_blocked[:, None], here[rows], moved)
    return _Batch(places, last, np.stack(targets), np.stack(modes), np.stack(movers), np.concatenate(hits, axis=1))


def _at(field: NDArray[_Scalar], cell: Float64s) -> NDArray[_Scalar]:
    """Values [...] of a field of the map at cells [..., 2]."""
    index = cell.astype(np.int64)
    return field[index[..., 0], index[..., 1]]


def _run_until_home(config: PrisonConfig, seed: int, indices: Int64s) -> tuple[list[_Batch], Int64s]:
    """Batches, and which of them [B] holds an episode, under which row: [2, B]. Stuck episodes are drawn anew."""
    found = np.full((2, len(indices)), -1)
    batches: list[_Batch] = []
    missing = np.arange(len(indices))
    while len(missing):
        batch = _run(config, seed, indices[missing] + len(batches) * _NEXT_ATTEMPT)
        home = np.flatnonzero(batch.last >= 0)
        found[0, missing[home]], found[1, missing[home]] = len(batches), home
        missing = np.delete(missing, home)
        batches.append(batch)
    return batches, found


def simulate_prison_batch(config: PrisonConfig, seed: int, indices: Int64s) -> Recordings:
    """The episodes `indices` [E] of `seed`; each depends on nothing but its index, the seed and the settings."""
    indices = np.asarray(indices, dtype=np.int64)
    batches, found = _run_until_home(config, seed, indices)
    target, is_detected, movers, refuge = [], [], [], []
    for place, row in found.T:
        batch = batches[place]
        count = batch.last[row] + 1
        seen = np.zeros(count, dtype=bool)
        seen[batch.hits[0, batch.hits[1] == row]] = True
        target.append(batch.target[:count, row])
        movers.append(batch.movers[:count, row])
        is_detected.append(seen)
        refuge.append(batch.places.refuge[row])
    cell = np.float32(CELL_M)
    return Recordings(
        STEP_S,
        np.concatenate([[0], np.cumsum([len(part) for part in target])]),
        np.concatenate(target).astype(np.float32) * cell,
        np.concatenate(is_detected),
        np.concatenate(movers).astype(np.float32) * cell,
        np.array(refuge, dtype=np.float32) * cell,
    )


def simulate_prison(config: PrisonConfig, seed: int, index: int) -> Episode:
    """One episode with all that happened in it; a detection a sensor and step."""
    return simulate_prison_episodes(config, seed, np.array([index]))[0]


def simulate_prison_episodes(config: PrisonConfig, seed: int, indices: Int64s) -> list[Episode]:
    """Several such episodes; together they take a fraction of the time."""
    batches, found = _run_until_home(config, seed, np.asarray(indices, dtype=np.int64))
    return [_episode(config, batches[place], row) for place, row in found.T.tolist()]


def _episode(config: PrisonConfig, batch: _Batch, row: int) -> Episode:
    """Row `row` of a batch."""
    count = int(batch.last[row]) + 1
    truth = batch.target[:count, row].astype(np.float64) * CELL_M
    step, _, sensor = batch.hits[:, batch.hits[1] == row]
    steps = np.arange(count)
    camera = batch.places.camera[row]
    movers = np.moveaxis(batch.movers[:count, row].astype(np.float64), 0, 1)
    sensors = np.concatenate([np.tile(camera[:, None], (1, count, 1)), movers]) * CELL_M
    known = batch.places.num_known
    names = ["known_camera"] * known + ["unknown_camera"] * (len(camera) - known) + [kind.name for kind in config.kinds]
    works = np.array([[is_working(kind, now) for now in steps.tolist()] for kind in config.kinds], dtype=bool)
    return Episode(
        world="prison",
        time_s=np.multiply(steps, STEP_S, dtype=np.float64),
        agent_ids=("fugitive",),
        truth_m=truth[None],
        mode_names=MODE_NAMES,
        mode=batch.mode[:count, row][None],
        goals_m=(np.concatenate([batch.places.goal[row], batch.places.refuge[row][None]]) * CELL_M,),
        sensor_ids=tuple(f"{name}_{names[:number].count(name):02d}" for number, name in enumerate(names)),
        sensors_m=sensors,
        is_active=np.concatenate([np.ones((len(camera), count), dtype=bool), works.reshape(-1, count)]),
        detections=SensorReports(
            step, np.zeros(len(step), dtype=np.int64), sensor, truth[step], np.tile(_SIGMA_M**2 * np.eye(2), (len(step), 1, 1))
        ),
        terrain=Terrain(SIDE * CELL_M, np.array([[*MOUNTAIN, KEEP_OUT]]) * CELL_M, ()),
        laws=_laws(config, sensors / CELL_M, len(camera)),
    )


def _laws(config: PrisonConfig, sensors: Float64s, num_cameras: int) -> tuple[SensorLaw, ...]:
    """What each sensor [S, T, 2], in cells, detects of a fugitive that walks, from the coverage where it stands in turn."""
    sensitivity = [_CAMERA_K] * num_cameras + [kind.sensitivity for kind in config.kinds]
    strength = config.detection_factor * MAX_SPEED * CELL_M
    covered = _at(prison_map().coverage, sensors)
    return tuple(mean_law(strength * k * row) for k, row in zip(sensitivity, covered, strict=True))
