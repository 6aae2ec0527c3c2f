"""Hypotheses of windows whose detections can be read in several ways: each is drawn under its own way."""

from collections.abc import Callable, Iterator

import numpy as np
import torch
from torch import Tensor

from cadence.types import HypothesisSet, WindowBatch
from pipeline.arrays import Int64s
from pipeline.infer.ways import WayWindows
from pipeline.windows import MissionWindows

_WINDOWS_AT_ONCE = 32
_WORST_FIRST = ("guidance_diverged", "infeasible", "ok")

Drawn = tuple[Tensor, Tensor, Tensor, list[list[str]]]
"""Numbers of windows [b], positions [b, K, A, T, 2] about their datum, weights [b, K], status [b][A]."""


def draw_tracks(ways: WayWindows, draw: Callable[[MissionWindows], Iterator[Drawn]]) -> Iterator[Drawn]:
    """For estimators that treat agents apart: every different track of a window is drawn once, and joined by the ways."""
    for begin in range(0, ways.windows.batch.num_windows, _WINDOWS_AT_ONCE):
        windows, column = ways.tracks(slice(begin, begin + _WINDOWS_AT_ONCE))
        for part, position, weight, status in draw(windows):
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


def draw_ways(
    ways: WayWindows, num_hypotheses: int, sample: Callable[[WindowBatch, Int64s, int], HypothesisSet]
) -> Iterator[Drawn]:
    """For estimators whose agents see each other: every way is a window, drawn as often as it has hypotheses.

    Args:
        ways: the windows.
        num_hypotheses: of a window, over all of its ways.
        sample: draws a batch out of windows with the given numbers.
    """
    whole = ways.windows
    num_agents, num_steps = len(whole.agent_ids), whole.batch.num_steps
    for begin in range(0, whole.batch.num_windows, _WINDOWS_AT_ONCE):
        part = torch.arange(begin, min(begin + _WINDOWS_AT_ONCE, whole.batch.num_windows))
        some, window, count = ways.ways(slice(begin, begin + len(part)))
        # hypotheses of a window by way: where those of each way begin
        first = np.cumsum(count) - count - num_hypotheses * (window - begin)
        position = torch.full((len(part), num_hypotheses, num_agents, num_steps, 2), torch.nan, dtype=torch.float64)
        weight = torch.zeros(len(part), num_hypotheses, dtype=torch.float64)
        found: list[list[set[str]]] = [[set() for _ in range(num_agents)] for _ in part]
        for size in np.unique(count).tolist():
            chosen = np.flatnonzero(count == size)
            drawn = sample(some.batch[torch.from_numpy(chosen)], window[chosen], size)
            rows = torch.from_numpy(window[chosen] - begin)[:, None]
            columns = torch.from_numpy(first[chosen])[:, None] + torch.arange(size)
            position[rows, columns] = drawn.position_m.double()
            weight[rows, columns] = drawn.weight.double() * size / num_hypotheses
            for row, words in zip(rows[:, 0].tolist(), drawn.status, strict=True):
                for agent, word in enumerate(words):
                    found[row][agent].add(word)
        yield part, position, weight, [[_worst(list(words)) for words in row] for row in found]
