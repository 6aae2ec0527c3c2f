"""What was asked of one agent or a pair: was it inside, when did it arrive, did it pass a line, did two meet."""

from dataclasses import dataclass

import numpy as np

from cadence.answers.areas import Area, Disc, Path
from cadence.answers.estimates import Law, Probability, law, probability
from cadence.answers.visits import Visits, between, visits
from cadence.answers.whereabouts import medoid
from cadence.arrays import Bools, Float64s, Indices
from cadence.stories import Stories, between_steps, steps_around

Span = tuple[float, float]
"""From when to when, seconds of the stories' clock."""


@dataclass(frozen=True)
class Inside:
    """Whether an agent was in an area within a span of time.

    ever            it was there at any moment; dwelt: without a break for as long as was asked
    at_start, at_end  it was there at the beginning and at the end of the span
    first_entry_s   when it came in first, over the stories in which it did (those that begin inside are left out)
    left_s          when it went out last, over the stories in which it was outside at the end
    total_s, longest_s  time inside altogether, and without a break, over the stories in which it was there
    """

    ever: Probability
    dwelt: Probability
    at_start: Probability
    at_end: Probability
    first_entry_s: Law | None
    left_s: Law | None
    total_s: Law | None
    longest_s: Law | None


@dataclass(frozen=True)
class Arrival:
    """Whether an agent came into an area from outside, when, and where over its border.

    arrived  it was outside at the beginning of the span or later, and came in; was_there: it was in it from the beginning
    place_m  where it crossed the border first: the story in the middle of all; place_spread_m mean distance to it
    """

    arrived: Probability
    was_there: Probability
    arrived_s: Law | None
    place_m: tuple[float, float] | None
    place_spread_m: float | None


@dataclass(frozen=True)
class Passage:
    """Whether an agent crossed a line.

    to_right   of those that crossed, how many went over it from left to right first, seen from its first point to its last
    along_m    where on the line, metres from its first point
    """

    passed: Probability
    to_right: Probability
    passed_s: Law | None
    along_m: Law | None
    num_crossings: Law | None


@dataclass(frozen=True)
class Meeting:
    """Whether two agents were within a distance of each other for long enough.

    met_s       when the first such meeting began; lasted_s the longest
    nearest_m   least distance of the two, over all stories in which both are there
    place_m     middle between both when it began: the story in the middle of all; place_spread_m mean distance to it
    """

    met: Probability
    met_s: Law | None
    lasted_s: Law | None
    nearest_m: Law | None
    place_m: tuple[float, float] | None
    place_spread_m: float | None


def inside(stories: Stories, agent: int, area: Area, span_s: Span, dwell_s: float = 0.0) -> Inside:
    """Whether agent number `agent` was in `area` within `span_s`, and for `dwell_s` without a break."""
    cut = between(stories, (agent,), *span_s)
    stays, weight = visits(cut.time_s, cut.position_m[:, 0], area), stories.weight
    begin_s, end_s = cut.time_s[[0, -1]]
    ever, first, last = stays.is_any, stays.first_s, stays.last_s
    at_start, at_end = ever & (first <= begin_s), ever & (last >= end_s)
    entry_s = stays.after(float(begin_s)).first_s
    return Inside(
        ever=probability(weight, ever),
        dwelt=probability(weight, stays.lasting(dwell_s).is_any),
        at_start=probability(weight, at_start),
        at_end=probability(weight, at_end),
        first_entry_s=_times(cut.time_s, cut.position_m[:, 0], np.where(at_start, np.nan, entry_s), weight),
        left_s=_times(cut.time_s, cut.position_m[:, 0], np.where(at_end, np.nan, last), weight),
        total_s=law(weight, np.where(ever, stays.total_s, np.nan)),
        longest_s=law(weight, np.where(ever, stays.longest_s, np.nan)),
    )


def arrive(stories: Stories, agent: int, area: Area, span_s: Span) -> Arrival:
    """Whether agent number `agent` came into `area` from outside within `span_s`, and when first."""
    cut = between(stories, (agent,), *span_s)
    track_m, weight = cut.position_m[:, 0], stories.weight
    stays = visits(cut.time_s, track_m, area)
    was_there = stays.is_any & (stays.first_s <= cut.time_s[0])
    # where an agent appears inside (it is no part of the story before) it did not come over the border
    arrived = stays[~_appears(cut.time_s, track_m, stays)].after(float(cut.time_s[0])).first_s
    place_m, spread_m = _place(track_m, cut.time_s, arrived, weight)
    return Arrival(
        probability(weight, np.isfinite(arrived)),
        probability(weight, was_there),
        _times(cut.time_s, track_m, arrived, weight),
        place_m,
        spread_m,
    )


def passed(stories: Stories, agent: int, line: Path, span_s: Span) -> Passage:
    """Whether agent number `agent` crossed `line` within `span_s`."""
    cut, weight = between(stories, (agent,), *span_s), stories.weight
    story, at_s, along_m, goes_right = _crossings(cut.time_s, cut.position_m[:, 0], line)
    count = np.bincount(story, minlength=len(weight)).astype(np.float64)
    is_first = np.ones(len(story), dtype=bool)
    is_first[1:] = story[1:] != story[:-1]
    first_s, where_m, first_right = (
        np.full(len(weight), np.nan),
        np.full(len(weight), np.nan),
        np.zeros(len(weight), dtype=bool),
    )
    first_s[story[is_first]], where_m[story[is_first]] = at_s[is_first], along_m[is_first]
    first_right[story[is_first]] = goes_right[is_first]
    did = count > 0
    return Passage(
        passed=probability(weight, did),
        to_right=probability(weight[did], first_right[did]),
        passed_s=_times(cut.time_s, cut.position_m[:, 0], first_s, weight),
        along_m=law(weight, where_m),
        num_crossings=law(weight, np.where(did, count, np.nan)),
    )


def _crossings(time_s: Float64s, track_m: Float64s, line: Path) -> tuple[Indices, Float64s, Float64s, Bools]:
    """Where tracks [K, T, 2] cross `line`, by story and time: which story, when, how far along it, and whether to its right."""
    start_m, end_m = track_m[:, :-1].reshape(-1, 2), track_m[:, 1:].reshape(-1, 2)
    known = np.flatnonzero(np.isfinite(start_m).all(1) & np.isfinite(end_m).all(1))
    segment, share, edge, edge_share = line.crossings(start_m[known], end_m[known])
    story, step = np.divmod(known[segment], max(len(time_s) - 1, 1))
    at_s = time_s[step] + share * (time_s[step + 1] - time_s[step])
    order = np.lexsort((at_s, story))
    story, segment, edge, edge_share, at_s = story[order], segment[order], edge[order], edge_share[order], at_s[order]
    # a corner of the track on the line, or of the line on the track, is met twice at one moment
    is_new = np.ones(len(order), dtype=bool)
    is_new[1:] = (story[1:] != story[:-1]) | (np.diff(at_s) > 1e-9 * np.abs(at_s[1:]))
    along, edge_along = (end_m - start_m)[known[segment]], (line.end_m - line.start_m)[edge]
    goes_right = along[:, 1] * edge_along[:, 0] - along[:, 0] * edge_along[:, 1] < 0
    return story[is_new], at_s[is_new], line.along_m(edge, edge_share)[is_new], goes_right[is_new]


def meet(stories: Stories, one: int, other: int, within_m: float, for_s: float, span_s: Span) -> Meeting:
    """Whether agents number `one` and `other` were within `within_m` of each other for `for_s` without a break."""
    cut = between(stories, (one, other), *span_s)
    track_m, weight = cut.position_m, stories.weight
    # between two steps both go straight, and so does one as seen from the other
    apart_m = track_m[:, 1] - track_m[:, 0]
    stays = visits(cut.time_s, apart_m, Disc((0.0, 0.0), within_m)).lasting(for_s)
    place_m, spread_m = _place(0.5 * (track_m[:, 0] + track_m[:, 1]), cut.time_s, stays.first_s, weight)
    return Meeting(
        met=probability(weight, stays.is_any),
        met_s=_times(cut.time_s, apart_m, stays.first_s, weight),
        lasted_s=law(weight, np.where(stays.is_any, stays.longest_s, np.nan)),
        nearest_m=law(weight, nearest_m(apart_m)),
        place_m=place_m,
        place_spread_m=spread_m,
    )


def nearest_m(apart_m: Float64s) -> Float64s:
    """Least distance from zero [K] of lines through points [K, T, 2], also between two points; NaN where all are NaN."""
    start, end = (apart_m, apart_m) if apart_m.shape[1] == 1 else (apart_m[:, :-1], apart_m[:, 1:])
    along = end - start
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.clip(np.nan_to_num(-(start * along).sum(-1) / (along * along).sum(-1)), 0.0, 1.0)
    near = start + share[..., None] * along
    distance = np.where(np.isnan(near).any(-1), np.inf, np.hypot(near[..., 0], near[..., 1])).min(axis=1)
    return np.where(np.isinf(distance), np.nan, distance)


def _times(time_s: Float64s, track_m: Float64s, at_s: Float64s, weight: Float64s) -> Law | None:
    """Law of times [K] at which tracks [K, T, 2] cross something, known as well as straight lines between steps tell them.

    A track that bends by b within two steps strays by b / 8 from the line between them (the sagitta of an arc), and comes by as
    much earlier or later: at most half a step.
    """
    if len(time_s) < 3:
        return law(weight, at_s)
    left = np.clip(np.searchsorted(time_s, np.nan_to_num(at_s, nan=time_s[0]), "right") - 1, 0, len(time_s) - 2)
    rows = np.arange(len(at_s))
    sagitta_m = np.minimum(_bend_m(track_m, left), _bend_m(track_m, left + 1)) / 8.0  # a corner at one end is no arc
    step_m = np.hypot(*(track_m[rows, left + 1] - track_m[rows, left]).T)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.nan_to_num(np.minimum(sagitta_m / step_m, 0.5))
    return law(weight, at_s, share * (time_s[left + 1] - time_s[left]))


def _bend_m(track_m: Float64s, step: Indices) -> Float64s:
    """How far tracks [K, T, 2] leave the straight way at a step each [K]: zero at their ends and beside an absence."""
    rows, inner = np.arange(len(step)), np.clip(step, 1, track_m.shape[1] - 2)
    before, at, after = (track_m[rows, inner + side] for side in (-1, 0, 1))
    bend_m: Float64s = np.where(inner == step, np.nan_to_num(np.hypot(*((after - at) - (at - before)).T)), 0.0)
    return bend_m


def _appears(time_s: Float64s, track_m: Float64s, stays: Visits) -> Bools:
    """Stays [N] that begin where the track itself begins, after it was absent."""
    is_there = np.isfinite(track_m[..., 0])
    step = np.searchsorted(time_s, stays.start_s)
    is_at_step = time_s[np.minimum(step, len(time_s) - 1)] == stays.start_s
    found: Bools = is_at_step & (step > 0) & ~is_there[stays.story, np.maximum(step - 1, 0)]
    return found


def _place(
    track_m: Float64s, time_s: Float64s, at_s: Float64s, weight: Float64s
) -> tuple[tuple[float, float] | None, float | None]:
    """The middle of where tracks [K, T, 2] are at times [K], NaN left out, and the mean distance to it."""
    is_there = np.isfinite(at_s) & (weight > 0)
    if not is_there.any():
        return None, None
    chosen, at_s = track_m[is_there], at_s[is_there]
    left, right, share = steps_around(time_s, at_s)
    rows = np.arange(len(at_s))
    point = between_steps(chosen[rows, left], chosen[rows, right], share)
    known = np.isfinite(point).all(-1)
    if not known.any():
        return None, None
    middle, spread_m = medoid(point[known], weight[is_there][known])
    x, y = point[known][middle].tolist()
    return (x, y), spread_m
