"""Export: hypotheses.parquet → `<log stem>.cadence.mcap`, which opens in Foxglove beside the log, and layouts for it."""

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from cadence.errors import InputError
from pipeline.arrays import Float64s
from pipeline.catalogue import Catalogue, read_catalogue
from pipeline.config import config_as_dict
from pipeline.export import maps, messages
from pipeline.export.display import Drawing, Marks, Style, draw, obstacle_entities, scene_entities
from pipeline.export.layouts import build_layout, build_legacy_layout
from pipeline.export.playback import Scene, Tick, build_scenes, plan_ticks
from pipeline.export.scene import encode_scene
from pipeline.files import hash_file
from pipeline.logs.append import write_combined
from pipeline.logs.recorder import Compression, Packing
from pipeline.logs.writer import LogWriter
from pipeline.manifest import StageResult, manifest_path, read_manifest, run_stage
from pipeline.missions import CATALOGUE_NAME
from pipeline.obstacle_file import OBSTACLES_NAME, read_obstacle_entries
from pipeline.progress import Progress
from pipeline.provenance import versions
from pipeline.results import MissionHypotheses, read_hypothesis_tables
from pipeline.tables import read_table
from pipeline.tracks import UNKNOWN_AGENT
from schemas import channels
from schemas.channels import Channel

_TABLES = ("hypotheses.parquet", "windows.parquet", "detections.parquet")
_EARLIER_STAGES = ("ingest", "extract", "infer")
_VERTICES, _VERTICES_OF_SHORT_SCENES = 32, 15
_SHORT_SCENE_TICKS = 3
_CLOCK_TOLERANCE_NS = 10 * 1_000_000_000


@dataclass(frozen=True)
class ExportConfig:
    """How results are written.

    tick_s                seconds between two scenes; by default 1, or the step of the windows where that is longer, or more
                          where the scenes would exceed max_scene_mb
    max_scene_mb          megabytes of scenes before compression: what a viewer has to read
    num_scene_hypotheses  hypotheses drawn for each agent, the heaviest first; all are in /cadence/hypotheses
    max_vertices          points of a drawn hypothesis; by default 32, or 15 where hypotheses are new in most scenes (lines that
                          stay cost next to nothing, new ones about 20 kB a scene for three agents)
    occupancy_cells       cells along the longer side of the heat map
    map_period_s          seconds between two regions on the map (viewers draw all at once); by default a window's length
    combined              also write the source log and our channels into one file
    compression           of the chunks: zstd, lz4 or none
    """

    tick_s: float | None = None
    max_scene_mb: float = 400.0
    num_scene_hypotheses: int = 30
    max_vertices: int | None = None
    occupancy_cells: int = 128
    map_period_s: float | None = None
    combined: bool = False
    compression: Compression = "zstd"

    def __post_init__(self) -> None:
        for name in ("tick_s", "map_period_s"):
            value = getattr(self, name)
            if value is not None and not 0.001 <= value < 1e9:
                raise ValueError(f"{name} must be at least 0.001 s, got {value}")
        if not self.max_scene_mb > 0:
            raise ValueError(f"max_scene_mb must be positive, got {self.max_scene_mb}")
        if self.max_vertices is not None and not 4 <= self.max_vertices <= 1000:
            raise ValueError(f"max_vertices must be 4 to 1000, got {self.max_vertices}")
        if self.num_scene_hypotheses < 1 or not 4 <= self.occupancy_cells <= 2048:
            raise ValueError("num_scene_hypotheses must be at least 1, occupancy_cells 4 to 2048")


@dataclass(frozen=True, eq=False)
class _Mission:
    """All that is exported. Times are the clock of the detections; `clock_offset_ns` brings them to the log's.

    `sources` holds the rows of ASSOCIATIONS by the row of their detection.
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


def export(directory: Path, config: ExportConfig, progress: Progress, force: bool = False) -> StageResult:
    """Write the side file and its layouts into a mission directory, and with `config.combined` the combined file.

    Raises `InputError` where an earlier stage is missing or, for a combined file, where the source log is damaged.
    """
    catalogue = read_catalogue(directory)
    if config.combined:
        _check_combinable(catalogue)
    inputs = [directory / name for name in (CATALOGUE_NAME, *_TABLES, OBSTACLES_NAME)]
    inputs += [manifest_path(stage, directory) for stage in _EARLIER_STAGES if manifest_path(stage, directory).is_file()]
    inputs += [path for path in [directory / "associations.parquet"] if path.is_file()]
    inputs += [catalogue.path] if config.combined else []

    def body(work: Path) -> dict[str, Any]:
        return _export(directory, work, catalogue, config, progress)

    return run_stage("export", directory, config=config, inputs=inputs, body=body, force=force)


def _check_combinable(catalogue: Catalogue) -> None:
    """Raise where a combined file would not hold the log as it was recorded; ingest has looked into every chunk."""
    path, health = catalogue.path, catalogue.health
    if catalogue.parts:
        raise InputError(f"{path}: is one part of {len(catalogue.parts)}, which cannot be combined; export without combined")
    if not health.is_complete:
        raise InputError(f"{path}: is damaged ({health.problems[0]}) and cannot be combined; export without combined")
    if hash_file(path) != catalogue.sha256:
        raise InputError(f"{path}: was changed after it was ingested and cannot be combined; run `cadence ingest` again")


def _export(directory: Path, work: Path, catalogue: Catalogue, config: ExportConfig, progress: Progress) -> dict[str, Any]:
    mission = _read_mission(directory, catalogue, config)
    stem = catalogue.name
    side = work / f"{stem}.cadence.mcap"
    counts = _write_side_file(side, directory, mission, config, progress)
    if config.combined:
        write_combined(catalogue.path, side, work / f"{stem}.combined.mcap", Packing(config.compression), progress)
    topics = sorted(counts)
    for name, layout in (("layout", build_layout), ("layout.legacy", build_legacy_layout)):
        content = layout(mission.hypotheses.frame, mission.style, catalogue.channels, topics)
        (work / f"{stem}.{name}.json").write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    if mission.clock_offset_ns:
        progress.note(
            f"{stem}: the detections' stamps run {-mission.clock_offset_ns * 1e-9:.3f} s ahead of the log's clock; "
            "the side file follows the log's"
        )
    return {
        "num_windows": len(mission.hypotheses.windows),
        "num_ticks": len(mission.ticks),
        "tick_s": mission.tick_s,
        "clock_offset_s": mission.clock_offset_ns * 1e-9,
        "size_bytes": side.stat().st_size,
        "num_messages": dict(sorted(counts.items())),
    }


def _read_mission(directory: Path, catalogue: Catalogue, config: ExportConfig) -> _Mission:
    hypotheses = read_hypothesis_tables(directory)
    table, _ = read_table(directory / "detections.parquet", "detections")
    table = table.append_column("row", pa.array(np.arange(table.num_rows))).sort_by([("time_ns", "ascending")])
    obstacles = read_obstacle_entries(directory / OBSTACLES_NAME)
    scenes = build_scenes(hypotheses)
    offset_ns = _clock_offset_ns(table)
    tick_ns = _tick_ns(scenes, config)
    ticks = plan_ticks(scenes, tick_ns, catalogue.end_ns - offset_ns) if scenes else []
    style = _style(hypotheses, table, config, num_vertices(len(scenes), len(ticks), config))
    return _Mission(
        catalogue=catalogue,
        hypotheses=hypotheses,
        detections=table.to_pylist(),
        sources=_read_sources(directory / "associations.parquet"),
        marks=_marks(table),
        obstacles=obstacles,
        style=style,
        scenes=scenes,
        ticks=ticks,
        tick_s=tick_ns * 1e-9,
        clock_offset_ns=offset_ns,
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
    """The configured tick; else a second or a step, and longer where the scenes would be too large."""
    if config.tick_s is not None:
        return round(config.tick_s * 1e9)
    steps = [live.window.step_ns for scene in scenes for live in scene.live]
    if not steps:
        return 1_000_000_000
    tick_ns = max(1_000_000_000, max(steps))
    # On the wire a flat point takes 20 bytes, and a line 70 more, twice: past and future.
    lines = np.mean([sum(min(len(live.weight), config.num_scene_hypotheses) for live in scene.live) for scene in scenes])
    seconds = (scenes[-1].end_ns - scenes[0].origin_ns) * 1e-9
    needed_s = seconds * lines * (20.0 * (config.max_vertices or _VERTICES) + 140.0) / (config.max_scene_mb * 1e6)
    return max(tick_ns, int(np.ceil(needed_s)) * 1_000_000_000)


def _marks(detections: pa.Table) -> tuple[Marks, ...]:
    agent = np.array([name or UNKNOWN_AGENT for name in detections["agent_id"].to_pylist()], dtype=object)
    time_ns = detections["time_ns"].to_numpy()
    position_m = _positions(detections)
    usable = np.isfinite(position_m).all(axis=-1)
    ids = sorted(set(agent.tolist()))
    return tuple(Marks(name, time_ns[(agent == name) & usable], position_m[(agent == name) & usable]) for name in ids)


def num_vertices(num_scenes: int, num_ticks: int, config: ExportConfig) -> int:
    """Points of a drawn hypothesis where `num_scenes` different scenes are shown in `num_ticks` ticks."""
    is_short = num_ticks < _SHORT_SCENE_TICKS * num_scenes
    return config.max_vertices or (_VERTICES_OF_SHORT_SCENES if is_short else _VERTICES)


def _style(hypotheses: MissionHypotheses, detections: pa.Table, config: ExportConfig, vertices: int) -> Style:
    position_m = _positions(detections)
    position_m = position_m[np.isfinite(position_m).all(axis=-1)]
    corners = np.stack([position_m.min(axis=0), position_m.max(axis=0)]) if len(position_m) else np.zeros((2, 2))
    center_m, extent_m = corners.mean(axis=0), float(np.max(corners[1] - corners[0]))
    z_m = detections["z_m"].to_numpy().astype(np.float64)
    z_m = z_m[np.isfinite(z_m)]
    return Style(
        agent_ids=hypotheses.agent_ids,
        center_m=(float(center_m[0]), float(center_m[1])),
        extent_m=max(extent_m, 1.0),
        z_m=round(float(z_m.mean()), 1) if len(z_m) else 0.0,
        num_hypotheses=config.num_scene_hypotheses,
        max_vertices=vertices,
        has_unknown_origin=any(agent.probability is not None for window in hypotheses.windows for agent in window.agents),
    )


def _positions(detections: pa.Table) -> Float64s:
    return np.stack([detections["x_m"].to_numpy(), detections["y_m"].to_numpy()], axis=-1)


def _write_side_file(path: Path, directory: Path, mission: _Mission, config: ExportConfig, progress: Progress) -> Counter[str]:
    """Write every message in the order of time; the number of messages by topic."""
    counts: Counter[str] = Counter()
    with LogWriter(path, Packing(config.compression)) as writer, progress.bar(len(mission.ticks), "export", "tick") as bar:
        for time_ns, channel, data in _in_order(mission, config):
            writer.write(channel, time_ns, data)
            counts[channel.topic] += 1
            bar.update(channel is channels.SCENE)
        writer.metadata(channels.METADATA_NAME, _provenance(directory, mission, config))
    return counts


_Message = tuple[int, Channel, bytes]


def _in_order(mission: _Mission, config: ExportConfig) -> Iterator[_Message]:
    """Log time, channel and content of every message by time, encoded one moment at a time."""
    windows, ticks, rows, frame = mission.hypotheses.windows, mission.ticks, mission.detections, mission.hypotheses.frame
    moments = [(window.origin_ns, 0, index) for index, window in enumerate(windows)]
    moments += [(row["time_ns"], 1, index) for index, row in enumerate(rows)]
    moments += [(tick.time_ns, 2, index) for index, tick in enumerate(ticks)]
    moments.sort()
    on_map = _map_ticks(mission, config)
    if moments:
        yield from _static(mission, moments[0][0] + mission.clock_offset_ns)
    drawing: Drawing | None = None
    for moment_ns, kind, index in moments:
        time_ns = moment_ns + mission.clock_offset_ns
        if kind == 0:
            yield time_ns, channels.HYPOTHESES, messages.encode_hypotheses(windows[index], frame, time_ns)
        elif kind == 1:
            yield from _detection(mission, rows[index], time_ns)
        else:
            tick = ticks[index]
            if index == 0 or tick.scene is not ticks[index - 1].scene:
                drawing = draw(tick.scene, mission.style) if tick.scene else None
                data = messages.encode_occupancy(tick, frame, time_ns, config.occupancy_cells, mission.style.z_m)
                yield time_ns, channels.OCCUPANCY, data
            yield from _tick(mission, tick, drawing, time_ns, index in on_map)


def _static(mission: _Mission, time_ns: int) -> Iterator[_Message]:
    """What does not change: viewers supply the last message of a topic wherever one seeks to."""
    frame = mission.hypotheses.frame
    known = {channel.frame_id for channel in mission.catalogue.channels}
    if frame.frame_id not in known:  # else the frame is the log's, and so is its place in the tree
        yield time_ns, channels.TRANSFORM, messages.encode_transform(frame, time_ns)
    if mission.obstacles:
        entities = obstacle_entities(mission.obstacles, mission.style)
        yield time_ns, channels.OBSTACLES, encode_scene(time_ns, frame.frame_id, entities)


def _detection(mission: _Mission, row: dict[str, Any], time_ns: int) -> Iterator[_Message]:
    frame = mission.hypotheses.frame
    yield time_ns, channels.DETECTIONS, messages.encode_detection(row, frame, time_ns, mission.sources.get(row["row"], ()))
    if frame.is_georeferenced:
        data = maps.encode_detection_fix(row, frame, mission.style, time_ns)
        yield time_ns, channels.detection_fix_channel(row["agent_id"]), data


def _tick(mission: _Mission, tick: Tick, drawing: Drawing | None, time_ns: int, is_on_map: bool) -> Iterator[_Message]:
    frame, style = mission.hypotheses.frame, mission.style
    entities = scene_entities(drawing, tick.time_ns, mission.marks, style)
    yield time_ns, channels.SCENE, encode_scene(time_ns, frame.frame_id, entities)
    yield time_ns, channels.AGENTS, messages.encode_agents(tick, time_ns)
    if frame.is_georeferenced and tick.scene is not None:
        for live in tick.scene.live:
            data = maps.encode_mean_fix(live, tick.time_ns, frame, style, time_ns)
            yield time_ns, channels.fix_channel(live.agent.agent_id), data
        if is_on_map:
            yield time_ns, channels.MAP, maps.encode_map(tick.scene, frame, style)


def _map_ticks(mission: _Mission, config: ExportConfig) -> set[int]:
    """Indices of the ticks whose regions go on the map: the first, and then one a period."""
    chosen: set[int] = set()
    last_ns = None
    for index, tick in enumerate(mission.ticks):
        scene = tick.scene
        if scene is not None and scene.live:
            span_ns = scene.end_ns - scene.start_ns
            period_ns = span_ns if config.map_period_s is None else round(config.map_period_s * 1e9)
            if last_ns is None or tick.time_ns - last_ns >= period_ns:
                chosen.add(index)
                last_ns = tick.time_ns
    return chosen


def _provenance(directory: Path, mission: _Mission, config: ExportConfig) -> dict[str, str]:
    """What made the file: enough to repeat it."""
    manifests = {stage: read_manifest(stage, directory) or {} for stage in _EARLIER_STAGES}
    infer = manifests["infer"]
    content = {
        "source": mission.catalogue.path.name,
        "source_sha256": mission.catalogue.sha256,
        "frame_id": mission.hypotheses.frame.frame_id,
        "latitude_deg": _text(mission.hypotheses.frame.latitude_deg),
        "longitude_deg": _text(mission.hypotheses.frame.longitude_deg),
        "clock_offset_ns": str(mission.clock_offset_ns),
        "tick_s": _text(mission.tick_s),
        "seed": _text(_find(infer, "seed")),
        "checkpoint_sha256": _text(_find(infer, "checkpoint_sha256")),
        "versions": _text(versions()),
        "config.export": _text(config_as_dict(config)),
    }
    for stage, manifest in manifests.items():
        content |= {f"{part}.{stage}": _text(manifest[part]) for part in ("config", "summary", "inputs") if part in manifest}
    return content


def _text(value: Any) -> str:
    return value if isinstance(value, str) else "" if value is None else json.dumps(value, sort_keys=True, ensure_ascii=False)


def _find(tree: Any, name: str) -> Any:
    """The first value called `name` anywhere in a manifest; None where there is none."""
    if isinstance(tree, dict):
        if name in tree:
            return tree[name]
        found = (_find(value, name) for value in tree.values())
        return next((value for value in found if value is not None), None)
    return None
