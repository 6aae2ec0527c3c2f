"""Numbers and choices of the page: envelopes, spread, errors against truth, moments worth a picture, runs of bad windows.

Letters of the shapes: K hypothesis, T time step, D space (2).
"""

from dataclasses import dataclass
from itertools import groupby

import numpy as np

from cadence.arrays import Bools, Float64s, Int64s
from pipeline.report.mission import Fan, Mission, Points, WindowRow
from pipeline.tracks import interpolated

LEVELS = (0.5, 0.9)
"""Shares of the weight that the two envelopes hold."""

SMALL_M2 = 1e-6
"""Added to variances (1 mm²): exact detections leave no spread, and a point must still have an inside."""

_GAP_FACTOR = 3.0
"""Truth is not interpolated in gaps of over so many times its median interval."""


@dataclass(frozen=True, eq=False)
class FanShape:
    """The hypotheses of one agent in one window, summed up at every step.

    mean_m [T, 2] weighted mean; axes_m [T, 2] and angle_rad [T]: standard deviations along the principal axes and the
    direction of the first; radius [2, T]: how many of them the envelopes of `LEVELS` reach
    """

    mean_m: Float64s
    axes_m: Float64s
    angle_rad: Float64s
    radius: Float64s

    @property
    def spread_m(self) -> Float64s:
        """Root mean square distance to the mean [T]."""
        return np.asarray(np.hypot(self.axes_m[:, 0], self.axes_m[:, 1]))


def shape_of(fan: Fan) -> FanShape:
    """Weighted mean, principal axes and the empirical envelopes of a fan.

    An envelope is, at every step, the smallest ellipse with the axes of the weighted covariance that holds the share of
    the weight.
    """
    offset_m = fan.offset_m.astype(np.float64)
    mean_m = np.einsum("k,ktd->td", fan.weight, offset_m)
    centred = offset_m - mean_m
    covariance = np.einsum("k,ktd,kte->tde", fan.weight, centred, centred)
    variance, axes = np.linalg.eigh(covariance)
    variance = np.maximum(variance, 0.0)
    along = np.einsum("ktd,tde->kte", centred, axes)
    distance = np.sqrt((along**2 / (variance + SMALL_M2)).sum(axis=-1))
    order = np.argsort(distance, axis=0, kind="stable")
    held = np.cumsum(fan.weight[order], axis=0)
    # The first hypothesis at which the share is reached; the small number forgives the rounding of the sum.
    radius = [
        np.take_along_axis(np.take_along_axis(distance, order, 0), (held >= level - 1e-9).argmax(0)[None], 0)[0]
        for level in LEVELS
    ]
    major = axes[:, :, 1]
    return FanShape(mean_m + fan.datum_m, np.sqrt(variance[:, ::-1]), np.arctan2(major[:, 1], major[:, 0]), np.stack(radius))


@dataclass(frozen=True)
class TruthScore:
    """Quick figures against truth over the steps of the past or of the future."""

    num_steps: int
    mean_error_m: float
    median_error_m: float
    coverage: float


def interpolate_truth(truth: Points, time_ns: Int64s) -> Float64s:
    """Truth of one agent at `time_ns` [T, 2]; NaN outside it, inside wide gaps, and where there is but one point."""
    if len(truth) < 2:
        return np.full((len(time_ns), 2), np.nan)
    return interpolated(truth.time_ns, truth.position_m, time_ns, _GAP_FACTOR * float(np.median(np.diff(truth.time_ns))))


def truth_errors(fan: Fan, shape: FanShape, truth: Points) -> tuple[Float64s, Bools]:
    """Distance from the mean to truth [T] (NaN where truth is silent) and whether the 90 % envelope holds truth [T]."""
    difference = interpolate_truth(truth, fan.time_ns) - shape.mean_m
    turn = np.stack([np.cos(shape.angle_rad), np.sin(shape.angle_rad)])
    along = difference[:, 0] * turn[0] + difference[:, 1] * turn[1]
    across = difference[:, 1] * turn[0] - difference[:, 0] * turn[1]
    distance = np.sqrt(along**2 / (shape.axes_m[:, 0] ** 2 + SMALL_M2) + across**2 / (shape.axes_m[:, 1] ** 2 + SMALL_M2))
    return np.hypot(along, across), distance <= shape.radius[1]


@dataclass(frozen=True, eq=False)
class Analysis:
    """What was computed over all fans.

    By position in `Mission.fans`: spread_now_m at the origin, spread_end_m at the last step, error_now_m of the mean at
    the origin (NaN where truth is silent). past, future: scores against truth, None without any.
    """

    spread_now_m: Float64s
    spread_end_m: Float64s
    error_now_m: Float64s
    past: TruthScore | None
    future: TruthScore | None


class Analyser:
    """Collects the numbers of one fan after the other, so that shapes need not all be kept."""

    def __init__(self, mission: Mission) -> None:
        self._truth = {agent: mission.truth.of(agent) for agent in range(len(mission.agents))} if mission.truth else {}
        self._detected_ns = [mission.detections.of(agent).time_ns for agent in range(len(mission.agents))]
        self._now: list[float] = []
        self._end: list[float] = []
        self._error: list[float] = []
        self._errors: tuple[list[Float64s], list[Float64s]] = ([], [])
        self._inside: tuple[list[Bools], list[Bools]] = ([], [])

    def add(self, fan: Fan, shape: FanShape) -> None:
        """Count one fan."""
        spread_m = shape.spread_m
        self._now.append(float(spread_m[fan.origin_index]))
        self._end.append(float(spread_m[-1]))
        error = float("nan")
        if fan.agent in self._truth and len(self._truth[fan.agent]) > 1:
            errors, inside = truth_errors(fan, shape, self._truth[fan.agent])
            errors[fan.time_ns < self._first_ns(fan)] = np.nan
            error = float(errors[fan.origin_index])
            for side, part in enumerate((slice(None, fan.origin_index + 1), slice(fan.origin_index + 1, None))):
                known = np.isfinite(errors[part])
                self._errors[side].append(errors[part][known])
                self._inside[side].append(inside[part][known])
        self._error.append(error)

    def _first_ns(self, fan: Fan) -> int:
        """The first detection in the window: as in evaluate, steps before it are not compared."""
        time_ns = self._detected_ns[fan.agent]
        place = int(np.searchsorted(time_ns, fan.time_ns[0]))
        return int(time_ns[place]) if place < len(time_ns) else int(fan.origin_ns)

    def result(self) -> Analysis:
        """The numbers so far."""
        scores = []
        for errors, inside in zip(self._errors, self._inside, strict=True):
            joined = np.concatenate(errors) if errors else np.empty(0)
            held = np.concatenate(inside) if inside else np.empty(0)
            scores.append(
                TruthScore(len(joined), float(joined.mean()), float(np.median(joined)), float(held.mean()))
                if len(joined)
                else None
            )
        return Analysis(np.array(self._now), np.array(self._end), np.array(self._error), scores[0], scores[1])


@dataclass(frozen=True)
class Moment:
    """A fan worth a picture, and why."""

    fan: int
    reason: str


def choose_moments(mission: Mission, analysis: Analysis, count: int) -> tuple[Moment, ...]:
    """At most `count` moments in the order of time; one that is chosen for two reasons names both."""
    fans = mission.fans
    if not fans:
        return ()
    row_of = {(row.window, row.agent): row for row in mission.rows}
    ages = np.array([_age(row_of.get((fan.window, fan.agent))) for fan in fans])
    origins = np.array([fan.origin_ns for fan in fans])
    # Windows before an agent's second detection are wide for want of data, which says nothing about the mission.
    is_seen = np.array([_detections(row_of.get((fan.window, fan.agent))) > 1 for fan in fans])
    now = np.where(is_seen | ~is_seen.any(), analysis.spread_now_m, np.nan)
    end = np.where(is_seen | ~is_seen.any(), analysis.spread_end_m, np.nan)
    wanted = [
        ("widest at the origin", _largest(now)),
        ("longest without a detection", _largest(ages)),
        ("largest error of the mean at the origin", _largest(analysis.error_now_m)),
        ("typical spread", int(np.argsort(analysis.spread_now_m, kind="stable")[len(fans) // 2])),
        ("widest future", _largest(end)),
        ("last window", _largest(np.where(origins == origins.max(), np.nan_to_num(analysis.spread_now_m), np.nan))),
        ("first window", _largest(np.where(origins == origins.min(), np.nan_to_num(analysis.spread_now_m), np.nan))),
        ("narrowest at the origin", int(np.argmin(analysis.spread_now_m))),
    ]
    reasons: dict[int, list[str]] = {}
    for reason, fan in wanted:
        if fan is not None and (fan in reasons or len(reasons) < count):
            reasons.setdefault(fan, []).append(reason)
    ordered = sorted(reasons.items(), key=lambda item: (fans[item[0]].origin_ns, item[0]))
    return tuple(Moment(fan, " and ".join(found).capitalize()) for fan, found in ordered)


def _age(row: WindowRow | None) -> float:
    return row.age_s if row is not None and row.age_s is not None else float("nan")


def _detections(row: WindowRow | None) -> int:
    return row.num_detections if row is not None else 0


def _largest(values: Float64s) -> int | None:
    return int(np.nanargmax(values)) if np.isfinite(values).any() else None


@dataclass(frozen=True)
class Trouble:
    """Consecutive windows of one agent that share a status other than ok."""

    agent: int
    status: str
    advice: str
    first: WindowRow
    last: WindowRow
    count: int


def find_troubles(mission: Mission) -> tuple[Trouble, ...]:
    """Runs of windows with a status other than ok, in the order of time."""
    place = {window: index for index, window in enumerate(mission.origins_ns)}
    bad = sorted(
        (row for row in mission.rows if row.status != "ok"),
        key=lambda row: (row.agent, row.status, row.advice, place[row.window]),
    )
    troubles = []
    # Neighbours keep the difference between their place and their rank: the classical key of runs.
    for _, group in groupby(
        enumerate(bad), key=lambda item: (item[1].agent, item[1].status, item[1].advice, place[item[1].window] - item[0])
    ):
        run = [row for _, row in group]
        troubles.append(Trouble(run[0].agent, run[0].status, run[0].advice, run[0], run[-1], len(run)))
    return tuple(sorted(troubles, key=lambda trouble: (trouble.first.origin_ns, trouble.agent)))


def share_of_steps(mission: Mission) -> float | None:
    """Share of the steps between an agent's first and last detection that hold at least one; None without any."""
    if not mission.fans:
        return None
    step_ns = mission.fans[0].step_ns
    seen = total = 0
    for agent in range(len(mission.agents)):
        time_ns = mission.detections.of(agent).time_ns
        if len(time_ns):
            step = (time_ns - time_ns[0]) // step_ns
            seen += len(np.unique(step))
            total += int(step[-1]) + 1
    return seen / total if total else None


SHARES = (1.0, 0.5, 0.25, 0.125)
MAX_TURNS = 2.5
"""Path length over the diagonal of its box beyond which drawn tracks are a ball of wool: a circle has 2.2."""


def shown_share(mission: Mission) -> float:
    """The largest of `SHARES` of a window's past and future whose tracks do not yet cover themselves again and again."""
    fans = mission.fans[:: max(1, len(mission.fans) // 100)]
    for share in SHARES:
        path = diagonal = 0.0
        for fan in fans:
            first, last = shown_steps(fan, share)
            track_m = fan.offset_m[int(fan.weight.argmax()), first : last + 1].astype(np.float64)
            path += float(np.hypot(*np.diff(track_m, axis=0).T).sum())
            diagonal += float(np.hypot(*np.ptp(track_m, axis=0)))
        if path <= MAX_TURNS * diagonal:
            return share
    return SHARES[-1]


def shown_steps(fan: Fan, share: float) -> tuple[int, int]:
    """First and last step of a share of the past and of the future, at least one step of each that is there."""
    last = fan.offset_m.shape[1] - 1
    back, ahead = (int(np.ceil(share * steps)) for steps in (fan.origin_index, last - fan.origin_index))
    return fan.origin_index - back, fan.origin_index + ahead
