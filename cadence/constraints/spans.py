"""What is to be repaired: tracks cut at their pinned steps into legs, and the spans of a leg that collide."""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cadence.arrays import Bools, Float64s, Indices
from cadence.constraints.roadmap import Zone

_RUN_UP = 0.4
"""Free steps before and after a collision that take part in the way round, as a share of the colliding ones."""


@dataclass(frozen=True)
class Leg:
    """Steps low..high of one track; nothing between them is pinned, the ends may be."""

    row: int
    low: int
    high: int


@dataclass(frozen=True, eq=False)
class Span:
    """Steps first..last of a leg whose way between collides. An open end is that of the leg, and may move."""

    first: int
    last: int
    parts: frozenset[int]
    is_open_start: bool
    is_open_end: bool
    path: Float64s | None = None
    """The way round [P, 2], from the position of `first` (or where it was moved to) to that of `last`."""


@dataclass(frozen=True, eq=False)
class Case:
    """A leg to repair: its positions [n, 2], which steps are bad [n], which of its ends are pinned, its region, its spans."""

    leg: Leg
    point: Float64s
    is_bad: Bools
    is_pinned: tuple[bool, bool]
    region: int
    spans: tuple[Span, ...]


def colliding_legs(track: Float64s, pinned: Bools, zone: Zone) -> list[Leg]:
    """The legs of all tracks that touch the zone; tracks far from it, or with NaN, cost next to nothing."""
    whole = np.flatnonzero(np.isfinite(track).all(axis=(1, 2)))
    near = whole[zone.near(track[whole].min(axis=1), track[whole].max(axis=1))]
    touches = (_hits(track[near], zone) >= 0).any(axis=1)
    return [Leg(row, low, high) for row in near[touches].tolist() for low, high in _cuts(pinned[row])]


def _cuts(pinned: Bools) -> Iterator[tuple[int, int]]:
    cuts = sorted({0, *np.flatnonzero(pinned).tolist(), len(pinned) - 1})
    yield from itertools.pairwise(cuts if len(cuts) > 1 else [0, 0])


def _hits(point: Float64s, zone: Zone) -> Indices:
    """The component in the way of every segment [R, T-1] (-1: none) of tracks [R, T, 2]; a single step is its own segment."""
    start, end = (point, point) if point.shape[1] == 1 else (point[:, :-1], point[:, 1:])
    return zone.hits(start.reshape(-1, 2), end.reshape(-1, 2)).reshape(start.shape[:2])


def diagnose(track: Float64s, pinned: Bools, legs: Sequence[Leg], zone: Zone, is_last: bool) -> tuple[list[Case], list[Case]]:
    """The legs that collide, as cases that have a chance, and as cases that have none against this zone."""
    rows = np.unique([leg.row for leg in legs]).astype(np.intp)
    points = track[rows]
    region = zone.regions(points.reshape(-1, 2)).reshape(points.shape[:2])
    part = _hits(points, zone)
    cases, failed = [], []
    for leg in legs:
        row = int(np.searchsorted(rows, leg.row))
        # A pinned step inside stays where it is: the rest of the leg is repaired as if it ended beside it.
        ends = [pinned[leg.row, step] and region[row, step] < 0 for step in (leg.low, leg.high)]
        if any(ends) and is_last:
            leg = replace(leg, low=leg.low + int(ends[0]), high=leg.high - int(ends[1]))
        if leg.low > leg.high:
            continue
        steps, segments = slice(leg.low, leg.high + 1), slice(leg.low, max(leg.high, leg.low + (part.shape[1] == 1)))
        is_pinned = (bool(pinned[leg.row, leg.low]), bool(pinned[leg.row, leg.high]))
        point, its_region = points[row, steps], region[row, steps]
        homes = {int(its_region[end]) for end in (0, -1) if is_pinned[end] and its_region[end] >= 0}
        home = homes.pop() if homes else _most_frequent(its_region)
        if homes or (any(ends) and not is_last):
            failed.append(Case(leg, point, its_region < 0, is_pinned, home, ()))
        elif spans := _spans(its_region != home, part[row, segments], point, zone):
            cases.append(Case(leg, point, its_region != home, is_pinned, home, spans))
    return cases, failed


def _most_frequent(region: Indices) -> int:
    free = region[region >= 0]
    return int(np.bincount(free).argmax()) if len(free) else 0


def _spans(is_bad: Bools, part: Indices, point: Float64s, zone: Zone) -> tuple[Span, ...]:
    """The runs of colliding segments; runs that are only parted by steps in a bay of the same component are one."""
    if len(is_bad) == 1:
        return (new_span(0, 0, frozenset(part[part >= 0].tolist()), is_bad),) if is_bad[0] else ()
    is_hit = (part >= 0) | is_bad[:-1] | is_bad[1:]
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_hit, [False]]).astype(np.int8)))
    spans: list[Span] = []
    for first, last in edges.reshape(-1, 2).tolist():
        parts = frozenset(part[first:last][part[first:last] >= 0].tolist())
        before = spans[-1] if spans else None
        if before is not None and any(zone.hull_holds(p, point[before.last : first + 1]) for p in parts & before.parts):
            spans[-1] = new_span(before.first, last, parts | before.parts, is_bad)
        else:
            spans.append(new_span(first, last, parts, is_bad))
    return tuple(_with_run_up(spans, is_bad))


def _with_run_up(spans: Sequence[Span], is_bad: Bools) -> Iterator[Span]:
    """The spans with some free steps before and after, so that a way round turns off before it stands at the wall."""
    for index, span in enumerate(spans):
        reach = math.ceil(_RUN_UP * (span.last - span.first))
        floor = 0 if index == 0 else (spans[index - 1].last + span.first + 1) // 2
        ceiling = len(is_bad) - 1 if index + 1 == len(spans) else (span.last + spans[index + 1].first) // 2
        yield new_span(max(floor, span.first - reach), min(ceiling, span.last + reach), span.parts, is_bad)


def new_span(first: int, last: int, parts: frozenset[int], is_bad: Bools) -> Span:
    """The span first..last without a path; its ends are open where they lie in an obstacle."""
    return Span(first, last, parts, is_open_start=bool(is_bad[first]), is_open_end=bool(is_bad[last]))


def which_touch(points: Sequence[Float64s | None], zone: Zone) -> list[bool]:
    """Which tracks [n, 2] touch the zone; those that are None do."""
    found = [point for point in points if point is not None]
    if not found:
        return [True] * len(points)
    start = np.concatenate([point[:-1] if len(point) > 1 else point for point in found])
    end = np.concatenate([point[1:] if len(point) > 1 else point for point in found])
    owner = np.repeat(np.arange(len(found)), [max(len(point) - 1, 1) for point in found])
    touches = iter(np.bincount(owner, zone.hits(start, end) >= 0, len(found)) > 0)
    return [True if point is None else bool(next(touches)) for point in points]
