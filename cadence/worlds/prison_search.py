"""The searching side of the Prison Escape world, step by step as in the original simulator.

The policy is that of `cadence.worlds.pursuit`, whose docstring describes it; here also everything that the original does
beside the point is kept, because detections follow from where the trackers are: slopes instead of angles (a target that goes
due west is cut off at a random height), the side taken from the x component alone, destinations near the mountain drawn anew
when they are approached, a spiral that is begun by a journey to somewhere else. Units are cells and steps.
"""

from dataclasses import dataclass, field

import numpy as np

from cadence.arrays import Bools, Float64s, Int64s
from cadence.worlds.draws import Draws
from cadence.worlds.prison_fugitive import distance_between, straight_out, turn_from
from cadence.worlds.prison_map import KEEP_OUT, MOUNTAIN, SIDE, prison_map
from cadence.worlds.pursuit import ARRIVED, CHASE_SPEED, MEET_SPEED, SPIRAL_SPEED, MoverKind, is_working

_TURN_OFF, _NO_DESTINATION, _SPIRAL_AT_ONCE = 160.0, 161.0, 170.0
_SCATTER = 200
_SPIRAL_UNIT, _SPIRAL_SIDES = 44, 8
_CHASE_GAP, _MEET_GAP = 30.0, 200.0
_LENGTH = 16
_GO, _SPIRAL, _LINE = range(3)
_STREAM_START, _STREAM_RANDOM, _STREAM_NEAR, _STREAM_APPROACH = 21, 22, 23, 24


def _spiral() -> Int64s:
    """Corners [14, 2] of the square spiral relative to its middle."""
    sides = np.repeat(np.arange(1, _SPIRAL_SIDES), 2)
    turns = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])[np.arange(len(sides)) % 4]
    corners: Int64s = np.cumsum(turns * sides[:, None] * _SPIRAL_UNIT, axis=0)
    return corners


def leaves_map(point: Float64s | Int64s) -> Bools:
    """Whether points [..., 2] lie off the map or on its outermost cells."""
    outside: Bools = np.any((point < 1) | (point >= SIDE - 1), axis=-1)
    return outside


def _is_near_mountain(point: Float64s, radius: float) -> Bools:
    near: Bools = distance_between(point, np.array(MOUNTAIN)) <= radius
    return near


def move(here: Float64s, direction: Float64s, speed: Float64s) -> Float64s:
    """One step [N, 2] of movers at cells `here`, turned along or away from the mountain, kept on the map."""
    moved = np.rint(here + direction * speed[:, None])
    near = np.flatnonzero(_is_near_mountain(moved, _TURN_OFF))
    if len(near):
        length, start = distance_between(moved[near], np.array(MOUNTAIN)), here[near]
        along = turn_from(MOUNTAIN, start, np.arctan2(direction[near, 1], direction[near, 0]))
        heading = np.where(length <= KEEP_OUT, straight_out(MOUNTAIN, start), along)
        turned = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        moved[near] = start + np.rint(turned * speed[near, None])
    return np.clip(moved, 0.0, SIDE - 1.0)


@dataclass(eq=False)
class Search:
    """The trackers of B episodes: N = B * M movers with plans of up to 16 legs each.

    `position` [B, M, 2] holds where they are. At every step call `notice` with what was detected, then `advance`, which
    brings them to the next step. Everything drawn depends on (seed, episode, step, mover) only.
    """

    kinds: tuple[MoverKind, ...]
    draws: Draws
    _leg: Int64s = field(init=False)

    def __post_init__(self) -> None:
        num_episodes, num_movers = len(self.draws), len(self.kinds)
        count = num_episodes * num_movers
        self._row = np.repeat(np.arange(num_episodes), num_movers)
        self._mover = np.tile(np.arange(num_movers), num_episodes)
        self._top = np.tile([kind.speed for kind in self.kinds], num_episodes)
        self._leg = np.zeros((count, _LENGTH), dtype=np.int64)
        self._place = np.zeros((count, _LENGTH, 2))
        self._head = np.zeros(count, dtype=np.int64)
        self._end = np.zeros(count, dtype=np.int64)
        self._fast = np.zeros(count)
        self._slow = np.zeros(count)
        self._seen = np.zeros((num_episodes, 2))
        self._seen_step = np.full(num_episodes, -1)
        everybody = np.arange(count)
        self._here = np.floor(self._share(everybody, 0, _STREAM_START, 0) * SIDE)
        self._go_anywhere(everybody, 0)

    @property
    def position(self) -> Float64s:
        """Where the movers are [B, M, 2]; a view that `advance` changes."""
        return self._here.reshape(len(self.draws), len(self.kinds), 2)

    def notice(self, step: int, is_detected: Bools, target: Float64s) -> None:
        """Tell the movers what was detected at `step`: in which episodes [B], and the target's position there [B, 2]."""
        if not is_detected.any():
            return
        # Positions travel as shares of the map's side: their last bits decide where slopes are steep.
        report = target / float(SIDE) * float(SIDE)
        is_first = is_detected & (self._seen_step < 0)
        movers = self._listening(is_first, step)
        self._go_near(movers, report[self._row[movers]], step)
        movers = self._listening(is_detected & ~is_first, step)
        self._intercept(movers, step, report)
        self._seen[is_detected] = report[is_detected]
        self._seen_step[is_detected] = step

    def advance(self, step: int, is_running: Bools) -> None:
        """Move from `step` to `step` + 1 in the episodes [B] that go on."""
        movers = self._listening(is_running, step)
        direction, speed = np.zeros((len(self._row), 2)), np.zeros(len(self._row))
        direction[movers], speed[movers] = self._act(movers, step)
        moving = self._listening(is_running, step + 1)
        self._here[moving] = move(self._here[moving], direction[moving], speed[moving])

    def _listening(self, episodes: Bools, step: int) -> Int64s:
        """Indices of the movers of these episodes that work at a step."""
        works = np.array([is_working(kind, step) for kind in self.kinds], dtype=bool)
        return np.flatnonzero((episodes[:, None] & works).ravel())

    def _act(self, movers: Int64s, step: int) -> tuple[Float64s, Float64s]:
        """Directions [n, 2] and speeds [n] that the plans ask for; finished legs are struck off."""
        head, here, top = self._head[movers], self._here[movers], self._top[movers]
        leg, place = self._leg[movers, head], self._place[movers, head].copy()
        is_line = leg == _LINE
        goal = self._approachable(movers[~is_line], step)
        direction = place.copy()
        way = goal - here[~is_line]
        length = np.sqrt((way * way).sum(axis=-1))
        direction[~is_line] = way / np.where(length > 0, length, 1.0)[:, None]
        is_fast = self._fast[movers] > 0
        remaining = distance_between(here, place)
        speed = np.minimum(remaining, np.where(leg == _SPIRAL, SPIRAL_SPEED, top))
        speed = np.where(is_line, np.where(is_fast, top, self._slow[movers]), speed)
        self._fast[movers[is_line & is_fast]] -= 1.0
        inside = ((here > top[:, None]) & (here < SIDE - top[:, None])).all(axis=-1)
        done = np.where(is_line, ~inside, remaining <= ARRIVED)
        self._head[movers[done]] += 1
        idle = done & (self._head[movers] == self._end[movers])
        self._go_anywhere(movers[idle & (leg != _GO)], step)
        self._plan_spiral(movers[idle & (leg == _GO)], step)
        return direction, np.minimum(speed, top)

    def _approachable(self, movers: Int64s, step: int) -> Float64s:
        """Destinations [n, 2] of the legs in hand as whole cells; those near the mountain are drawn anew, for good."""
        head = self._head[movers]
        goal = np.trunc(self._place[movers, head])
        wrong, attempt = np.flatnonzero(_is_near_mountain(goal, _NO_DESTINATION)), 0
        changed = wrong
        while len(wrong):
            goal[wrong] = self._near(movers[wrong], goal[wrong], step, _STREAM_APPROACH, attempt)
            wrong, attempt = wrong[_is_near_mountain(goal[wrong], _NO_DESTINATION)], attempt + 1
        self._place[movers[changed], head[changed]] = goal[changed]
        self._leg[movers[changed], head[changed]] = _GO
        return goal

    def _go_near(self, movers: Int64s, place: Float64s, step: int) -> None:
        """Plan to go to places [n, 2], or to others within 200 cells of those that are not allowed."""
        goal = place.copy()
        wrong, attempt = np.arange(len(movers)), 0
        while True:
            wrong = wrong[leaves_map(goal[wrong]) | _is_near_mountain(goal[wrong], _NO_DESTINATION)]
            if not len(wrong):
                break
            goal[wrong] = self._near(movers[wrong], place[wrong], step, _STREAM_NEAR, attempt)
            attempt += 1
        self._begin(movers, goal)

    def _go_anywhere(self, movers: Int64s, step: int) -> None:
        """Plan to go to a random place off the mountain."""
        is_mountain = prison_map().is_mountain
        place, wrong, attempt = np.zeros((len(movers), 2)), np.arange(len(movers)), 0
        while len(wrong):
            place[wrong] = np.floor(self._share(movers[wrong], step, _STREAM_RANDOM, attempt) * SIDE)
            cell = place[wrong].astype(np.int64)
            wrong, attempt = wrong[is_mountain[cell[:, 0], cell[:, 1]]], attempt + 1
        self._go_near(movers, place, step)

    def _begin(self, movers: Int64s, place: Float64s) -> None:
        """A new plan of one leg, to places [n, 2]."""
        self._head[movers], self._end[movers] = 0, 1
        self._leg[movers, 0], self._place[movers, 0] = _GO, place

    def _plan_spiral(self, movers: Int64s, step: int) -> None:
        """Plan a spiral around here; away from the mountain a journey to a random place comes before it."""
        if not len(movers):
            return
        here = self._here[movers]
        at_once = _is_near_mountain(here, _SPIRAL_AT_ONCE)
        self._go_anywhere(movers[~at_once], step)
        self._head[movers[at_once]], self._end[movers[at_once]] = 0, 0
        corner = here[:, None] + _spiral()
        count = np.cumprod(~leaves_map(corner), axis=1).sum(axis=1)
        first = self._end[movers]
        for index in range(corner.shape[1]):
            some = index < count
            slot = first[some] + index
            self._leg[movers[some], slot], self._place[movers[some], slot] = _SPIRAL, corner[some, index]
        self._end[movers] = first + count
        self._go_anywhere(movers[self._end[movers] == 0], step)

    def _intercept(self, movers: Int64s, step: int, report: Float64s) -> None:
        """Plan to cut off a target that was seen at `report` [B, 2] at `step`, with the speed and heading it had since then."""
        if not len(movers):
            return
        row, here, top = self._row[movers], self._here[movers], self._top[movers]
        target, way = report[row], report[row] - self._seen[row]
        pace = np.sqrt((way * way).sum(axis=-1)) / (step - self._seen_step[row])
        heading = np.arctan2(way[:, 1], way[:, 0])
        foot = _foot_of_perpendicular(here, target, heading)
        to_target, to_foot, along = (distance_between(*pair) for pair in ((here, target), (here, foot), (target, foot)))
        is_there = to_target < top
        is_ahead = ~is_there & ((foot[:, 0] - target[:, 0]) * np.cos(heading) > 0)
        is_off = is_ahead & leaves_map(foot)
        crosses = is_ahead & ~is_off
        with np.errstate(divide="ignore", invalid="ignore"):
            meets = crosses & ~(along / pace < to_foot / top)
            gap = np.where(meets, along - pace * (to_foot / top) - _MEET_GAP, pace * (to_foot / top) - along - _CHASE_GAP)
            gap = np.where(crosses, gap, pace * to_target / top - _CHASE_GAP)
            fast = gap / np.where(meets, top + pace, top - pace)
        self._begin(movers, np.where(is_off[:, None], np.clip(foot, 0.0, SIDE - 1.0), target))
        self._go_near(movers[crosses], foot[crosses], step)
        lines = ~is_there & ~is_off
        onward = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        part = movers[lines]
        self._leg[part, 1] = _LINE
        self._place[part, 1] = np.where(meets[:, None], -onward, onward)[lines]
        self._end[part] = 2
        self._fast[part] = np.where(fast > 1.0, fast - 1.0, -1.0)[lines]
        self._slow[part] = np.where(meets, MEET_SPEED, CHASE_SPEED)[lines]
        self._head[movers[crosses & (to_foot == 0)]] = 1

    def _near(self, movers: Int64s, middle: Float64s, step: int, stream: int, attempt: int) -> Float64s:
        """A random cell [n, 2] within 200 cells of `middle` [n, 2] on either axis."""
        share = self._share(movers, step, stream, attempt)
        cell: Float64s = np.trunc(middle - _SCATTER) + np.floor(share * (2 * _SCATTER))
        return cell

    def _share(self, movers: Int64s, step: int, stream: int, attempt: int) -> Float64s:
        index = self._mover[movers] + len(self.kinds) * attempt
        return self.draws.point(self._row[movers], stream, step, index)


def _foot_of_perpendicular(here: Float64s, target: Float64s, heading: Float64s) -> Float64s:
    """Cells [N, 2] on the line through `target` along `heading` [N] that are nearest to `here`, by the slopes of both lines.

    Due west the slopes are as good as infinite and the height is what is left of their last bits.
    """
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        slope = np.tan(heading)
        across = -1.0 / slope
        own, other = here[:, 1] - across * here[:, 0], target[:, 1] - slope * target[:, 0]
        x = (own - other) / (slope - across)
        y = across * x + own
        # As integers: what does not fit becomes the least of them.
        foot = np.rint(np.stack([x, y], axis=-1)).astype(np.int64).astype(np.float64)
    is_level = np.abs(heading) < 1e-3
    return np.where(is_level[:, None], np.stack([here[:, 0], target[:, 1]], axis=-1), foot)
