"""World "narco": one smuggler crosses the eastern Pacific by a rendezvous to a hideout; vessels and aeroplanes search.

After the authors' Smuggler simulator (facts from its source, written anew): the smuggler leaves (4000, 100), makes for one
of four rendezvous drawn with equal chances, and from there for the nearer of two hideouts, drawn from four; it knows no
evasion. Its ways are the cheapest over the cells of `cadence.worlds.ocean` (cost: length in cells plus wave height in
metres), at 7.5 km a step. As in the original nothing else about its way is random: there are not more than sixteen ways.
It has passed the rendezvous, or arrived, within 50 km. Two vessels and two (set "low") or three (set "high") aeroplanes
search (`cadence.worlds.pursuit`) with R = factor * coverage * k * speed; a vessel within 100 km ends the episode, and so do the
hideout and step 4320. Aeroplanes on the ground still see. No hideout is known to the trackers: `known_goal_m` is NaN.

One unit is one kilometre, one step a minute; the mission frame is in metres with its origin at the map's south-west corner.

Ours: the coast and the waves (see `cadence.worlds.ocean`; the authors' charts are not public), and with them what a factor
means. The published factor is 40 in both sets, the published mean detection rates are 13.8 % and 31.5 %. On our sea 40 gives
the first; for "high" the factor was tuned to the rate, three aeroplanes and 40 alone would give about 20 %.
"""

import functools
import itertools
from dataclasses import dataclass
from typing import Literal

import numpy as np
import shapely

from cadence.arrays import Bools, Float32s, Float64s, Int64s
from cadence.recordings import Recordings
from cadence.worlds.detection import detect, mean_law
from cadence.worlds.draws import Draws
from cadence.worlds.episode import Episode, SensorLaw, SensorReports
from cadence.worlds.ocean import CELL, SIZE, Ocean, eastern_pacific
from cadence.worlds.pursuit import AIRPLANE, VESSEL, MoverKind, Pursuit, is_working
from cadence.worlds.terrain import Terrain

START = np.array([4000.0, 100.0])
RENDEZVOUS = np.array([[3000.0, 1500.0], [2000.0, 2500.0], [5000.0, 1000.0], [6300.0, 500.0]])
HIDEOUTS = np.array([[4300.0, 3400.0], [5000.0, 3000.0], [6000.0, 2600.0], [7000.0, 2000.0]])
SPEED = 7.5
STEP_S = 60.0
UNIT_M = 1000.0
MAX_STEPS = 4320
DETECTION_FACTORS = {"low": 40.0, "high": 58.5}

_NUM_VESSELS = 2
_NUM_AIRPLANES = {"low": 2, "high": 3}
_ARRIVAL_RADIUS, _CAPTURE_RADIUS = 50.0, 100.0
_SMUGGLERS_WAVE_COST = 1.0
_STREAM_DETECT, _STREAM_ROUTE = 11, 12
_SIGMA_M = 1.0
"""Detections are exact; covariances must not be zero."""

_MODES = ("to the rendezvous", "to the hideout")


@dataclass(frozen=True)
class NarcoConfig:
    """Settings of the world.

    set     "low" (two aeroplanes, 13.8 % of the steps with a detection) or "high" (three, 31.5 %): means over episodes
    factor  detection factor, which scales all ranges; None: that which gives the set's rate
    """

    set: Literal["low", "high"] = "low"
    factor: float | None = None

    def __post_init__(self) -> None:
        if self.set not in _NUM_AIRPLANES:
            raise ValueError(f'set "{self.set}" must be "low" or "high"')
        if self.factor is not None and not self.factor >= 0.0:
            raise ValueError(f"factor {self.factor} must not be negative")

    @property
    def kinds(self) -> tuple[MoverKind, ...]:
        """The searchers, aeroplanes first."""
        return (AIRPLANE,) * _NUM_AIRPLANES[self.set] + (VESSEL,) * _NUM_VESSELS

    @property
    def detection_factor(self) -> float:
        """The factor in use."""
        return DETECTION_FACTORS[self.set] if self.factor is None else self.factor


@dataclass(frozen=True, eq=False)
class _Routes:
    """The smuggler's ways from the start by rendezvous r to hideout h, route 4 r + h, padded with their ends.

    position [16, T, 2] km, speed [16, T] km a step (0 at the start), last [16] index of the arrival, met [16] of the
    rendezvous
    """

    position: Float64s
    speed: Float64s
    last: Int64s
    met: Int64s


@dataclass(frozen=True, eq=False)
class _Batch:
    """B episodes in lockstep: route [B], hideouts [B, 2], last step [B], movers [T, B, M, 2] km, hits [T, B, M]."""

    route: Int64s
    last: Int64s
    movers: Float32s
    hit: Bools


def _sail(points: Float64s) -> Float64s:
    """Positions [T, 2] along way-points, 7.5 km a step, the last step to each of them shorter; without the first point."""
    legs = []
    for begin, end in itertools.pairwise(points):
        length = float(np.hypot(*(end - begin)))
        count = int(np.ceil(length / SPEED - 1e-9))
        if count:
            legs.append(begin + (end - begin) * np.minimum(np.arange(1, count + 1) * SPEED / length, 1.0)[:, None])
    return np.concatenate(legs)


@functools.cache
def _routes(ocean: Ocean) -> _Routes:
    paths, met = [], []
    for rendezvous in RENDEZVOUS:
        first = np.concatenate([START[None], _sail(ocean.way(START, rendezvous, _SMUGGLERS_WAVE_COST))])
        near = np.hypot(*(first[:, None] - RENDEZVOUS).T).min(axis=0) <= _ARRIVAL_RADIUS
        for hideout in HIDEOUTS:
            second = _sail(ocean.way(rendezvous, hideout, _SMUGGLERS_WAVE_COST))
            arrival = int(np.argmax(np.hypot(*(second - hideout).T) <= _ARRIVAL_RADIUS))
            paths.append(np.concatenate([first, second[: arrival + 1]]))
            met.append(int(np.argmax(near)))
    longest = max(len(path) for path in paths)
    position = np.stack([np.pad(path, ((0, longest - len(path)), (0, 0)), mode="edge") for path in paths])
    speed = np.zeros(position.shape[:2])
    speed[:, 1:] = np.hypot(*np.moveaxis(np.diff(position, axis=1), -1, 0))
    return _Routes(position, speed, np.array([len(path) - 1 for path in paths]), np.array(met))


def _choose_routes(draws: Draws) -> Int64s:
    """A rendezvous and the nearer of two different hideouts for every episode [B]."""
    rows = np.arange(len(draws))
    share = [draws.uniform(rows, _STREAM_ROUTE, 0, choice) for choice in range(3)]
    rendezvous = (share[0] * len(RENDEZVOUS)).astype(np.int64)
    one = (share[1] * len(HIDEOUTS)).astype(np.int64)
    other = (one + 1 + (share[2] * (len(HIDEOUTS) - 1)).astype(np.int64)) % len(HIDEOUTS)
    distance = np.hypot(*(RENDEZVOUS[:, None] - HIDEOUTS).T).T
    nearer = np.where(distance[rendezvous, one] <= distance[rendezvous, other], one, other)
    return rendezvous * len(HIDEOUTS) + nearer


def _run(config: NarcoConfig, seed: int, indices: Int64s) -> _Batch:
    """Simulate the episodes `indices` [B] of `seed` together; what happens in one depends on no other."""
    ocean, kinds, draws = eastern_pacific(), config.kinds, Draws(seed, indices)
    routes, route = _routes(ocean), _choose_routes(draws)
    pursuit = Pursuit(ocean, kinds, draws)
    is_vessel = np.array([kind is VESSEL for kind in kinds])
    strength = config.detection_factor * np.array([kind.sensitivity for kind in kinds])
    last = np.minimum(routes.last[route], MAX_STEPS)
    num_steps = int(last.max()) + 1
    movers = np.zeros((num_steps, len(indices), len(kinds), 2), dtype=np.float32)
    hit = np.zeros(movers.shape[:3], dtype=bool)
    movers[0] = pursuit.position
    for step in range(1, num_steps):
        is_running = step <= last
        if not is_running.any():
            break
        pursuit.notice(step - 1, hit[step - 1].any(axis=1) & is_running, routes.position[route, step - 1])
        pursuit.advance(step, is_running)
        target, speed = routes.position[route, step], routes.speed[route, step]
        reach = strength * ocean.coverage(pursuit.position, step) * speed[:, None]
        hit[step] = detect(draws, _STREAM_DETECT, step, pursuit.position, target, reach) & is_running[:, None]
        distance = np.hypot(*np.moveaxis(pursuit.position[:, is_vessel] - target[:, None], -1, 0))
        caught = is_running & (distance <= _CAPTURE_RADIUS).any(axis=1)
        last[caught] = step
        movers[step] = pursuit.position
    return _Batch(route, last, movers, hit)


def simulate_narco_batch(config: NarcoConfig, seed: int, indices: Int64s) -> Recordings:
    """The episodes `indices` [E] of `seed`; each depends on nothing but its index, the seed and the settings."""
    indices = np.asarray(indices, dtype=np.int64)
    batch, routes = _run(config, seed, indices), _routes(eastern_pacific())
    length = batch.last + 1
    offset = np.concatenate([[0], np.cumsum(length)])
    episode = np.repeat(np.arange(len(indices)), length)
    step = np.arange(offset[-1]) - offset[episode]
    return Recordings(
        STEP_S,
        offset,
        (routes.position[batch.route[episode], step] * UNIT_M).astype(np.float32),
        batch.hit[step, episode].any(axis=1),
        batch.movers[step, episode] * np.float32(UNIT_M),
        np.full((len(indices), 2), np.nan, dtype=np.float32),
    )


def simulate_narco(config: NarcoConfig, seed: int, index: int) -> Episode:
    """One episode with all that happened in it; a detection a sensor and step."""
    batch, routes = _run(config, seed, np.array([index])), _routes(eastern_pacific())
    route, count = int(batch.route[0]), int(batch.last[0]) + 1
    truth = routes.position[route, :count] * UNIT_M
    step, sensor = np.nonzero(batch.hit[:count, 0])
    steps = np.arange(count)
    names: dict[str, int] = {}
    for kind in config.kinds:
        names[kind.name] = names.get(kind.name, 0) + 1
    return Episode(
        world="narco",
        time_s=np.multiply(steps, STEP_S, dtype=np.float64),
        agent_ids=("smuggler",),
        truth_m=truth[None],
        mode_names=_MODES,
        mode=(steps >= routes.met[route]).astype(np.int8)[None],
        goals_m=(np.stack([RENDEZVOUS[route // len(HIDEOUTS)], HIDEOUTS[route % len(HIDEOUTS)]]) * UNIT_M,),
        sensor_ids=tuple(f"{name}_{number + 1}" for name, total in names.items() for number in range(total)),
        sensors_m=np.moveaxis(batch.movers[:count, 0].astype(np.float64), 0, 1) * UNIT_M,
        is_active=np.array([[is_working(kind, int(now)) for now in steps] for kind in config.kinds]),
        detections=SensorReports(
            step, np.zeros(len(step), dtype=np.int64), sensor, truth[step], np.tile(_SIGMA_M**2 * np.eye(2), (len(step), 1, 1))
        ),
        terrain=land_of(eastern_pacific()),
        laws=_laws(config, batch.movers[:count, 0].astype(np.float64), float(routes.speed[route, 1:count].mean())),
    )


def _laws(config: NarcoConfig, movers: Float64s, speed: float) -> tuple[SensorLaw, ...]:
    """What each mover [T, M, 2] detects of a target at this speed, from the coverage where it was in turn."""
    ocean = eastern_pacific()
    covered = np.stack([ocean.coverage(movers[step], step) for step in range(len(movers))])
    strength = config.detection_factor * speed * UNIT_M
    return tuple(mean_law(strength * kind.sensitivity * covered[:, number]) for number, kind in enumerate(config.kinds))


def land_of(ocean: Ocean) -> Terrain:
    """The land as polygons in the mission frame."""
    column, row = np.nonzero(ocean.is_land)
    corner = np.stack([column, row], axis=-1) * CELL
    cells = shapely.box(*corner.T, *(corner + CELL).T)
    joined = shapely.get_parts(shapely.simplify(shapely.union_all(cells, grid_size=1e-6), 1e-3))
    polygons = tuple(np.array(part.exterior.coords[:-1]) * UNIT_M for part in joined)
    return Terrain(float(SIZE.max()) * UNIT_M, np.zeros((0, 3)), polygons)
