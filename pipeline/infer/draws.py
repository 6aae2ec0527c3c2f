"""Windows in chunks to hypotheses; where detections are of unknown origin, each is drawn under its own association."""

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from cadence.types import Estimator
from pipeline.associations import AssociatedWindows
from pipeline.windows import MissionWindows

_WINDOWS_AT_ONCE = 32
_TRACKS_AT_ONCE = 48
_WORST_FIRST = ("guidance_diverged", "infeasible", "ok")

Drawn = tuple[Tensor, Tensor, Tensor, list[list[str]]]
"""Numbers of windows [b], positions [b, K, A, T, 2] about their datum, weights [b, K], status [b][A]."""


def draw_windows(estimator: Estimator, windows: MissionWindows, num_hypotheses: int, is_apart: bool) -> Iterator[Drawn]:
    """Windows whose detections say whose they are; `is_apart`: agent by agent, so that chunks are counted in agents."""
    batch = windows.batch
    for part in _by_tracks(windows) if is_apart else _by_windows(batch.num_windows):
        drawn = estimator.sample(batch[part], num_hypotheses)
        yield part, drawn.position_m.double(), drawn.weight.double(), [list(row) for row in drawn.status]


def _by_windows(num_windows: int) -> Iterator[Tensor]:
    for begin in range(0, num_windows, _WINDOWS_AT_ONCE):
        yield torch.arange(begin, min(begin + _WINDOWS_AT_ONCE, num_windows))


def _by_tracks(windows: MissionWindows) -> Iterator[Tensor]:
    per_window = windows.batch.is_active.sum(1).clamp_min(1)
    chunk_of = (per_window.cumsum(0) - 1) // _TRACKS_AT_ONCE
    for chunk in range(int(chunk_of[-1]) + 1):
        part = torch.nonzero(chunk_of == chunk)[:, 0]
        if len(part):
            yield part


def draw_tracks(estimator: Estimator, associated: AssociatedWindows, num_hypotheses: int) -> Iterator[Drawn]:
    """For estimators that treat agents apart: every different track of a window is drawn once, and joined by association."""
    for whole in _by_windows(associated.windows.batch.num_windows):
        begin = int(whole[0])
        windows, column = associated.tracks(slice(begin, begin + len(whole)))
        for part, position, weight, status in draw_windows(estimator, windows, num_hypotheses, is_apart=True):
            yield begin + part, *_joined(column[part], position, weight, status)


def _joined(
    column: Tensor, position: Tensor, weight: Tensor, status: list[list[str]]
) -> tuple[Tensor, Tensor, list[list[str]]]:
    """Agents [b, K, A] out of tracks [b, K, U]; NaN where an agent is not part of a hypothesis."""
    pick = column.clamp_min(0)[..., None, None].expand(-1, -1, -1, *position.shape[3:])
    joined = torch.where((column >= 0)[..., None, None], position.gather(2, pick), torch.nan)
    found = [
        [_worst([row[u] for u in used.unique().tolist() if u >= 0]) for used in columns.unbind(-1)]
        for row, columns in zip(status, column, strict=True)
    ]
    return joined, weight, found


def _worst(status: list[str]) -> str:
    return next((word for word in _WORST_FIRST if word in status), "no_detections")


def draw_associations(estimator: Estimator, associated: AssociatedWindows, num_hypotheses: int) -> Iterator[Drawn]:
    """For estimators whose agents see each other: every association is a window, drawn as often as it has hypotheses."""
    whole = associated.windows
    num_agents, num_steps = len(whole.agent_ids), whole.batch.num_steps
    for part in _by_windows(whole.batch.num_windows):
        begin = int(part[0])
        some, window, count = associated.by_association(slice(begin, begin + len(part)))
        # hypotheses of a window by association: where those of each begin
        first = np.cumsum(count) - count - num_hypotheses * (window - begin)
        position = torch.full((len(part), num_hypotheses, num_agents, num_steps, 2), torch.nan, dtype=torch.float64)
        weight = torch.zeros(len(part), num_hypotheses, dtype=torch.float64)
        found: list[list[set[str]]] = [[set() for _ in range(num_agents)] for _ in part]
        for size in np.unique(count).tolist():
            chosen = np.flatnonzero(count == size)
            drawn = estimator.sample(some.batch[torch.from_numpy(chosen)], size)
            rows = torch.from_numpy(window[chosen] - begin)[:, None]
            columns = torch.from_numpy(first[chosen])[:, None] + torch.arange(size)
            position[rows, columns] = drawn.position_m.double()
            weight[rows, columns] = drawn.weight.double() * size / num_hypotheses
            for row, words in zip(rows[:, 0].tolist(), drawn.status, strict=True):
                for agent, word in enumerate(words):
                    found[row][agent].add(word)
        yield part, position, weight, [[_worst(list(words)) for words in row] for row in found]
