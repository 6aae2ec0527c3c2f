"""Which agent of the truth an agent of unknown origin stands for: in each window, by the detections that it was given."""

import dataclasses

import numpy as np
import pyarrow as pa
import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from cadence.arrays import Float64s
from cadence.types import Detections, HypothesisSet, WindowBatch
from pipeline.tracks import agent_tracks, interpolated
from pipeline.windows import MissionWindows

_LEAST_SHARE = 0.5


def match_to_truth(
    windows: MissionWindows, truth: pa.Table, names: tuple[str, ...], max_gap_s: float, reach_m: float
) -> Tensor:
    """The agent [B, J] whose detections lie nearest to each agent of the truth, each taken once; -1 where there is none.

    A detection counts the more the nearer it lies to the truth at its time, and nothing beyond `reach_m`; agents are assigned
    so that the most is counted. An agent of whose detections less than half is counted stands for nobody.
    """
    gain, count = _gains(windows, truth, names, max_gap_s, reach_m), windows.batch.detections.count.numpy()
    match = np.full((len(gain), len(names)), -1)
    for b, gains in enumerate(gain):
        agent, other = linear_sum_assignment(-gains)
        is_match = gains[agent, other] > _LEAST_SHARE * np.maximum(count[b, agent], 1)
        match[b, other[is_match]] = agent[is_match]
    return torch.from_numpy(match)


def _gains(windows: MissionWindows, truth: pa.Table, names: tuple[str, ...], max_gap_s: float, reach_m: float) -> Float64s:
    """How much of each agent's detections the truth of each other counts for [B, A, J]."""
    found = windows.batch.detections
    time_ns = windows.origins_ns[:, None, None] + np.round(found.time_s.numpy() * 1e9).astype(np.int64)
    position_m = found.position_m.numpy() + windows.datum_m[:, None, None]
    tracks = dict(agent_tracks(truth, 0.0))
    gain = np.zeros((*time_ns.shape[:2], len(names)))
    for index, name in enumerate(names):
        true_m = interpolated(tracks[name].time_ns, tracks[name].position_m, time_ns, max_gap_s * 1e9)
        near = np.clip(1.0 - np.linalg.norm(position_m - true_m, axis=-1) / reach_m, 0.0, 1.0)
        gain[..., index] = np.where(found.is_observed.numpy(), np.nan_to_num(near), 0.0).sum(-1)
    return gain


def matched(found: HypothesisSet, match: Tensor) -> HypothesisSet:
    """Hypotheses by the agents of the truth [b, K, J, T, 2]; NaN where no agent stands for one."""
    pick = match.clamp_min(0)[:, None, :, None, None].expand(-1, found.weight.shape[1], -1, *found.position_m.shape[3:])
    position = torch.where((match >= 0)[:, None, :, None, None], found.position_m.gather(2, pick), torch.nan)
    status = tuple(
        tuple(row[agent] if agent >= 0 else "no_detections" for agent in agents)
        for row, agents in zip(found.status, match.tolist(), strict=True)
    )
    height = found.height_m
    if height is not None:
        height = torch.where((match >= 0)[:, None, :, None], height.gather(2, pick[..., 0]), torch.nan)
    return HypothesisSet(position, found.weight, status, height_m=height)


def matched_windows(windows: WindowBatch, match: Tensor) -> WindowBatch:
    """Detections by the agents of the truth [B, J, N]; none where no agent stands for one."""
    found, row = windows.detections, torch.arange(len(match))[:, None]
    column = match.clamp_min(0)
    time_s, position_m, covariance_m2 = (value[row, column] for value in (found.time_s, found.position_m, found.covariance_m2))
    is_observed = found.is_observed[row, column] & (match >= 0)[..., None]
    return dataclasses.replace(windows, detections=Detections(time_s, position_m, covariance_m2, is_observed))
