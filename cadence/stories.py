"""Mission hypotheses: joint tracks of all agents over a whole mission, one continuous path an agent and hypothesis."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cadence.arrays import Bools, Float64s, Indices


@dataclass(frozen=True, eq=False)
class Stories:
    """K weighted joint stories: the same hypothesis number is the same story from beginning to end.

    time_s      [T] float64 strictly increasing seconds from the beginning of the mission, not evenly spaced where detections
                come in passes; between two times a track is the straight line between its positions
    position_m  [K, A, T, 2] float64 metres in the mission frame; NaN where the agent is no part of the story (yet, any more)
    weight      [K] non-negative, sums to one
    agent_ids   [A] names
    height_m    [K, A, T] float64 metres up, NaN where nothing is known; None where no agent has a height
    """

    time_s: Float64s
    position_m: Float64s
    weight: Float64s
    agent_ids: tuple[str, ...]
    height_m: Float64s | None = None

    def __post_init__(self) -> None:
        k, a, t = len(self.weight), len(self.agent_ids), len(self.time_s)
        if self.position_m.shape != (k, a, t, 2):
            raise ValueError(f"Stories.position_m has shape {self.position_m.shape}, expected [K, A, T, 2] = {(k, a, t, 2)}")
        if self.height_m is not None and self.height_m.shape != (k, a, t):
            raise ValueError(f"Stories.height_m has shape {self.height_m.shape}, expected [K, A, T] = {(k, a, t)}")
        if t > 1 and not (np.diff(self.time_s) > 0).all():
            raise ValueError("Stories.time_s must increase strictly")
        if k and (not (self.weight >= 0).all() or abs(float(self.weight.sum()) - 1.0) > 1e-6):
            raise ValueError("Stories.weight must be non-negative and sum to one")

    @property
    def num_hypotheses(self) -> int:
        """Number of stories K."""
        return len(self.weight)

    @property
    def is_present(self) -> Bools:
        """Where an agent is part of a story [K, A, T]."""
        present: Bools = ~np.isnan(self.position_m[..., 0])
        return present

    def agent(self, name: str) -> int:
        """Number of an agent by its name; ValueError names those there are."""
        if name not in self.agent_ids:
            raise ValueError(f"no agent {name!r}; there are {', '.join(self.agent_ids)}")
        return self.agent_ids.index(name)

    def of(self, agents: Sequence[int]) -> "Stories":
        """The stories of the agents with these numbers alone; heights stay behind."""
        names = tuple(self.agent_ids[agent] for agent in agents)
        return replace(self, position_m=self.position_m[:, list(agents)], agent_ids=names, height_m=None)

    def at(self, time_s: Float64s) -> Float64s:
        """Positions [K, A, len(time_s), 2] at other times, linear between two steps; NaN outside the stories' times."""
        left, right, share = steps_around(self.time_s, time_s)
        there = between_steps(self.position_m[:, :, left], self.position_m[:, :, right], share)
        there[:, :, (time_s < self.time_s[0]) | (time_s > self.time_s[-1])] = np.nan
        return there


def steps_around(steps_s: Float64s, time_s: Float64s) -> tuple[Indices, Indices, Float64s]:
    """The steps before and after times [M], and how far between them each is, 0 to 1; the nearest end outside of all steps."""
    right = np.clip(np.searchsorted(steps_s, time_s), min(1, len(steps_s) - 1), len(steps_s) - 1)
    left = np.maximum(right - 1, 0)
    length_s = np.where(right > left, steps_s[right] - steps_s[left], 1.0)
    return left, right, np.clip((time_s - steps_s[left]) / length_s, 0.0, 1.0)


def between_steps(before: Float64s, after: Float64s, share: Float64s) -> Float64s:
    """Positions [..., M, 2] on straight lines, at shares [M]; a step that is met exactly is not lost beside an absence."""
    part = share[:, None]
    mixed: Float64s = np.where(part == 0, before, np.where(part == 1, after, before + part * (after - before)))
    return mixed
