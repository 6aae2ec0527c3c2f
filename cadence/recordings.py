"""Many recorded or simulated episodes as flat arrays, of one target or of several at once, and forecasting windows out of them.

The protocol is the paper's (Ye et al., CADENCE, MRS 2023, section V): at a step of an episode the detections up to it are
known, and the next positions are asked for; after the episode's end the target stays where it was.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cadence.arrays import Bools, Float32s, Float64s, Int64s
from cadence.seeds import derived_seeds, part_seeds
from cadence.types import Context, Detections, WindowBatch

NUM_STEPS = 120
"""Steps that a window asks for; the first one is now."""

_SIGMA_M = 1.0
"""Detections are exact; covariances must not be zero. This is far below the step length."""


@dataclass(frozen=True, eq=False)
class Recordings:
    """E tracks with S steps in all, one behind the other; mission frame, metres.

    An episode of one target is one track. Of `num_agents` targets at once it is so many tracks in a row, all of one length.

    step_s       seconds between steps
    offset       [E + 1] int64: the rows of track i are offset[i] ... offset[i + 1] - 1
    position_m   [S, 2] float32 the target
    is_detected  [S] bool: somebody detected it; detections are exact
    tracker_m    [S, M, 2] float32 the moving trackers, aircraft first; NaN where there is none
    known_goal_m [E, 2] float32 the goal that the trackers know of; NaN where they know none
    num_agents   targets of every episode
    """

    step_s: float
    offset: Int64s
    position_m: Float32s
    is_detected: Bools
    tracker_m: Float32s
    known_goal_m: Float32s
    num_agents: int = 1

    def __post_init__(self) -> None:
        e, s = len(self.offset) - 1, len(self.position_m)
        if e < 0 or self.offset[0] != 0 or self.offset[-1] != s or (np.diff(self.offset) < 1).any():
            raise ValueError(f"Recordings.offset must rise from 0 to {s}, one step an episode at least")
        expected = {"position_m": (s, 2), "is_detected": (s,), "known_goal_m": (e, 2)}
        expected["tracker_m"] = (s, self.tracker_m.shape[1] if self.tracker_m.ndim == 3 else 0, 2)
        for name, want in expected.items():
            if getattr(self, name).shape != want:
                raise ValueError(f"Recordings.{name} has shape {getattr(self, name).shape}, expected {want}")
        if self.num_agents < 1 or e % self.num_agents or np.ptp(self.length.reshape(-1, self.num_agents), axis=1).any():
            raise ValueError(f"Recordings: {e} tracks are no episodes of {self.num_agents} agents with tracks of one length")

    def __len__(self) -> int:
        return len(self.offset) - 1

    @property
    def num_episodes(self) -> int:
        """Episodes, each of `num_agents` tracks."""
        return len(self) // self.num_agents

    @property
    def length(self) -> Int64s:
        """Steps of every track [E]."""
        return np.diff(self.offset)

    def apart(self) -> "Recordings":
        """The same tracks, each an episode of its own."""
        return dataclasses.replace(self, num_agents=1)

    def rates(self) -> Float64s:
        """Share of steps with a detection, a track [E]."""
        return np.add.reduceat(self.is_detected.astype(np.float64), self.offset[:-1]) / self.length

    def select(self, episodes: Sequence[int] | Int64s | slice) -> "Recordings":
        """Some of the episodes, in the order given."""
        chosen = np.arange(len(self)).reshape(-1, self.num_agents)[episodes].ravel()
        length = self.length[chosen]
        offset = np.concatenate([[0], np.cumsum(length)])
        rows = np.arange(offset[-1]) + np.repeat(self.offset[:-1][chosen] - offset[:-1], length)
        return Recordings(
            self.step_s,
            offset,
            self.position_m[rows],
            self.is_detected[rows],
            self.tracker_m[rows],
            self.known_goal_m[chosen],
            self.num_agents,
        )

    @staticmethod
    def of_tracks(tracks_m: Sequence[Float64s | Float32s], is_detected: Sequence[Bools], step_s: float) -> "Recordings":
        """Tracks of single targets, one an episode, without trackers and goals.

        Args:
            tracks_m: a track [T, 2] in metres each, at even steps; their lengths may differ.
            is_detected: at which of its steps each target was seen, [T] bool.
            step_s: seconds between steps.
        """
        length = [len(track) for track in tracks_m]
        position = np.concatenate(tracks_m).astype(np.float32)
        return Recordings(
            step_s,
            np.concatenate([[0], np.cumsum(length)]).astype(np.int64),
            position,
            np.concatenate(is_detected),
            np.full((len(position), 0, 2), np.nan, dtype=np.float32),
            np.full((len(length), 2), np.nan, dtype=np.float32),
        )

    @staticmethod
    def concatenate(parts: Sequence["Recordings"]) -> "Recordings":
        """All episodes of the parts, in order; missing trackers are absent (NaN).

        Raises where steps differ in length, or episodes in the number of agents.
        """
        if len({(part.step_s, part.num_agents) for part in parts}) != 1:
            raise ValueError("Recordings.concatenate: parts with different steps or numbers of agents, or none")
        num_trackers = max(part.tracker_m.shape[1] for part in parts)
        trackers = [
            np.pad(part.tracker_m, ((0, 0), (0, num_trackers - part.tracker_m.shape[1]), (0, 0)), constant_values=np.nan)
            for part in parts
        ]
        return Recordings(
            parts[0].step_s,
            np.concatenate([[0], np.cumsum(np.concatenate([part.length for part in parts]))]),
            np.concatenate([part.position_m for part in parts]),
            np.concatenate([part.is_detected for part in parts]),
            np.concatenate(trackers),
            np.concatenate([part.known_goal_m for part in parts]),
            parts[0].num_agents,
        )


@dataclass(frozen=True, eq=False)
class ForecastWindows:
    """B windows of A agents: what is known, and what came.

    windows  their grid is now and the steps after it; the datum is the last detection of the first agent that has one, or the
             map's origin without any. The context has all but obstacles; the trackers are those of the first agent's track
    truth_m  [B, A, T, 2] relative to the datum, float64
    episode, step  [B] int64 where they were cut
    """

    windows: WindowBatch
    truth_m: Tensor
    episode: Tensor
    step: Tensor

    def __len__(self) -> int:
        return len(self.episode)

    @property
    def context(self) -> Context:
        """What is known beside the detections."""
        return self.windows.required_context("ForecastWindows")

    def with_context(self, context: Context) -> "ForecastWindows":
        """The same windows, of which something else is known."""
        return dataclasses.replace(self, windows=self.windows.with_context(context))

    def __getitem__(self, pick: slice | Tensor) -> "ForecastWindows":
        """A selection of windows."""
        return ForecastWindows(self.windows[pick], self.truth_m[pick], self.episode[pick], self.step[pick])

    def apart(self) -> "ForecastWindows":
        """Every agent of every window as a window of its own [B * A], the agents of a window in a row."""
        size = self.windows.num_agents
        window = torch.arange(len(self)).repeat_interleave(size)
        rows = self[window]
        d, goal = self.windows.detections, self.context.known_goal_m
        columns = (value.flatten(0, 1)[:, None] for value in (d.time_s, d.position_m, d.covariance_m2, d.is_observed))
        seeds = part_seeds(rows.windows.seeds, "agent", torch.arange(size).repeat(len(self)))
        context = dataclasses.replace(rows.context, known_goal_m=None if goal is None else goal.flatten(0, 1)[:, None])
        alone = WindowBatch(self.windows.time_s, Detections(*columns), seeds, self.windows.origin_index, context)
        return dataclasses.replace(rows, windows=alone, truth_m=self.truth_m.flatten(0, 1)[:, None])


def choose_windows(
    recordings: Recordings, num_windows: int, rng: np.random.Generator, known_start: bool = True
) -> tuple[Int64s, Int64s]:
    """Random (episode [B], step [B]), every step of every episode equally likely.

    Without a known start only steps at or after the first detection are taken: before it nothing is known.
    """
    if known_start:
        rows = np.arange(len(recordings.position_m))
    else:
        seen = np.concatenate([[0], np.cumsum(recordings.is_detected)])
        rows = np.flatnonzero(seen[1:] > np.repeat(seen[recordings.offset[:-1]], recordings.length))
    chosen = np.sort(rng.choice(rows, num_windows, replace=num_windows > len(rows)))
    track = np.searchsorted(recordings.offset, chosen, side="right") - 1
    return track // recordings.num_agents, chosen - recordings.offset[track]


def cut_windows(
    recordings: Recordings,
    episode: Int64s,
    step: Int64s,
    *,
    known_start: bool | Bools = True,
    num_detections: int = 512,
    num_tracker_steps: int = 64,
    seed: int = 0,
) -> ForecastWindows:
    """Windows at the steps [B] of the episodes [B], all agents of an episode in one window.

    Args:
        recordings: what is cut.
        episode: [B] index of the episode.
        step: [B] the window's origin in it.
        known_start: the target's first position counts as a detection (the authors' code does so); one for all, or [B].
        num_detections: the last so many are kept.
        num_tracker_steps: so many steps of the trackers' tracks.
        seed: of the windows' own seeds, which depend on episode and step besides.
    """
    agents = recordings.num_agents
    track = (episode[:, None] * agents + np.arange(agents)).ravel()  # [B * A]
    begin, end = recordings.offset[track], recordings.offset[track + 1]
    now = begin + np.repeat(step, agents)
    if not ((now >= begin) & (now < end)).all():
        raise ValueError("cut_windows: a step lies outside its episode")
    has_start = np.repeat(np.broadcast_to(np.asarray(known_start, dtype=bool), step.shape), agents)
    rows, is_observed = _detection_rows(recordings, begin, now, has_start, num_detections)
    last = rows[np.arange(len(rows)), np.maximum(is_observed.sum(axis=1) - 1, 0)]
    place = recordings.position_m.astype(np.float64)

    def by_window(rows: NDArray[Any]) -> NDArray[Any]:
        """Rows [B * A, ...] as [B, A, ...]."""
        return rows.reshape(-1, agents, *rows.shape[1:])

    is_active = np.take(by_window(is_observed), 0, axis=2)
    first = np.arange(len(step)) * agents + is_active.argmax(axis=1)
    datum = np.where(is_active.any(axis=1)[:, None], place[last[first]], 0.0)  # [B, 2]
    detections = Detections(
        torch.from_numpy(by_window((rows - now[:, None]) * recordings.step_s)),
        torch.from_numpy(by_window(place[rows]) - datum[:, None, None]),
        (_SIGMA_M**2 * torch.eye(2, dtype=torch.float64)).expand(len(step), agents, rows.shape[1], 2, 2),
        torch.from_numpy(by_window(is_observed)),
    )
    time_s = torch.arange(NUM_STEPS, dtype=torch.float64) * recordings.step_s
    later = np.minimum(now[:, None] + np.arange(NUM_STEPS), end[:, None] - 1)
    context = Context(
        torch.from_numpy(datum),
        elapsed_s=torch.from_numpy(step * recordings.step_s),
        known_goal_m=torch.from_numpy(by_window(recordings.known_goal_m[track])).double(),
        tracker_m=torch.from_numpy(_trackers(recordings, begin[::agents], now[::agents], num_tracker_steps)),
    )
    return ForecastWindows(
        WindowBatch(time_s, detections, torch.from_numpy(derived_seeds(seed, "window", episode, step)), 0, context),
        torch.from_numpy(by_window(place[later]) - datum[:, None, None]),
        torch.from_numpy(np.asarray(episode, dtype=np.int64)),
        torch.from_numpy(np.asarray(step, dtype=np.int64)),
    )


def _trackers(recordings: Recordings, begin: Int64s, now: Int64s, num_steps: int) -> Float32s:
    """The trackers at the steps up to `now` [B, H, M, 2]; NaN before the track's first row, `begin`."""
    past = now[:, None] + np.arange(1 - num_steps, 1)
    trackers: Float32s = recordings.tracker_m[np.maximum(past, begin[:, None])]
    trackers[np.less(past, begin[:, None])] = np.nan
    return trackers


def _detection_rows(recordings: Recordings, begin: Int64s, now: Int64s, known_start: Bools, keep: int) -> tuple[Int64s, Bools]:
    """Rows [B, N] of the last detections from `begin` to `now`, oldest first and left-packed, and which of them exist."""
    found = np.flatnonzero(recordings.is_detected)
    first, stop = np.searchsorted(found, begin), np.searchsorted(found, now, side="right")
    count = stop - first
    is_seen_at_start = recordings.is_detected[begin]
    adds_start = known_start & ~is_seen_at_start
    total = np.minimum(count + adds_start, keep)
    place = np.arange(max(1, int(total.max(initial=1))))
    is_observed = place < total[:, None]
    index = np.clip(stop[:, None] - total[:, None] + place, 0, max(len(found) - 1, 0))
    rows = found[index] if len(found) else np.zeros(index.shape, dtype=np.int64)
    is_start = adds_start & (count < keep)
    rows[is_start, 0] = begin[is_start]
    return np.where(is_observed, rows, now[:, None]), is_observed
