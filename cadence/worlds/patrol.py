"""World "patrol": smugglers cross an archipelago, watched by patrol boats, a sweeping aircraft and masts on the shore.

The smugglers run from cove to cove by ways that differ from leg to leg, and react to sensors that come near: they hide
behind land, creep, or run. The sensors search, and boats go after what was seen. Detections therefore come in bursts with
long gaps between them, and where a smuggler is in a gap depends on the land and on the sensors.
"""

from dataclasses import dataclass, field

import numpy as np

from cadence.arrays import Bools, Float64s, Int64s
from cadence.worlds.crews import (
    AIRCRAFT,
    BOAT,
    CRUISE_MPS,
    MAST,
    MODE_NAMES,
    Sea,
    alert,
    commission,
    launch,
    steer_boat,
    steer_smuggler,
)
from cadence.worlds.episode import Episode, SensorLaw, SensorReports
from cadence.worlds.sensors import (
    Listening,
    SensorKind,
    Sortie,
    draw_noise,
    hear,
    measurement_covariance,
    sweep_track,
    swerling_probability,
)
from cadence.worlds.terrain import Terrain, blocks_segment, random_archipelago

_NUM_POINTS = 26
# Mean share of steps with a detection by the factor on all detection ranges; 120 episodes of the defaults each.
_RANGE_FACTORS = (0.5, 0.7, 0.85, 1.0, 1.2, 1.5, 2.0, 3.0)
_RATES = (0.027, 0.047, 0.076, 0.103, 0.139, 0.187, 0.263, 0.406)


@dataclass(frozen=True)
class PatrolConfig:
    """Settings of the world.

    num_agents      smugglers
    duration_s, step_s  length of an episode, and time between its steps
    detection_rate  mean share of steps with a detection of an agent, over episodes; single episodes differ widely. It sets
                    the sensors' ranges, nothing is thinned out afterwards
    line_of_sight   whether land hides agents from the sensors at sea level
    side_m          side of the map
    num_boats, num_aircraft, num_masts  sensors of each kind
    listening       direction finders on them
    """

    num_agents: int = 1
    duration_s: float = 7200.0
    step_s: float = 10.0
    detection_rate: float = 0.1
    line_of_sight: bool = True
    side_m: float = 30000.0
    num_boats: int = 3
    num_aircraft: int = 1
    num_masts: int = 2
    listening: Listening = field(default_factory=Listening)

    def __post_init__(self) -> None:
        if self.num_agents < 1:
            raise ValueError(f"num_agents is {self.num_agents}; at least one agent is needed")
        if not 1.0 <= self.step_s <= 30.0 or self.duration_s < 2 * self.step_s:
            raise ValueError(f"step_s {self.step_s} must lie in 1..30 and duration_s {self.duration_s} hold at least two steps")
        if not 0.03 <= self.detection_rate <= 0.4:
            raise ValueError(f"detection_rate {self.detection_rate} must lie in 0.03..0.4, where the law has been measured")
        if not 20000.0 <= self.side_m <= 60000.0:
            raise ValueError(f"side_m {self.side_m} must lie in 20000..60000")
        if min(self.num_boats, self.num_aircraft, self.num_masts) < 0 or self.num_sensors == 0:
            raise ValueError("at least one boat, aircraft or mast is needed to detect anything")

    @property
    def num_sensors(self) -> int:
        """Sensors of all kinds."""
        return self.num_boats + self.num_aircraft + self.num_masts

    @property
    def range_factor(self) -> float:
        """Factor on the ranges of all sensors that gives `detection_rate`."""
        return float(np.exp(np.interp(np.log(self.detection_rate), np.log(_RATES), np.log(_RANGE_FACTORS))))


@dataclass
class _Log:
    """Detections while they are collected."""

    step: list[Int64s] = field(default_factory=list)
    agent: list[Int64s] = field(default_factory=list)
    sensor: list[Int64s] = field(default_factory=list)
    position_m: list[Float64s] = field(default_factory=list)
    covariance_m2: list[Float64s] = field(default_factory=list)

    def close(self) -> SensorReports:
        """All of it as arrays."""
        integer, real = np.zeros(0, dtype=np.int64), np.zeros((0, 2))
        return SensorReports(
            np.concatenate([integer, *self.step]),
            np.concatenate([integer, *self.agent]),
            np.concatenate([integer, *self.sensor]),
            np.concatenate([real, *self.position_m]),
            np.concatenate([np.zeros((0, 2, 2)), *self.covariance_m2]),
        )


class _Eyes:
    """The detection law of all sensors of one episode."""

    def __init__(self, kinds: list[SensorKind], factor: float, sea: Sea, line_of_sight: bool) -> None:
        self.range_m = np.array([kind.range_m for kind in kinds]) * factor
        self.scan_share = np.array([kind.scan_share for kind in kinds])
        self.range_sigma_m = np.array([kind.range_sigma_m for kind in kinds])
        self.bearing_sigma_rad = np.array([kind.bearing_sigma_rad for kind in kinds])
        self.needs_sight = np.array([kind.needs_sight for kind in kinds]) & line_of_sight
        self.land = sea.land

    def laws(self) -> tuple[SensorLaw, ...]:
        """What each sensor detects of a boat at cruising speed, a scan a step."""
        found = []
        for range_m, share, is_hidden in zip(self.range_m, self.scan_share, self.needs_sight, strict=True):
            distance_m = np.linspace(0.0, 2.5 * range_m, _NUM_POINTS)
            probability = np.round(share * swerling_probability(distance_m, range_m), 4)
            found.append(SensorLaw(distance_m, probability, bool(is_hidden), is_always=False))
        return tuple(found)

    def look(
        self, targets_m: Float64s, speed_mps: Float64s, sensors_m: Float64s, is_active: Bools, rng: np.random.Generator
    ) -> tuple[Int64s, Int64s, Float64s, Float64s]:
        """Agent [N], sensor [N], measured position [N, 2] and covariance [N, 2, 2] of one step's detections.

        targets_m [A, 2], speed_mps [A], sensors_m [S, 2], is_active [S]. A fast boat shows a wake: the range grows from 0.6
        to 1.3 times with its speed.
        """
        offset = targets_m[:, None] - sensors_m
        distance = np.hypot(offset[..., 0], offset[..., 1])
        signature = np.clip(0.6 + 0.4 * speed_mps / CRUISE_MPS, 0.6, 1.3)
        draw = rng.random(distance.shape)
        hit = is_active & (draw < self.scan_share * swerling_probability(distance, self.range_m * signature[:, None]))
        agent, sensor = np.nonzero(hit)
        if (self.needs_sight[sensor]).any():
            is_hidden = blocks_segment(self.land, sensors_m[sensor], targets_m[agent]) & self.needs_sight[sensor]
            agent, sensor = agent[~is_hidden], sensor[~is_hidden]
        covariance = measurement_covariance(offset[agent, sensor], self.range_sigma_m[sensor], self.bearing_sigma_rad[sensor])
        return agent, sensor, targets_m[agent] + draw_noise(covariance, rng), covariance


def simulate_patrol(config: PatrolConfig, rng: np.random.Generator) -> Episode:
    """One episode; the same configuration and generator state give the same episode."""
    terrain = random_archipelago(rng, config.side_m)
    masts = _mast_sites(terrain, config.num_masts, rng)
    sea = Sea.of(terrain, masts, config.step_s)
    time_s: Float64s = config.step_s * np.arange(round(config.duration_s / config.step_s) + 1, dtype=np.float64)
    smugglers = [launch(sea, rng) for _ in range(config.num_agents)]
    boats = [commission(sea, index, config.num_boats, rng) for index in range(config.num_boats)]
    sweeps = [sweep_track(rng, time_s, config.side_m, Sortie()) for _ in range(config.num_aircraft)]
    kinds = [BOAT] * len(boats) + [AIRCRAFT] * len(sweeps) + [MAST] * len(masts)
    eyes = _Eyes(kinds, config.range_factor, sea, config.line_of_sight)

    truth = np.zeros((len(smugglers), len(time_s), 2))
    mode = np.zeros(truth.shape[:2], dtype=np.int8)
    sensors = np.zeros((len(kinds), len(time_s), 2))
    is_active = np.ones(sensors.shape[:2], dtype=bool)
    for row, (track, is_flying) in enumerate(sweeps, start=len(boats)):
        sensors[row], is_active[row] = track, is_flying
    sensors[len(boats) + len(sweeps) :] = masts[:, None]

    log = _Log()
    for step, now in enumerate(time_s):
        truth[:, step] = [smuggler.craft.position_m for smuggler in smugglers]
        mode[:, step] = [smuggler.mode for smuggler in smugglers]
        sensors[: len(boats), step] = np.array([boat.craft.position_m for boat in boats]).reshape(-1, 2)
        speed = np.array([smuggler.craft.speed_mps for smuggler in smugglers])
        agent, sensor, position, covariance = eyes.look(truth[:, step], speed, sensors[:, step], is_active[:, step], rng)
        if len(agent):
            log.step.append(np.full(len(agent), step))
            log.agent.append(agent)
            log.sensor.append(sensor)
            log.position_m.append(position)
            log.covariance_m2.append(covariance)
            alert(boats, position[0], sea, float(now))
        for smuggler in smugglers:
            steer_smuggler(smuggler, sensors[:, step], is_active[:, step], kinds, sea, float(now), config.step_s, rng)
        for boat in boats:
            steer_boat(boat, sea, float(now), config.step_s)
    bearings = None
    if config.listening.kind != "none":  # from a stream of their own: all else stays as it was
        listens = np.array([config.listening.kind in (kind.name, "both") and kind is not AIRCRAFT for kind in kinds])
        bearings = hear(config.listening, truth, sensors, listens, rng.spawn(1)[0])
    return Episode(
        world="patrol",
        time_s=time_s,
        agent_ids=tuple(f"smuggler_{index + 1}" for index in range(len(smugglers))),
        truth_m=truth,
        mode_names=MODE_NAMES,
        mode=mode,
        goals_m=tuple(np.array(smuggler.goals_m) for smuggler in smugglers),
        sensor_ids=_number([kind.name for kind in kinds]),
        sensors_m=sensors,
        is_active=is_active,
        detections=log.close(),
        terrain=terrain,
        laws=eyes.laws(),
        bearings=bearings,
    )


def _number(names: list[str]) -> tuple[str, ...]:
    """name_1, name_2, ... counted by name."""
    return tuple(f"{name}_{names[: index + 1].count(name)}" for index, name in enumerate(names))


def _mast_sites(terrain: Terrain, count: int, rng: np.random.Generator) -> Float64s:
    """Places [M, 2] just off the shore of the larger islands; the island behind a mast hides what is on its other side."""
    islands = terrain.polygons_m[: max(count, 5)]
    if not islands:
        return rng.uniform(-0.4, 0.4, (count, 2)) * terrain.side_m
    sites = []
    for index in rng.permutation(len(islands))[:count]:
        polygon = islands[index]
        vertex, centre = polygon[rng.integers(len(polygon))], polygon.mean(axis=0)
        sites.append(vertex + 60.0 * (vertex - centre) / np.hypot(*(vertex - centre)))
    return np.array(sites).reshape(-1, 2)
