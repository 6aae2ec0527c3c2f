"""Windows in chunks to hypotheses; where detections are of unknown origin, each is drawn under its own association.

Chunks are pieces of work that know nothing of one another: `pipeline.threads.in_order` does several at once.
"""

import functools
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from cadence.evidence.estimator import CONTRADICTED, FEW_FIT, weighed_as_drawn
from cadence.evidence.settings import WeighingConfig
from cadence.types import Estimator, HypothesisSet
from pipeline.associations import AssociatedWindows
from pipeline.windows import MissionWindows

_WINDOWS_AT_ONCE = 32
_TRACKS_AT_ONCE = 48
_WORST_FIRST = ("guidance_diverged", "infeasible", CONTRADICTED, FEW_FIT, "scarce", "ok")

Drawn = tuple[Tensor, HypothesisSet]
"""Numbers of windows [b], and their hypotheses in float64."""
Piece = Callable[[], Drawn]


def draw_windows(estimator: Estimator, windows: MissionWindows, num_hypotheses: int, is_apart: bool) -> Iterator[Piece]:
    """Windows whose detections say whose they are; `is_apart`: agent by agent, so that chunks are counted in agents."""
    for part in _by_tracks(windows) if is_apart else _by_windows(windows.batch.num_windows):
        yield functools.partial(_draw_part, estimator, windows, num_hypotheses, part)


def _draw_part(estimator: Estimator, windows: MissionWindows, num_hypotheses: int, part: Tensor) -> Drawn:
    drawn = estimator.sample(windows.batch[part], num_hypotheses)
    return part, replace(drawn, position_m=drawn.position_m.double(), weight=drawn.weight.double())


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


def draw_tracks(
    estimator: Estimator, associated: AssociatedWindows, num_hypotheses: int, weighing: WeighingConfig
) -> Iterator[Piece]:
    """For estimators that treat agents apart: every different track of a window is drawn once, and joined by association.

    Evidence weighs what is joined: it speaks of agents, not of tracks that may be theirs.
    """
    for whole in _by_windows(associated.windows.batch.num_windows):
        begin = int(whole[0])
        windows, column = associated.tracks(slice(begin, begin + len(whole)))
        for piece in draw_windows(estimator, windows, num_hypotheses, is_apart=True):
            yield functools.partial(_joined, begin, column, piece, associated, weighing)


def _joined(begin: int, all_columns: Tensor, piece: Piece, associated: AssociatedWindows, weighing: WeighingConfig) -> Drawn:
    """Agents [b, K, A] out of tracks [b, K, U]; NaN where an agent is not part of a hypothesis."""
    part, drawn = piece()
    position = drawn.position_m
    column = all_columns[part]
    pick = column.clamp_min(0)[..., None, None].expand(-1, -1, -1, *position.shape[3:])
    joined = torch.where((column >= 0)[..., None, None], position.gather(2, pick), torch.nan)
    found = tuple(
        tuple(_worst([row[u] for u in used.unique().tolist() if u >= 0]) for used in columns.unbind(-1))
        for row, columns in zip(drawn.status, column, strict=True)
    )
    height = drawn.height_m
    if height is not None:
        height = torch.where((column >= 0)[..., None], height.gather(2, pick[..., 0]), torch.nan)
    whole = HypothesisSet(joined, drawn.weight, found, height_m=height)
    return begin + part, weighed_as_drawn(whole, associated.windows.batch[begin + part], weighing)


def _worst(status: list[str]) -> str:
    return next((word for word in _WORST_FIRST if word in status), "no_detections")


def draw_associations(
    estimator: Estimator, associated: AssociatedWindows, num_hypotheses: int, weighing: WeighingConfig
) -> Iterator[Piece]:
    """For estimators whose agents see each other: every association is a window, drawn as often as it has hypotheses."""
    for part in _by_windows(associated.windows.batch.num_windows):
        yield functools.partial(_draw_associated, estimator, associated, num_hypotheses, weighing, part)


def _draw_associated(
    estimator: Estimator, associated: AssociatedWindows, num_hypotheses: int, weighing: WeighingConfig, part: Tensor
) -> Drawn:
    begin, num_agents = int(part[0]), len(associated.windows.agent_ids)
    some, window, count = associated.by_association(slice(begin, begin + len(part)))
    # hypotheses of a window by association: where those of each begin
    first = np.cumsum(count) - count - num_hypotheses * (window - begin)
    shape = (len(part), num_hypotheses, num_agents, associated.windows.batch.num_steps, 2)
    position = torch.full(shape, torch.nan, dtype=torch.float64)
    weight = torch.zeros(len(part), num_hypotheses, dtype=torch.float64)
    height = None if some.batch.detections.height_m is None else torch.full(shape[:-1], torch.nan, dtype=torch.float64)
    found: list[list[set[str]]] = [[set() for _ in range(num_agents)] for _ in part]
    for size in np.unique(count).tolist():
        chosen = np.flatnonzero(count == size)
        drawn = estimator.sample(some.batch[torch.from_numpy(chosen)], size)
        rows = torch.from_numpy(window[chosen] - begin)[:, None]
        columns = torch.from_numpy(first[chosen])[:, None] + torch.arange(size)
        position[rows, columns] = drawn.position_m.double()
        weight[rows, columns] = drawn.weight.double() * size / num_hypotheses
        if height is not None and drawn.height_m is not None:
            height[rows, columns] = drawn.height_m
        for row, words in zip(rows[:, 0].tolist(), drawn.status, strict=True):
            for agent, word in enumerate(words):
                found[row][agent].add(word)
    status = tuple(tuple(_worst(list(words)) for words in row) for row in found)
    whole = HypothesisSet(position, weight, status, height_m=height)
    return part, weighed_as_drawn(whole, associated.windows.batch[part], weighing)
