"""The fugitive of the Prison Escape world: A* through the dark, and what it does when it notices that it is followed.

A policy without randomness (the only draw: another block to plan from where the own one is closed). Facts are those of the
original's `AStarAdversarialAvoid`, its peculiarities included, because recorded episodes are followed step by step: actions
are float32; a plan is a queue of moves, made for the place where it was planned, that goes on after a detour which did not
discard it; the mountain on the planning grid lies beside the real one.
"""

from dataclasses import dataclass, field
from functools import cache

import numpy as np
from numpy.typing import NDArray

from cadence.arrays import Bools, Float64s, Int64s
from cadence.worlds.block_route import BlockPlanner
from cadence.worlds.draws import Draws
from cadence.worlds.prison_map import KEEP_OUT, MOUNTAIN, SIDE, PrisonMap, prison_map

MAX_SPEED = 7.5
MODE_NAMES = ("run", "hide", "give up")
"""What the fugitive does: go for its hideout; leave a pursuer's sight; make for the known hideout."""

_RUN, _HIDE, _GIVE_UP = range(3)
_PRICE_OF_LIGHT = 1000.0
_TURN_OFF = 150.0
_MEMORY = 200
_HIDING_RANGE = 250
_NOWHERE_TO_HIDE = (1500, 1500)
_FROM_HELICOPTER, _FROM_PARTY = 1, 2
"""What it last ran from."""
_SLOWED_DOWN = 1
_STREAM_BLOCK = 31


def turn_from(centre: tuple[float, float], here: Float64s, heading: Float64s) -> Float64s:
    """The headings [N], turned to the nearer tangent around `centre` where they lead from `here` [N, 2] towards it.

    With the original's cases: each compares headings without wrapping them.
    """
    to_centre = np.arctan2(centre[1] - here[:, 1], centre[0] - here[:, 0])
    is_third = (to_centre > -np.pi) & (to_centre < -np.pi / 2)
    is_second = (to_centre > np.pi / 2) & (to_centre < np.pi)
    one = np.where(is_third, to_centre + np.pi / 2, to_centre - np.pi / 2)
    two = np.where(is_third, to_centre + 3 * np.pi / 2, np.where(is_second, to_centre - 3 * np.pi / 2, to_centre + np.pi / 2))
    between = (one < heading) & (heading < two)
    beyond = np.where(is_third, (heading < one) | (heading > two), (heading > one) | (heading < two))
    is_towards = np.where(is_third | is_second, beyond, between)
    nearer = np.where(_angle_between(heading, one) < _angle_between(heading, two), one, two)
    turned: Float64s = np.where(is_towards, nearer, heading)
    return turned


def _angle_between(one: Float64s, other: Float64s) -> Float64s:
    difference = one - other
    least: Float64s = np.minimum(np.abs(difference), np.minimum(np.abs(difference + 2 * np.pi), np.abs(difference - 2 * np.pi)))
    return least


def straight_out(centre: tuple[float, float], here: Float64s) -> Float64s:
    """Headings [N] from `centre` through `here` [N, 2]."""
    inwards = np.arctan2(centre[1] - here[:, 1], centre[0] - here[:, 0])
    outwards: Float64s = np.where(inwards < 0, inwards + np.pi, inwards - np.pi)
    return outwards


def stride(here: Float64s, speed: Float64s, heading: Float64s) -> Float64s:
    """Where a move [N] of float32 speed and heading leads: whole cells, kept on the map."""
    pace, turn = speed.astype(np.float32), heading.astype(np.float32)
    step = np.stack([np.cos(turn), np.sin(turn)], axis=-1) * pace[:, None]
    moved: Float64s = np.clip(np.rint(here + step), 0.0, SIDE - 1.0)
    return moved


def heading_to(here: Float64s, goal: Float64s) -> Float64s:
    """Headings [N] from `here` to `goal` [N, 2]."""
    angle: Float64s = np.arctan2(goal[:, 1] - here[:, 1], goal[:, 0] - here[:, 0])
    return angle


def distance_between(one: Float64s, other: Float64s) -> Float64s:
    """Distances [...] of points [..., 2]; exact for whole cells."""
    offset = one - other
    length: Float64s = np.sqrt((offset * offset).sum(axis=-1))
    return length


@dataclass(frozen=True, eq=False)
class Sight:
    """What B fugitives know at a step.

    step      number of the step
    here      [B, 2] own cells; speed [B] of the last move
    tracker   [B, M, 2] trackers, helicopters first; is_seen [B, M] which of them it sees
    """

    step: int
    here: Float64s
    speed: Float64s
    tracker: Float64s
    is_seen: Bools


@dataclass(eq=False)
class _Plans:
    """Queues of moves along way-points, unrolled while they are taken.

    point [B, W, 2] way-points; index, last [B] the next one and the final one; here [B, 2] where the plan believes to be
    """

    point: Float64s
    index: Int64s
    last: Int64s
    here: Float64s

    @classmethod
    def none(cls, count: int) -> "_Plans":
        """No plans."""
        integer = np.zeros(count, dtype=np.int64)
        return cls(np.zeros((count, 8, 2)), integer.copy(), integer - 1, np.zeros((count, 2)))

    def is_spent(self, rows: Int64s) -> Bools:
        """Whether nothing is left to do."""
        spent: Bools = self.index[rows] > self.last[rows]
        return spent

    def discard(self, rows: Int64s) -> None:
        """Forget the plans of these rows."""
        self.last[rows] = self.index[rows] - 1

    def put(self, row: int, here: Float64s, points: Float64s) -> None:
        """A new plan for one row."""
        if len(points) > self.point.shape[1]:
            more = len(points) - self.point.shape[1]
            self.point = np.pad(self.point, ((0, 0), (0, more), (0, 0)))
        self.point[row, : len(points)] = points
        self.index[row], self.last[row], self.here[row] = 0, len(points) - 1, here
        self._skip_reached(np.array([row]))

    def take(self, rows: Int64s) -> tuple[Float64s, Float64s]:
        """The next moves: speed, heading [N]."""
        goal, here = self.point[rows, self.index[rows]], self.here[rows]
        speed = np.minimum(distance_between(here, goal), MAX_SPEED)
        heading = heading_to(here, goal)
        self.here[rows] = stride(here, speed, heading)
        self._skip_reached(rows)
        return speed, heading

    def _skip_reached(self, rows: Int64s) -> None:
        while len(rows):
            there = (self.here[rows] == self.point[rows, self.index[rows]]).all(axis=1)
            rows = rows[there]
            self.index[rows] += 1
            rows = rows[~self.is_spent(rows)]


@dataclass(eq=False)
class Fugitives:
    """B fugitives in lockstep. `goal` [B, U, 2] are the hideouts they make for, `refuge` [B, 2] the known one.

    camera [B, C, 2] are the cameras they know. `act` gives their next moves; `mode` [B] then says what they are doing.
    """

    goal: Float64s
    refuge: Float64s
    camera: Float64s
    num_helicopters: int
    draws: Draws
    mode: NDArray[np.int8] = field(init=False)
    _plans: _Plans = field(init=False)

    def __post_init__(self) -> None:
        count = len(self.goal)
        self.mode = np.zeros(count, dtype=np.int8)
        self._plans = _Plans.none(count)
        self._aim = np.full(count, -1)
        self._fear = np.zeros(count, dtype=np.int8)
        self._note = np.zeros(count, dtype=np.int8)
        self._heading = np.zeros(count)
        self._was_tracked = np.zeros((count, _MEMORY), dtype=bool)
        self._ground: PrisonMap = prison_map()

    def act(self, rows: Int64s, sight: Sight) -> tuple[Float64s, Float64s]:
        """Speed and heading [N] of the episodes `rows` [N]; `sight` holds all episodes."""
        here, seen = sight.here[rows], sight.is_seen[rows]
        tracker_range = distance_between(sight.tracker[rows], here[:, None])
        helicopter, helicopter_range = _first(seen[:, : self.num_helicopters], tracker_range[:, : self.num_helicopters])
        party, party_range = _first(seen[:, self.num_helicopters :], tracker_range[:, self.num_helicopters :])
        reach = 12.0 * sight.speed[rows] + 5.0
        in_camera = (distance_between(self.camera[rows], here[:, None]) <= reach[:, None]).any(axis=1)
        self._was_tracked[rows, sight.step % _MEMORY] = helicopter | party | in_camera
        lately = self._was_tracked[rows[:, None], (sight.step - np.arange(10)) % _MEMORY].sum(axis=1)
        long = self._was_tracked[rows].sum(axis=1)

        is_caught = helicopter & party & in_camera
        is_lost = helicopter & party & ~is_caught & (long > 50)
        rest = ~is_caught & ~is_lost & (lately >= 7)
        from_helicopter, from_party = rest & helicopter, rest & ~helicopter & party
        in_forest = self._ground.is_dense[here[:, 0].astype(np.int64), here[:, 1].astype(np.int64)]
        is_far = (from_helicopter & (helicopter_range > 100)) | (from_party & (party_range > 50))
        self._note[rows[is_far]] = 0
        hides = from_helicopter & (helicopter_range <= np.where(in_forest, 50.0, 100.0))
        hides |= from_party & (party_range <= np.where(in_forest, 20.0, 50.0))
        plans = ~(is_caught | is_lost | hides)

        self.mode[rows] = np.where(plans, _RUN, np.where(hides, _HIDE, _GIVE_UP))
        self._plans.discard(rows[is_lost])
        speed, heading = np.full(len(rows), MAX_SPEED), np.zeros(len(rows))
        chosen = np.flatnonzero(plans)
        speed[chosen], heading[chosen] = self._run(rows[chosen], here[chosen], sight.step)
        chosen = np.flatnonzero(is_caught | is_lost)
        speed[chosen], heading[chosen] = self._give_up(rows[chosen], here[chosen])
        for is_from, hide in ((from_helicopter, self._hide_from_helicopter), (from_party, self._hide_from_party)):
            chosen = np.flatnonzero(hides & is_from)
            if len(chosen):
                part = rows[chosen]
                speed[chosen], heading[chosen] = hide(part, here[chosen], in_forest[chosen], long[chosen] > 180)
        return speed, heading

    def _run(self, rows: Int64s, here: Float64s, step: int) -> tuple[Float64s, Float64s]:
        """Along the plan; where none is left, along a new one to the nearest hideout."""
        fresh = np.flatnonzero(self._plans.is_spent(rows))
        self._aim[rows[fresh]] = distance_between(self.goal[rows[fresh]], here[fresh, None]).argmin(axis=1)
        for row, place in zip(rows[fresh].tolist(), here[fresh], strict=True):
            self._plans.put(row, place, self._way(row, place, step))
        return self._plans.take(rows)

    def _way(self, row: int, here: Float64s, step: int) -> Float64s:
        """Way-points [W, 2] from `here` to the hideout aimed at: corners of blocks, stretched to the map, then the hideout."""
        planner, goal = _planner(), self.goal[row, self._aim[row]]
        scale = SIDE / planner.side
        block, end = (here / scale).astype(np.int64), (goal / scale).astype(np.int64)
        start, attempt = block, 0
        while not planner.is_open[start[0] * planner.side + start[1]]:
            share = self.draws.point(np.array([row]), _STREAM_BLOCK, step, attempt)[0]
            start, attempt = block + (share * 7.0).astype(np.int64) - 3, attempt + 1
        way = planner.plan(int(start[0] * planner.side + start[1]), int(end[0] * planner.side + end[1]))
        return np.concatenate([np.floor(way[1:] * scale), goal[None]])

    def _give_up(self, rows: Int64s, here: Float64s) -> tuple[Float64s, Float64s]:
        """At full speed to the known hideout."""
        return _avoid(here, np.full(len(rows), MAX_SPEED), heading_to(here, self.refuge[rows]))

    def _turn_elsewhere(self, rows: Int64s, here: Float64s) -> tuple[Float64s, Float64s]:
        """Creep towards the nearest of the hideouts that it did not make for, and make for that one."""
        length = distance_between(self.goal[rows], here[:, None])
        length[np.arange(self.goal.shape[1]) == self._aim[rows, None]] = np.inf
        self._aim[rows] = length.argmin(axis=1)
        self._heading[rows] = heading_to(here, self.goal[rows, self._aim[rows]])
        self._note[rows] = _SLOWED_DOWN
        return _avoid(here, np.ones(len(rows)), self._heading[rows])

    def _seek_forest(self, rows: Int64s, here: Float64s, fear: int) -> None:
        """Begin to run: towards the nearest dense forest, and on in that direction."""
        self._fear[rows] = fear
        self._heading[rows] = heading_to(here, nearest_forest(self._ground.is_dense, here))

    def _hide_from_helicopter(
        self, rows: Int64s, here: Float64s, in_forest: Bools, is_hopeless: Bools
    ) -> tuple[Float64s, Float64s]:
        self._plans.discard(rows)
        has_begun = self._fear[rows] == _FROM_HELICOPTER
        begins, turns = ~has_begun, has_begun & in_forest & (self._note[rows] != _SLOWED_DOWN)
        self._seek_forest(rows[begins], here[begins], _FROM_HELICOPTER)
        speed, heading = _avoid(here, np.where(begins, 5.0, MAX_SPEED), self._heading[rows])
        speed[turns], heading[turns] = self._turn_elsewhere(rows[turns], here[turns])
        self._heading[rows[turns]] = heading[turns]
        ends = has_begun & ~turns & is_hopeless
        speed[ends], heading[ends] = self._give_up(rows[ends], here[ends])
        self.mode[rows[ends]] = _GIVE_UP
        return speed, heading

    def _hide_from_party(self, rows: Int64s, here: Float64s, in_forest: Bools, is_hopeless: Bools) -> tuple[Float64s, Float64s]:
        self._plans.discard(rows)
        is_almost_safe = in_forest & (self._fear[rows] == _FROM_HELICOPTER)
        turns = is_almost_safe & (self._note[rows] != _SLOWED_DOWN)
        begins = ~is_almost_safe & (self._fear[rows] != _FROM_PARTY)
        self._seek_forest(rows[begins], here[begins], _FROM_PARTY)
        speed, heading = _avoid(here, np.where(is_almost_safe, 2.0, MAX_SPEED), self._heading[rows])
        speed[turns], heading[turns] = self._turn_elsewhere(rows[turns], here[turns])
        speed[begins], heading[begins] = MAX_SPEED, self._heading[rows[begins]]
        return speed, heading


@cache
def _planner() -> BlockPlanner:
    return BlockPlanner(prison_map().planning, _PRICE_OF_LIGHT)


def _first(is_seen: Bools, length: Float64s) -> tuple[Bools, Float64s]:
    """Whether any tracker [N, K] is seen, and the distance [N] to the first of them that is."""
    if not is_seen.shape[1]:
        return np.zeros(len(is_seen), dtype=bool), np.full(len(is_seen), np.inf)
    any_seen: Bools = np.any(is_seen, axis=1)
    return any_seen, length[np.arange(len(length)), is_seen.argmax(axis=1)]


def _avoid(here: Float64s, speed: Float64s, heading: Float64s) -> tuple[Float64s, Float64s]:
    """Speed and heading [N] of moves that lead past the mountain: along its edge within 150 cells, straight out within 140."""
    heading = heading.astype(np.float32).astype(np.float64)
    length = distance_between(stride(here, speed, heading), np.array(MOUNTAIN))
    is_near = length <= _TURN_OFF
    turned = np.where(length <= KEEP_OUT, straight_out(MOUNTAIN, here), turn_from(MOUNTAIN, here, heading))
    # Headings travel as float32 in the original, too.
    turned = turned.astype(np.float32).astype(np.float64)
    return np.where(is_near, MAX_SPEED, speed), np.where(is_near, turned, heading)


@cache
def _hiding_offsets() -> Int64s:
    """Offsets [K, 2] of the cells that are searched for a hiding place, nearest first, of equals the last in reading order."""
    along = np.arange(-_HIDING_RANGE, _HIDING_RANGE)
    offset = np.stack(np.meshgrid(along, along, indexing="ij"), axis=-1).reshape(-1, 2)
    order = np.lexsort((-offset[:, 1], -offset[:, 0], (offset * offset).sum(axis=1)))
    return offset[order[1:]]


def nearest_forest(is_dense: Bools, here: Float64s) -> Float64s:
    """The nearest dense forest [N, 2] other than the own cell, at most 250 cells away on either axis."""
    offsets, place = _hiding_offsets(), here.astype(np.int64)
    found: Float64s = np.tile(np.array(_NOWHERE_TO_HIDE, dtype=np.float64), (len(here), 1))
    rows = np.arange(len(here))
    for begin, end in ((0, 400), (400, 8000), (8000, len(offsets))):
        cell = place[rows, None] + offsets[begin:end]
        inside = ((cell >= 0) & (cell < SIDE)).all(axis=-1)
        cell = np.clip(cell, 0, SIDE - 1)
        fits = inside & is_dense[cell[..., 0], cell[..., 1]]
        first, any_fits = fits.argmax(axis=1), fits.any(axis=1)
        found[rows[any_fits]] = cell[any_fits, first[any_fits]]
        rows = rows[~any_fits]
        if not len(rows):
            break
    return found
