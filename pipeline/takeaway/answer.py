"""What is taken away: tracks with their times and weights, and regions at moments, in the mission frame.

Mission hypotheses are continuous from beginning to end. Windows are not: each knows what lay before its origin, so that every
window tells the stretch since the origin of the window before, and the last one also the future.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import shapely

from cadence.answers.whereabouts import whereabouts
from cadence.arrays import Float64s, Int64s
from cadence.errors import InputError
from pipeline.results import WindowHypotheses, read_hypothesis_tables
from pipeline.stories import MISSION_NAME, read_stories
from pipeline.tables import Frame

Source = Literal["mission", "windows"]
LEVELS = (0.9, 0.5)
NUM_MOMENTS = 24
"""At which regions are given."""
_SIMPLER = 0.003
"""Of its width an outline may stray."""
_MIN_MOMENTS, _MAX_REGIONS = 6, 600
"""Of a level: each takes a tenth of a second."""


@dataclass(frozen=True, eq=False)
class Stretch:
    """K joint hypotheses of A agents at T times.

    window       number of the window; None of mission hypotheses
    hypothesis   [K] numbers, weight [K]
    position_m   [K, A, T, 2] in the mission frame; NaN where an agent is no part of a hypothesis
    height_m     [K, A, T]; None where no agent has a height
    """

    window: int | None
    time_ns: Int64s
    hypothesis: Int64s
    weight: Float64s
    agent_ids: tuple[str, ...]
    position_m: Float64s
    height_m: Float64s | None = None

    def first(self, num_hypotheses: int) -> "Stretch":
        """The same with so many hypotheses, the heaviest, whose weights sum to one again."""
        chosen = np.sort(np.argsort(-self.weight, kind="stable")[:num_hypotheses])
        height_m = None if self.height_m is None else self.height_m[chosen]
        weight = self.weight[chosen]
        return replace(
            self,
            hypothesis=self.hypothesis[chosen],
            weight=weight / weight.sum(),
            position_m=self.position_m[chosen],
            height_m=height_m,
        )


@dataclass(frozen=True, eq=False)
class Track:
    """One continuous piece of a track [T]: of a hypothesis, or of the weighted mean of all (hypothesis None).

    weight     of the hypothesis; 1 of the mean
    spread_m   [T] of the mean: root mean square distance of the hypotheses to it; radius_m [T]: holds 68 % of their weight
    """

    agent_id: str
    window: int | None
    hypothesis: int | None
    weight: float
    time_ns: Int64s
    position_m: Float64s
    height_m: Float64s | None = None
    spread_m: Float64s | None = None
    radius_m: Float64s | None = None

    def __len__(self) -> int:
        return len(self.time_ns)

    @property
    def name(self) -> str:
        """What it is called in a list."""
        kind = "mean" if self.hypothesis is None else f"hypothesis {self.hypothesis}"
        return f"{self.agent_id} {kind}" if self.window is None else f"{self.agent_id} window {self.window} {kind}"

    def at(self, rows: Any) -> "Track":
        """Some of its steps."""
        columns = {name: getattr(self, name) for name in ("height_m", "spread_m", "radius_m")}
        chosen: dict[str, Any] = {name: None if column is None else column[rows] for name, column in columns.items()}
        return replace(self, time_ns=self.time_ns[rows], position_m=self.position_m[rows], **chosen)


@dataclass(frozen=True, eq=False)
class RegionAt:
    """The densest area (shapely, metres) that holds `level` of an agent's hypotheses at a moment; it is shown until end_ns."""

    agent_id: str
    window: int | None
    level: float
    time_ns: int
    end_ns: int
    shape: Any


@dataclass(frozen=True, eq=False)
class Answer:
    """The results of a mission, in the order of time."""

    name: str
    log_id: str
    frame: Frame
    source: Source
    stretches: tuple[Stretch, ...]

    @property
    def agent_ids(self) -> tuple[str, ...]:
        """All agents, by name."""
        return tuple(sorted({name for stretch in self.stretches for name in stretch.agent_ids}))

    def tracks(self, num_hypotheses: int | None = None) -> Iterator[Track]:
        """Hypotheses, agent by agent in each stretch."""
        for stretch in self.stretches:
            drawn = stretch if num_hypotheses is None else stretch.first(num_hypotheses)
            for agent, name in enumerate(drawn.agent_ids):
                for k, number in enumerate(drawn.hypothesis.tolist()):
                    height_m = None if drawn.height_m is None else drawn.height_m[k, agent]
                    weight = float(drawn.weight[k])
                    yield from _pieces(
                        Track(name, drawn.window, number, weight, drawn.time_ns, drawn.position_m[k, agent], height_m)
                    )

    def means(self) -> Iterator[Track]:
        """The weighted mean of each agent in each stretch, with how far hypotheses lie apart."""
        for stretch in self.stretches:
            for agent, name in enumerate(stretch.agent_ids):
                yield from _pieces(_mean(stretch, agent, name))

    @cached_property
    def regions(self) -> tuple[RegionAt, ...]:
        """Areas of each agent at NUM_MOMENTS, or fewer where there are many agents, evenly over the times of all stretches."""
        start_ns, end_ns = int(self.stretches[0].time_ns[0]), int(self.stretches[-1].time_ns[-1])
        num_moments = max(_MIN_MOMENTS, min(NUM_MOMENTS, _MAX_REGIONS // max(1, len(self.agent_ids))))
        moments = np.unique(np.linspace(start_ns, end_ns, num_moments).astype(np.int64))
        return tuple(
            region
            for moment_ns, until_ns in zip(moments.tolist(), [*moments[1:].tolist(), end_ns], strict=True)
            for region in self._regions_at(moment_ns, until_ns)
        )

    def _regions_at(self, moment_ns: int, until_ns: int) -> Iterator[RegionAt]:
        told = (each for each in reversed(self.stretches) if each.time_ns[0] <= moment_ns <= each.time_ns[-1])
        stretch = next(told, None)
        if stretch is not None:
            step = int(np.abs(stretch.time_ns - moment_ns).argmin())
            for agent, name in enumerate(stretch.agent_ids):
                yield from _regions(stretch, agent, name, step, until_ns)


def read_answer(directory: Path, name: str, source: Source | None) -> Answer:
    """Mission hypotheses where there are any, else windows, unless `source` says which; `InputError` where there are none."""
    if source == "mission" or (source is None and (directory / MISSION_NAME).is_file()):
        mission = read_stories(directory)
        stories = mission.stories
        whole = Stretch(
            None,
            mission.time_ns,
            np.arange(stories.num_hypotheses),
            stories.weight,
            stories.agent_ids,
            stories.position_m,
            stories.height_m,
        )
        return Answer(name, mission.log_id, mission.frame, "mission", (whole,))
    found = read_hypothesis_tables(directory)
    stretches, last_ns = [], None
    for index, window in enumerate(found.windows):
        stretch = _of_window(window, last_ns, index == len(found.windows) - 1)
        last_ns = window.origin_ns
        if stretch is not None:
            stretches.append(stretch)
    if not stretches:
        raise InputError(f"{directory}: holds no hypotheses to take away; look into its report for what to do")
    log_id = next((window.log_id for window in found.windows if window.log_id), name)
    return Answer(name, log_id, found.frame, "windows", tuple(stretches))


def _of_window(window: WindowHypotheses, last_ns: int | None, is_last: bool) -> Stretch | None:
    """What a window tells: since the origin of the one before, up to its own, the last one to its end."""
    live = [agent for agent in window.agents if agent.is_live]
    if not live:
        return None
    time_ns = window.origin_ns + (np.arange(window.num_steps, dtype=np.int64) - window.origin_index) * window.step_ns
    is_told = np.ones(len(time_ns), np.bool_) if last_ns is None else time_ns >= last_ns
    is_told &= is_last | (time_ns <= window.origin_ns)
    if not is_told.any():
        return None
    position = np.stack([agent.position_m[:, is_told].astype(np.float64) + np.array(agent.datum_m) for agent in live], axis=1)
    weight = window.weight.astype(np.float64)
    names = tuple(agent.agent_id for agent in live)
    return Stretch(window.window, time_ns[is_told], window.hypothesis.astype(np.int64), weight / weight.sum(), names, position)


def _mean(stretch: Stretch, agent: int, name: str) -> Track:
    position, weight = stretch.position_m[:, agent], stretch.weight[:, None]
    there = np.isfinite(position[..., 0])
    share = np.where(there, weight, 0.0)
    total = share.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = share / total
    mean = np.where((total > 0)[:, None], (share[..., None] * np.where(there[..., None], position, 0.0)).sum(axis=0), np.nan)
    away = np.where(there, np.linalg.norm(np.where(there[..., None], position, 0.0) - mean, axis=-1), np.inf)
    order = np.argsort(away, axis=0)
    held = np.cumsum(np.take_along_axis(np.nan_to_num(share), order, axis=0), axis=0)
    radius = np.take_along_axis(np.take_along_axis(away, order, axis=0), np.argmax(held >= 0.68 - 1e-9, axis=0)[None], axis=0)[
        0
    ]
    spread = np.sqrt((np.nan_to_num(share) * np.where(there, away, 0.0) ** 2).sum(axis=0))
    height = None
    if stretch.height_m is not None:
        known = np.isfinite(stretch.height_m[:, agent]) & there
        part = np.where(known, weight, 0.0)
        with np.errstate(invalid="ignore", divide="ignore"):
            height = (part * np.where(known, stretch.height_m[:, agent], 0.0)).sum(axis=0) / part.sum(axis=0)
    return Track(name, stretch.window, None, 1.0, stretch.time_ns, mean, height, spread, radius)


def _pieces(track: Track) -> Iterator[Track]:
    """The stretches of a track in which its agent is there."""
    there = np.isfinite(track.position_m[:, 0])
    if there.all():
        yield track
        return
    edges = np.flatnonzero(np.diff(np.concatenate([[False], there, [False]])))
    for first, stop in edges.reshape(-1, 2).tolist():
        yield track.at(slice(first, stop))


def _regions(stretch: Stretch, agent: int, name: str, step: int, until_ns: int) -> Iterator[RegionAt]:
    position = stretch.position_m[:, agent, step]
    if not np.isfinite(position).all(axis=1).any():
        return
    for area in whereabouts(position, stretch.weight, LEVELS).areas:
        shape = shapely.simplify(area.shape, _SIMPLER * area.area_m2**0.5)  # the outline has a corner a cell of a fine grid
        if not shape.is_empty:
            yield RegionAt(name, stretch.window, area.level, int(stretch.time_ns[step]), until_ns, shape)
