"""All that is exported of a mission: what earlier stages left in its directory, planned for the eye."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cadence.arrays import Float64s
from pipeline.catalogue import Catalogue
from pipeline.export.config import ExportConfig
from pipeline.export.display import Marks, Style
from pipeline.export.playback import Scene, Tick, build_scenes, plan_ticks
from pipeline.export.sizes import mark_sizes_m
from pipeline.obstacle_file import OBSTACLES_NAME, read_obstacle_entries
from pipeline.results import MissionHypotheses, read_hypothesis_tables
from pipeline.stories import MISSION_NAME, MissionStories, read_stories
from pipeline.tables import read_table
from pipeline.tracks import UNKNOWN_AGENT, agent_tracks

_VERTICES, _FEWEST_VERTICES = 48, 4
_LINE_BYTES, _VERTEX_BYTES, _MARK_BYTES = 70.0, 20.0, 400.0
"""On the wire, before compression: of a line, each of its points where all are flat, and all marks of an agent at a moment."""

_CLOCK_TOLERANCE_NS = 10 * 1_000_000_000


@dataclass(frozen=True, eq=False)
class Exported:
    """All that is exported. Times are the clock of the detections; `clock_offset_ns` brings them to the log's.

    `stories` are as many mission hypotheses as are drawn, None where there are none; `sources` holds the rows of ASSOCIATIONS
    by the row of their detection.
    """

    catalogue: Catalogue
    hypotheses: MissionHypotheses
    detections: list[dict[str, Any]]
    sources: dict[int, list[dict[str, Any]]]
    marks: tuple[Marks, ...]
    obstacles: list[dict[str, Any]]
    style: Style
    scenes: list[Scene]
    ticks: list[Tick]
    tick_s: float
    clock_offset_ns: int
    stories: MissionStories | None = None


def read_exported(directory: Path, catalogue: Catalogue, config: ExportConfig) -> Exported:
    """Read a mission directory.

    Raises `InputError` where a table is absent or damaged.
    """
    hypotheses = read_hypothesis_tables(directory)
    table, _ = read_table(directory / "detections.parquet", "detections")
    table = table.append_column("row", pa.array(np.arange(table.num_rows))).sort_by([("time_ns", "ascending")])
    obstacles = read_obstacle_entries(directory / OBSTACLES_NAME)
    scenes = build_scenes(hypotheses)
    offset_ns = _clock_offset_ns(table)
    tick_ns = _tick_ns(scenes, config)
    return Exported(
        catalogue=catalogue,
        hypotheses=hypotheses,
        detections=table.to_pylist(),
        sources=_read_sources(directory / "associations.parquet"),
        marks=_marks(table),
        obstacles=obstacles,
        style=_style(hypotheses, scenes, table, config),
        scenes=scenes,
        ticks=plan_ticks(scenes, tick_ns, catalogue.end_ns - offset_ns) if scenes else [],
        tick_s=tick_ns * 1e-9,
        clock_offset_ns=offset_ns,
        stories=read_stories(directory, config.num_scene_hypotheses) if (directory / MISSION_NAME).is_file() else None,
    )


def _read_sources(path: Path) -> dict[int, list[dict[str, Any]]]:
    """Who may have caused each detection of unknown origin; empty where infer told none apart."""
    found: dict[int, list[dict[str, Any]]] = {}
    for row in read_table(path, "associations")[0].to_pylist() if path.is_file() else ():
        found.setdefault(row["detection"], []).append(row)
    return found


def _clock_offset_ns(detections: pa.Table) -> int:
    """What to add to the detections' stamps to land on the log's clock; 0 where they differ by mere latency.

    Simulators stamp from zero and record at today's date: without this our channels and the log's would not overlap.
    """
    difference = detections["log_time_ns"].to_numpy() - detections["time_ns"].to_numpy()
    offset_ns = int(np.median(difference)) if len(difference) else 0
    return offset_ns if abs(offset_ns) > _CLOCK_TOLERANCE_NS else 0


def _tick_ns(scenes: list[Scene], config: ExportConfig) -> int:
    """The configured tick; else a second or a step, and longer where the marks would be too large."""
    if config.tick_s is not None:
        return round(config.tick_s * 1e9)
    steps = [live.window.step_ns for scene in scenes for live in scene.live]
    if not steps:
        return 1_000_000_000
    seconds = (scenes[-1].end_ns - scenes[0].origin_ns) * 1e-9
    marked_bytes = seconds * float(np.mean([len(scene.live) for scene in scenes])) * _MARK_BYTES
    needed_s = marked_bytes / (config.max_scene_mb * 1e6)
    return max(1_000_000_000, max(steps), int(np.ceil(needed_s)) * 1_000_000_000)


def num_vertices(scenes: list[Scene], config: ExportConfig) -> int:
    """Points of a drawn hypothesis, at most: fewer where all lines together would be larger than is allowed."""
    if config.max_vertices is not None:
        return config.max_vertices
    num_lines = sum(min(len(live.weight), config.num_scene_hypotheses) for scene in scenes for live in scene.live)
    room_bytes = config.max_scene_mb * 1e6 / max(num_lines, 1) - 2.0 * _LINE_BYTES  # past and future are a line each
    return int(np.clip(room_bytes / _VERTEX_BYTES, _FEWEST_VERTICES, _VERTICES))


def _marks(detections: pa.Table) -> tuple[Marks, ...]:
    agent = np.array([name or UNKNOWN_AGENT for name in detections["agent_id"].to_pylist()], dtype=object)
    time_ns = detections["time_ns"].to_numpy()
    position_m = _positions(detections)
    usable = np.isfinite(position_m).all(axis=-1)
    height_m = detections["z_m"].to_numpy().astype(np.float64) if "cov_zz_m2" in detections.column_names else None
    found = []
    for name in sorted(set(agent.tolist())):
        own = (agent == name) & usable
        found.append(Marks(name, time_ns[own], position_m[own], None if height_m is None else height_m[own]))
    return tuple(found)


def _style(hypotheses: MissionHypotheses, scenes: list[Scene], detections: pa.Table, config: ExportConfig) -> Style:
    position_m = _positions(detections)
    position_m = position_m[np.isfinite(position_m).all(axis=-1)]
    corners = np.stack([position_m.min(axis=0), position_m.max(axis=0)]) if len(position_m) else np.zeros((2, 2))
    center_m, extent_m = corners.mean(axis=0), max(float(np.max(corners[1] - corners[0])), 1.0)
    z_m = detections["z_m"].to_numpy().astype(np.float64)
    z_m = z_m[np.isfinite(z_m)]
    has_height = "cov_zz_m2" in detections.column_names
    live = [one.agent for scene in scenes for one in scene.live]
    num_seen = Counter({agent.agent_id: 0 for agent in live})
    for agent in live:
        num_seen[agent.agent_id] = max(num_seen[agent.agent_id], agent.num_detections)
    return Style(
        agent_ids=hypotheses.agent_ids,
        center_m=(float(center_m[0]), float(center_m[1])),
        extent_m=extent_m,
        z_m=round(float(z_m.min() if has_height else z_m.mean()), 1) if len(z_m) else 0.0,
        num_hypotheses=config.num_scene_hypotheses,
        max_vertices=num_vertices(scenes, config),
        mark_m=mark_sizes_m(scenes, _sigma_m(detections), extent_m),
        plotted_ids=tuple(sorted(num_seen, key=lambda agent_id: (-num_seen[agent_id], agent_id))),
        named_ids=frozenset(pc.unique(detections["agent_id"]).drop_null().to_pylist()),
        uncertain_ids=frozenset(agent.agent_id for agent in live if agent.probability is not None),
        high_ids=frozenset(agent.agent_id for agent in live if agent.height_m is not None),
    )


def _sigma_m(detections: pa.Table) -> dict[str, float]:
    """Accuracy of the detections of each agent, in the median: the radius of a circle as large as the covariance's ellipse."""
    spread = {name: np.linalg.det(track.covariance_m2) ** 0.25 for name, track in agent_tracks(detections, 0.0)}
    return {name: float(np.nanmedian(radius_m)) for name, radius_m in spread.items()}


def _positions(detections: pa.Table) -> Float64s:
    return np.stack([detections["x_m"].to_numpy(), detections["y_m"].to_numpy()], axis=-1)
