"""Windows and tracks as rows, one agent a row, and rows back as joint hypotheses."""

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from cadence.bank.smoother import Nodes
from cadence.types import Detections, HypothesisSet, WindowBatch


def active_rows(windows: WindowBatch) -> tuple[Nodes, Tensor]:
    """The detections of every active agent as rows [R, N], float64, and a seed a row."""
    active = windows.is_active
    detections = windows.detections
    num_used = int(detections.count.max()) if active.any() else 1
    columns = [
        value[active][:, :num_used]
        for value in (detections.time_s, detections.position_m, detections.covariance_m2, detections.is_observed)
    ]
    times, observed = columns[0].double(), columns[3]
    # padding repeats the last detection's time, so that time never runs backwards
    times = torch.where(observed, times, torch.full_like(times, -math.inf)).cummax(dim=1).values
    agent = torch.arange(windows.num_agents).expand(active.shape)
    # windows' seeds are hashes: no two rows of a mission meet
    seeds = (windows.seeds[:, None] * 1_000_003 + agent * 7_919)[active] % (2**62)
    return Nodes(times, columns[1].double(), columns[2].double(), observed), seeds


def scatter_hypotheses(sample_m: Tensor, windows: WindowBatch) -> HypothesisSet:
    """Equally weighted hypotheses [B, K, A, T, 2] from the rows [R, K, T, 2] of the active agents."""
    active = windows.is_active
    b, a = active.shape
    k, t = sample_m.shape[1:3]
    position = torch.full((b, a, k, t, 2), math.nan, dtype=sample_m.dtype)
    position[active] = sample_m
    status = tuple(tuple("ok" if flag else "no_detections" for flag in row) for row in active.tolist())
    return HypothesisSet(position.transpose(1, 2), torch.full((b, k), 1.0 / k, dtype=sample_m.dtype), status)


def with_status(drawn: HypothesisSet, windows: WindowBatch, words: Mapping[str, Tensor]) -> HypothesisSet:
    """The same hypotheses; of the active agents, rows [R], the first of the words is said whose mask [R] is true there."""
    status = [list(row) for row in drawn.status]
    for row, (window, agent) in enumerate(windows.is_active.nonzero().tolist()):
        status[window][agent] = next((word for word, where in words.items() if bool(where[row])), status[window][agent])
    return HypothesisSet(drawn.position_m, drawn.weight, tuple(map(tuple, status)))


def track_rows(tracks: Detections) -> Nodes:
    """Stretches of detections [B, 1, N] as rows [R, N] (stretches without any left out)."""
    seeds = torch.zeros(len(tracks.time_s), dtype=torch.int64)
    rows, _ = active_rows(WindowBatch(torch.zeros(1), tracks, seeds, 0))
    return rows


def spaced(rows: Nodes, spacing_s: float) -> Nodes:
    """The same rows without detections that lie less than `spacing_s` before the next one that is kept; the last one is."""
    if not len(rows.time_s):
        return rows
    is_kept = torch.zeros_like(rows.is_observed)
    newer_s = torch.full((len(rows.time_s),), torch.inf, dtype=torch.float64)
    for index in range(rows.time_s.shape[1] - 1, -1, -1):
        keep = rows.is_observed[:, index] & (newer_s - rows.time_s[:, index] >= spacing_s)
        is_kept[:, index] = keep
        newer_s = torch.where(keep, rows.time_s[:, index], newer_s)
    order = torch.argsort((~is_kept).to(torch.int8), dim=1, stable=True)[:, : max(1, int(is_kept.sum(1).amax()))]
    is_kept = is_kept.gather(1, order)
    time_s = torch.where(is_kept, rows.time_s.gather(1, order), -torch.inf).cummax(dim=1).values
    position_m = rows.position_m.gather(1, order[..., None].expand(-1, -1, 2))
    return Nodes(time_s, position_m, rows.covariance_m2.gather(1, order[..., None, None].expand(-1, -1, 2, 2)), is_kept)
