"""How often agents are detected, come and go: what is expected of the next detection before its position is looked at.

An agent is detected at a rate of its own until it leaves, after an exponential time. The rate has a gamma law around the
stream's rate, learned from the agent's detections, of which the latest count most where rates change: a ship at anchor reports
less often than one under way. Neither is sampled: that a silent agent may have left is part of how unlikely its next detection
is. Where the number of agents is unknown, as many come as leave, and those who are there at first are met soon. Times are
seconds since the first detection.
"""

from dataclasses import dataclass

import numpy as np

from cadence.arrays import Float64s
from cadence.association.motion import Modes
from cadence.association.tracks import Tracks


@dataclass(frozen=True, eq=False)
class Habits:
    """What is typical of a stream; `cadence.association.fitting` finds it.

    modes          how agents move
    rate_hz        detections of an agent per second
    rate_weight    how many detections' worth of evidence that rate holds against an agent's own
    rate_memory    with each detection of an agent the earlier ones count this much for its own rate, in (0, 1]
    leave_hz       one over the mean time an agent stays; zero: all stay all through the log
    num_present    how many are there at a moment on average, from the first detection on, where their number is unknown
    clutter_hz     false detections per second
    area_m2        where new agents and clutter are met, evenly
    temper         exponent of a position's density: below one, as every model of motion is wrong a little
    floor_m        no detection counts as more exact than this
    num_agents     how many there are; None: unknown
    max_agents     never more than this
    max_speed_mps  an agent is never faster; None: no limit
    """

    modes: Modes
    rate_hz: float
    rate_weight: float
    rate_memory: float
    leave_hz: float
    num_present: float
    clutter_hz: float
    area_m2: float
    temper: float
    floor_m: float
    num_agents: int | None
    max_agents: int
    max_speed_mps: float | None


def log_silence(tracks: Tracks, habits: Habits, time_s: float) -> tuple[Float64s, Float64s]:
    """For every track [R]: log probability of no detection from its last one to `time_s`, and log density of one just then.

    An agent that stays is silent with probability (1 + silent / watched) ^ -count (a Poisson process whose rate has a gamma
    law); one that leaves is silent from then on. The two are joined as for a Poisson process of the same silence.
    """
    count, watched_s, unseen, left = _waiting(tracks, habits, time_s)
    total = unseen + left
    with np.errstate(divide="ignore", invalid="ignore"):
        silence = np.logaddexp(np.log(left), np.log(unseen) - total) - np.log(total)
    return np.where(total > 0, silence, 0.0), np.log(count / watched_s) - total


def left_by(tracks: Tracks, habits: Habits, time_s: float) -> Float64s:
    """Probability that an agent has left, given its silence from its last detection to `time_s` [P, A]."""
    _, _, unseen, left = _waiting(tracks, habits, time_s)
    return np.asarray(1.0 - np.exp(-unseen - left - log_silence(tracks, habits, time_s)[0]))[tracks.row]


def _waiting(tracks: Tracks, habits: Habits, time_s: float) -> tuple[Float64s, Float64s, Float64s, Float64s]:
    """Evidence of each track's rate at `time_s` (detections, seconds), and minus the log probabilities of silence and stay."""
    silent_s = np.maximum(time_s - tracks.last_s, 0.0)
    watched_s = habits.rate_weight / habits.rate_hz + tracks.watched_s
    count = habits.rate_weight + tracks.repeats
    return count, watched_s + silent_s, count * np.log1p(silent_s / watched_s), habits.leave_hz * silent_s


def log_silence_between(tracks: Tracks, habits: Habits, begin_s: float, end_s: float) -> Float64s:
    """Log probability that nobody was detected from `begin_s` to `end_s`, given the detections up to `begin_s` [P]."""
    silence = log_silence(tracks, habits, end_s)[0] - log_silence(tracks, habits, begin_s)[0]
    silence[0] = 0.0
    return np.asarray(silence[tracks.row].sum(1) - _num_new(tracks, habits, begin_s, end_s))


def log_hazards(tracks: Tracks, habits: Habits, time_s: float) -> Float64s:
    """Log rates [P, A + 2] at which the next detection comes: from each agent, a new one, or from nobody.

    An agent that was detected at this very moment is not detected twice.
    """
    num_particles, num_slots = tracks.row.shape
    silence, again = log_silence(tracks, habits, time_s)
    hazard = np.where(tracks.last_s < time_s, again - silence, -np.inf)
    hazard[0] = -np.inf
    hazards = np.empty((num_particles, num_slots + 2))
    hazards[:, :-2] = hazard[tracks.row]
    with np.errstate(divide="ignore"):
        hazards[:, -2] = np.log(_new_hz(tracks, habits, time_s))
        hazards[:, -1] = np.log(habits.clutter_hz)
    return hazards


def _new_hz(tracks: Tracks, habits: Habits, time_s: float) -> Float64s:
    """Rate at which an agent is met for the first time [P]; where their number is unknown: there at first, or come later."""
    if habits.num_agents is not None:
        return np.asarray((habits.num_agents - tracks.num_agents) * habits.rate_hz)
    waited = 1.0 + habits.rate_hz * time_s / habits.rate_weight
    new_hz = habits.num_present * (habits.leave_hz + habits.rate_hz * waited ** -(habits.rate_weight + 1.0))
    return np.where(tracks.num_agents < habits.max_agents, new_hz, 0.0)


def _num_new(tracks: Tracks, habits: Habits, begin_s: float, end_s: float) -> Float64s:
    """The integral of `_new_hz` [P]."""
    if habits.num_agents is not None:
        return _new_hz(tracks, habits, begin_s) * (end_s - begin_s)
    unmet = [(1.0 + habits.rate_hz * time_s / habits.rate_weight) ** -habits.rate_weight for time_s in (begin_s, end_s)]
    num_new = habits.num_present * (habits.leave_hz * (end_s - begin_s) + unmet[0] - unmet[1])
    return np.where(tracks.num_agents < habits.max_agents, num_new, 0.0)
