"""How searchers move at sea, and what kinds of searchers the paper's two worlds have.

The policy is that of the authors' simulators (BlueHeuristic and MovingObject; read for facts, written anew for batches).
Every mover holds a plan and follows it until the next detection:

* at first it goes to a random point;
* the first detection sends everybody to where the target was;
* every later one gives the target's speed and heading from the last two detections, and each mover plans to cut its way off:
  it goes to the foot of the perpendicular from itself to the target's line, and from there along the line, towards the
  target where it gets there first, after it where the target does; a mover that is behind goes to where the target was and
  on after it; one whose foot is off the map goes to the point of the map next to it; one that could be there in a step goes;
* along the line it is fast until the target should be near (30 units behind, 200 ahead), then slow (22 behind, 8 ahead);
* after a point without a line it runs a square spiral around it, then goes to a random point, and so on.

Aircraft work in cycles: 200 steps in the air, 40 at rest, where they keep their plan, hear no command, and still see.

Decided here, where the original does something that cannot be meant: the side on which a mover is, is taken from the whole
direction and not from its x component, which says nothing of a target that goes north; a line that runs into land ends there,
as it does at the map's edge, and a spiral breaks off at land (in the original a mover sticks there until the next detection);
a destination that is not allowed is drawn anew around it.
`cadence.worlds.prison_search` is the same policy on land, with its rounding to cells and its mountain.

Units are the world's and steps.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from cadence.arrays import Bools, Float64s, Int64s
from cadence.worlds.draws import Draws

STEPS_ON, STEPS_OFF = 200, 40
ARRIVED = 10.0
"""A mover this near to a point has reached it."""

SPIRAL_SPEED, CHASE_SPEED, MEET_SPEED = 30.0, 22.0, 8.0
_CHASE_GAP, _MEET_GAP = 30.0, 200.0
_SPIRAL_UNIT = 44.0
_STREAM_START, _STREAM_RANDOM, _STREAM_NEAR = 1, 2, 3
_SCATTER = 200.0

_GO, _SPIRAL, _LINE, _NOTHING = range(4)


def _spiral_offsets() -> Float64s:
    """Corners [14, 2] of the square spiral relative to its middle: sides of 1, 1, 2, 2 ... 7, 7 units."""
    sides = np.repeat(np.arange(1, 8), 2)
    turns = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])[np.arange(14) % 4]
    offsets: Float64s = np.cumsum(turns * sides[:, None] * _SPIRAL_UNIT, axis=0)
    return offsets


_OFFSETS = _spiral_offsets()


@dataclass(frozen=True)
class MoverKind:
    """A kind of searcher: its name, top speed a step, sensor factor k, and whether it works in cycles."""

    name: str
    speed: float
    sensitivity: float
    is_cyclic: bool = False


PARTY = MoverKind("party", 6.5, 0.75)
HELICOPTER = MoverKind("helicopter", 127.0, 0.5, is_cyclic=True)
VESSEL = MoverKind("vessel", 6.5, 0.75)
AIRPLANE = MoverKind("airplane", 127.0, 2.0, is_cyclic=True)


class Ground(Protocol):
    """What a world tells its searchers; all points are [N, 2]."""

    @property
    def size(self) -> Float64s:
        """Width and height."""
        ...

    def is_outside(self, point: Float64s) -> Bools:
        """Where plans may not lead because it is off the map."""
        ...

    def is_closed(self, point: Float64s) -> Bools:
        """Where plans may not lead because of an obstacle."""
        ...

    def ends_spiral(self, point: Float64s) -> Bools:
        """Corners at which a spiral breaks off."""
        ...

    def ends_line(self, point: Float64s, ahead: Float64s, speed: Float64s) -> Bools:
        """Where a mover of top `speed` [N] on a line, about to go from `point` to `ahead`, has come to its end."""
        ...

    def settle(self, point: Float64s, heading: Float64s, otherwise: Float64s) -> Float64s:
        """A foot of the perpendicular, moved along the heading to where it is allowed."""
        ...

    def aim(self, position: Float64s, goal: Float64s) -> Float64s:
        """The point to make for now on the way to the goal."""
        ...

    def move(self, position: Float64s, direction: Float64s, speed: Float64s) -> Float64s:
        """Where a mover gets in one step."""
        ...


def is_working(kind: MoverKind, step: int) -> bool:
    """Whether movers of this kind are on the move at a step."""
    return not kind.is_cyclic or step % (STEPS_ON + STEPS_OFF) < STEPS_ON


class Pursuit:
    """The movers of a batch of episodes: their positions and plans, as flat arrays of N = B * M movers.

    `position` [B, M, 2] holds where they are. At every step call `notice` with what was detected at the step before, then
    `advance`. Everything drawn depends on (seed, episode, step, mover) only.
    """

    def __init__(self, ground: Ground, kinds: Sequence[MoverKind], draws: Draws) -> None:
        num_episodes, num_movers = len(draws), len(kinds)
        count = num_episodes * num_movers
        self.kinds = tuple(kinds)
        self._ground, self._draws = ground, draws
        self._shape = (num_episodes, num_movers)
        self._row = np.repeat(np.arange(num_episodes), num_movers)
        self._mover = np.tile(np.arange(num_movers), num_episodes)
        self._speed = np.tile([kind.speed for kind in kinds], num_episodes)
        self._leg = np.full(count, _GO, dtype=np.int8)
        self._after = np.full(count, _NOTHING, dtype=np.int8)
        self._goal = np.zeros((count, 2))
        self._middle = np.zeros((count, 2))
        self._corner = np.zeros(count, dtype=np.int64)
        self._num_corners = np.zeros(count, dtype=np.int64)
        self._heading = np.zeros((count, 2))
        self._fast_steps = np.zeros(count)
        self._slow_speed = np.zeros(count)
        self._seen = np.full((num_episodes, 2), np.nan)
        self._seen_step = np.full(num_episodes, -1)
        everybody = np.arange(count)
        self._position = self._open_point(everybody, 0, _STREAM_START)
        self._go_random(everybody, 0)

    @property
    def position(self) -> Float64s:
        """Where the movers are [B, M, 2]; a view that `advance` changes."""
        return self._position.reshape(*self._shape, 2)

    def notice(self, step: int, is_detected: Bools, target: Float64s) -> None:
        """Tell the movers what was detected at `step`: in which episodes [B], and the target's position there [B, 2]."""
        if not is_detected.any():
            return
        is_first = is_detected & (self._seen_step < 0)
        commands = self._listening(is_detected & ~is_first, step)
        if len(commands):
            row = self._row[commands]
            way = target[row] - self._seen[row]
            self._intercept(commands, step, target[row], way, step - self._seen_step[row])
        commands = self._listening(is_first, step)
        self._go(commands, target[self._row[commands]], _NOTHING, step)
        self._seen[is_detected] = target[is_detected]
        self._seen_step[is_detected] = step

    def advance(self, step: int, is_running: Bools) -> None:
        """Move from `step` - 1 to `step` in the episodes [B] that go on."""
        movers = self._listening(is_running, step - 1)
        for _ in range(3):  # the next leg may end here, too
            self._finish_legs(movers, step)
        direction, speed = self._steer(movers)
        self._fast_steps[movers[self._leg[movers] == _LINE]] -= 1
        moves = np.array([is_working(kind, step) for kind in self.kinds])[self._mover[movers]]
        moving = movers[moves]
        self._position[moving] = self._ground.move(self._position[moving], direction[moves], speed[moves])

    def _listening(self, episodes: Bools, step: int) -> Int64s:
        """Indices of the movers of these episodes that work at a step."""
        works = np.array([is_working(kind, step) for kind in self.kinds])
        return np.flatnonzero((episodes[:, None] & works).ravel())

    def _steer(self, movers: Int64s) -> tuple[Float64s, Float64s]:
        """Unit directions [n, 2] and speeds [n] that the plans ask for."""
        leg, here = self._leg[movers], self._position[movers]
        is_line = leg == _LINE
        direction = self._heading[movers].copy()
        is_fast = self._fast_steps[movers] > 0
        speed = np.where(is_line & ~is_fast, self._slow_speed[movers], self._speed[movers])
        speed = np.where(leg == _SPIRAL, SPIRAL_SPEED, speed)
        points = np.flatnonzero(~is_line)
        way = self._ground.aim(here[points], self._goal[movers[points]]) - here[points]
        distance = np.sqrt((way * way).sum(axis=-1))
        direction[points] = way / np.where(distance > 0, distance, 1.0)[:, None]
        speed[points] = np.minimum(speed[points], distance)
        return direction, np.minimum(speed, self._speed[movers])

    def _finish_legs(self, movers: Int64s, step: int) -> None:
        """Take the next leg where one is finished."""
        leg, here = self._leg[movers], self._position[movers]
        way = self._goal[movers] - here
        there = (way * way).sum(axis=-1) <= ARRIVED * ARRIVED
        is_line = leg == _LINE
        spent = is_line.copy()
        lines = np.flatnonzero(is_line)
        spent[lines] = self._ends_line(movers[lines])
        after = self._after[movers]
        arrived = there & (leg == _GO)
        self._leg[movers[arrived & (after == _LINE)]] = _LINE
        cornered = movers[there & (leg == _SPIRAL)]
        self._corner[cornered] += 1
        is_last = self._corner[cornered] >= self._num_corners[cornered]
        self._go_corner(cornered[~is_last])
        self._plan_spiral(movers[arrived & (after == _NOTHING)], step)
        self._go_random(np.concatenate([cornered[is_last], movers[spent]]), step)

    def _ends_line(self, movers: Int64s) -> Bools:
        here, top = self._position[movers], self._speed[movers]
        speed = np.where(self._fast_steps[movers] > 0, top, np.minimum(self._slow_speed[movers], top))
        return self._ground.ends_line(here, here + self._heading[movers] * speed[:, None], top)

    def _go(self, movers: Int64s, goal: Float64s, after: int, step: int) -> None:
        """Plan to go to a point, or near it where it is not allowed, and then what `after` says."""
        self._leg[movers], self._after[movers] = _GO, after
        self._goal[movers] = self._allowed(movers, goal, step)

    def _go_random(self, movers: Int64s, step: int) -> None:
        if len(movers):
            self._leg[movers], self._after[movers] = _GO, _NOTHING
            self._goal[movers] = self._open_point(movers, step, _STREAM_RANDOM)

    def _plan_spiral(self, movers: Int64s, step: int) -> None:
        """A spiral around where the movers are, as far as there is room; a random point where there is none."""
        if not len(movers):
            return
        here = self._position[movers]
        corners = here[:, None] + _OFFSETS
        ends = self._ground.ends_spiral(corners.reshape(-1, 2)).reshape(len(movers), -1)
        count = np.where(ends.any(axis=1), ends.argmax(axis=1), len(_OFFSETS))
        self._middle[movers], self._corner[movers], self._num_corners[movers] = here, 0, count
        self._go_random(movers[count == 0], step)
        self._go_corner(movers[count > 0])

    def _go_corner(self, movers: Int64s) -> None:
        """Make for the next corner of the spiral."""
        self._leg[movers] = _SPIRAL
        self._goal[movers] = self._middle[movers] + _OFFSETS[self._corner[movers]]

    def _intercept(self, movers: Int64s, step: int, target: Float64s, way: Float64s, steps: Float64s) -> None:
        """Plan to cut off a target [n, 2] that came `way` [n, 2] in `steps` [n]."""
        ground, here, top = self._ground, self._position[movers], self._speed[movers]
        length = np.sqrt((way * way).sum(axis=-1))
        heading = np.where(length[:, None] > 0, way / np.where(length > 0, length, 1.0)[:, None], [1.0, 0.0])
        speed = length / steps
        along = ((here - target) * heading).sum(axis=-1)
        foot = target + along[:, None] * heading
        distance = np.hypot(*(here - target).T)
        to_foot = np.hypot(*(foot - here).T)
        from_target = np.hypot(*(foot - target).T)
        beside = distance < top
        ahead = ~beside & (along > 0)
        outside = ahead & ground.is_outside(foot)
        on_line = ahead & ~outside
        behind = ~beside & ~ahead
        time = to_foot / top
        meets = on_line & (from_target >= speed * time)
        foot[on_line] = ground.settle(foot[on_line], heading[on_line], target[on_line])
        goal = np.where(on_line[:, None], foot, target)
        goal[outside] = np.clip(foot[outside], 1.0, ground.size - 2.0)
        gap = np.where(behind, speed * distance / top, np.abs(speed * time - from_target))
        gap -= np.where(meets, _MEET_GAP, _CHASE_GAP)
        closing = np.where(meets, top + speed, top - speed)
        with np.errstate(divide="ignore", invalid="ignore"):
            fast = gap / closing
        self._heading[movers] = np.where(meets[:, None], -heading, heading)
        self._fast_steps[movers] = np.where(fast > 1.0, fast - 1.0, 0.0)
        self._slow_speed[movers] = np.where(meets, MEET_SPEED, CHASE_SPEED)
        self._go(movers, goal, _LINE, step)
        self._after[movers[beside | outside]] = _NOTHING
        self._leg[movers[on_line & (to_foot == 0)]] = _LINE

    def _allowed(self, movers: Int64s, goal: Float64s, step: int) -> Float64s:
        """The goals, each moved within 200 units to where it is allowed if it is not."""
        goal = goal.copy()
        wrong = np.flatnonzero(self._ground.is_closed(goal) | self._ground.is_outside(goal))
        middle, attempt = goal[wrong], 0
        while len(wrong):
            shift = self._draw(movers[wrong], step, _STREAM_NEAR, attempt)
            # Wider with every eighth attempt: a point may lie deep in an obstacle.
            reach = _SCATTER * (1 + attempt // 8)
            trial = middle + reach * (2.0 * shift - 1.0)
            right = ~(self._ground.is_closed(trial) | self._ground.is_outside(trial))
            goal[wrong[right]] = trial[right]
            wrong, middle, attempt = wrong[~right], middle[~right], attempt + 1
        return goal

    def _open_point(self, movers: Int64s, step: int, stream: int) -> Float64s:
        """A random point of the map that is allowed, a mover [n, 2]."""
        point, wrong, attempt = np.zeros((len(movers), 2)), np.arange(len(movers)), 0
        while len(wrong):
            trial = self._draw(movers[wrong], step, stream, attempt) * (self._ground.size - 1.0)
            right = ~(self._ground.is_closed(trial) | self._ground.is_outside(trial))
            point[wrong[right]] = trial[right]
            wrong, attempt = wrong[~right], attempt + 1
        return point

    def _draw(self, movers: Int64s, step: int, stream: int, attempt: int) -> Float64s:
        index = self._mover[movers] + len(self.kinds) * attempt
        return self._draws.point(self._row[movers], stream, step, index)
