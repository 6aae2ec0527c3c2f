"""Mission hypotheses: joint tracks of all agents over a whole mission, one continuous path an agent and hypothesis."""

from dataclasses import dataclass

import numpy as np

from cadence.arrays import Bools, Float64s


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

    def at(self, time_s: Float64s) -> Float64s:
        """Positions [K, A, len(time_s), 2] at other times, linear between two steps; NaN outside the stories' times."""
        steps = self.time_s
        right = np.clip(np.searchsorted(steps, time_s, side="left"), 1, max(len(steps) - 1, 1))
        if len(steps) == 1:
            share, left, right = np.zeros(len(time_s)), np.zeros(len(time_s), np.intp), np.zeros(len(time_s), np.intp)
        else:
            left = right - 1
            share = (time_s - steps[left]) / (steps[right] - steps[left])
        before, after = self.position_m[:, :, left], self.position_m[:, :, right]
        # a step that is met exactly must not be lost to a neighbour where the agent is absent
        mixed = np.where(
            (share == 0)[:, None], before, np.where((share == 1)[:, None], after, before + share[:, None] * (after - before))
        )
        outside = (time_s < steps[0]) | (time_s > steps[-1])
        mixed[:, :, outside] = np.nan
        result: Float64s = mixed
        return result
