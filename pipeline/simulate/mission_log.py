"""A simulated episode as a mission log: truth, sensors, detections, obstacles to look at and obstacles to compute with.

Topics: /truth/AGENT (positions), /sensors/SENSOR/pose (positions) or /trackers (all sensors that move in one message),
/detections (messages that name agent and sensor, or do not know them) or /detections/AGENT (messages that have no field for the
agent), /bearings (mission.Bearing: who was heard, and from where), with ranges in place of /detections where these are polar,
/scene/obstacles (foxglove.SceneUpdate, protobuf always).
Metadata records: `mission` (JSON values: how the log came about), `cadence.obstacles` (key `obstacles`: the list of
obstacles.json, in the mission frame, whose datum stands beside it), `cadence.sensors` (key `sensors`: entries of
[[extract.sensors]], what each sensor detects, so that its silence counts).
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap.writer import Writer

from cadence.worlds.episode import Episode
from cadence.worlds.terrain import Terrain
from pipeline.frames import to_geodetic
from pipeline.obstacle_file import obstacles_as_json
from pipeline.provenance import versions
from pipeline.simulate.forms import Encoding, Form, Report, bearing_form, detection_form, group_form, pose_form, protobuf_schema
from pipeline.tables import Frame

SCENE_PERIOD_S = 60.0
SCENE_STEPS = 10
"""The obstacles' scene is repeated so often, but not more than once in so many steps where these are long: after a seek,
viewers show only what they find near."""

OBSTACLE_NAMES = {"prison": ("island", "mountain"), "rendezvous": ("massif", "peak")}
"""What polygons and circles are called, by world; elsewhere islands and shoals."""

LAND_RGBA = (0.62, 0.68, 0.5, 0.9)
SHOAL_RGBA = (0.8, 0.72, 0.5, 0.9)


@dataclass(frozen=True)
class MissionForm:
    """How an episode is written. The frame's datum is set for positions in latitude and longitude.

    With `groups_trackers` the sensors that move are one message a step, and those that do not are left to the Metadata
    record; no message type has latitudes and longitudes of several, so geodetic logs write every sensor apart. Without
    `names_agents` nothing tells which agent a detection is of. With `is_polar` detections are ranges and bearings.
    """

    encoding: Encoding
    frame: Frame
    start_ns: int
    groups_trackers: bool = False
    names_agents: bool = True
    is_polar: bool = False

    @property
    def is_geodetic(self) -> bool:
        """Whether positions are latitude and longitude."""
        return self.frame.is_georeferenced


def write_mission(path: Path, episode: Episode, form: MissionForm, mission: Mapping[str, Any]) -> None:
    """Write one log; the same arguments give the same bytes. `mission` becomes the Metadata record of that name, as JSON."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=1 << 18, enable_data_crcs=True)
        writer.start(profile="ros2" if form.encoding == "cdr" else "", library=f"cadence {versions()['cadence']}")
        writer.add_metadata("mission", {key: json.dumps(value, sort_keys=True) for key, value in mission.items()})
        writer.add_metadata("cadence.obstacles", _obstacle_metadata(episode.terrain, form.frame))
        if episode.laws:
            writer.add_metadata("cadence.sensors", {"sensors": json.dumps(sensor_entries(episode, form))})
        _write_messages(writer, episode, form)
        writer.finish()  # type: ignore[no-untyped-call]


def _obstacle_metadata(terrain: Terrain, frame: Frame) -> dict[str, str]:
    # The datum travels with the obstacles: their metres mean nothing in a frame about another datum.
    keys = {"frame_id": frame.frame_id, "latitude_deg": frame.latitude_deg, "longitude_deg": frame.longitude_deg}
    return {
        "obstacles": json.dumps(obstacles_as_json(terrain)),
        **{key: json.dumps(value) for key, value in keys.items() if value is not None},
    }


def sensor_entries(episode: Episode, form: MissionForm) -> list[dict[str, Any]]:
    """The sensors of an episode as entries of [[extract.sensors]]."""
    step_s = float(episode.time_s[1] - episode.time_s[0])
    moves = (np.diff(episode.sensors_m, axis=1) != 0).any(axis=(1, 2))
    is_grouped = form.groups_trackers and not form.is_geodetic
    number_in_group = np.cumsum(moves) - 1
    entries = []
    for sensor, (name, law) in enumerate(zip(episode.sensor_ids, episode.laws, strict=True)):
        if not law.probability.any():
            continue
        points = np.column_stack([np.round(law.distance_m, 1), law.probability]).tolist()
        entry: dict[str, Any] = {"sensor": name, "probability": points, "every_s": step_s}
        if is_grouped and moves[sensor]:
            entry |= {"sensor": f"trackers/{number_in_group[sensor]}", "detects_as": name}
        elif is_grouped:
            entry["position"] = np.round(episode.sensors_m[sensor, 0], 3).tolist()
        if not (law.is_always or episode.is_active[sensor].all()):
            entry["on"] = _stretches(episode.is_active[sensor], step_s)
        entries.append(entry | ({"is_hidden": True} if law.is_hidden else {}))
    return entries


def _stretches(is_active: np.ndarray[Any, np.dtype[np.bool_]], step_s: float) -> list[list[float]]:
    """Pairs of seconds, half a step around the steps [T] at which a sensor looks."""
    change = np.diff(np.concatenate([[0], is_active.astype(np.int8), [0]]))
    first, stop = np.flatnonzero(change == 1), np.flatnonzero(change == -1)
    return [[(a - 0.5) * step_s, (b - 0.5) * step_s] for a, b in zip(first.tolist(), stop.tolist(), strict=True)]


class _Topics:
    """Channels by topic, registered at their first message, with running sequence numbers."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._channels: dict[str, int] = {}
        self._counts: dict[str, int] = {}

    def write(self, topic: str, form: Form, report: Report) -> None:
        """Append one message, logged at its own time."""
        if topic not in self._channels:
            self._channels[topic] = form.register(self._writer, topic)
        self.append(topic, report.time_ns, form.encode(report))

    def open(self, topic: str, channel: int) -> None:
        """Use a channel that is registered already."""
        self._channels[topic] = channel

    def append(self, topic: str, time_ns: int, data: bytes) -> None:
        """Append bytes to a channel that is open."""
        sequence = self._counts[topic] = self._counts.get(topic, -1) + 1
        self._writer.add_message(self._channels[topic], time_ns, data, time_ns, sequence)


def _write_messages(writer: Writer, episode: Episode, form: MissionForm) -> None:
    """All messages in the order of time."""
    topics = _Topics(writer)
    scene_schema = writer.register_schema("foxglove.SceneUpdate", "protobuf", protobuf_schema(SceneUpdate))
    topics.open("/scene/obstacles", writer.register_channel("/scene/obstacles", "protobuf", scene_schema))
    scene = _scene(episode.terrain, form.frame.frame_id, *OBSTACLE_NAMES.get(episode.world, ("island", "shoal")))
    poses, detections = pose_form(form.encoding, form.is_geodetic), detection_form(form.encoding, form.is_geodetic)
    truth, sensors = _place(episode.truth_m, form), _place(episode.sensors_m, form)
    measured, seen = _place(episode.detections.position_m, form), episode.detections
    moves = (np.diff(episode.sensors_m, axis=1) != 0).any(axis=(1, 2))
    step_ns = np.round(episode.time_s * 1e9).astype(np.int64) + form.start_ns
    step_s = episode.time_s[1] - episode.time_s[0]
    scene_every = round(SCENE_PERIOD_S / step_s) if step_s < SCENE_PERIOD_S else SCENE_STEPS
    group = group_form(form.encoding) if form.groups_trackers and not form.is_geodetic else None
    first, last = np.searchsorted(seen.step, [np.arange(len(step_ns)), np.arange(1, len(step_ns) + 1)])
    frame_id = form.frame.frame_id
    for step, time_ns in enumerate(step_ns.tolist()):
        is_slow_tick = step % scene_every == 0
        if is_slow_tick:
            topics.append("/scene/obstacles", time_ns, _stamped(scene, time_ns))
        for agent, name in enumerate(episode.agent_ids):
            topics.write(f"/truth/{name}", poses, Report(time_ns, frame_id, *truth[agent, step].tolist()))
        if group is not None:
            places = tuple((x, y) for x, y in sensors[moves, step].tolist())
            topics.write("/trackers", group, Report(time_ns, frame_id, 0.0, 0.0, group=places))
        for sensor, name in enumerate(episode.sensor_ids if group is None else ()):
            if moves[sensor] or is_slow_tick:
                topics.write(f"/sensors/{name}/pose", poses, Report(time_ns, frame_id, *sensors[sensor, step].tolist()))
        for topic, report in _bearings(episode, step, time_ns, form):
            topics.write(topic, bearing_form(), report)
        for row in range(first[step], last[step]) if not form.is_polar else ():
            agent_id = _name(episode.agent_ids, int(seen.agent[row])) if form.names_agents else ""
            sensor_id = _name(episode.sensor_ids, int(seen.sensor[row]))
            (xx, xy), (_, yy) = np.round(seen.covariance_m2[row], 3).tolist()
            x, y = measured[row].tolist()
            report = Report(time_ns, frame_id, x, y, (xx, xy, yy), agent_id, sensor_id)
            is_apart = agent_id and not detections.has_agent_id
            topics.write(f"/detections/{agent_id}" if is_apart else "/detections", detections, report)


def _bearings(episode: Episode, step: int, time_ns: int, form: MissionForm) -> Iterator[tuple[str, Report]]:
    """What was heard in a step, and with ranges what was detected, if that is written so."""
    heard, seen, frame_id = episode.bearings, episode.detections, form.frame.frame_id

    def report(agent: int, sensor: int, **measured: float) -> Report:
        values = tuple((name, round(value, 4)) for name, value in measured.items())
        names = episode.agent_ids[agent], episode.sensor_ids[sensor]
        return Report(time_ns, frame_id, 0.0, 0.0, None, *names, measured=values)

    if heard is not None:
        for row in range(*np.searchsorted(heard.step, [step, step + 1]).tolist()):
            bearing_deg, sigma_deg = _compass_deg(heard.bearing_rad[row]), float(np.degrees(heard.sigma_rad[row]))
            yield "/bearings", report(heard.agent[row], heard.sensor[row], bearing=bearing_deg, bearing_sigma=sigma_deg)
    if form.is_polar:
        for row in range(*np.searchsorted(seen.step, [step, step + 1]).tolist()):
            offset = seen.position_m[row] - episode.sensors_m[seen.sensor[row], step]
            range_m = float(np.hypot(*offset))
            along = offset / range_m
            across = np.array([-along[1], along[0]])
            sigmas = [float(np.sqrt(way @ seen.covariance_m2[row] @ way)) for way in (along, across)]
            measured = {"range": range_m, "range_sigma": sigmas[0], "bearing": _compass_deg(np.arctan2(*offset[::-1]))}
            sigma_deg = float(np.degrees(sigmas[1] / range_m))
            yield "/detections", report(seen.agent[row], seen.sensor[row], **measured, bearing_sigma=sigma_deg)


def _compass_deg(bearing_rad: float) -> float:
    """Clockwise from north of an angle from east towards north."""
    return float((90.0 - np.degrees(bearing_rad)) % 360.0)


def _name(names: Sequence[str], index: int) -> str:
    """The name of that number; empty for -1, which is nobody."""
    return names[index] if index >= 0 else ""


def _place(position_m: np.ndarray[Any, np.dtype[np.float64]], form: MissionForm) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Positions [..., 2] as the forms want them: metres to the millimetre, or longitude and latitude to 1e-8 degrees."""
    if not form.is_geodetic:
        return np.round(position_m, 3)
    latitude, longitude = to_geodetic(form.frame, position_m[..., 0].ravel(), position_m[..., 1].ravel())
    return np.round(np.stack([longitude, latitude], axis=-1), 8).reshape(position_m.shape)


def _scene(terrain: Terrain, frame_id: str, name_of_polygons: str, name_of_circles: str) -> SceneUpdate:
    """Polygons as triangles with an outline, circles as flat cylinders; one self-contained message."""
    scene = SceneUpdate()
    for index, polygon in enumerate(terrain.polygons_m):
        entity = scene.entities.add(id=f"{name_of_polygons}_{index + 1}", frame_id=frame_id)
        land = entity.triangles.add()
        land.pose.orientation.w = 1.0
        land.color.r, land.color.g, land.color.b, land.color.a = LAND_RGBA
        for x, y in _triangles(polygon):
            land.points.add(x=x, y=y)
        shore = entity.lines.add(type=1, thickness=2.0, scale_invariant=True)  # 1 = LINE_LOOP
        shore.pose.orientation.w = 1.0
        shore.color.r = shore.color.g = shore.color.b = 0.3
        shore.color.a = 1.0
        for x, y in np.round(polygon, 3).tolist():
            shore.points.add(x=x, y=y)
    for index, (x, y, radius) in enumerate(np.round(terrain.circles_m, 3).tolist()):
        entity = scene.entities.add(id=f"{name_of_circles}_{index + 1}", frame_id=frame_id)
        disc = entity.cylinders.add(bottom_scale=1.0, top_scale=1.0)
        disc.pose.position.x, disc.pose.position.y = x, y
        disc.pose.orientation.w = 1.0
        disc.size.x = disc.size.y = 2 * radius
        disc.size.z = 1.0
        disc.color.r, disc.color.g, disc.color.b, disc.color.a = SHOAL_RGBA
    return scene


def _triangles(polygon: np.ndarray[Any, np.dtype[np.float64]]) -> list[list[float]]:
    """Corners of triangles that fill a polygon for the eye: those of its vertices' Delaunay net whose middle is inside."""
    shape = shapely.Polygon(polygon)
    net = shapely.get_parts(shapely.delaunay_triangles(shape))
    inside = [triangle for triangle in net if shape.contains(triangle.centroid)]
    corners: list[list[float]] = np.round([shapely.get_coordinates(t)[:3] for t in inside], 3).reshape(-1, 2).tolist()
    return corners


def _stamped(scene: SceneUpdate, time_ns: int) -> bytes:
    for entity in scene.entities:
        entity.timestamp.FromNanoseconds(time_ns)
    return bytes(scene.SerializeToString(deterministic=True))
