"""A log and its side file in Rerun: the log through Rerun's own importer, our scenes as its lines and points.

Rerun checks and plays our files, but has no decoder for foxglove.SceneUpdate. This script fills that gap, and keeps the time
lines of the importer, so that both lie beneath the same cursor.

    python docs/rerun_view.py LOG.mcap results/LOG/LOG.cadence.mcap --save mission.rrd
    rerun mission.rrd

Needs `rerun-sdk` (the extra `viewer`). With `--until 0.5` scenes end in the middle of the mission; the view opens at the last.
"""

import argparse
import sys
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from pipeline.logs.reader import MissionLog, open_log
from schemas import channels

LOG_TIME = "message_log_time"
"""The importer's name for the log time."""


def read_scenes(log: MissionLog, topic: str) -> list[tuple[int, SceneUpdate]]:
    """Every scene of a topic with its time."""
    return [(message.log_time_ns, SceneUpdate.FromString(message.data)) for message in log.messages({topic})]


def log_scenes(scenes: list[tuple[int, SceneUpdate]], topic: str, static: bool = False) -> None:
    """Log scenes to Rerun; entities that a scene no longer holds disappear."""
    shown: set[str] = set()
    for time_ns, update in scenes:
        rr.set_time(LOG_TIME, timestamp=np.datetime64(time_ns, "ns"))
        entities = {f"{topic}/drawn/{entity.id}": entity for entity in update.entities}
        for path in sorted(shown - entities.keys()):
            rr.log(path, rr.Clear(recursive=True))
        for path, entity in entities.items():
            log_entity(path, entity, static)
        shown = set(entities)


def log_entity(path: str, entity: SceneEntity, static: bool) -> None:
    """Lines, spheres and texts of one entity."""
    frame = rr.CoordinateFrame(entity.frame_id)
    if entity.lines:
        strips = [strip for line in entity.lines for strip in strips_of(line)]
        colors = [faded(line.color) for line in entity.lines for _ in strips_of(line)]
        # Thickness is in pixels, whatever the zoom; Rerun writes radii on the screen as negative numbers.
        radii = [-0.5 * line.thickness for line in entity.lines for _ in strips_of(line)]
        rr.log(f"{path}/lines", rr.LineStrips3D(strips, colors=colors, radii=radii), frame, static=static)
    if entity.spheres or entity.texts:
        spheres = [(s.pose.position, faded(s.color), 0.5 * s.size.x, "") for s in entity.spheres]
        spheres += [(t.pose.position, faded(t.color), 0.0, t.text) for t in entity.texts]
        places = [(place.x, place.y, place.z) for place, *_ in spheres]
        points = rr.Points3D(places, colors=[c for _, c, *_ in spheres], radii=[r for *_, r, _ in spheres])
        rr.log(f"{path}/points", points, frame, static=static)
        if entity.texts:
            names = rr.Points3D(places[-1:], labels=[entity.texts[-1].text], colors=[spheres[-1][1]], show_labels=True)
            rr.log(f"{path}/name", names, frame, static=static)


def strips_of(line: LinePrimitive) -> Iterable[list[tuple[float, float, float]]]:
    """What Rerun draws as one strip: a whole line, a closed one, or the pieces of a list."""
    points = [(point.x, point.y, point.z) for point in line.points]
    if line.type == LinePrimitive.LINE_LIST:
        return [points[i : i + 2] for i in range(0, len(points), 2)]
    return [[*points, points[0]] if line.type == LinePrimitive.LINE_LOOP else points]


def faded(color: object) -> tuple[int, int, int]:
    """Opacity is weight; Rerun's lines are opaque, so colours are darkened instead (its background is dark)."""
    return tuple(round(255 * channel * color.a) for channel in (color.r, color.g, color.b))


def blueprint(update: SceneUpdate) -> rrb.Blueprint:
    """One view from above on all lines of a scene, the cursor at the end."""
    points = [(p.x, p.y, p.z) for entity in update.entities for line in entity.lines for p in line.points]
    low, high = np.percentile(np.array(points or [(0.0, 0.0, 0.0), (1.0, 1.0, 0.0)]), [1, 99], axis=0)
    middle, extent = (low + high) / 2, float(np.max(high - low))
    frame_id = update.entities[0].frame_id if update.entities else "map"
    eye = rrb.EyeControls3D(position=middle + np.array([0.0, -0.4, 0.9]) * extent, look_target=middle, eye_up=(0.0, 0.0, 1.0))
    view = rrb.Spatial3DView(
        origin="/", name="hypotheses", eye_controls=eye, line_grid=False, background=(16, 21, 28),
        spatial_information=rrb.SpatialInformation(target_frame=frame_id),
    )  # fmt: skip
    time_panel = rrb.TimePanel(timeline=LOG_TIME, play_state="following")
    return rrb.Blueprint(view, time_panel, rrb.SelectionPanel(expanded=False), collapse_panels=False)


def main() -> int:
    """Read, log, and save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", type=Path, help="the log that was ingested")
    parser.add_argument("side", type=Path, help="NAME.cadence.mcap of that log")
    parser.add_argument("--save", type=Path, default=Path("mission.rrd"), help="file for Rerun (default: mission.rrd)")
    parser.add_argument("--until", type=float, default=1.0, help="the part of the mission whose scenes are drawn (0 to 1)")
    arguments = parser.parse_args()
    side = open_log(arguments.side)
    present = read_scenes(side, channels.PRESENT.topic)
    present = present[: max(1, round(arguments.until * len(present)))]
    scenes = [item for item in read_scenes(side, channels.SCENE.topic) if present and item[0] <= present[-1][0]]
    rr.init("cadence", recording_id=arguments.side.stem)
    rr.save(arguments.save)
    drawn = [update for _, update in scenes if update.entities]
    if drawn:
        rr.send_blueprint(blueprint(drawn[-1]))
    log_scenes(read_scenes(side, channels.OBSTACLES.topic), channels.OBSTACLES.topic, static=True)
    log_scenes(scenes, channels.SCENE.topic)
    log_scenes(present, channels.PRESENT.topic)
    rr.log_file_from_path(arguments.log)
    rr.disconnect()
    return 0


if __name__ == "__main__":
    sys.exit(main())
