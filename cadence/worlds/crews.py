"""Who sails in the world "patrol", and how they behave: smugglers that evade, boats that patrol and go after sightings."""

import math
from dataclasses import dataclass

import numpy as np
import shapely
from scipy import sparse

from cadence.arrays import Bools, Float64s
from cadence.worlds.route import Agility, Craft, RouteField, RouteGrid, keep_out_for, smooth_path
from cadence.worlds.sensors import SensorKind, square_search
from cadence.worlds.terrain import Clearance, Terrain, blocks_segment, smooth_field

BOAT = SensorKind("boat", 2300.0, 0.45, 20.0, math.radians(0.8), needs_sight=True)
AIRCRAFT = SensorKind("aircraft", 3400.0, 0.6, 40.0, math.radians(0.7), needs_sight=False)
MAST = SensorKind("mast", 3200.0, 0.5, 15.0, math.radians(0.5), needs_sight=True)

SMUGGLER_AGILITY = Agility(max_speed_mps=16.0, max_accel_mps2=0.25, max_turn_degps=4.0)
BOAT_AGILITY = Agility(max_speed_mps=12.0, max_accel_mps2=0.2, max_turn_degps=3.0)
CRUISE_MPS = 9.0

MODE_NAMES = ("transit", "sprint", "hide", "creep", "loiter")
TRANSIT, SPRINT, HIDE, CREEP, LOITER = range(5)


@dataclass(frozen=True, eq=False)
class Sea:
    """The map of one episode, prepared for planning: what every craft knows."""

    terrain: Terrain
    land: shapely.STRtree
    clearance: Clearance
    grid: RouteGrid
    keep_out_m: float
    base_cost: Float64s
    open_graph: sparse.csr_matrix
    coves_m: Float64s

    @classmethod
    def of(cls, terrain: Terrain, masts_m: Float64s, step_s: float) -> "Sea":
        """Prepare a terrain; smugglers shun the masts [M, 2] and open edges, and know where the coves are."""
        clearance = Clearance.of(terrain, 100.0)
        keep_out = keep_out_for(clearance, SMUGGLER_AGILITY.max_speed_mps, step_s)
        grid = RouteGrid.of(clearance, 250.0, keep_out + 150.0)
        centres = grid.centres_m
        cost = np.ones(grid.is_free.shape)
        for mast in masts_m:
            cost += 2.0 * np.exp(-0.5 * (np.hypot(*(centres - mast).T).T / 2500.0) ** 2)
        shore = clearance.at_points(centres)
        edge = terrain.side_m / 2 - np.abs(centres).max(axis=-1)
        coves = grid.is_free & (shore < keep_out + 500.0) & (edge > 1500.0)
        if not coves.any():
            coves = grid.is_free
        return cls(terrain, terrain.land(), clearance, grid, keep_out, cost, grid.graph(np.ones_like(cost)), centres[coves])

    def route(self, fields: RouteField, position_m: Float64s) -> Float64s:
        """The smoothed way [P, 2] to a field's goal."""
        return smooth_path(fields.path_from(position_m), self.clearance, self.keep_out_m + 60.0)


@dataclass
class Smuggler:
    """One target: its craft, what it is doing, and until when."""

    craft: Craft
    cruise_mps: float
    goals_m: list[Float64s]
    fields: RouteField
    mode: int = TRANSIT
    until_s: float = 0.0
    calm_from_s: float = 0.0
    is_via: bool = False
    pace: float = 0.0
    drift_rad: float = 0.0


@dataclass
class Boat:
    """One patrol boat: a ring of waypoints, and what it is after."""

    craft: Craft
    ring: list[RouteField]
    leg: int = 0
    chase_until_s: float = -1.0
    rest_until_s: float = 0.0
    planned_s: float = -1e9
    is_squaring: bool = False


def launch(sea: Sea, rng: np.random.Generator) -> Smuggler:
    """A smuggler in a random cove, with its first leg planned."""
    start = sea.coves_m[rng.integers(len(sea.coves_m))]
    craft = Craft(SMUGGLER_AGILITY, sea.clearance, sea.keep_out_m, float(start[0]), float(start[1]), 0.0)
    smuggler = Smuggler(craft, CRUISE_MPS, [], RouteField.to(sea.grid, sea.open_graph, start))
    _next_leg(smuggler, sea, rng)
    ahead = craft.route_m[min(3, len(craft.route_m) - 1)] - start
    craft.heading_rad = math.atan2(ahead[1], ahead[0])
    craft.speed_mps = 0.5 * smuggler.cruise_mps
    return smuggler


def _next_leg(smuggler: Smuggler, sea: Sea, rng: np.random.Generator) -> None:
    """Choose the next goal, far away, and a way to it that this leg's mood finds cheap; every other leg has a via point."""
    here = smuggler.craft.position_m
    smuggler.is_via = not smuggler.is_via and rng.random() < 0.4
    reach = np.array([0.25, 0.5] if smuggler.is_via else [0.45, 1.2]) * sea.terrain.side_m
    distance = np.hypot(*(sea.coves_m - here).T)
    choice = np.flatnonzero((distance > reach[0]) & (distance < reach[1]))
    goal = sea.coves_m[rng.choice(choice)] if len(choice) else sea.coves_m[np.argmax(distance)]
    mood = np.exp(2.2 * smooth_field(rng, len(sea.grid.is_free), 16.0, octaves=2))
    smuggler.goals_m.append(goal)
    smuggler.fields = RouteField.to(sea.grid, sea.grid.graph(sea.base_cost * mood), goal)
    smuggler.cruise_mps = rng.uniform(6.5, 11.5)
    _resume(smuggler, sea)


def _resume(smuggler: Smuggler, sea: Sea) -> None:
    """Go on to the present goal from wherever the smuggler is."""
    smuggler.mode = TRANSIT
    smuggler.craft.take(sea.route(smuggler.fields, smuggler.craft.position_m))


def steer_smuggler(
    smuggler: Smuggler,
    sensors_m: Float64s,
    is_active: Bools,
    kinds: list[SensorKind],
    sea: Sea,
    now_s: float,
    step_s: float,
    rng: np.random.Generator,
) -> None:
    """Decide and move one smuggler for one step."""
    craft = smuggler.craft
    if smuggler.mode != TRANSIT and now_s >= smuggler.until_s:
        if smuggler.mode == LOITER:
            _next_leg(smuggler, sea, rng)
        else:
            _resume(smuggler, sea)
            smuggler.calm_from_s = now_s + rng.uniform(300.0, 900.0)
    if smuggler.mode in (TRANSIT, SPRINT) and craft.has_arrived:
        if smuggler.is_via:
            _next_leg(smuggler, sea, rng)
        else:
            smuggler.mode, smuggler.until_s = LOITER, now_s + rng.uniform(150.0, 600.0)
    if smuggler.mode == TRANSIT and now_s >= smuggler.calm_from_s:
        offset = sensors_m - craft.position_m
        distance = np.where(is_active, np.hypot(offset[:, 0], offset[:, 1]), np.inf)
        nearest = int(np.argmin(distance))
        if kinds[nearest] is not MAST and distance[nearest] < 4500.0 and rng.random() < 0.02 * step_s:
            _evade(smuggler, sensors_m[nearest], kinds[nearest], sea, now_s, rng)
    decay = math.exp(-step_s / 240.0)
    scatter = math.sqrt(1.0 - decay * decay)
    smuggler.pace = decay * smuggler.pace + 0.15 * scatter * rng.standard_normal()
    smuggler.drift_rad = decay * smuggler.drift_rad + 0.12 * scatter * rng.standard_normal()
    speed = {
        TRANSIT: smuggler.cruise_mps,
        SPRINT: 15.0,
        HIDE: 1.0 if craft.has_arrived else 11.0,
        CREEP: 2.0,
        LOITER: 1.2,
    }[smuggler.mode]
    wander = 6.0 * smuggler.drift_rad if craft.has_arrived else smuggler.drift_rad
    craft.follow(speed * (1.0 + smuggler.pace), step_s, wander)


def _evade(smuggler: Smuggler, sensor_m: Float64s, kind: SensorKind, sea: Sea, now_s: float, rng: np.random.Generator) -> None:
    """React to a sensor that came near: hide behind land, creep, run by another way, or take no notice for a while."""
    choice = rng.random()
    smuggler.calm_from_s = now_s + rng.uniform(200.0, 600.0)
    if choice < 0.45:
        shelter = _shelter(smuggler.craft.position_m, sensor_m, sea, rng)
        if shelter is not None:
            smuggler.mode, smuggler.until_s = HIDE, now_s + rng.uniform(400.0, 1000.0)
            fields = RouteField.to(sea.grid, sea.open_graph, shelter)
            smuggler.craft.take(sea.route(fields, smuggler.craft.position_m))
            return
    if kind is AIRCRAFT and choice < 0.75:
        smuggler.mode, smuggler.until_s = CREEP, now_s + rng.uniform(120.0, 300.0)
    elif kind is BOAT:
        smuggler.mode, smuggler.until_s = SPRINT, now_s + rng.uniform(240.0, 600.0)
        threat = 6.0 * np.exp(-0.5 * (np.hypot(*(sea.grid.centres_m - sensor_m).T).T / 2500.0) ** 2)
        fields = RouteField.to(sea.grid, sea.grid.graph(sea.base_cost + threat), smuggler.fields.goal_m)
        smuggler.craft.take(sea.route(fields, smuggler.craft.position_m))


def _shelter(position_m: Float64s, sensor_m: Float64s, sea: Sea, rng: np.random.Generator) -> Float64s | None:
    """The nearest of some coves within 4 km that land hides from the sensor; None where there is none."""
    distance = np.hypot(*(sea.coves_m - position_m).T)
    near = np.flatnonzero(distance < 4000.0)
    if len(near) == 0:
        return None
    some = rng.choice(near, min(len(near), 40), replace=False)
    hidden = some[blocks_segment(sea.land, sensor_m[None], sea.coves_m[some])]
    place: Float64s | None = sea.coves_m[hidden[np.argmin(distance[hidden])]] if len(hidden) else None
    return place


def commission(sea: Sea, index: int, count: int, rng: np.random.Generator) -> Boat:
    """A patrol boat on a ring of four waypoints in its part of the map, somewhere along it."""
    middle = 2 * np.pi * (index + rng.uniform(0.0, 1.0)) / count
    centre = 0.2 * sea.terrain.side_m * np.array([np.cos(middle), np.sin(middle)])
    bearings = rng.uniform(0.0, 2 * np.pi) + np.array([0.0, 0.5, 1.0, 1.5]) * np.pi * (1.0 if rng.random() < 0.5 else -1.0)
    radius = rng.uniform(0.12, 0.3, 4) * sea.terrain.side_m
    corners = centre + radius[:, None] * np.stack([np.cos(bearings), np.sin(bearings)], axis=-1)
    ring = [RouteField.to(sea.grid, sea.open_graph, corner) for corner in corners]
    start = ring[-1].goal_m
    craft = Craft(BOAT_AGILITY, sea.clearance, sea.keep_out_m, float(start[0]), float(start[1]), float(bearings[0]), 6.0)
    craft.take(sea.route(ring[0], start))
    return Boat(craft, ring)


def alert(boats: list[Boat], seen_m: Float64s, sea: Sea, now_s: float) -> None:
    """Send the nearest boat that is within 7 km and rested to where something was seen, for seven minutes at most."""
    ready = [boat for boat in boats if now_s < boat.chase_until_s or now_s >= boat.rest_until_s]
    if not ready:
        return
    distances = [float(np.hypot(*(boat.craft.position_m - seen_m))) for boat in ready]
    boat = ready[int(np.argmin(distances))]
    if min(distances) > 7000.0 or now_s < boat.planned_s + 120.0:
        return
    if boat.chase_until_s < now_s:
        boat.chase_until_s = now_s + 420.0
    boat.planned_s, boat.is_squaring = now_s, False
    boat.craft.take(sea.route(RouteField.to(sea.grid, sea.open_graph, seen_m), boat.craft.position_m))


def steer_boat(boat: Boat, sea: Sea, now_s: float, step_s: float) -> None:
    """Move one boat: along its ring, to what was seen, or in an expanding square around where it was seen last."""
    is_chasing = now_s < boat.chase_until_s
    if not is_chasing and boat.chase_until_s > 0.0:
        boat.chase_until_s, boat.rest_until_s, boat.is_squaring = -1.0, now_s + 1500.0, False
        boat.craft.take(sea.route(boat.ring[boat.leg], boat.craft.position_m))
    elif is_chasing and boat.craft.has_arrived and not boat.is_squaring:
        boat.is_squaring = True
        boat.craft.take(square_search(boat.craft.position_m, 1200.0))
    elif boat.craft.has_arrived and not is_chasing:
        boat.leg = (boat.leg + 1) % len(boat.ring)
        boat.craft.take(sea.route(boat.ring[boat.leg], boat.craft.position_m))
    boat.craft.follow(12.0 if is_chasing and not boat.is_squaring else 7.5, step_s)
