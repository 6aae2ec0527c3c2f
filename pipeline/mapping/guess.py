"""What the channels of a log look like: roles by the words of their names and by their schemas, and sources ready to use.

The suggestion is shown by `cadence info` and used by `extract` for every role that the user leaves unconfigured.
"""

import itertools
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Final, Literal

from pipeline.mapping.field_paths import coordinate_paths, measured_paths
from pipeline.mapping.message_types import MESSAGE_TYPES, POLAR, SETPOINTS, normalise_schema, type_of_schema
from pipeline.mapping.sources import ChannelLike, SourceConfig
from pipeline.mapping.topic_names import DETECTION_WORDS, POSE_WORDS, TRUTH_WORDS, pattern_of, words_of

Role = Literal["detections", "truth", "poses", "positions", "tf", "obstacles"]
"""`positions` are positions whose name does not tell of what; `tf` and `obstacles` have readers of their own."""

# Where a vehicle is told to be is not where anything is.
_SETPOINT = {"setpoint", "setpoints", "goal", "goals", "cmd", "command", "commanded", "desired", "waypoint", "waypoints"}
_MAYBE_SETPOINT = re.compile(r"target_(pose|position|point|location|local|global|odom|state)")
"""A name that autopilots use for a set-point, and others for where the target is."""
_ONLY_WITH: Final = {"TransformStamped": TRUTH_WORDS, "GeoJSON": DETECTION_WORDS}
"""Presets that are not suggested but for topics with one of these words."""
_MMSI: Final = re.compile(r"(?<=/)[2-7][0-9]{8}(?=/|$)")
"""Of ships, by the country: stations ashore and buoys begin with another digit (ITU-R M.585)."""
_OBSTACLE = {"obstacle", "obstacles", "map", "costmap", "grid", "keepout", "nogo"}
_TF_SCHEMAS = {"TFMessage", "tfMessage", "TransformStamped", "FrameTransform", "FrameTransforms"}
_OBSTACLE_SCHEMAS = {"OccupancyGrid", "Grid", "GeoJSON"}
OWN_TOPICS = "/cadence/"
"""What an earlier run wrote into a combined file is never an input."""
# Of a type that is not known only a name as plain as this makes a detection: /radar/image or /battery/report are none.
_PLAIN_DETECTION = {"contact", "contacts", "detection", "detections", "target", "targets", "sighting", "sightings"}
_DETECTION_TYPE = re.compile(r"Detection|Detected|Track(?!er)|Object|Contact|Targets|Sighting|Radar|BoundingBox|AIS|Ais|ADSB")
_SPARE: Final = "returns of a radar are used by themselves only where there are no other detections, which may be made of them"
_NEVER_POSITIONS = {"std_msgs", "sensor_msgs", "rcl_interfaces", "diagnostic_msgs", "visualization_msgs"}


@dataclass(frozen=True)
class SuggestedMapping:
    """What the channels look like. `roles` maps topics to roles; the sources hold only channels of known types.

    `unread` are detections of types that are not known, with paths that may fit; `cameras` see what only the user can name;
    `unused` all topics that may hold detections and are in no source, and why they are not.
    """

    roles: Mapping[str, Role]
    detections: tuple[SourceConfig, ...] = ()
    truth: tuple[SourceConfig, ...] = ()
    poses: tuple[SourceConfig, ...] = ()
    positions: tuple[SourceConfig, ...] = ()
    unread: tuple[SourceConfig, ...] = ()
    cameras: tuple[SourceConfig, ...] = ()
    unused: Mapping[str, str] = field(default_factory=dict)

    def to_toml(self) -> str:
        """The `[extract]` lines of this mapping, ready to paste; what needs a decision is a comment."""
        blocks = [_entry(role, source) for role in ("detections", "truth", "poses") for source in getattr(self, role)]
        comments = {
            "a position, but the name does not tell of what: make it detections, truth or poses": self.positions,
            "its type is not known: give the paths of its fields": self.unread,
            "boxes of a camera are directions: say whom they show, by agent or agent_path": self.cameras,
        }
        for comment, sources in comments.items():
            blocks += ["# " + f"{comment}\n{_entry('detections', each)}".replace("\n", "\n# ") for each in sources]
        if not self.detections and not self.truth:
            seen = [replace(each, topic=each.topic.replace("{sensor}", "{agent}")) for each in self.poses]
            told = "if it tells where a target is, and not where a sensor was, say instead"
            blocks += ["# " + f"{told}\n{_entry('detections', each)}".replace("\n", "\n# ") for each in seen]
        if blocks and not self.detections:
            blocks.append("# to make sparse detections out of the dense channel:\n# [extract.thinning]\n# enabled = true")
        return "\n\n".join(blocks) + ("\n" if blocks else "")


def suggest_mapping(channels: Sequence[ChannelLike]) -> SuggestedMapping:
    """The roles that names and schemas suggest, and sources for the channels that have messages of known types."""
    roles = {channel.topic: role for channel in channels if (role := _role(channel)) is not None}
    doubtful = [topic for topic, role in roles.items() if role == "detections" and _may_be_setpoint(topic)]
    if len(doubtful) < sum(role == "detections" for role in roles.values()):
        roles = {topic: role for topic, role in roles.items() if topic not in doubtful}

    def readable(role: Role) -> list[ChannelLike]:
        return [c for c in channels if roles.get(c.topic) == role and usable_type(c) and c.message_count != 0]

    detecting = readable("detections")
    positions = [channel for channel in detecting if not _is_returns(channel)]
    spare = [channel for channel in detecting if positions and channel not in positions]
    used = positions or detecting
    unused = {c.topic: why for c in channels if c.message_count != 0 and (why := _why_unused(c, roles.get(c.topic)))}
    return SuggestedMapping(
        roles,
        detections=_name_only_agent(_sources(used, "detections"), used, readable("truth")),
        truth=_sources(readable("truth"), "truth"),
        poses=_sources(readable("poses"), "poses"),
        positions=_sources(readable("positions"), "positions"),
        unread=tuple(_unread_source(c) for c in channels if roles.get(c.topic) == "detections" and not usable_type(c)),
        cameras=tuple(SourceConfig(c.topic, message_type=known, agent="NAME") for c in channels if (known := _boxes_of(c))),
        unused=unused | {channel.topic: _SPARE for channel in spare},
    )


def usable_type(channel: ChannelLike) -> str | None:
    """The name of the known type by which a channel can be read without being told; None where there is none."""
    words = words_of(channel.topic)
    name = type_of_schema(channel.schema_name) or ("AIS" if not channel.schema_name and "ais" in words else None)
    if name is None or MESSAGE_TYPES[name].is_suggested or _ONLY_WITH.get(name, set()).intersection(words):
        return name
    return None


def dense_sources(channels: Sequence[ChannelLike], suggested: SuggestedMapping) -> tuple[SourceConfig, ...]:
    """Poses and positions as sources of truth, for a log whose only position channel is the one to thin."""
    usable = [c for c in channels if suggested.roles.get(c.topic) in ("poses", "positions") and usable_type(c)]
    return _sources([c for c in usable if c.message_count != 0], "truth")


def describe_channels(channels: Iterable[ChannelLike]) -> str:
    """`/a (Type), /b (Type)` for messages, cut after eight."""
    named = [f"{channel.topic} ({channel.schema_name or 'no schema'})" for channel in channels]
    rest = f" and {len(named) - 8} more" if len(named) > 8 else ""
    return ", ".join(named[:8]) + rest if named else "none"


def _role(channel: ChannelLike) -> Role | None:
    """Schema first, then the words of the name; truth before detection, detection before pose (`/truth/target/pose`)."""
    package, _, kind = normalise_schema(channel.schema_name).rpartition(".")
    words, known = words_of(channel.topic), usable_type(channel)
    if kind in _TF_SCHEMAS and known is None:
        return "tf"
    if (kind in _OBSTACLE_SCHEMAS and known is None) or (known == "SceneUpdate" and _OBSTACLE.intersection(words)):
        return "obstacles"
    if channel.topic.startswith(OWN_TOPICS) or _is_setpoint(channel) or normalise_schema(channel.schema_name) in POLAR:
        return None
    if known is None:
        if type_of_schema(channel.schema_name) is not None or package in _NEVER_POSITIONS:
            return None  # only when told
        if _PLAIN_DETECTION.intersection(words):
            return "detections"
        return "obstacles" if _OBSTACLE.intersection(words) else None
    if TRUTH_WORDS.intersection(words) or ("ground", "truth") in itertools.pairwise(words):
        return "truth"
    if MESSAGE_TYPES[known].role is not None or DETECTION_WORDS.intersection(words):
        return MESSAGE_TYPES[known].role or "detections"
    if known == "SceneUpdate":
        return None  # a scene without such a name may show anything
    return "poses" if POSE_WORDS.intersection(words) else "positions"


def _is_setpoint(channel: ChannelLike) -> bool:
    return normalise_schema(channel.schema_name) in SETPOINTS or not _SETPOINT.isdisjoint(words_of(channel.topic))


def _may_be_setpoint(topic: str) -> bool:
    parts = topic.split("/")
    doubtful = [part for part in parts if _MAYBE_SETPOINT.fullmatch(part)]
    return bool(doubtful) and all(DETECTION_WORDS.isdisjoint(words_of(part)) for part in parts if part not in doubtful)


def _why_unused(channel: ChannelLike, role: Role | None) -> str | None:
    """Why a channel that may hold detections is in no source; None for all others."""
    kind = normalise_schema(channel.schema_name).rpartition(".")[2]
    has_name, has_type = not _PLAIN_DETECTION.isdisjoint(words_of(channel.topic)), _DETECTION_TYPE.search(kind) is not None
    if role not in (None, "detections") or channel.topic.startswith(OWN_TOPICS) or not (has_name or has_type):
        return None
    if usable_type(channel) is not None and role == "detections":
        return None
    if _is_setpoint(channel) or _may_be_setpoint(channel.topic):
        return "it may be where a vehicle is told to go"
    if normalise_schema(channel.schema_name) in POLAR:
        return "its ranges and bearings are used only where a source states their paths"
    if _boxes_of(channel):
        return "boxes of a camera are directions; a source that says whom they show uses them"
    if type_of_schema(channel.schema_name) is not None:
        return "what is drawn may be anything"
    return "its type is not known"


def _unread_source(channel: ChannelLike) -> SourceConfig:
    """An entry for a channel of a type that is not known, with paths out of its schema where it has any that fit."""
    found = coordinate_paths(channel.schema_name, channel.schema_data)
    measured = {} if found else measured_paths(channel.schema_name, channel.schema_data)
    if measured:
        return _unread_bearings(channel.topic, measured)
    first, second = found or ("position.x", "position.y")
    if first.rpartition(".")[2].startswith("lat"):
        return SourceConfig(channel.topic, latitude=first, longitude=second)
    is_ned = normalise_schema(channel.schema_name).startswith("px4_msgs.")
    return SourceConfig(channel.topic, x=first, y=second, frame_convention="ned" if is_ned else None)


def _unread_bearings(topic: str, paths: Mapping[str, str]) -> SourceConfig:
    """An entry with paths of bearings, and accuracies that whoever knows the sensor will correct."""
    has_range, has_elevation = "range" in paths, "elevation" in paths
    return SourceConfig(
        topic, range=paths.get("range"), bearing=paths["bearing"], elevation=paths.get("elevation"),
        bearing_unit="deg" if paths["bearing"].endswith("_deg") else None, range_sigma_m=10.0 if has_range else None,
        bearing_sigma_deg=1.0, elevation_sigma_deg=1.0 if has_elevation else None,
    )  # fmt: skip


def _sources(channels: Sequence[ChannelLike], role: Role) -> tuple[SourceConfig, ...]:
    """One source a pattern: topics of one type that differ only in a name share it."""
    topics = [channel.topic for channel in channels]
    found = {(_pattern(c, role, topics), usable_type(c)): None for c in channels}
    return tuple(_source(pattern, known) for pattern, known in found)


def _pattern(channel: ChannelLike, role: Role, topics: Sequence[str]) -> str:
    """The topic with placeholders; of ships it may hold their MMSI, which messages then leave out (Digitraffic)."""
    if usable_type(channel) == "AIS" and _MMSI.search(channel.topic):
        return _MMSI.sub("{agent}", channel.topic, count=1)
    return pattern_of(channel.topic, role, not _holds_several(channel), topics)


def _source(pattern: str, known: str | None) -> SourceConfig:
    """A source of a known type; of ranges and bearings with the accuracy that is taken, so that everybody sees it."""
    if known is None or not MESSAGE_TYPES[known].is_polar:
        return SourceConfig(pattern, message_type=known)
    taken = MESSAGE_TYPES[known]
    return SourceConfig(
        pattern, message_type=known, range_sigma_m=taken.range_sigma_m, bearing_sigma_deg=taken.bearing_sigma_deg
    )


def _name_only_agent(
    detections: tuple[SourceConfig, ...], channels: Sequence[ChannelLike], truth: Sequence[ChannelLike]
) -> tuple[SourceConfig, ...]:
    """Detections without identity are of the only agent that the log's truth knows, where that is only one."""
    named = [
        found.get("agent", c.topic.strip("/"))
        for source in _sources(truth, "truth")
        for c in truth
        if (found := source.match(c.topic))
    ]
    if len(truth) != 1 or len(named) != 1 or _names_agents(truth[0]):
        return detections
    identified = {c.topic for c in channels if b"agent_id" in c.schema_data or _names_agents(c)}
    is_named = [source.topic in identified or "{agent}" in source.topic for source in detections]
    return tuple(s if known else replace(s, agent=named[0]) for s, known in zip(detections, is_named, strict=True))


def _holds_several(channel: ChannelLike) -> bool:
    """Whether the name of the topic cannot be that of who was seen: messages name agents, or hold several."""
    known = usable_type(channel)
    return known is not None and (MESSAGE_TYPES[known].names_agents or MESSAGE_TYPES[known].is_array)


def _names_agents(channel: ChannelLike) -> bool:
    known = usable_type(channel)
    return known is not None and MESSAGE_TYPES[known].names_agents


def _boxes_of(channel: ChannelLike) -> str | None:
    """The name of the known type of a camera's boxes."""
    name = type_of_schema(channel.schema_name)
    return name if name is not None and MESSAGE_TYPES[name].pixel_x else None


def _is_returns(channel: ChannelLike) -> bool:
    """Whether it holds what a radar measures before somebody says what of it is a target."""
    known = usable_type(channel)
    return known is not None and MESSAGE_TYPES[known].is_polar and not MESSAGE_TYPES[known].names_agents


def _entry(role: str, source: SourceConfig) -> str:
    lines = [f"[[extract.{role}]]"]
    stated = {item.name: getattr(source, item.name) for item in fields(source)}
    lines += [f"{name} = {json.dumps(value)}" for name, value in stated.items() if value is not None]
    return "\n".join(lines)
