"""What a mission is to viewers: the side file, the layouts, and where it is asked for the combined file."""

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from pipeline.ask.events import Event
from pipeline.ask.told import ANSWERS_NAME, EVENTS_NAME, Told, tell
from pipeline.catalogue import Catalogue
from pipeline.config import config_as_dict
from pipeline.export import maps, messages
from pipeline.export.clouds import encode_cloud, encode_fixes, plan_clouds
from pipeline.export.config import ExportConfig
from pipeline.export.display import hypothesis_entities, obstacle_entities, present_entities, story_entities
from pipeline.export.inputs import EARLIER_STAGES
from pipeline.export.layouts import MAX_PLOTTED, build_layout, build_legacy_layout
from pipeline.export.mission import Exported, read_exported
from pipeline.export.occupancy import future_occupancy
from pipeline.export.playback import Tick, shows_new_scene
from pipeline.export.scene import encode_scene
from pipeline.export.voxels import encode_voxels
from pipeline.logs.append import write_combined
from pipeline.logs.recorder import Packing
from pipeline.logs.writer import LogWriter
from pipeline.manifest import read_manifest
from pipeline.progress import Progress
from pipeline.provenance import versions
from schemas import channels
from schemas.channels import Channel

_VERSION = "2"
"""Of the side file: docs/formats.md says what differs."""
_ZSTD_LEVEL, _ZSTD_LEVEL_LARGE, _LARGE_BYTES = 19, 9, 4_000_000
"""Of small files, and of those whose table of hypotheses is large: level 19 makes files 5 % smaller than 9 (and 9 by 6 % than
3), and takes thirty times as long, more than half a second a megabyte."""


def write_files(directory: Path, work: Path, catalogue: Catalogue, config: ExportConfig, progress: Progress) -> dict[str, Any]:
    """Write the files of the stage for the mission in `directory` into `work`; the summary."""
    mission = read_exported(directory, catalogue, config)
    stem = catalogue.name
    side = work / f"{stem}.cadence.mcap"
    told = tell(directory, config.questions, config.meeting_m)
    counts = _write_side_file(side, directory, mission, told, config, progress)
    (work / EVENTS_NAME).write_text(told.events_csv(), encoding="utf-8")
    if config.questions:
        (work / ANSWERS_NAME).write_text(told.answers_json(), encoding="utf-8")
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
    num_agents = len(mission.style.plotted_ids)
    if num_agents > MAX_PLOTTED:
        progress.note(
            f"{stem}: the layouts plot the {MAX_PLOTTED} of {num_agents} agents that were detected most; "
            "the series of the others are in the plots' settings, switched off"
        )
    return {
        "num_windows": len(mission.hypotheses.windows),
        "num_ticks": len(mission.ticks),
        "tick_s": mission.tick_s,
        "clock_offset_s": mission.clock_offset_ns * 1e-9,
        "size_bytes": side.stat().st_size,
        "num_events": len(told.events),
        "num_messages": dict(sorted(counts.items())),
    }


def _write_side_file(
    path: Path, directory: Path, mission: Exported, told: Told, config: ExportConfig, progress: Progress
) -> Counter[str]:
    """Write every message in the order of time; the number of messages by topic."""
    counts: Counter[str] = Counter()
    is_large = (directory / "hypotheses.parquet").stat().st_size > _LARGE_BYTES
    packing = Packing(config.compression, level=_ZSTD_LEVEL_LARGE if is_large else _ZSTD_LEVEL)
    with LogWriter(path, packing) as writer, progress.bar(len(mission.ticks), "export", "tick") as bar:
        for time_ns, channel, data in _in_order(mission, told.events, config):
            writer.write(channel, time_ns, data)
            counts[channel.topic] += 1
            bar.update(channel is channels.AGENTS)
        writer.metadata(channels.METADATA_NAME, _provenance(directory, mission, config))
    return counts


_Message = tuple[int, Channel, bytes]


def _in_order(mission: Exported, events: Sequence[Event], config: ExportConfig) -> Iterator[_Message]:
    """Log time, channel and content of every message by time, encoded one moment at a time."""
    windows, ticks, rows, frame = mission.hypotheses.windows, mission.ticks, mission.detections, mission.hypotheses.frame
    moments = [(window.origin_ns, 0, index) for index, window in enumerate(windows)]
    moments += [(row["time_ns"], 1, index) for index, row in enumerate(rows)]
    moments += [(tick.time_ns, 2, index) for index, tick in enumerate(ticks)]
    moments += [(event.start_ns, 3, index) for index, event in enumerate(events)]
    if mission.stories is not None:
        moments += [(block.start_ns, 4, index) for index, block in enumerate(mission.stories.blocks)]
    moments.sort()
    map_start_ns = maps.plan_map(ticks, config.map_period_s) if frame.is_georeferenced else {}
    fixes = maps.MovingFixes(frame, mission.style)
    clouds = plan_clouds(ticks, windows, mission.style.num_hypotheses, frame.is_georeferenced)
    if moments:
        yield from _static(mission, moments[0][0] + mission.clock_offset_ns)
    for moment_ns, kind, index in moments:
        time_ns = moment_ns + mission.clock_offset_ns
        if kind == 0:
            yield time_ns, channels.HYPOTHESES, messages.encode_hypotheses(windows[index], frame, time_ns)
        elif kind == 1:
            yield from _detection(mission, rows[index], time_ns)
        elif kind == 3:
            yield time_ns, channels.EVENTS, messages.encode_event(events[index], mission.clock_offset_ns)
        elif kind == 4 and mission.stories is not None:
            for agent in range(len(mission.stories.stories.agent_ids)):
                found = messages.encode_mission(mission.stories, agent, index, time_ns)
                if found is not None:
                    yield time_ns, channels.MISSION, found
        else:
            tick = ticks[index]
            if shows_new_scene(ticks, index):
                yield from _new_scene(mission, tick, time_ns, config, map_start_ns.get(index))
            yield from _tick(mission, tick, time_ns)
            if index in clouds.clouds:
                yield time_ns, channels.CLOUD, encode_cloud(tick, frame, mission.style, time_ns)
            if index in clouds.fixes:
                yield time_ns, channels.FIXES, encode_fixes(tick, frame, mission.style, time_ns)
            if frame.is_georeferenced and tick.scene is not None:
                for agent_id, data in fixes.at(tick.scene, tick.time_ns, time_ns):
                    yield time_ns, channels.fix_channel(agent_id), data


def _static(mission: Exported, time_ns: int) -> Iterator[_Message]:
    """What does not change: viewers supply the last message of a topic wherever one seeks to."""
    frame = mission.hypotheses.frame
    known = {channel.frame_id for channel in mission.catalogue.channels}
    if frame.frame_id not in known:  # else the frame is the log's, and so is its place in the tree
        yield time_ns, channels.TRANSFORM, messages.encode_transform(frame, time_ns)
    if mission.obstacles:
        entities = obstacle_entities(mission.obstacles, mission.style)
        yield time_ns, channels.OBSTACLES, encode_scene(time_ns, frame.frame_id, entities)
    if mission.stories is not None:
        entities = story_entities(mission.stories.stories, mission.style)
        yield time_ns, channels.MISSION_SCENE, encode_scene(time_ns, frame.frame_id, entities)


def _detection(mission: Exported, row: dict[str, Any], time_ns: int) -> Iterator[_Message]:
    frame = mission.hypotheses.frame
    yield time_ns, channels.DETECTIONS, messages.encode_detection(row, frame, time_ns, mission.sources.get(row["row"], ()))
    if frame.is_georeferenced:
        data = maps.encode_detection_fix(row, frame, mission.style, time_ns)
        yield time_ns, channels.detection_fix_channel(row["agent_id"]), data


def _new_scene(
    mission: Exported, tick: Tick, time_ns: int, config: ExportConfig, map_start_ns: int | None
) -> Iterator[_Message]:
    """What stands until the next windows; every topic clears what it showed before, so that one may seek."""
    frame, style, scene = mission.hypotheses.frame, mission.style, tick.scene
    found = future_occupancy(scene.live if scene else (), config.occupancy_cells)
    yield time_ns, channels.OCCUPANCY, messages.encode_occupancy(found, frame, time_ns, style.z_m)
    yield time_ns, channels.VOXELS, encode_voxels(found, frame, time_ns, style.z_m)
    entities = hypothesis_entities(scene, mission.marks, style) if scene else ()
    yield time_ns, channels.SCENE, encode_scene(time_ns, frame.frame_id, entities)
    if scene is not None and map_start_ns is not None:
        yield time_ns, channels.MAP, maps.encode_map(scene, map_start_ns, frame, style)


def _tick(mission: Exported, tick: Tick, time_ns: int) -> Iterator[_Message]:
    """What moves."""
    frame, style = mission.hypotheses.frame, mission.style
    entities = present_entities(tick.scene, tick.time_ns, mission.marks, style) if tick.scene else ()
    yield time_ns, channels.PRESENT, encode_scene(time_ns, frame.frame_id, entities)
    yield time_ns, channels.AGENTS, messages.encode_agents(tick, time_ns)


def _provenance(directory: Path, mission: Exported, config: ExportConfig) -> dict[str, str]:
    """What made the file: enough to repeat it."""
    manifests = {stage: read_manifest(stage, directory) or {} for stage in EARLIER_STAGES}
    infer = manifests["infer"]
    content = {
        "side_file_version": _VERSION,
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
