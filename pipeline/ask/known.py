"""What a mission's results know, for questions: stories of the whole mission, or of what was known at a moment."""

import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from cadence.arrays import Float64s
from cadence.errors import InputError, UsageError
from cadence.stories import Stories
from pipeline.ask.areas import Places
from pipeline.catalogue import read_catalogue
from pipeline.clock import Clock
from pipeline.missions import is_mission_directory, no_mission
from pipeline.moments import moment_ns
from pipeline.obstacle_file import OBSTACLES_NAME, read_obstacle_entries
from pipeline.results import WindowHypotheses, read_hypothesis_tables
from pipeline.stories import Block, MissionStories, read_stories, seconds_since
from pipeline.suggestions import did_you_mean
from pipeline.tables import Frame

_DAY_NS = 86_400_000_000_000
_TIME_OF_DAY = re.compile(r"(\d{1,2}):(\d\d)(?::(\d\d(?:\.\d{1,9})?))?")


@dataclass(frozen=True, eq=False)
class Known:
    """Results that can be asked.

    directory  of the mission
    mission    its stories: of the whole mission, or of one window
    begin_ns   what seconds are counted from: the beginning of the log; of the stories, where the log has another clock
    as_of_ns   the origin of the window, where only what was known then is to count; None: everything that was detected
    """

    directory: Path
    mission: MissionStories
    begin_ns: int
    as_of_ns: int | None = None

    @property
    def stories(self) -> Stories:
        """The stories."""
        return self.mission.stories

    @property
    def frame(self) -> Frame:
        """The mission frame."""
        return self.mission.frame

    @property
    def start_ns(self) -> int:
        """When the stories' seconds are zero."""
        return self.mission.start_ns

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last moment of the stories, on their clock."""
        return float(self.stories.time_s[0]), float(self.stories.time_s[-1])

    @cached_property
    def clock(self) -> Clock:
        """How times are written."""
        first_s, last_s = self.span_s
        return Clock(self.start_ns + round(first_s * 1e9), self.start_ns + round(last_s * 1e9))

    @cached_property
    def places(self) -> Places:
        """How places are understood."""
        path = self.directory / OBSTACLES_NAME
        entries = read_obstacle_entries(path) if path.is_file() else []
        return Places(self.frame, entries, _middles(self.stories))

    def agent(self, name: str) -> int:
        """Number of an agent; `UsageError` names what may have been meant."""
        names = self.stories.agent_ids
        if name not in names:
            known = f"{', '.join(names[:8])}{' and others' if len(names) > 8 else ''}"
            raise UsageError(f"no agent {name!r} in {self.directory}{did_you_mean(name, names)}; there are {known}")
        return names.index(name)

    def seconds(self, stated: float | str, what: str) -> float:
        """A moment as people state it on the stories' clock; `UsageError` where it is none, or outside of what is known."""
        at_ns = stated_ns(stated, self.begin_ns)
        if at_ns is None:
            raise UsageError(f"{what} {stated!r}: no time; give ISO 8601, a time of day (UTC), or seconds after the log begins")
        at_s = (at_ns - self.start_ns) * 1e-9
        first_s, last_s = self.span_s
        # a millisecond: what rounding a printed time may cost
        if not first_s - 1e-3 <= at_s <= last_s + 1e-3:
            known = self.clock.range()
            since = "" if self.as_of_ns is None else " by the window of as-of"
            raise UsageError(f"{what} {stated}: outside of what is known{since}, {known}")
        return float(np.clip(at_s, first_s, last_s))

    def span(self, start: float | str | None, end: float | str | None) -> tuple[float, float]:
        """From when to when on the stories' clock; by default all of it."""
        first_s, last_s = self.span_s
        from_s = first_s if start is None else self.seconds(start, "from")
        to_s = last_s if end is None else self.seconds(end, "to")
        if not from_s < to_s:
            raise UsageError(f"from {start} is not before to {end}; give them in order")
        return from_s, to_s


def open_known(directory: Path, as_of: float | str | None = None) -> Known:
    """The stories of a mission directory, or with `as_of` those of the last window before that moment.

    Raises `InputError` where the results are absent, empty, damaged or of another version, `UsageError` for a moment before
    the first window.
    """
    if not is_mission_directory(directory):
        raise no_mission(directory)
    log_start_ns = read_catalogue(directory).start_ns
    if as_of is None:
        mission = read_stories(directory)
        _check_any(mission.stories, directory)
        return Known(directory, mission, _begin_ns(log_start_ns, mission.start_ns))
    found = read_hypothesis_tables(directory)
    windows = [window for window in found.windows if any(agent.is_live for agent in window.agents)]
    if not windows:
        raise InputError(f"{directory}: no window has hypotheses; see windows.parquet (status, advice) for the reasons")
    begin_ns = _begin_ns(log_start_ns, windows[0].start_ns)
    at_ns = stated_ns(as_of, begin_ns)
    if at_ns is None:
        raise UsageError(f"as-of {as_of!r}: no time; give ISO 8601, a time of day (UTC), or seconds after the log begins")
    before = [window for window in windows if window.origin_ns <= at_ns]
    if not before:
        first = Clock(windows[0].origin_ns, windows[-1].origin_ns).range()
        raise UsageError(f"as-of {as_of}: nothing was known yet; windows are from {first}")
    return Known(directory, window_stories(before[-1], found.frame), begin_ns, before[-1].origin_ns)


def window_stories(window: WindowHypotheses, frame: Frame) -> MissionStories:
    """One window as stories: past and future, as they were known at its origin."""
    live = [agent for agent in window.agents if agent.is_live]
    position_m = np.stack([agent.position_m.astype(np.float64) + np.array(agent.datum_m) for agent in live], axis=1)
    block = Block(0, window.num_steps, window.start_ns, window.step_ns)
    weight = window.weight.astype(np.float64)
    stories = Stories(
        seconds_since(block.start_ns, [block]), position_m, weight / weight.sum(), tuple(agent.agent_id for agent in live)
    )
    return MissionStories(frame, window.log_id, block.start_ns, stories, (block,))


def stated_ns(stated: float | str, begin_ns: int) -> int | None:
    """A moment in nanoseconds: ISO 8601, a time of day in UTC (the first from `begin_ns` on), or seconds after it."""
    match = _TIME_OF_DAY.fullmatch(stated.strip()) if isinstance(stated, str) else None
    if match is None:
        return moment_ns(stated, begin_ns)
    hours, minutes, seconds = int(match[1]), int(match[2]), float(match[3] or 0)
    if hours > 24 or minutes > 59 or seconds >= 61:
        return None
    time_ns = (hours * 60 + minutes) * 60_000_000_000 + round(seconds * 1e9)
    found = begin_ns - begin_ns % _DAY_NS + time_ns
    # a mission that begins at 10:00:00.3 begins at ten for people
    return found if found >= begin_ns - 60_000_000_000 else found + _DAY_NS


def _begin_ns(log_start_ns: int, stories_start_ns: int) -> int:
    """The beginning of the log where it shares the stories' clock."""
    return log_start_ns if abs(log_start_ns - stories_start_ns) < _DAY_NS else stories_start_ns


def _check_any(stories: Stories, directory: Path) -> None:
    if not stories.num_hypotheses or not stories.agent_ids or not stories.is_present.any():
        raise InputError(f"{directory}: holds no stories of any agent; see windows.parquet (status, advice) for the reasons")


def _middles(stories: Stories) -> Float64s:
    """Where agents were in the first story [N, 2]: enough to tell a place from one on another continent."""
    found: Float64s = stories.position_m[0].reshape(-1, 2)
    return found
