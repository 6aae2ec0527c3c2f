"""What mission hypotheses are made of: the detections by agent, under each association, and what infer was told of them."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa

from cadence.arrays import Int64s
from cadence.association.types import CLUTTER
from pipeline.associations import DataAssociation, shared_out
from pipeline.estimators.fitting import FittingData
from pipeline.estimators.presets import load_estimator
from pipeline.estimators.samplings import Samplings
from pipeline.grids import Grid, GridConfig, plan_grid
from pipeline.pasts import read_pasts
from pipeline.retrospect.told import Told
from pipeline.tables import Frame, read_table
from pipeline.tracks import DetectionTrack, agent_tracks
from pipeline.windows import build_windows

_LEAST_HISTORY = 16
"""Windows with fewer steps up to their origin say nothing of how long a target keeps its way."""


@dataclass(frozen=True, eq=False)
class Share:
    """One track of an agent, and the stories in which it is the agent's: those of one association, or of all."""

    agent: int
    track: DetectionTrack
    stories: Int64s


@dataclass(frozen=True, eq=False)
class MissionSources:
    """The detections of a mission by agent.

    named   the likeliest agent of each, as models of motion are fitted to them
    shares  which track each agent has in which stories; an agent is no part of stories that none names
    is_grid_of_windows  the grid is that of infer's windows, so that what infer found of the bank holds on it
    """

    told: Told
    summary: dict[str, Any]
    frame: Frame
    log_id: str
    named: pa.Table
    grid: Grid
    agent_ids: tuple[str, ...]
    shares: tuple[Share, ...]
    is_grid_of_windows: bool = False

    @staticmethod
    def read(directory: Path, num_stories: int, seed: int) -> "MissionSources":
        """The sources of a mission directory. `InputError` where a table is absent or of other hypotheses."""
        told, summary = Told.of(directory)
        detections, frame = read_table(directory / "detections.parquet", "detections")
        origins_ns = np.unique(read_table(directory / "windows.parquet", "windows")[0]["origin_ns"].to_numpy())
        association = read_pasts(directory, detections, origins_ns, told.default_sigma_m)
        named = detections if association is None else association.named(detections)
        grid, is_same = _grid(named, told, summary, origins_ns)
        agent_ids, shares = _shares(detections, association, told.default_sigma_m, num_stories, seed)
        return MissionSources(told, summary, frame, str(detections["log_id"][0]), named, grid, agent_ids, shares, is_same)

    def told_of(self, name: Literal["bank", "height"]) -> Mapping[str, Any] | None:
        """What infer says of a bank that it fitted to the same detections on the same grid, if it did."""
        found = self.summary.get(name) if self.is_grid_of_windows else None
        return found if isinstance(found, dict) else None

    def fitting(self, seed: int) -> FittingData:
        """What models are fitted to, as in infer."""
        sigma_m = self.told.default_sigma_m
        return FittingData.of(self.named, self.grid, build_windows(self.named, self.grid, seed, sigma_m), sigma_m)


def _grid(named: pa.Table, told: Told, summary: Mapping[str, Any], origins_ns: Int64s) -> tuple[Grid, bool]:
    """The grid of the windows, and that it is; where it is that of a place model, which sees no history, one that fits."""
    config = load_estimator(str(summary.get("checkpoint", told.checkpoint)), Samplings()).grid(told.grid)
    if config.history_steps < _LEAST_HISTORY:
        return plan_grid(named, GridConfig()), False
    step_ns = round(float(summary["step_s"]) * 1e9)
    return Grid(step_ns, config.history_steps, config.horizon_steps, origins_ns, summary.get("context_steps")), True


def _shares(
    detections: pa.Table, association: DataAssociation | None, sigma_m: float, num_stories: int, seed: int
) -> tuple[tuple[str, ...], tuple[Share, ...]]:
    """Names of the agents, and their tracks."""
    known = detections if association is None else detections.filter(detections["agent_id"].is_valid())
    tracks = dict(agent_tracks(known, sigma_m)) if known.num_rows else {}
    agent_ids = tuple(sorted({*tracks, *(association.agent_ids if association is not None else ())}))
    every = np.arange(num_stories)
    shares = [Share(agent_ids.index(name), track, every) for name, track in tracks.items()]
    if association is not None:
        shares += _by_association(association, agent_ids, num_stories, seed)
    return agent_ids, tuple(shares)


def _by_association(association: DataAssociation, agent_ids: tuple[str, ...], num_stories: int, seed: int) -> list[Share]:
    """A share for every different track of an agent under the associations of the whole stream."""
    found = association.at_origins[-1]
    # in random order, as the hypotheses of an association are no neighbours
    order = np.random.default_rng(seed).permutation(num_stories)
    owner = np.empty(num_stories, dtype=np.int64)
    owner[order] = shared_out(found.weight, num_stories, seed)
    stories: dict[tuple[int, bytes], list[Int64s]] = {}
    rows_of: dict[tuple[int, bytes], Int64s] = {}
    for number in np.unique(owner):
        label = found.label[number]
        for agent in np.unique(label[label != CLUTTER]).tolist():
            rows = np.flatnonzero(label == agent)
            key = agent_ids.index(association.agent_ids[agent]), rows.tobytes()
            rows_of[key] = rows
            stories.setdefault(key, []).append(np.flatnonzero(owner == number))
    return [
        Share(key[0], association.stream[rows_of[key]], np.sort(np.concatenate(numbers))) for key, numbers in stories.items()
    ]
