"""What a mission's hypotheses are compared with: its truth on the grid of the windows, by the agents that it names."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import torch
from torch import Tensor

from cadence.constraints.checker import segments_in_collision, states_in_collision
from cadence.constraints.obstacles import Obstacles
from cadence.errors import InputError
from cadence.types import HypothesisSet, WindowBatch
from pipeline.associations import DataAssociation, Sources, build_associated_windows
from pipeline.grids import Grid
from pipeline.manifest import read_manifest
from pipeline.obstacle_file import OBSTACLES_NAME, read_obstacles
from pipeline.results import MissionHypotheses
from pipeline.scoring.matching import match_to_truth, matched, matched_windows
from pipeline.scoring.scores import IsInside
from pipeline.tables import read_table
from pipeline.tracks import UNKNOWN_AGENT
from pipeline.windows import MissionWindows, build_windows, heights_on_grid, truth_on_grid

LABELS_NAME = "labels.parquet"
_TRUTH_GAP_STEPS = 2.0
_CUTOFF_STEPS = 16.0
_LEAST_PROBABILITY = 0.5


@dataclass(frozen=True, eq=False)
class Case:
    """What is compared with what.

    stored      the hypotheses
    grid        of their windows; default_sigma_m accuracy of detections that state none
    detections  each with its agent, the likeliest one where the log does not say; they lie in the windows, which rivals see
    is_counted  [B, A] agents that are said to be there
    names       of the J agents of the truth that are compared; match [B, J] which of the A each one is, -1: none
    is_matched  whether they had to be matched, as the origin of detections is unknown
    truth_m     [B, J, T, 2] about the datum, is_known [B, J, T]
    truth_height_m  [B, J, T] NaN where unknown; None where hypotheses have no heights
    """

    stored: MissionHypotheses
    grid: Grid
    default_sigma_m: float
    detections: pa.Table
    windows: MissionWindows
    is_counted: Tensor
    names: tuple[str, ...]
    match: Tensor
    is_matched: bool
    truth_m: Tensor
    is_known: Tensor
    max_truth_gap_s: float
    cutoff_m: float
    truth_height_m: Tensor | None = None

    @cached_property
    def scored(self) -> WindowBatch:
        """The windows by the agents of the truth."""
        return matched_windows(self.windows.batch, self.match) if self.is_matched else self.windows.batch

    @property
    def is_joint(self) -> bool:
        """Whether there is something to say of all agents together."""
        return len(self.names) > 1 or self.is_matched

    @property
    def num_hypotheses(self) -> int:
        """The most of any window."""
        return max(len(window.hypothesis) for window in self.stored.windows)

    def draw(self, index: Tensor) -> HypothesisSet:
        """The stored hypotheses of the windows with the indices [b]."""
        return _stored_hypotheses(self.stored, self.windows, index, self.num_hypotheses)

    def draw_scored(self, index: Tensor) -> HypothesisSet:
        """The same by the agents of the truth."""
        found = self.draw(index)
        return matched(found, self.match[index]) if self.is_matched else found


def read_case(
    directory: Path,
    stored: MissionHypotheses,
    max_truth_gap_s: float | None = None,
    cutoff_m: float | None = None,
    seed: int = 0,
) -> Case:
    """The case of a mission directory with detections and truth; `stored` are its hypotheses.

    Raises `InputError` where hypotheses and truth cannot be compared, with the reason.
    """
    detections, _ = read_table(directory / "detections.parquet", "detections")
    truth, _ = read_table(directory / "truth.parquet", "truth")
    told = _Told.of(directory)
    grid, sigma_m = _stored_grid(stored, directory, told.context_steps), told.default_sigma_m
    path = directory / LABELS_NAME
    is_matched = path.is_file()
    labels = read_table(path, "labels")[0] if is_matched else None
    windows, detections = _seen(detections, grid, sigma_m, seed, labels)
    if not is_matched:
        truth = _named_like(truth, windows.agent_ids, directory)
    names = tuple(sorted(pc.unique(truth["agent_id"]).to_pylist())) if is_matched else windows.agent_ids
    max_gap_s = max_truth_gap_s or default_truth_gap_s(truth, grid.step_s)
    truth_m, is_known = truth_on_grid(truth, replace(windows, agent_ids=names), max_gap_s)
    cutoff_m = cutoff_m or _default_cutoff_m(truth_m, is_known)
    match = torch.arange(len(names)).expand(len(truth_m), -1)
    if is_matched:
        match = match_to_truth(windows, truth, names, max_gap_s, cutoff_m)
    is_counted = _is_counted(stored, windows.agent_ids)
    truth_height_m = None
    if any(agent.height_m is not None for window in stored.windows for agent in window.agents):
        truth_height_m = heights_on_grid(truth, replace(windows, agent_ids=names), max_gap_s)
    return Case(
        stored,
        grid,
        sigma_m,
        detections,
        windows,
        is_counted,
        names,
        match,
        is_matched,
        truth_m,
        is_known,
        max_gap_s,
        cutoff_m,
        truth_height_m,
    )


def _seen(
    detections: pa.Table, grid: Grid, sigma_m: float, seed: int, labels: pa.Table | None
) -> tuple[MissionWindows, pa.Table]:
    """Windows as they were inferred from, of unknown origin under the likeliest association, and the detections by agents."""
    if labels is None:
        return build_windows(detections, grid, seed, sigma_m), detections
    found = DataAssociation.of_labels(detections, labels, grid, sigma_m)
    sources = Sources(found.named(detections), grid, found)
    return build_associated_windows(detections, sources, seed, 1, sigma_m).windows, sources.named


def _is_counted(stored: MissionHypotheses, agent_ids: tuple[str, ...]) -> Tensor:
    """Agents [B, A] that are rather there than not; those of known origin are."""
    is_counted = torch.ones(len(stored.windows), len(agent_ids), dtype=torch.bool)
    for b, window in enumerate(stored.windows):
        for agent in window.agents:
            if agent.agent_id in agent_ids and agent.probability is not None:
                is_counted[b, agent_ids.index(agent.agent_id)] = agent.probability > _LEAST_PROBABILITY
    return is_counted


def _default_cutoff_m(truth_m: Tensor, is_known: Tensor) -> float:
    """The way that agents typically go in the gap between two detections: sixteen steps at their mean speed, at least 1 m."""
    step_m = torch.linalg.vector_norm(truth_m.diff(dim=2), dim=-1)[is_known[..., 1:] & is_known[..., :-1]]
    return max(1.0, _CUTOFF_STEPS * float(step_m.mean())) if len(step_m) else 1.0


def default_truth_gap_s(truth: pa.Table, step_s: float) -> float:
    """Two steps, or twice the median time between an agent's truth samples where that is longer."""
    order = truth.sort_by([("agent_id", "ascending"), ("time_ns", "ascending")])
    agent = order["agent_id"].combine_chunks().dictionary_encode()
    codes = pa.chunked_array([agent] if isinstance(agent, pa.Array) else agent.chunks).unify_dictionaries()
    index = np.concatenate([chunk.indices.to_numpy() for chunk in codes.chunks]) if truth.num_rows else np.zeros(0, np.int32)
    gaps = np.diff(order["time_ns"].to_numpy())[np.diff(index) == 0]
    median_s = float(np.median(gaps)) * 1e-9 if len(gaps) else 0.0
    return max(_TRUTH_GAP_STEPS * step_s, 2.0 * median_s)


def _stored_grid(stored: MissionHypotheses, directory: Path, context_steps: int | None) -> Grid:
    drawn = [window for window in stored.windows if len(window.hypothesis)]
    if not drawn:
        raise InputError(f"{directory}: there are no hypotheses to score; see windows.parquet (status, advice) for the reasons")
    origins_ns = np.array([window.origin_ns for window in stored.windows], dtype=np.int64)
    first = drawn[0]
    return Grid(
        first.step_ns, first.origin_index + 1, first.num_steps - first.origin_index - 1, origins_ns, context_steps
    )  # fmt: skip


def mission_obstacles(directory: Path) -> Obstacles | None:
    """What stands in the way of a mission directory; None where nothing does."""
    path = directory / OBSTACLES_NAME
    obstacles = read_obstacles(path) if path.is_file() else None
    return obstacles if obstacles is not None and obstacles.count else None


def collision_test(obstacles: Obstacles | None, windows: MissionWindows, are_ways_straight: bool = True) -> IsInside | None:
    """Which states touch an obstacle, themselves or on the straight way from the step before; None without obstacles.

    `are_ways_straight`: false of the truth, of which the way between two steps is not known.
    """
    if obstacles is None:
        return None

    def collides(position_m: Tensor, index: Tensor) -> Tensor:
        offset_m = torch.from_numpy(windows.datum_m[index.numpy()])[:, None, None, None]
        hit = states_in_collision(position_m, obstacles, offset_m=offset_m)
        if are_ways_straight:
            hit[..., 1:] |= segments_in_collision(position_m, obstacles, offset_m=offset_m)
        return hit

    return collides


@dataclass(frozen=True)
class _Told:
    """What infer was told of the detections: rivals get the same.

    default_sigma_m  accuracy of detections that state none
    context_steps    how far back they are read, which is for infer's checkpoint to say
    """

    default_sigma_m: float = 0.0
    context_steps: int | None = None

    @staticmethod
    def of(directory: Path) -> "_Told":
        """By infer's manifest; the defaults where there is none."""
        manifest = read_manifest("infer", directory) or {}
        config, summary = manifest.get("config") or {}, manifest.get("summary") or {}
        steps = summary.get("context_steps", (config.get("grid") or {}).get("context_steps"))
        return _Told(float(config.get("default_sigma_m") or 0.0), steps)


def _named_like(truth: pa.Table, agent_ids: tuple[str, ...], directory: Path) -> pa.Table:
    """The truth under the agents' names: detections of unknown origin belong to the only agent that there is."""
    names = pc.unique(truth["agent_id"]).to_pylist()
    if set(names) & set(agent_ids):
        return truth
    if agent_ids == (UNKNOWN_AGENT,) and len(names) == 1:
        column = pa.array([UNKNOWN_AGENT] * truth.num_rows, pa.string())
        return truth.set_column(truth.schema.get_field_index("agent_id"), truth.schema.field("agent_id"), column)
    raise InputError(
        f"{directory}: truth is of {', '.join(map(str, names[:5])) or 'nobody'}, detections are of {', '.join(agent_ids[:5])}; "
        "give both the same names (agent, agent_path or {agent} in [[extract.truth]] and [[extract.detections]])"
    )


def _stored_hypotheses(stored: MissionHypotheses, windows: MissionWindows, index: Tensor, num_hypotheses: int) -> HypothesisSet:
    """Hypotheses of some windows as one set; a window with fewer of them is filled up with weight zero."""
    shape = (len(index), num_hypotheses, len(windows.agent_ids), windows.batch.num_steps, 2)
    position = np.full(shape, np.nan)
    has_height = any(agent.height_m is not None for b in index.tolist() for agent in stored.windows[b].agents)
    height = np.full(shape[:-1], np.nan) if has_height else None
    weight = np.zeros(shape[:2])
    for row, b in enumerate(index.tolist()):
        window = stored.windows[b]
        k = len(window.hypothesis)
        weight[row, :k] = window.weight if k else 0.0
        for agent in window.agents:
            if agent.is_live and agent.agent_id in windows.agent_ids:
                shift_m = np.array(agent.datum_m) - windows.datum_m[b]
                target = position[row, :, windows.agent_ids.index(agent.agent_id)]
                target[:k], target[k:] = agent.position_m + shift_m, agent.position_m[0] + shift_m
                if height is not None and agent.height_m is not None:
                    high = height[row, :, windows.agent_ids.index(agent.agent_id)]
                    high[:k], high[k:] = agent.height_m, agent.height_m[0]
    weight[weight.sum(axis=1) == 0] = 1.0  # nothing was drawn: all NaN, any weight does
    weight /= weight.sum(axis=1, keepdims=True)
    status = tuple(tuple("ok" for _ in windows.agent_ids) for _ in range(len(index)))
    high_m = None if height is None else torch.from_numpy(height)
    return HypothesisSet(torch.from_numpy(position), torch.from_numpy(weight), status, height_m=high_m)
