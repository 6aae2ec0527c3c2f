"""Whether two detections, or two tracks, are of one target: what the stories say about it, and what they cannot."""

from dataclasses import dataclass

import numpy as np

from cadence.answers.estimates import Law, Probability, law, probability, wilson
from cadence.arrays import Bools, Float64s, Indices
from cadence.stories import Stories


@dataclass(frozen=True)
class SameDetections:
    """How likely one agent caused both of two detections.

    value         its probability; low and high its 95 % Monte Carlo interval, num_effective stories of equal weight
    likeliest     agents to which the stories give the first and the second, with these probabilities
    """

    value: float
    low: float
    high: float
    num_effective: float
    likeliest: tuple[tuple[str, float], tuple[str, float]]


@dataclass(frozen=True)
class SameTracks:
    """Whether two agents may be one target.

    apart       they were further apart than `tolerance_m` at one time: then they are two
    overlap_s   time during which both are there, in the middle story
    gap_s, speed_mps  time from the end of the earlier to the beginning of the later, and the speed that this would have
                needed, where they are never there together
    usual_mps   speeds of the two over as long a time (both together)
    as_fast     how likely one of them goes as fast within so long a time
    """

    apart: Probability
    tolerance_m: float
    overlap_s: float
    gap_s: Law | None
    speed_mps: Law | None
    usual_mps: Law | None
    as_fast: Probability | None


def same_detections(
    stories: Stories, time_s: Float64s, position_m: Float64s, covariance_m2: Float64s, clutter_density: float
) -> SameDetections:
    """How likely two detections are of one agent, by which agents' tracks pass through both.

    In each story a detection belongs to agent a with the likelihood N(position; track of a, covariance), or to none with
    `clutter_density` (per square metre); stories count by their weight.

    Args:
        stories: all of them, in which the agents may be as uncertain as they like.
        time_s: of the two detections, [2].
        position_m: of the two detections, [2, 2].
        covariance_m2: of the two detections, [2, 2, 2], positive definite.
        clutter_density: of detections that nobody caused, where an agent could be.
    """
    at_m = stories.at(time_s)  # [K, A, 2, 2]
    delta = at_m - position_m
    exponent = np.einsum("kanx,nxy,kany->kan", delta, np.linalg.inv(covariance_m2), delta)
    height = 1.0 / (2.0 * np.pi * np.sqrt(np.linalg.det(covariance_m2)))
    likelihood = np.where(np.isfinite(exponent), height * np.exp(-0.5 * np.nan_to_num(exponent)), 0.0)
    share = likelihood / np.maximum(likelihood.sum(axis=1, keepdims=True) + clutter_density, np.finfo(np.float64).tiny)
    both = (share[..., 0] * share[..., 1]).sum(axis=1)
    value = float(stories.weight @ both)
    num = 1.0 / float(np.square(stories.weight).sum())
    mean = np.einsum("k,kan->an", stories.weight, share)
    best = mean.argmax(axis=0)
    first, second = ((stories.agent_ids[int(a)], float(mean[a, n])) for n, a in enumerate(best))
    return SameDetections(value, *wilson(min(max(value, 0.0), 1.0), num), num, (first, second))


def same_tracks(stories: Stories, one: int, other: int, tolerance_m: float) -> SameTracks:
    """Whether agents number `one` and `other` can be one target: never apart while both are there, or near enough in time."""
    weight, position_m, time_s = stories.weight, stories.position_m, stories.time_s
    is_there = stories.is_present
    both = is_there[:, one] & is_there[:, other]
    apart_m = np.where(both, np.hypot(*np.moveaxis(position_m[:, one] - position_m[:, other], -1, 0)), 0.0)
    apart = probability(weight, apart_m.max(axis=1) > tolerance_m)
    step_s = np.diff(time_s, prepend=time_s[0])
    overlap_s = float(weight @ (both * step_s).sum(axis=1))
    begin, end = (_ends(is_there[:, agent], time_s) for agent in (one, other))
    is_first = begin[1] <= end[0]
    gap_s = np.where(both.any(1), np.nan, np.where(is_first, end[0] - begin[1], begin[0] - end[1]))
    if not np.isfinite(gap_s).any():
        return SameTracks(apart, tolerance_m, overlap_s, None, None, None, None)
    rows = np.arange(len(weight))
    leaves = np.where(is_first[:, None], position_m[rows, one, begin[3]], position_m[rows, other, end[3]])
    comes = np.where(is_first[:, None], position_m[rows, other, end[2]], position_m[rows, one, begin[2]])
    needed = np.hypot(*(comes - leaves).T) / np.maximum(gap_s, 1e-9)
    usual = np.fmax(*(_fastest(stories, agent, float(np.nanmedian(gap_s))) for agent in (one, other)))
    known = np.isfinite(needed) & np.isfinite(usual)
    as_fast = probability(weight[known], usual[known] >= needed[known]) if known.any() else None
    return SameTracks(apart, tolerance_m, overlap_s, law(weight, gap_s), law(weight, needed), law(weight, usual), as_fast)


def _ends(is_there: Bools, time_s: Float64s) -> tuple[Float64s, Float64s, Indices, Indices]:
    """First and last time [K] at which tracks [K, T] are there, NaN for never, and the steps of both [K]."""
    first, last = is_there.argmax(axis=1), is_there.shape[1] - 1 - is_there[:, ::-1].argmax(axis=1)
    never = ~is_there.any(axis=1)
    return np.where(never, np.nan, time_s[first]), np.where(never, np.nan, time_s[last]), first, last


def _fastest(stories: Stories, agent: int, over_s: float) -> Float64s:
    """The largest mean speed [K] of an agent over any time of `over_s`; over all of its time where that is shorter; m/s."""
    time_s = stories.time_s
    track = stories.position_m[:, agent]
    later = np.searchsorted(time_s, time_s + over_s)
    usable = later < len(time_s)
    if not usable.any():
        usable, later = np.arange(len(time_s)) == 0, np.full(len(time_s), len(time_s) - 1)
    lag_s = np.maximum(time_s[later[usable]] - time_s[usable], 1e-9)
    speed = np.hypot(*np.moveaxis(track[:, later[usable]] - track[:, usable], -1, 0)) / lag_s
    known = np.isfinite(speed)
    return np.where(known.any(1), np.where(known, speed, 0.0).max(axis=1), np.nan)
