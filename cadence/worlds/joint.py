"""Episodes of several targets that behave together, and whether they met."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cadence.arrays import Bools, Float32s, Float64s, Floats, Int64s
from cadence.recordings import Recordings

MEETING_RADIUS_M = 600.0
"""Agents that are so near to a site at one step are there together: four steps' way, a fifth of the distance of sites."""


@dataclass(frozen=True, eq=False)
class JointRecordings:
    """E episodes of A agents each.

    recordings     their tracks: those of episode e are its tracks e * A ... e * A + A - 1
    is_meeting     [E] bool: the agents met at the site and went on together; otherwise each went straight to the goal
    goal_m         [E, 2] float64 where all of them went
    site_m         [E, 2] float64 the meeting site that was drawn; nobody made for it where `is_meeting` is false
    left_site_step [E] int64 the step at which the group leaves the site; -1 where it never went there
    """

    recordings: Recordings
    is_meeting: Bools
    goal_m: Float64s
    site_m: Float64s
    left_site_step: Int64s

    def __post_init__(self) -> None:
        count = len(self.is_meeting)
        if self.recordings.num_episodes != count:
            raise ValueError(f"JointRecordings: {self.recordings.num_episodes} recorded episodes are not {count}")
        expected = {"is_meeting": (count,), "goal_m": (count, 2), "site_m": (count, 2), "left_site_step": (count,)}
        for name, want in expected.items():
            if getattr(self, name).shape != want:
                raise ValueError(f"JointRecordings.{name} has shape {getattr(self, name).shape}, expected {want}")

    def __len__(self) -> int:
        return len(self.is_meeting)

    @property
    def num_agents(self) -> int:
        """Agents A of every episode."""
        return self.recordings.num_agents

    @property
    def length(self) -> Int64s:
        """Steps of every episode [E]."""
        return self.recordings.length[:: self.num_agents]

    def track_m(self, episode: int) -> Float32s:
        """Where the agents of one episode were [A, T, 2]."""
        first, end = self.recordings.offset[[episode * self.num_agents, (episode + 1) * self.num_agents]]
        return self.recordings.position_m[first:end].reshape(self.num_agents, -1, 2)

    def select(self, episodes: Sequence[int] | Int64s | slice) -> "JointRecordings":
        """Some of the episodes, in the order given."""
        chosen = np.arange(len(self))[episodes]
        return JointRecordings(
            self.recordings.select(chosen),
            self.is_meeting[chosen],
            self.goal_m[chosen],
            self.site_m[chosen],
            self.left_site_step[chosen],
        )


def meets(position_m: Floats, sites_m: Float64s, radius_m: float = MEETING_RADIUS_M) -> Bools:
    """Whether [...] the agents of tracks [..., A, T, 2] are all within `radius_m` of one of the sites [S, 2] at some step.

    The same rule for truth and for samples. Agents that are NaN at a step are not asked; two at least must be there.
    """
    is_absent = np.isnan(position_m).any(axis=-1)
    are_enough = (~is_absent).sum(axis=-2) >= 2
    has_met = np.zeros(position_m.shape[:-3], dtype=bool)
    for site in sites_m:
        offset = position_m - site.astype(position_m.dtype)
        is_near = (offset * offset).sum(axis=-1) <= radius_m**2
        has_met |= ((is_near | is_absent).all(axis=-2) & are_enough).any(axis=-1)
    return has_met
