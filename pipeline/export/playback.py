"""What is to be seen when: the windows on the mission's time line, and the moments at which the scene is written."""

import bisect
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cadence.arrays import Float64s, Indices
from pipeline.export import numbers
from pipeline.results import AgentHypotheses, MissionHypotheses, WindowHypotheses

HEIGHT_COUNTS = 4.0
"""So much more than a metre in the plane a metre of height counts: heights reach less far, and are looked at from the side."""

_MOST_COMPARED = 64
"""Hypotheses among which the central one is sought, the heaviest first: the work grows as their square."""


@dataclass(frozen=True, eq=False)
class LiveAgent:
    """One agent of one window, ready to be drawn: positions in the mission frame, without hypotheses that are not finite.

    hypothesis [K] row in the window, weight [K] sums to one, position_m [K, T, 2] float64; height_m [K, T] where it is known.
    """

    agent: AgentHypotheses
    window: WindowHypotheses
    hypothesis: Indices
    weight: Float64s
    position_m: Float64s
    height_m: Float64s | None = None

    @cached_property
    def mean_m(self) -> Float64s:
        """Weighted mean track [T, 2]."""
        return np.asarray(np.einsum("k,ktd->td", self.weight, self.position_m))

    @cached_property
    def central(self) -> int:
        """The hypothesis nearest to all others, over all steps: unlike the mean it is a track that somebody can have taken."""
        few = np.argsort(-self.weight, kind="stable")[:_MOST_COMPARED]
        track_m = self.position_m[few]
        if self.height_m is not None:
            track_m = np.concatenate([track_m, HEIGHT_COUNTS * self.height_m[few][..., None]], axis=-1)
        away_m = np.array([np.linalg.norm(track_m - one, axis=-1).mean(axis=-1) @ self.weight[few] for one in track_m])
        return int(few[away_m.argmin()])

    @cached_property
    def num_modes(self) -> int:
        """Separate groups of hypotheses at the end of the future."""
        return numbers.count_modes(self.position_m[:, -1], self.weight)

    def speed_mps(self, time_ns: int) -> float:
        """Weighted mean of the hypotheses' speeds in the step around a time; 0 without a second step."""
        window = self.window
        if window.num_steps < 2:
            return 0.0
        step = window.origin_index + (time_ns - window.origin_ns) // window.step_ns
        low = int(np.clip(step, 0, window.num_steps - 2))
        moved = np.linalg.norm(self.position_m[:, low + 1] - self.position_m[:, low], axis=-1)
        return float(self.weight @ moved) / (window.step_ns * 1e-9)

    def mean_at(self, time_ns: int) -> Float64s:
        """Weighted mean position [2] at a time."""
        return np.asarray(self.weight @ self.at(time_ns))

    def at(self, time_ns: int) -> Float64s:
        """Positions [K, 2] at a time: linear between steps, the first or last step outside of them."""
        return self._between_steps(self.position_m, time_ns)

    def height_at(self, time_ns: int) -> Float64s | None:
        """Heights [K] at a time, as positions; None where they are unknown."""
        return None if self.height_m is None else self._between_steps(self.height_m, time_ns)

    def _between_steps(self, values: Float64s, time_ns: int) -> Float64s:
        steps = self.window.origin_index + (time_ns - self.window.origin_ns) / self.window.step_ns
        low = int(np.clip(np.floor(steps), 0, max(self.window.num_steps - 2, 0)))
        high = min(low + 1, self.window.num_steps - 1)
        share = float(np.clip(steps - low, 0.0, 1.0))
        return np.asarray((1.0 - share) * values[:, low] + share * values[:, high])


@dataclass(frozen=True, eq=False)
class Scene:
    """What the newest windows (those of one origin) say; shown from `origin_ns` until `end_ns`."""

    origin_ns: int
    start_ns: int
    end_ns: int
    agents: tuple[AgentHypotheses, ...]
    live: tuple[LiveAgent, ...]


@dataclass(frozen=True, eq=False)
class Tick:
    """A moment at which the scene is written; `scene` is None where no window is live any more."""

    time_ns: int
    scene: Scene | None


def build_scenes(mission: MissionHypotheses) -> list[Scene]:
    """The scenes of a mission by origin; windows with the same origin are one scene."""
    groups = [list(group) for _, group in itertools.groupby(mission.windows, key=lambda window: window.origin_ns)]
    origins = [group[0].origin_ns for group in groups]
    stride_ns = int(np.median(np.diff(origins))) if len(origins) > 1 else 0
    return [_scene(group, stride_ns) for group in groups]


def plan_ticks(scenes: Sequence[Scene], tick_ns: int, end_ns: int) -> list[Tick]:
    """Ticks `tick_ns` apart which show the newest scene each, moved by less than a tick to fall on origins.

    A tick without a scene follows the end of a window that no other replaces. Nothing comes after both `end_ns` and the
    last origin.
    """
    ticks: list[Tick] = []
    origins = [scene.origin_ns for scene in scenes]
    time_ns = origins[0] if origins else end_ns + 1
    while origins and time_ns <= max(end_ns, origins[-1]):
        newest = scenes[bisect.bisect_right(origins, time_ns) - 1]
        is_live = time_ns <= newest.end_ns
        ticks.append(Tick(time_ns, newest if is_live else None))
        index = bisect.bisect_left(origins, time_ns + (tick_ns if is_live else 1))
        following = origins[index] if index < len(origins) else None
        if not is_live and following is None:
            break
        is_near = following is not None and (not is_live or following < time_ns + 2 * tick_ns)
        time_ns = following if following is not None and is_near else time_ns + tick_ns
    return ticks


def shows_new_scene(ticks: Sequence[Tick], index: int) -> bool:
    """Whether a tick shows another scene than the one before it."""
    return index == 0 or ticks[index].scene is not ticks[index - 1].scene


def _scene(group: list[WindowHypotheses], stride_ns: int) -> Scene:
    live = [_live(window, agent) for window in group for agent in window.agents if agent.is_live]
    shown = tuple(agent for agent in live if len(agent.hypothesis))
    origin_ns = group[0].origin_ns
    return Scene(
        origin_ns=origin_ns,
        start_ns=min(window.start_ns for window in group),
        # Without a future (or with a short one) a window stands until the next is due.
        end_ns=max(origin_ns + stride_ns, *(window.end_ns for window in group)),
        agents=tuple(agent for window in group for agent in window.agents),
        live=tuple(sorted(shown, key=lambda agent: agent.agent.agent_id)),
    )


def _live(window: WindowHypotheses, agent: AgentHypotheses) -> LiveAgent:
    is_finite = np.isfinite(agent.position_m).all(axis=(1, 2))
    kept = np.flatnonzero(is_finite)
    weight = np.nan_to_num(window.weight[kept].astype(np.float64))
    if not weight.sum() > 0:
        weight = np.ones(len(kept))
    share = np.asarray(weight / max(float(weight.sum()), 1e-300))
    position_m = agent.position_m[kept].astype(np.float64) + agent.datum_m
    height_m = None if agent.height_m is None else agent.height_m[kept].astype(np.float64)
    return LiveAgent(agent, window, kept, share, position_m, height_m)
