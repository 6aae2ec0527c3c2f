"""The filter: many association hypotheses of a stream side by side, each with its agents' Kalman filters.

Rao-Blackwellised particle data association (Särkkä, Vehtari, Lampinen, "Rao-Blackwellized particle filter for multiple target
tracking", 2007). Every one is continued by every agent that may have caused the next detection, and of all continuations the
best are kept and the others drawn from (`resampling`), which is the optimal importance distribution without its noise. Those
that have become alike are one from then on (`history`).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from cadence.arrays import Bools, Float64s, Int64s
from cadence.association.history import Ending, Step, drawn_associations, grouped, recently, step_of
from cadence.association.presence import Habits, log_hazards, log_silence_between
from cadence.association.tracks import Detection, Tracks, log_densities, updated
from cadence.association.types import CLUTTER
from cadence.resampling import resample

NUM_RECENT = 3
"""An agent's last detections from which its future follows: older ones say little that these do not."""

_NEGLIGIBLE = 1e-6
"""Hypotheses of less weight are given up even where there is room: a clear stretch of a stream needs few."""


@dataclass(frozen=True, eq=False)
class Stream:
    """N detections of unknown origin, oldest first.

    time_s        [N] seconds, non-decreasing
    position_m    [N, 2]
    covariance_m2 [N, 2, 2] symmetric positive semi-definite
    """

    time_s: Float64s
    position_m: Float64s
    covariance_m2: Float64s

    def __post_init__(self) -> None:
        n = len(self.time_s)
        if self.time_s.shape != (n,) or self.position_m.shape != (n, 2) or self.covariance_m2.shape != (n, 2, 2):
            shapes = [self.time_s.shape, self.position_m.shape, self.covariance_m2.shape]
            raise ValueError(f"Stream: shapes {shapes}, expected [N], [N, 2] and [N, 2, 2]")
        if np.any(np.diff(self.time_s) < 0):
            raise ValueError("Stream.time_s must not decrease")

    def __getitem__(self, detections: slice) -> "Stream":
        """A stretch of the stream."""
        return Stream(self.time_s[detections], self.position_m[detections], self.covariance_m2[detections])


@dataclass(frozen=True, eq=False)
class Particles:
    """P association hypotheses of the first N detections, each with all pasts that led to it.

    weight        [P] sums to one
    tracks        what each one knows of its agents, which it numbers by itself
    recent        [P, A, L] the last detections of each agent, oldest first, -1 for none
    steps         [N] how the particles came about
    log_evidence  log density of the detections so far
    """

    weight: Float64s
    tracks: Tracks
    recent: Int64s
    steps: list[Step]
    log_evidence: float

    def associations(self, particle: Int64s, generator: np.random.Generator) -> Int64s:
        """Labels [M, N] of one hypothesis for each of M particles, drawn from its pasts."""
        return drawn_associations(self.steps, [Ending(len(self.steps), particle, generator)])[0]


def follow(stream: Stream, habits: Habits, num_particles: int, seed: int, num_recent: int = NUM_RECENT) -> Iterator[Particles]:
    """The particles before the first detection and after each one: N + 1 times, each valid until the next is asked for.

    Hypotheses that agree on the last `num_recent` detections of every agent are one particle.
    """
    generator = np.random.default_rng(seed)
    recent = np.zeros((1, 0, num_recent), dtype=np.int64)
    particles = Particles(np.ones(1), Tracks.none(len(habits.modes)), recent, [], 0.0)
    yield particles
    floor = habits.floor_m**2 * np.eye(2)
    before_s = 0.0
    since_s = stream.time_s - stream.time_s[:1]
    for time_s, position_m, covariance_m2 in zip(since_s, stream.position_m, stream.covariance_m2, strict=True):
        seen = Detection(float(time_s), position_m, covariance_m2 + floor)
        particles = _next(particles, habits, seen, before_s, num_particles, float(generator.random()))
        before_s = seen.time_s
        yield particles


def _next(
    particles: Particles, habits: Habits, seen: Detection, before_s: float, num_particles: int, uniform: float
) -> Particles:
    """The particles after one more detection."""
    tracks = particles.tracks
    likelihood = continuations(tracks, habits, seen, before_s) + np.log(particles.weight)[:, None]
    peak = float(likelihood.max())
    weight = np.exp(likelihood - peak)
    total = float(weight.sum())
    share = weight.ravel() / total
    flat = np.flatnonzero(share >= _NEGLIGIBLE)
    parent, column = np.divmod(flat, weight.shape[1])
    num_slots = weight.shape[1] - 2
    agent = np.where(column == num_slots, tracks.num_agents[parent], np.where(column > num_slots, CLUTTER, column))
    recent = _with_room(particles.recent, int(agent.max(initial=CLUTTER)) + 1)[parent]
    recent = recently(recent, agent, len(particles.steps))
    group, order = grouped(recent)
    group_share = np.bincount(group, share[flat])
    kept, new_weight = resample(group_share / group_share.sum(), num_particles, uniform)
    child = np.full(len(group_share), -1)
    child[kept] = np.arange(len(kept))
    step, heaviest = step_of(share[flat], parent, agent, group, order, child)
    particles.steps.append(step)
    log_evidence = particles.log_evidence + peak + float(np.log(total))
    after = updated(tracks[parent[heaviest]], habits.modes, seen, agent[heaviest], habits.rate_memory)
    return Particles(new_weight, after, recent[heaviest], particles.steps, log_evidence)


def _with_room(recent: Int64s, num_slots: int) -> Int64s:
    """The same with room for so many agents at least."""
    more = num_slots - recent.shape[1]
    return recent if more <= 0 else np.pad(recent, [(0, 0), (0, more), (0, 0)], constant_values=-1)


def continuations(tracks: Tracks, habits: Habits, seen: Detection, before_s: float) -> Float64s:
    """Log density [P, A + 2] of the silence up to the detection and of the detection from each agent, a new one, or nobody."""
    out = log_hazards(tracks, habits, seen.time_s) + log_silence_between(tracks, habits, before_s, seen.time_s)[:, None]
    out[:, :-2] += (habits.temper * log_densities(tracks, habits.modes, seen))[tracks.row]
    out[:, -2:] -= habits.temper * np.log(habits.area_m2)
    if habits.max_speed_mps is not None:
        out[:, :-2][is_too_fast(tracks, habits, seen)[tracks.row]] = -np.inf
    return out


def is_too_fast(tracks: Tracks, habits: Habits, seen: Detection) -> Bools:
    """Tracks [R] that would have to exceed the speed limit by more than four standard deviations to be seen here."""
    place = (np.exp(tracks.log_share)[..., None] * tracks.mean[..., :2]).sum(-2)
    variance = tracks.covariance[..., 0, 0].max(-1) + tracks.covariance[..., 1, 1].max(-1) + np.trace(seen.covariance_m2)
    way_m = np.sqrt(((seen.position_m - place) ** 2).sum(-1))
    return np.asarray(way_m > (habits.max_speed_mps or np.inf) * (seen.time_s - tracks.last_s) + 4.0 * np.sqrt(variance))
