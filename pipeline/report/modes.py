"""Where hypotheses keep together, and where they part into several ways.

The mean of hypotheses that pass an island on either side lies on the island, where nobody can be. So a mean and bands are
made only of hypotheses that keep together; each way is drawn as one of its hypotheses, with its share of the weight.

Letters of the shapes: K hypothesis, T time step, S step of a strand.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
import torch

from cadence.arrays import Bools, Float64s, Indices
from cadence.constraints.checker import segments_in_collision, states_in_collision
from cadence.constraints.obstacles import Obstacles
from pipeline.report.mission import Fan
from pipeline.report.shapes import SMALL_M2, FanShape, shape_of, turned

LEAST_SHARE = 0.1
"""Of the weight: fewer hypotheses are strays, not a way."""

MAX_WAYS = 4
LEAST_RUN = 3
"""Runs of fewer steps are chance, and so are shorter breaks of a run."""

FAR, FAR_A_HYPOTHESIS = 4.0, 30.0
"""Halves are two ways where their middles are 4 + 30 / K of their own deviations apart: those of a normal cloud are 2.7, of a
uniform one 3.5 apart, and the fewer hypotheses there are, the further apart chance puts them."""

_FAR_WHEN_BLOCKED = 2.7
_TOGETHER = 256
"""Fans of which the means are held at once."""
_LEAST_SPREAD = 0.05
"""Of the widest of the fan: ways that are hardly apart need not be told."""

DIRECTIONS = ("east", "north-east", "north", "north-west", "west", "south-west", "south", "south-east")


@dataclass(frozen=True, eq=False)
class Strand:
    """Hypotheses that keep together over the steps from first to last, both included.

    share       of the weight: 1 where all keep together
    shape       of them over these steps
    line_m      [S, 2] where they are drawn: their mean where they are all, else the hypothesis nearest to it
    hypothesis  that one; None where the mean is drawn
    apart       the step at which the ways are furthest apart
    direction   of this one from the middle of all, there
    """

    first: int
    last: int
    share: float
    shape: FanShape
    line_m: Float64s
    hypothesis: int | None = None
    apart: int = -1
    direction: str = ""


def strands_of(fan: Fan, shape: FanShape, obstacles: Obstacles | None) -> tuple[Strand, ...]:
    """The strands of a fan in the order of time, those of the same steps by falling share."""
    return _strands_where(fan, shape, _are_blocked(shape.mean_m[None], obstacles)[0])


def strands_of_all(fans: Sequence[Fan], obstacles: Obstacles | None) -> Iterator[tuple[Fan, tuple[Strand, ...]]]:
    """Every fan with its strands; obstacles are asked once for many fans of one length."""
    for begin in range(0, len(fans), _TOGETHER):
        for _, run in groupby(fans[begin : begin + _TOGETHER], key=lambda fan: fan.offset_m.shape[1]):
            some = list(run)
            shapes = [shape_of(fan) for fan in some]
            blocked = _are_blocked(np.stack([shape.mean_m for shape in shapes]), obstacles)
            for fan, shape, is_blocked in zip(some, shapes, blocked, strict=True):
                yield fan, _strands_where(fan, shape, is_blocked)


def _strands_where(fan: Fan, shape: FanShape, is_blocked: Bools) -> tuple[Strand, ...]:
    centred = fan.offset_m + (fan.datum_m - shape.mean_m)
    distance = _halves(turned(centred, shape.angle_rad)[0], fan.weight)[0]
    spread_m = shape.spread_m
    is_apart = (distance > _least_distance(fan)) & (spread_m > _LEAST_SPREAD * spread_m.max())
    return tuple(_strands(fan, shape, _in_runs(is_apart, is_blocked), is_blocked, np.where(is_apart, distance, 0.0)))


def _strands(fan: Fan, shape: FanShape, is_parted: Bools, is_blocked: Bools, distance: Float64s) -> Iterator[Strand]:
    last_step = len(is_parted) - 1
    for parted, run in groupby(range(last_step + 1), key=lambda step: bool(is_parted[step])):
        steps = list(run)
        # Lines meet where ways begin and end: both reach a step into what is one strand.
        first, last = (max(steps[0] - 1, 0), min(steps[-1] + 1, last_step)) if parted else (steps[0], steps[-1])
        if not parted:
            whole = shape[first : last + 1]
            yield Strand(first, last, 1.0, whole, whole.mean_m)
            continue
        inner = slice(steps[0], steps[-1] + 1)
        # Where nothing else tells, the ways are furthest apart where the spread is widest.
        apart = steps[0] + int(np.argmax(distance[inner] if distance[inner].any() else shape.spread_m[inner]))
        least = _FAR_WHEN_BLOCKED if is_blocked[inner].any() else _least_distance(fan)
        ways = _split(fan.offset_m[:, apart].astype(np.float64), fan.weight, np.arange(len(fan.weight)), least)
        yield from sorted(
            (_way(fan, members, first, last, apart, shape.mean_m[apart]) for members in ways), key=lambda way: -way.share
        )


def _way(fan: Fan, members: Indices, first: int, last: int, apart: int, middle_m: Float64s) -> Strand:
    share = float(fan.weight[members].sum())
    own = replace(fan, weight=fan.weight[members] / share, offset_m=fan.offset_m[members, first : last + 1])
    shape = shape_of(own)
    away = own.offset_m + (fan.datum_m - shape.mean_m)
    nearest = int(np.hypot(away[..., 0], away[..., 1]).sum(axis=1).argmin())
    toward = shape.mean_m[apart - first] - middle_m
    octant = round(float(np.arctan2(toward[1], toward[0])) / (np.pi / 4)) % 8
    line_m = own.offset_m[nearest] + fan.datum_m
    return Strand(first, last, share, shape, line_m, int(members[nearest]), apart, DIRECTIONS[octant])


def _least_distance(fan: Fan) -> float:
    return FAR + FAR_A_HYPOTHESIS / len(fan.weight)


def _are_blocked(mean_m: Float64s, obstacles: Obstacles | None) -> Bools:
    """Where the lines of the means [F, T, 2] run through an obstacle [F, T]."""
    if obstacles is None or obstacles.count == 0:
        return np.zeros(mean_m.shape[:2], dtype=bool)
    line = torch.from_numpy(mean_m)
    hit = states_in_collision(line, obstacles).numpy().copy()
    crossing = segments_in_collision(line, obstacles).numpy()
    hit[:, 1:] |= crossing
    hit[:, :-1] |= crossing
    return np.asarray(hit)


def _in_runs(is_apart: Bools, is_blocked: Bools) -> Bools:
    """Steps of ways: in runs that last, or hold a step that is blocked."""
    found = is_apart | is_blocked
    if not found.any():
        return found
    for wanted in (False, True):  # first breaks that are too short, then runs
        for value, run in groupby(range(len(found)), key=lambda step: bool(found[step])):
            steps = list(run)
            is_short = len(steps) < LEAST_RUN and not is_blocked[steps].any()
            is_inner = 0 < steps[0] and steps[-1] < len(found) - 1
            if value is wanted and is_short and (wanted or is_inner):
                found[steps] = not value
    return found


def _split(point_m: Float64s, weight: Float64s, members: Indices, least: float) -> list[Indices]:
    """The ways at one step, each as members [M] of the positions [K, 2]; halves are halved again, the heaviest first."""
    ways, is_first = [members], True
    while len(ways) < MAX_WAYS:
        halves = next((found for way in ways if (found := _halved(point_m, weight, way, least)) is not None), None)
        if halves is None:
            break
        ways = [way for way in ways if way is not halves[0]] + list(halves[1:])
        if is_first:
            least, is_first = max(least, FAR + FAR_A_HYPOTHESIS / len(members)), False
    return ways


def _halved(point_m: Float64s, weight: Float64s, way: Indices, least: float) -> tuple[Indices, Indices, Indices] | None:
    """A way and its two halves; None where it is one."""
    if len(way) < 2:
        return None
    mass = weight[way] / weight[way].sum()
    centred = point_m[way] - mass @ point_m[way]
    angle = np.arctan2(2 * mass @ (centred[:, 0] * centred[:, 1]), mass @ (centred[:, 0] ** 2 - centred[:, 1] ** 2)) / 2
    along = turned(centred[:, None], np.array([angle]))[0]
    distance, cut = _halves(along, mass, LEAST_SHARE / float(weight[way].sum()))
    is_high = along[:, 0] > cut[0]
    if distance[0] <= least or is_high.all() or not is_high.any():
        return None
    return way, way[is_high], way[~is_high]


def _halves(along: Float64s, weight: Float64s, least_share: float = LEAST_SHARE) -> tuple[Float64s, Float64s]:
    """The best cut of [K, T] in two at every step (Otsu, 1979): where it is [T], and before it how far apart the halves [T].

    That is in units of their own deviation, and zero where no cut leaves both halves the least share of the weight [K].
    """
    order = np.argsort(along, axis=0, kind="stable")
    value, mass = np.take_along_axis(along, order, 0), weight[order]
    low = np.cumsum(mass, axis=0)[:-1]
    total, squares = np.cumsum(mass * value, axis=0), np.cumsum(mass * value**2, axis=0)
    high = np.maximum(1.0 - low, 1e-12)
    low_mean, high_mean = total[:-1] / low, (total[-1] - total[:-1]) / high
    gained = np.where((low >= least_share) & (high >= least_share), low * high * (high_mean - low_mean) ** 2, -1.0)
    if not len(gained):
        return np.zeros(along.shape[1]), np.zeros(along.shape[1])
    best, step = gained.argmax(axis=0), np.arange(along.shape[1])
    within = (squares[:-1] / low - low_mean**2 + (squares[-1] - squares[:-1]) / high - high_mean**2)[best, step] / 2
    apart = (high_mean - low_mean)[best, step] / np.sqrt(np.maximum(within, 0.0) + SMALL_M2)
    return np.where(gained[best, step] > 0, apart, 0.0), (value[:-1] + value[1:])[best, step] / 2
