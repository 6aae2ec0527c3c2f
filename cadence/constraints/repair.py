"""The last step of inference: tracks that cross an obstacle are led around it, the detections stay where they are.

A track is cut at its pinned steps into legs; in each leg, the spans that collide (`spans`) are replaced by the shortest way
around (`roadmap`), and their steps and some neighbours are laid along it in the old rhythm (`placement`). What cannot
be led around with the margin that was asked for is tried again with smaller ones; the checker has the last word.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import shapely
import torch
from torch import Tensor

from cadence.arrays import Bools, Float64s
from cadence.constraints.checker import absolute_array, segments_in_collision, states_in_collision
from cadence.constraints.obstacles import Obstacles
from cadence.constraints.placement import arc_length, place
from cadence.constraints.roadmap import MAX_CORNERS, Growth, Request, Zone
from cadence.constraints.spans import Case, Leg, Span, colliding_legs, diagnose, new_span, which_touch

_STRETCH = 1.15
"""Steps may become this much longer before further neighbours share the detour."""
_DETOUR = 1.5
"""How much longer than the shortest a way on the side where most of the track already is may be."""
_WIDEN_ROUNDS = 8
_HOP_COST = 0.25
"""What a corner costs, in mean steps: corners use up steps, so that few steps mean a coarser way round."""


def repair(
    position_m: Tensor,
    obstacles: Obstacles,
    is_pinned: Tensor,
    margin_m: float = 0.0,
    *,
    offset_m: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Tracks led around the obstacles, and whether they are now free of collisions.

    position_m [..., T, 2] in metres, offset_m (broadcastable) is added to bring them into the obstacles' frame;
    is_pinned [..., T] bool, steps that must stay exactly where they are. `margin_m` is kept from the obstacles where pinned
    steps and gaps allow it. Steps that need not change are returned bit-identical; tracks with NaN are left alone.

    Returns position_m and is_feasible [...]: True where no segment and no state collides (by `checker`). A pinned step inside
    an obstacle, or two that are closer in time than any way around allows, make a track infeasible; the rest of it is repaired.
    """
    track = absolute_array(position_m, offset_m)
    pinned = is_pinned.expand(position_m.shape[:-1]).reshape(track.shape[:2]).cpu().numpy()
    repaired = track.copy()
    if obstacles.count and track.size:
        legs: list[Leg] | None = None
        for growth in (growths := _growths(obstacles, margin_m, position_m.dtype)):
            if legs is None or legs:
                zone = Zone(obstacles, growth)
                legs = colliding_legs(track, pinned, zone) if legs is None else legs
                legs = _repair_legs(track, repaired, pinned, legs, zone, growth is growths[-1])
    changed = torch.from_numpy((repaired != track).any(axis=-1)).reshape(position_m.shape[:-1])
    if not bool(changed.any()):
        moved = position_m
    else:
        absolute = torch.from_numpy(repaired).reshape(position_m.shape).to(position_m.device)
        relative = absolute if offset_m is None else absolute - offset_m.to(absolute)
        moved = torch.where(changed.to(position_m.device)[..., None], relative.to(position_m.dtype), position_m)
    collides = segments_in_collision(moved, obstacles, offset_m=offset_m).any(dim=-1)
    return moved, ~(collides | states_in_collision(moved, obstacles, offset_m=offset_m).any(dim=-1))


def _growths(obstacles: Obstacles, margin_m: float, dtype: torch.dtype) -> list[Growth]:
    """From what was asked for to what just keeps clear: the second and third only see legs that the first cannot repair."""
    boxes = shapely.bounds(obstacles.shapes)
    size = float(np.median([*2 * obstacles.circle_array[:, 2], *np.hypot(*(boxes[:, 2:] - boxes[:, :2]).T)]))
    # Rounding to the tracks' type must not bring a way into an obstacle. By the obstacles alone, not by the tracks: how a
    # hypothesis is repaired must not depend on the others. In single precision enough for 800 sizes from the datum.
    least = size * (1e-4 if dtype.itemsize < 8 else 1e-9)
    wide = max(0.02 * size, 0.25 * margin_m)
    growths = [Growth(margin_m + least, wide)] if margin_m > least else []
    return [*growths, Growth(least, wide), Growth(0.1 * least, 0.001 * size, core_sides=256, outline_sides=24)]


def _repair_legs(track: Float64s, repaired: Float64s, pinned: Bools, legs: list[Leg], zone: Zone, is_last: bool) -> list[Leg]:
    """Repair what can be repaired against one zone, into `repaired`; returns the legs that could not."""
    cases, failed = diagnose(track, pinned, legs, zone, is_last)
    cases, unrouted = _route(cases, zone)
    for is_strict in (False, True):
        placed = [(case, _place_case(case, is_strict)) for case in cases]
        is_blocked = which_touch([point for _, point in placed], zone)
        for (case, point), blocked in zip(placed, is_blocked, strict=True):
            if not blocked:
                repaired[case.leg.row, case.leg.low : case.leg.high + 1] = point
        cases = [case for (case, _), blocked in zip(placed, is_blocked, strict=True) if blocked]
    failed += [*unrouted, *cases]
    if is_last:
        for case in failed:
            repaired[case.leg.row, case.leg.low : case.leg.high + 1] = _pushed_out(case, zone)
    return [case.leg for case in failed]


def _route(cases: list[Case], zone: Zone) -> tuple[list[Case], list[Case]]:
    """The cases with a path for every span, and those for which none was found even between the ends of the leg."""
    routed, unrouted = [], []
    for attempt in range(_WIDEN_ROUNDS):
        wanted = [(case, span) for case in cases for span in case.spans if span.path is None]
        paths = dict(zip(map(id, (span for _, span in wanted)), _paths(wanted, zone), strict=True))
        again = []
        for case in cases:
            spans = tuple(replace(span, path=paths.get(id(span), span.path)) for span in case.spans)
            case = replace(case, spans=spans)
            if all(span.path is not None for span in spans):
                routed.append(case)
            elif (wider := _widened(case, 2**attempt)) is None:
                unrouted.append(case)
            else:
                again.append(wider)
        if not (cases := again):
            break
    return routed, unrouted + cases


def _widened(case: Case, steps: int) -> Case | None:
    """The case with more steps for its spans without path, overlapping spans merged; None where there are no more."""
    end = len(case.point) - 1
    if any(span.path is None and (span.first, span.last) == (0, end) for span in case.spans):
        span = case.spans[0]
        opened = replace(span, is_open_start=not case.is_pinned[0], is_open_end=not case.is_pinned[1])
        is_news = (opened.is_open_start, opened.is_open_end) != (span.is_open_start, span.is_open_end)
        return replace(case, spans=(opened,)) if is_news else None
    spans: list[Span] = []
    for span in case.spans:
        if span.path is None:
            span = new_span(max(0, span.first - steps), min(end, span.last + steps), span.parts, case.is_bad)
        while spans and spans[-1].last > span.first:
            before = spans.pop()
            first, last = min(before.first, span.first), max(before.last, span.last)
            span = new_span(first, last, before.parts | span.parts, case.is_bad)
        spans.append(span)
    return replace(case, spans=tuple(spans))


def _paths(wanted: Sequence[tuple[Case, Span]], zone: Zone) -> list[Float64s | None]:
    """The way round for each span, [P, 2] from start to end, or None."""
    paths: list[Float64s | None] = [None] * len(wanted)
    requests = {}
    for index, (case, span) in enumerate(wanted):
        if (request := _request(case, span, zone)) is not None:
            requests[index] = request
    ways = dict(zip(requests, zone.routes(list(requests.values())), strict=True))
    for index, way in ways.items():
        if way is not None:
            paths[index] = np.concatenate([requests[index].start[None], way, requests[index].end[None]])
    others = {}
    for index, path in enumerate(paths):
        if path is not None and (barrier := _barrier(*wanted[index], path, zone)) is not None:
            others[index] = replace(requests[index], barrier=barrier)
    for (index, request), way in zip(others.items(), zone.routes(list(others.values())), strict=True):
        path = paths[index]
        if way is not None and path is not None:
            other = np.concatenate([request.start[None], way, request.end[None]])
            if arc_length(other)[-1] <= _DETOUR * arc_length(path)[-1]:
                paths[index] = other
    return paths


def _request(case: Case, span: Span, zone: Zone) -> Request | None:
    ends = np.array([span.first, span.last])
    point, is_bad = case.point[ends], case.is_bad[ends]
    if is_bad.any():
        exits = zone.exits(point, case.region)
        if exits is None or bool((zone.regions(exits) != case.region)[is_bad].any()):
            return None
        point = np.where(is_bad[:, None], exits, point)
    steps = span.last - span.first
    hop_cost = _HOP_COST * arc_length(case.point[span.first : span.last + 1])[-1] / max(steps, 1)
    # A track that need not arrive may take a way with more corners than it has steps.
    corners = MAX_CORNERS if span.is_open_start or span.is_open_end else steps - 1
    return Request(point[0], point[1], corners, hop_cost, tuple(sorted(span.parts)))


def _barrier(case: Case, span: Span, path: Float64s, zone: Zone) -> Float64s | None:
    """A ray across the side of `path`, where most of the colliding steps are nearer to the other side; else None."""
    inside = case.point[span.first + 1 : span.last][case.is_bad[span.first + 1 : span.last]]
    chord = path[-1] - path[0]
    chord_length = float(np.hypot(*chord))
    if span.is_open_start or span.is_open_end or not len(inside) or len(path) < 3 or chord_length == 0:
        return None
    exits = zone.exits(inside, case.region)
    if exits is None:
        return None
    left = np.array([-chord[1], chord[0]]) / chord_length
    vote = int(np.sign((exits - inside) @ left).sum())
    side = float(np.sign(((path[1:-1] - path[0]) @ left).mean()))
    if vote * side >= 0:
        return None
    reach = 4 * (max(zone.size(part) for part in span.parts) + chord_length)
    middle = inside[len(inside) // 2]
    return np.stack([middle, middle + side * reach * left])


def _place_case(case: Case, is_strict: bool) -> Float64s | None:
    """The positions [n, 2] of the leg with every span laid along its path; `is_strict` keeps to the spans' own steps."""
    point, end = case.point.copy(), len(case.point) - 1
    for index, span in enumerate(case.spans):
        floor = 0 if index == 0 else (case.spans[index - 1].last + span.first) // 2
        ceiling = end if index + 1 == len(case.spans) else (span.last + case.spans[index + 1].first) // 2
        is_open = (span.is_open_start, span.is_open_end)
        low, high = span.first, span.last
        if not is_strict and not any(is_open):
            low, high = _share(case.point, span, floor, ceiling)
            if _stretch(case.point, span, low, high) > _STRETCH:
                # Rather than run, a track that need not arrive arrives later, or comes from less far.
                is_open_end = high == end and not case.is_pinned[1]
                is_open = (low == 0 and not case.is_pinned[0] and not is_open_end, is_open_end)
        assert span.path is not None
        path = np.concatenate([case.point[low : span.first], span.path, case.point[span.last + 1 : high + 1]])
        bends = slice(span.first - low + 1, len(path) - 1 - (high - span.last))
        new = _lay(case.point[low : high + 1], path, bends, is_open)
        if new is None:
            return None
        point[low : high + 1] = new
    return point


def _stretch(point: Float64s, span: Span, low: int, high: int) -> float:
    """How much longer the way low..high of a leg becomes by the detour of a span."""
    assert span.path is not None
    walked = arc_length(point)
    old = walked[high] - walked[low]
    new = old + arc_length(span.path)[-1] - (walked[span.last] - walked[span.first])
    return float(new / old) if old > 0 else np.inf


def _share(point: Float64s, span: Span, floor: int, ceiling: int) -> tuple[int, int]:
    """The fewest steps around a span, low..high, that share its detour so that none becomes much longer than it was."""
    low, high = span.first, span.last
    while (low > floor or high < ceiling) and _stretch(point, span, low, high) > _STRETCH:
        grow = 1 + (high - low) // 8
        low, high = max(floor, low - grow), min(ceiling, high + grow)
    return low, high


def _lay(old: Float64s, path: Float64s, bends: slice, is_open: tuple[bool, bool]) -> Float64s | None:
    """Steps old [n, 2] laid along a path [P, 2], hitting the vertices `bends`; to its end or, if open, as far as before."""
    if len(old) == 1:
        return path[:1]
    if is_open == (True, False):
        count = len(path)
        bends = slice(count - bends.stop, count - bends.start)
        new = _lay(old[::-1], path[::-1], bends, (False, True))
        return None if new is None else new[::-1]
    walked = arc_length(path)
    length, corners = float(walked[-1]), walked[bends]
    if any(is_open):
        length = min(length, _STRETCH * float(arc_length(old)[-1]))
        # With fewer steps than corners the last step stays at a corner.
        corners = corners[corners > 0]
        length = min(length, *corners[len(old) - 2 : len(old) - 1].tolist(), length)
    new = place(old, path, corners, length)
    if new is not None and not any(is_open):
        new[-1] = old[-1]
    return new


def _pushed_out(case: Case, zone: Zone) -> Float64s:
    """The leg with every colliding step at the nearest free point: the most that can be done without a way round."""
    exits = zone.exits(case.point, case.region)
    return case.point if exits is None else np.where(case.is_bad[:, None], exits, case.point)
