"""Many recorded or simulated episodes of one target as flat arrays, and forecasting windows cut out of them.

The protocol is the paper's (Ye et al., CADENCE, MRS 2023, section V): at a step of an episode the detections up to it are
known, and the next positions are asked for; after the episode's end the target stays where it was.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cadence.types import Context, Detections, WindowBatch

NUM_STEPS = 120
"""Steps that a window asks for; the first one is now."""

_SIGMA_M = 1.0
"""Detections are exact; covariances must not be zero. This is far below the step length."""

Int64s = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Recordings:
    """E episodes with S steps in all, one behind the other; mission frame, metres.

    step_s       seconds between steps
    offset       [E + 1] int64: the rows of episode i are offset[i] ... offset[i + 1] - 1
    position_m   [S, 2] float32 the target
    is_detected  [S] bool: somebody detected it; detections are exact
    tracker_m    [S, M, 2] float32 the moving trackers, aircraft first; NaN where there is none
    known_goal_m [E, 2] float32 the goal that the trackers know of; NaN where they know none
    """

    step_s: float
    offset: Int64s
    position_m: NDArray[np.float32]
    is_detected: NDArray[np.bool_]
    tracker_m: NDArray[np.float32]
    known_goal_m: NDArray[np.float32]

    def __post_init__(self) -> None:
        e, s = len(self.offset) - 1, len(self.position_m)
        if e < 0 or self.offset[0] != 0 or self.offset[-1] != s or (np.diff(self.offset) < 1).any():
            raise ValueError(f"Recordings.offset must rise from 0 to {s}, one step an episode at least")
        expected = {"position_m": (s, 2), "is_detected": (s,), "known_goal_m": (e, 2)}
        expected["tracker_m"] = (s, self.tracker_m.shape[1] if self.tracker_m.ndim == 3 else 0, 2)
        for name, want in expected.items():
            if getattr(self, name).shape != want:
                raise ValueError(f"Recordings.{name} has shape {getattr(self, name).shape}, expected {want}")

    def __len__(self) -> int:
        return len(self.offset) - 1

    @property
    def length(self) -> Int64s:
        """Steps of every episode [E]."""
        return np.diff(self.offset)

    def rates(self) -> NDArray[np.float64]:
        """Share of steps with a detection, an episode [E]."""
        return np.add.reduceat(self.is_detected.astype(np.float64), self.offset[:-1]) / self.length

    def select(self, episodes: Sequence[int] | Int64s | slice) -> "Recordings":
        """Some of the episodes, in the order given."""
        chosen = np.arange(len(self))[episodes]
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
        )

    @staticmethod
    def concatenate(parts: Sequence["Recordings"]) -> "Recordings":
        """All episodes of the parts, in order; missing trackers are absent (NaN). Raises where steps differ in length."""
        if len({part.step_s for part in parts}) != 1:
            raise ValueError("Recordings.concatenate: parts with different steps, or none")
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
        )


@dataclass(frozen=True, eq=False)
class ForecastWindows:
    """B windows of one agent: what is known, and what came.

    windows  their grid is now and the steps after it; the datum is the last detection, or the map's origin without any
    context  all that `Context` has
    truth_m  [B, 1, T, 2] relative to the datum, float64
    episode, step  [B] int64 where they were cut
    """

    windows: WindowBatch
    context: Context
    truth_m: Tensor
    episode: Tensor
    step: Tensor

    def __len__(self) -> int:
        return len(self.episode)

    def __getitem__(self, pick: slice | Tensor) -> "ForecastWindows":
        """A selection of windows."""
        return ForecastWindows(self.windows[pick], self.context[pick], self.truth_m[pick], self.episode[pick], self.step[pick])


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
    episode = np.searchsorted(recordings.offset, chosen, side="right") - 1
    return episode, chosen - recordings.offset[episode]


def cut_windows(
    recordings: Recordings,
    episode: Int64s,
    step: Int64s,
    *,
    known_start: bool | NDArray[np.bool_] = True,
    num_detections: int = 512,
    num_tracker_steps: int = 64,
    seed: int = 0,
) -> ForecastWindows:
    """Windows at the steps [B] of the episodes [B].

    Args:
        recordings: what is cut.
        episode: [B] index of the episode.
        step: [B] the window's origin in it.
        known_start: the target's first position counts as a detection (the authors' code does so); one for all, or [B].
        num_detections: the last so many are kept.
        num_tracker_steps: so many steps of the trackers' tracks.
        seed: of the windows' own seeds, which depend on episode and step besides.
    """
    begin, end = recordings.offset[episode], recordings.offset[episode + 1]
    now = begin + step
    if not ((step >= 0) & (now < end)).all():
        raise ValueError("cut_windows: a step lies outside its episode")
    has_start = np.broadcast_to(np.asarray(known_start, dtype=bool), begin.shape)
    rows, is_observed = _detection_rows(recordings, begin, now, has_start, num_detections)
    last = rows[np.arange(len(rows)), np.maximum(is_observed.sum(axis=1) - 1, 0)]
    place = recordings.position_m.astype(np.float64)
    datum = np.where(is_observed[:, :1], place[last], 0.0)
    detections = Detections(
        torch.from_numpy((rows - now[:, None]) * recordings.step_s)[:, None],
        torch.from_numpy(place[rows] - datum[:, None])[:, None],
        (_SIGMA_M**2 * torch.eye(2, dtype=torch.float64)).expand(len(rows), 1, rows.shape[1], 2, 2),
        torch.from_numpy(is_observed)[:, None],
    )
    seeds = torch.from_numpy((seed * 1_000_003 + episode) * 10_007 + step)
    time_s = torch.arange(NUM_STEPS, dtype=torch.float64) * recordings.step_s
    later = np.minimum(now[:, None] + np.arange(NUM_STEPS), end[:, None] - 1)
    past = now[:, None] + np.arange(1 - num_tracker_steps, 1)
    trackers = recordings.tracker_m[np.maximum(past, begin[:, None])]
    trackers[np.less(past, begin[:, None])] = np.nan
    context = Context(
        torch.from_numpy(datum),
        torch.from_numpy(step * recordings.step_s),
        torch.from_numpy(recordings.known_goal_m[episode])[:, None].double(),
        torch.from_numpy(trackers),
    )
    return ForecastWindows(
        WindowBatch(time_s, detections, seeds, 0),
        context,
        torch.from_numpy(place[later] - datum[:, None])[:, None],
        torch.from_numpy(np.asarray(episode, dtype=np.int64)),
        torch.from_numpy(np.asarray(step, dtype=np.int64)),
    )


def _detection_rows(
    recordings: Recordings, begin: Int64s, now: Int64s, known_start: NDArray[np.bool_], keep: int
) -> tuple[Int64s, NDArray[np.bool_]]:
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
