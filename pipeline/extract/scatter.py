"""How accurate detections are that do not say so, by how they scatter about smooth ways; and statements that cannot be meant.

White noise makes the same residual about a cubic through the neighbours at any stride, while that of a manoeuvre grows with the
stride; and sampled so fast that no vehicle could follow, residuals are no turns that were seen too rarely. Rows without a name
must be one target's: of several, each row would fit far better between some two of its neighbours than between the nearest.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from cadence.arrays import Float64s, Int64s
from pipeline.extract.positions import Positions
from pipeline.suspicions import Suspicions

_NEIGHBOURS: Final = (-2, -1, 1, 2)
_MAX_GAPS: Final = 3.0
"""Rows whose neighbours are further apart than so many median gaps say nothing."""
_MIN_RESIDUALS: Final = 20
_MIN_UNNAMED: Final = 40
_MAX_ROWS: Final = 4096
"""More rows of a track would not tell more."""
_WHITE: Final = (0.7, 1.3)
"""Residuals of twice the stride, in those of the stride: 1 for white noise, 1.4 for a random walk, more for manoeuvres."""
_MIN_MPS2: Final = 2.0
"""No vehicle changes its velocity by this much, at random, from each position to the next. An aircraft that circles between two
reports a few minutes apart scatters by kilometres, and accelerates by centimetres a second squared."""
_MIN_STEP_SHARE: Final = 0.1
"""Scatter below this share of a step hardly changes what is known of the motion; a rounded position is such."""
_MAX_ELONGATION: Final = 3.0
_MIN_NEAREST: Final = 0.7
_REACH: Final = 4
_MEDIAN: Final = 0.6745
"""Of the absolute values of a standard normal number."""
_MIN_VAGUE_M: Final = 100.0
_VAGUE_RATIO: Final = 1000.0
"""Smoothed positions scatter less than they are off, by a hundred times at most; by a thousand where a driver writes 1e6 m²."""
_SURE_RATIO: Final = 10.0


@dataclass(frozen=True)
class Scatter:
    """How one track's positions scatter: about smooth ways in metres an axis, and whether that is white noise."""

    sigma_m: float
    is_noise: bool


def with_scatter(
    rows: Positions, told_topics: Collection[str], has_default: bool, suspicions: Suspicions
) -> tuple[Positions, dict[str, float]]:
    """Detections [N], in metres, with a covariance where they state none and scatter; and those standard deviations by topic.

    `told_topics` have an accuracy of the user's, who with `has_default` has one for all others that state none. Statements that
    the scatter contradicts are not believed, and suspected.
    """
    found: dict[str, float] = {}
    covariance = rows.covariance_m2.copy()
    topics, agents = rows.topics.number, rows.agents.number
    for number in range(int(topics.max(initial=-1)) + 1):
        of_topic = topics == number
        topic = str(rows.topic[of_topic.argmax()])
        scatter = None if topic in told_topics else _of_topic(rows, agents, np.flatnonzero(of_topic))
        if scatter is None:
            continue
        is_stated = of_topic & ~np.isnan(covariance[:, 0])
        if suspicions.looks_for("covariance") and _is_contradicted(topic, rows.covariance_m2[is_stated], scatter, suspicions):
            covariance[is_stated] = np.nan
        is_open = of_topic & np.isnan(covariance[:, 0])
        if scatter.is_noise and is_open.any() and not has_default:
            covariance[is_open] = scatter.sigma_m**2 * np.array([1.0, 0.0, 1.0])
            found[topic] = scatter.sigma_m
    return rows.changed(covariance_m2=covariance), found


def _is_contradicted(topic: str, covariance_m2: Float64s, scatter: Scatter, suspicions: Suspicions) -> bool:
    if not len(covariance_m2):
        return False
    stated_m = float(np.sqrt(np.median(covariance_m2[:, [0, 2]].mean(axis=1))))
    is_vague = stated_m >= _MIN_VAGUE_M and stated_m > _VAGUE_RATIO * scatter.sigma_m
    is_sure = scatter.is_noise and scatter.sigma_m > _SURE_RATIO * stated_m
    if is_vague or is_sure:
        done = f"{scatter.sigma_m:.3g} m are taken" if scatter.is_noise else "taken as not stated"
        seen = f"a standard deviation of {stated_m:.3g} m is stated, but the detections scatter by {scatter.sigma_m:.3g} m"
        suspicions.add("covariance", topic, seen=seen, done=done, setting='extract.trusted = ["covariance"]')
    return is_vague or is_sure


def _of_topic(rows: Positions, agents: Int64s, of_topic: Int64s) -> Scatter | None:
    """The scatter of the detections `of_topic`: the median of its agents'; None where they tell of none."""
    order = of_topic[np.argsort(agents[of_topic], kind="stable")]
    found = []
    for track in np.split(order, np.flatnonzero(np.diff(agents[order])) + 1):
        is_named = bool(agents[track[0]] >= 0)
        track = track[:_MAX_ROWS]
        if is_named or len(np.unique(rows.message[track])) == len(track):
            track = track[np.argsort(rows.time_ns[track], kind="stable")]
            time_s = (rows.time_ns[track] - rows.time_ns[track[0]]) * 1e-9
            scatter = scatter_of(time_s, np.column_stack([rows.first[track], rows.second[track]]), is_named)
            found += [] if scatter is None else [scatter]
    return _median(found)


def _median(found: Sequence[Scatter]) -> Scatter | None:
    noisy = [scatter.sigma_m for scatter in found if scatter.is_noise]
    if not found:
        return None
    if 2 * len(noisy) > len(found):
        return Scatter(float(np.median(noisy)), True)
    return Scatter(float(np.median([scatter.sigma_m for scatter in found])), False)


def scatter_of(time_s: Float64s, position_m: Float64s, is_one: bool) -> Scatter | None:
    """The scatter of a track, by time [N], positions [N, 2]; None where there are too few rows, or more than one target's.

    `is_one`: the rows are known to be one target's.
    """
    is_new = np.diff(time_s, prepend=-np.inf) > 0
    time_s, position_m = time_s[is_new], position_m[is_new]
    if len(time_s) < (_MIN_RESIDUALS if is_one else _MIN_UNNAMED) + 8:
        return None
    near, far = (_residuals(time_s, position_m, stride) for stride in (1, 2))
    if min(len(near), len(far)) < _MIN_RESIDUALS:
        return None
    sigma_m, far_m = _scale(near), _scale(far)
    step_m = float(np.median(np.hypot(*np.diff(position_m, axis=0).T)))
    is_white = sigma_m > 0 and _WHITE[0] < far_m / sigma_m < _WHITE[1]
    is_jerky = np.sqrt(6) * sigma_m > _MIN_MPS2 * float(np.median(np.diff(time_s))) ** 2
    is_noise = is_white and is_jerky and sigma_m > _MIN_STEP_SHARE * step_m
    if not is_one and (not is_noise or not _are_of_one(time_s, position_m, near)):
        return None
    return Scatter(sigma_m, is_noise)


def _scale(residuals_m: Float64s) -> float:
    return float(np.median(np.abs(residuals_m))) / _MEDIAN


def _residuals(time_s: Float64s, position_m: Float64s, stride: int) -> Float64s:
    """Residuals [M, 2] about the cubic through two neighbours on either side, as large as the noise of one position is."""
    offsets = np.array(_NEIGHBOURS) * stride
    at = np.arange(2 * stride, len(time_s) - 2 * stride)
    times = time_s[at[:, None] + offsets]
    span_s = times[:, -1] - times[:, 0]
    is_near = span_s <= 4 * stride * _MAX_GAPS * float(np.median(np.diff(time_s)))
    return _about(time_s, position_m, at[is_near], offsets)


def _about(time_s: Float64s, position_m: Float64s, at: Int64s, offsets: Int64s) -> Float64s:
    """Residuals [M, 2] of rows `at` [M] about the polynomial through those at `offsets`, over the root of their variance."""
    places = at[:, None] + offsets
    times = time_s[places]
    weights = np.ones(places.shape)
    for one in range(len(offsets)):
        for other in range(len(offsets)):
            if one != other:
                weights[:, one] *= (time_s[at] - times[:, other]) / (times[:, one] - times[:, other])
    residuals = position_m[at] - np.einsum("mj,mjd->md", weights, position_m[places])
    return np.asarray(residuals / np.sqrt(1 + (weights**2).sum(axis=1))[:, None])


def _are_of_one(time_s: Float64s, position_m: Float64s, residuals_m: Float64s) -> bool:
    """Whether rows may be one target's: their noise is round, and not better explained by other two of the neighbours.

    What white noise of one target would give there is drawn, with a fixed seed, at the same times.
    """
    low, high = np.linalg.eigvalsh(np.cov(residuals_m.T))
    drawn = np.sqrt(np.mean(residuals_m**2)) * np.random.default_rng(0).standard_normal(position_m.shape)
    is_round = high < _MAX_ELONGATION * low
    return bool(is_round and _nearest(time_s, position_m) > _MIN_NEAREST * _nearest(time_s, drawn))


def _nearest(time_s: Float64s, position_m: Float64s) -> float:
    """Median distance of rows from the nearest of the lines between one of some rows before and one of some after."""
    at = np.arange(_REACH, len(time_s) - _REACH)
    reach = range(1, _REACH + 1)
    lines = [_about(time_s, position_m, at, np.array([-before, after])) for before in reach for after in reach]
    return float(np.median(np.min([np.hypot(*line.T) for line in lines], axis=0)))
