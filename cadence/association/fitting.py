"""What is typical of a stream, found from its detections alone (empirical Bayes): ways to move, rates of detection, clutter.

The filter begins with ways to move of every scale. Expectation maximisation over its agents finds how often each is met, and
those that are not met are left out. Where the number of agents or the share of clutter is unknown the likelihood of the stream
chooses where to begin: a stream that is thought clean makes an agent of every false detection, and goes on doing so.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np

from cadence.arrays import Float64s
from cadence.association.motion import Modes
from cadence.association.particles import Particles, Stream, follow
from cadence.association.presence import Habits, left_by
from cadence.association.tracks import Tracks
from cadence.association.types import CLUTTER, AssociationConfig

_RELAXATIONS = (0.3, 2.0, 12.0, 72.0)
_SPEEDS = tuple(3.0 ** -np.arange(8.0))
"""Ways to move in units of the mean time between two detections of an agent, and of the stream's extent in that time."""
_SWITCH_SHARE = 0.2
_TEMPER = 0.6
"""Chosen on simulated episodes for P(detection -> agent) that comes true as often as it says."""
_FLOOR = 1e-5
"""No detection counts as more exact than this share of the stream's extent."""
_LEAST_CLUTTER = 1e-6
"""A detection that fits nobody must not rule out all hypotheses, whatever the settings say."""
_NUM_AGENTS = (3, 10, 30)
_CLUTTER_SHARES = (0.01, 0.2)
_CLUTTER_COUNT = 0.5
"""False detections that are thought to be in a stream before anything is known of it."""
_FIRST_DEPARTURES = 0.5
"""How many agents are thought to leave within a log before anything is known."""
_RATE_WEIGHTS = (2.0, 5.0, 15.0, 50.0)
_RATE_MEMORIES = (0.75, 0.9, 1.0)
_NUM_PARTICLES, _NUM_ROUNDS = 16, 3
_NUM_FIRST, _MAX_DETECTIONS = 150, 400
"""So many detections choose among beginnings, in which agents may move in any way, which is slow; so many are fitted to."""
_LEAST_SHARE, _PSEUDO_COUNT = 0.02, 4.0


def num_steps_to_fit(num_detections: int, config: AssociationConfig) -> int:
    """How often `fit_habits` looks at a detection."""
    num_shares = 1 if config.clutter_share is not None else len(_CLUTTER_SHARES)
    num_first = num_shares * (1 if config.num_agents is not None else len(_NUM_AGENTS))
    num_runs = num_shares + _NUM_ROUNDS - 2
    return num_first * min(num_detections, _NUM_FIRST) + num_runs * min(num_detections, _MAX_DETECTIONS)


def fit_habits(
    stream: Stream,
    config: AssociationConfig,
    seed: int,
    max_speed_mps: float | None = None,
    on_step: Callable[[], object] = int,
) -> Habits:
    """The habits of greatest likelihood for a stream; any sensible ones for a stream that says nothing.

    `on_step` hears of each of the steps that `num_steps_to_fit` counts.
    """
    first, part = stream[:_NUM_FIRST], stream[:_MAX_DETECTIONS]
    numbers = _NUM_AGENTS if config.num_agents is None else (config.num_agents,)
    shares = _CLUTTER_SHARES if config.clutter_share is None else (config.clutter_share,)
    tried = [[_first_habits(stream, config, number, share, max_speed_mps) for number in numbers] for share in shares]
    if len(stream.time_s) < 2:
        return tried[0][len(numbers) // 2]
    is_counted = config.clutter_share is None
    rounds = []
    for group in tried:
        habits = _improved(*_likeliest(first, group, seed, on_step), first, is_counted)
        rounds.append((habits, _run(part, habits, seed, on_step)))
    habits, run = max(rounds, key=lambda round_: round_[1][0].log_evidence)
    for _ in range(_NUM_ROUNDS - 2):
        habits = _improved(habits, run, part, is_counted)
        run = _run(part, habits, seed, on_step)
    return _improved(habits, run, part, is_counted)


_Run = tuple[Particles, Float64s]
"""The particles after a whole stream, and how much each mode was used [C]."""


def _likeliest(stream: Stream, tried: Sequence[Habits], seed: int, on_step: Callable[[], object]) -> tuple[Habits, _Run]:
    runs = ((habits, _run(stream, habits, seed, on_step)) for habits in tried)
    return max(runs, key=lambda found: found[1][0].log_evidence)


def _first_habits(
    stream: Stream, config: AssociationConfig, num_agents: int, clutter_share: float, max_speed_mps: float | None
) -> Habits:
    """Habits of a stream of so many agents that may move in any way."""
    num, sizes = max(len(stream.time_s), 1), np.ptp(stream.position_m, axis=0) if len(stream.time_s) else np.ones(2)
    noise_m = math.sqrt(float(np.trace(stream.covariance_m2.mean(0)))) if len(stream.time_s) else 0.0
    extent_m = max(float(np.hypot(*sizes)), noise_m, 1e-3)
    span_s = max(float(np.ptp(stream.time_s)) if len(stream.time_s) else 1.0, 1e-3)
    gap_s = span_s * num_agents / num
    pairs = [(relaxation * gap_s, speed * extent_m / gap_s) for relaxation in _RELAXATIONS for speed in _SPEEDS]
    relaxation_s, speeds_mps = np.array(pairs).T
    share = np.full(len(pairs), 1.0 / len(pairs))
    is_known = config.num_agents is not None
    return Habits(
        modes=Modes(relaxation_s, speeds_mps, share, _SWITCH_SHARE),
        rate_hz=1.0 / gap_s,
        rate_weight=_RATE_WEIGHTS[1],
        rate_memory=_RATE_MEMORIES[1],
        leave_hz=0.0 if is_known else _FIRST_DEPARTURES / span_s,
        num_present=float(num_agents),
        clutter_hz=max(clutter_share, _LEAST_CLUTTER) * num / span_s,
        area_m2=float(np.prod(np.maximum(sizes, 0.1 * extent_m))),
        temper=_TEMPER,
        floor_m=_FLOOR * extent_m,
        num_agents=config.num_agents,
        max_agents=config.max_agents,
        max_speed_mps=max_speed_mps,
    )


def _run(stream: Stream, habits: Habits, seed: int, on_step: Callable[[], object]) -> _Run:
    usage = np.zeros(len(habits.modes))
    switch, share = habits.modes.switch_share, habits.modes.share
    for number, particles in enumerate(follow(stream, habits, _NUM_PARTICLES, seed), -1):
        is_seen_again = (particles.recent[..., -1] == number) & (particles.recent[..., -2] >= 0)
        row, agent = np.nonzero(is_seen_again)
        after = np.exp(particles.tracks.log_share[particles.tracks.row[row, agent]])
        before_switch = (after - switch * share) / (1.0 - switch)
        usage += (particles.weight[row, None] * before_switch).sum(0)
        if number >= 0:
            on_step()
    return particles, usage


def _improved(habits: Habits, run: _Run, stream: Stream, is_clutter_counted: bool) -> Habits:
    """Habits after one round: modes as often as they were used, rates as one history of the likeliest particle counts them."""
    particles, usage = run
    share = usage + _PSEUDO_COUNT / len(usage)
    share = share / share.sum()
    is_used = share >= _LEAST_SHARE
    modes = habits.modes
    modes = Modes(
        modes.relaxation_s[is_used], modes.speed_mps[is_used], share[is_used] / share[is_used].sum(), modes.switch_share
    )
    best = np.array([particles.weight.argmax()])
    label = particles.associations(best, np.random.default_rng(0))[0]
    if is_clutter_counted:
        span_s = max(float(np.ptp(stream.time_s)), 1e-3)
        habits = dataclasses.replace(habits, clutter_hz=(float((label == CLUTTER).sum()) + _CLUTTER_COUNT) / span_s)
    gaps_s = [np.diff(stream.time_s[label == agent]) for agent in range(int(label.max()) + 1)]
    watched_s, again = sum(float(gap.sum()) for gap in gaps_s), sum(map(len, gaps_s))
    if again < 1 or watched_s <= 0:
        return dataclasses.replace(habits, modes=modes)
    if habits.num_agents is None:
        habits = _with_rates(habits, particles.tracks[best], again / watched_s, watched_s, float(np.ptp(stream.time_s)))
    rate_hz, laws = habits.rate_hz, itertools.product(_RATE_WEIGHTS, _RATE_MEMORIES)
    weight, memory = max(laws, key=lambda law: _log_density(gaps_s, rate_hz, *law))
    return dataclasses.replace(habits, modes=modes, rate_weight=weight, rate_memory=memory)


def _with_rates(habits: Habits, tracks: Tracks, rate_hz: float, watched_s: float, span_s: float) -> Habits:
    """How often agents are detected, come and leave, as one association hypothesis counts it."""
    num = int(tracks.num_agents[0])
    left = left_by(tracks, habits, span_s)[0, :num]
    watched_s += float(((1.0 - left) * (span_s - tracks.last_s[tracks.row[0, :num]])).sum())
    leave_hz = (float(left.sum()) + _FIRST_DEPARTURES) / watched_s
    return dataclasses.replace(habits, rate_hz=rate_hz, leave_hz=leave_hz, num_present=num / (1.0 + leave_hz * span_s))


def _log_density(gaps_s: list[Float64s], rate_hz: float, weight: float, memory: float) -> float:
    """Log density of agents' gaps between detections, where each has a rate of its own (see `presence`)."""
    total = 0.0
    for gaps in gaps_s:
        repeats, watched_s = 0.0, 0.0
        for gap_s in gaps.tolist():
            count, time_s = weight + repeats, weight / rate_hz + watched_s
            total += math.log(count / time_s) - (count + 1.0) * math.log1p(gap_s / time_s)
            repeats, watched_s = 1.0 + memory * repeats, gap_s + memory * watched_s
    return total
