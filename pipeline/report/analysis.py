"""Numbers and choices of the page: spread, speeds, errors, moments worth a picture, runs of bad windows."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from cadence.arrays import Float64s
from pipeline.report.mission import LIKELY, Fan, Mission, WindowRow
from pipeline.report.scored import Scored, errors_now
from pipeline.report.shapes import spread_at

_ROUNDING = 1e-3
"""Tracks are stored as float32: a speed that is over a limit by less than this share keeps it."""


@dataclass(frozen=True, eq=False)
class Speeds:
    """How fast the tracks are, a track being one hypothesis of one agent in one window.

    limit_mps  that none should exceed: stated by the user, or else plausible by the log's own detections; None where neither is
    known. num_over of num_tracks have a segment that exceeds it; fastest_mps is the fastest segment of all.
    """

    limit_mps: float | None
    is_stated: bool
    num_tracks: int
    num_over: int
    fastest_mps: float


@dataclass(frozen=True, eq=False)
class Analysis:
    """What was computed over all fans.

    By position in `Mission.fans`: spread_now_m at the window's moment, spread_end_m at the last step, error_now_m mean distance
    of a hypothesis from the truth at the moment (NaN where the truth is silent). scored: against the truth, or why not.
    """

    spread_now_m: Float64s
    spread_end_m: Float64s
    error_now_m: Float64s
    speeds: Speeds
    scored: Scored | str


def analyse(mission: Mission, scored: Scored | str, after_fan: Callable[[int], object]) -> Analysis:
    """The numbers over all fans; `after_fan` is called for each."""
    errors = errors_now(scored)
    true_agent = {} if isinstance(scored, str) else scored.true_agent
    spread_m, error_m, fastest_mps = np.zeros((len(mission.fans), 2)), np.full(len(mission.fans), np.nan), []
    for index, fan in enumerate(mission.fans):
        spread_m[index] = spread_at(fan, [fan.origin_index, -1])
        key = fan.window, mission.agents[fan.agent]
        error_m[index] = errors.get((fan.window, true_agent.get(key, "")), np.nan)
        fastest_mps.append(_fastest_mps(fan))
        after_fan(1)
    joined = np.concatenate(fastest_mps) if fastest_mps else np.zeros(0)
    return Analysis(spread_m[:, 0], spread_m[:, 1], error_m, _speeds(mission, joined), scored)


def _fastest_mps(fan: Fan) -> Float64s:
    """Speed of the fastest segment of each hypothesis [K]."""
    step = np.diff(fan.offset_m, axis=1)
    length_m: Float64s = np.sqrt((step**2).sum(axis=-1).max(axis=1, initial=0.0)).astype(np.float64)
    return length_m / (fan.step_ns / 1e9)


def _speeds(mission: Mission, fastest_mps: Float64s) -> Speeds:
    infer = mission.manifests.get("infer", {})
    config, summary = infer.get("config") or {}, infer.get("summary") or {}
    stated = (config.get("guidance") or {}).get("max_speed_mps")
    limit = stated if stated is not None else summary.get("plausible_speed_mps")
    over = 0 if limit is None else int((fastest_mps > limit * (1 + _ROUNDING)).sum())
    return Speeds(limit, stated is not None, len(fastest_mps), over, float(fastest_mps.max(initial=0.0)))


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
    rows = [row_of.get((fan.window, fan.agent)) for fan in fans]
    is_there = np.array([row is None or row.probability is None or row.probability >= LIKELY for row in rows])
    is_there |= not is_there.any()
    ages, error_m = np.array([_age(row) for row in rows]), analysis.error_now_m
    now_m, end_m = (np.where(is_there, spread_m, np.nan) for spread_m in (analysis.spread_now_m, analysis.spread_end_m))
    origins = np.array([fan.origin_ns for fan in fans])
    known = int((np.isfinite(error_m) & is_there).sum())
    of = f" (of the {known:,} of {int(is_there.sum()):,} windows and agents whose truth is known at the moment)"
    wanted = [
        ("widest at its moment", _largest(now_m)),
        ("longest without a detection", _largest(np.where(is_there, ages, np.nan))),
        (f"furthest from the truth{of if known < is_there.sum() else ''}", _largest(np.where(is_there, error_m, np.nan))),
        ("typical spread", int(np.argsort(now_m, kind="stable")[is_there.sum() // 2])),
        ("widest future", _largest(end_m)),
        ("last window", _largest(np.where(origins == origins.max(), now_m, np.nan))),
        ("first window", _largest(np.where(origins == origins.min(), now_m, np.nan))),
        ("narrowest at its moment", _largest(-now_m)),
    ]
    reasons: dict[int, list[str]] = {}
    for reason, fan in wanted:
        if fan is not None and (fan in reasons or len(reasons) < count):
            reasons.setdefault(fan, []).append(reason)
    ordered = sorted(reasons.items(), key=lambda item: (fans[item[0]].origin_ns, item[0]))
    return tuple(Moment(fan, " and ".join(found).capitalize()) for fan, found in ordered)


def _age(row: WindowRow | None) -> float:
    return row.age_s if row is not None and row.age_s is not None else float("nan")


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
