"""Messages that tell where frames are → the links of a transform tree.

Read are tf2_msgs/TFMessage and its kin, foxglove.FrameTransform(s), and Odometry of ROS and Foxglove, which tells where its
child frame is. ROS marks what never moves by the topic /tf_static, and such a transform holds from the first to the last moment
of the log wherever in it it stands; Foxglove has no such mark, so there a transform that never changes is static.
"""

import math
from array import array
from collections import Counter
from typing import Any, Literal, get_args

import numpy as np

from pipeline.counted import told
from pipeline.extract.clocks import Stamps
from pipeline.extract.contested import check_links, check_static
from pipeline.extract.field_reader import FieldReader
from pipeline.extract.mission_clock import MissionClock
from pipeline.extract.stamps import stamp_ns
from pipeline.extract.transforms import Link, TransformTree, tree_of
from pipeline.logs.decode import UndecodableChannel, UndecodableMessage, decoder_for
from pipeline.logs.reader import Channel, MissionLog, RawMessage
from pipeline.mapping.message_path import MissingFieldError, parse_path
from pipeline.mapping.message_types import normalise_schema
from pipeline.progress import Progress

STATIC_TOPIC = "tf_static"
Kind = Literal["static", "moving", "unmarked", "vehicle"]
"""Static by its topic; moving; Foxglove's, static if it never changes; a vehicle's odometry."""

_ROS = ("header.stamp", "header.frame_id", "child_frame_id", "transform.translation", "transform.rotation")
_FOXGLOVE = ("timestamp", "parent_frame_id", "child_frame_id", "translation", "rotation")
_FORMS = {  # time, parent, child (| between alternatives), translation, rotation; before them where there are several
    "tf2_msgs.TFMessage": ("transforms[:]", *_ROS),
    "tf.tfMessage": ("transforms[:]", *_ROS),
    "geometry_msgs.TransformStamped": ("", *_ROS),
    "foxglove.FrameTransform": ("", *_FOXGLOVE),
    "foxglove.FrameTransforms": ("transforms[:]", *_FOXGLOVE),
    "nav_msgs.Odometry": (
        "",
        "header.stamp",
        "header.frame_id",
        "child_frame_id",
        "pose.pose.position",
        "pose.pose.orientation",
    ),
    "foxglove.Odometry": ("", "timestamp", "frame_id", "body_frame_id|child_frame_id", "pose.position", "pose.orientation"),
}


class _Samples:
    """Growing samples of one link."""

    def __init__(self) -> None:
        self.times, self.log_times = array("q"), array("q")
        self.poses = array("d")

    def link(self, parent: str, child: str, kind: Kind, clock: MissionClock) -> Link:
        """The samples by time; of several at one time the last counts, of static ones the last in the log."""
        times = np.array(self.times, dtype=np.int64)
        poses = np.array(self.poses, dtype=np.float64).reshape(-1, 7)
        if kind == "static" or (kind == "unmarked" and (poses == poses[0]).all()):
            check_static(parent, child, poses, clock.suspicions)
            return Link(parent, child, times[-1:], poses[-1:, :3], poses[-1:, 3:], is_static=True)
        stamps = Stamps(times, np.array(self.log_times, dtype=np.int64), poses)
        times, is_kept = clock.mended(f"the transform {parent} → {child}", stamps)
        times, poses = times[is_kept], poses[is_kept]
        order = np.argsort(times, kind="stable")
        times, poses = times[order], poses[order]
        is_last = np.append(times[1:] != times[:-1], True)
        return Link(parent, child, times[is_last], poses[is_last, :3], poses[is_last, 3:])


SamplesByFrames = dict[tuple[str, str], _Samples]
"""By parent and child."""


class _Reader:
    """Reads one channel of transforms into `samples`, which channels of a kind share."""

    def __init__(self, channel: Channel, kind: Kind, samples: SamplesByFrames, counts: Counter[str]) -> None:
        items, *paths = _FORMS[normalise_schema(channel.schema_name)]
        self.channel, self.kind, self.samples, self.counts = channel, kind, samples, counts
        self.decode = decoder_for(channel)
        self._items = parse_path(items) if items else None
        self._paths = [FieldReader(path.split("|")) for path in paths]

    def read(self, raw: RawMessage) -> None:
        """Add the transforms of one message."""
        try:
            message = self.decode(raw.data)
            items = [message] if self._items is None else self._items.values(message)
        except (UndecodableMessage, MissingFieldError):
            self.counts["undecodable_transforms"] += 1
            return
        for item in items:
            try:
                self._add(item, raw.log_time_ns)
            except (LookupError, AttributeError, TypeError, ValueError):
                self.counts["bad_transforms"] += 1

    def _add(self, item: Any, log_time_ns: int) -> None:
        """`ValueError` and the like where a field is absent or no number."""
        stamp, parent, child, translation, rotation = ((path.located(item) or {})[()] for path in self._paths)
        parent, child = parent.lstrip("/"), child.lstrip("/")
        if self.kind == "vehicle" and not child:
            return  # it tells of itself, and not of a frame
        x, y, z = (_number(translation, axis) for axis in "xyz")
        turn = [_number(rotation, axis) for axis in "xyzw"]
        norm = math.hypot(*turn)
        if norm <= _MIN_NORM:
            self.counts["zero_rotations"] += 1
            return
        if not (math.isfinite(x + y + z) and norm < math.inf and parent and child and parent != child):
            raise ValueError("no transform")
        samples = self.samples.setdefault((parent, child), _Samples())
        samples.times.append(stamp_ns(stamp) or log_time_ns)
        samples.log_times.append(log_time_ns)
        samples.poses.extend((x, y, z, *(part / norm for part in turn)))


_MIN_NORM = 1e-6


_FAULTS = {
    "zero_rotations": "transforms have a rotation of zeros, which is none, and were skipped",
    "bad_transforms": "transforms lack a field, or are no rotation and translation, and were skipped",
    "undecodable_transforms": "messages with transforms cannot be decoded and were skipped",
}


class LogTransforms:
    """The transforms of a log, read at the first need; `apart` are frames that were found not to be joined to the mission's."""

    def __init__(self, log: MissionLog, progress: Progress) -> None:
        self._log, self._progress = log, progress
        self._tree: TransformTree | None = None
        self.counts: Counter[str] = Counter()
        self.apart: set[str] = set()

    def read(self, clock: MissionClock) -> TransformTree:
        """The trees, their times on the mission's clock; empty ones for a log without transforms."""
        if self._tree is None:
            self._tree = read_transforms(self._log, clock, self.counts, self._progress)
        return self._tree

    def summary(self, counts: Counter[str]) -> dict[str, Any]:
        """What was moved (in `counts`), what could not be, and what is wrong with the transforms."""
        tree, both = self._tree or TransformTree(), counts + self.counts
        return {
            "num_frames": len(tree.links),
            "problems": list(tree.problems),
            "unconnected_frames": sorted(self.apart),
            **{name: both[name] for name in ("transformed", "no_transform", *_FAULTS)},
        }

    def faults(self) -> list[tuple[str, int]]:
        """What is wrong with transforms, in words, and with how many."""
        return [(meaning, self.counts[name]) for name, meaning in _FAULTS.items() if self.counts[name]]

    def tell(self) -> None:
        """One line for each kind of thing that is wrong."""
        for problem in self._tree.problems if self._tree is not None else ():
            self._progress.note(f"extract: {problem}")
        if self.apart:
            self._progress.note(f"extract: no transform joins the detections' frame to {', '.join(sorted(self.apart))}")
        for meaning, count in self.faults():
            self._progress.note(f"extract: {told(count, meaning)}")


def read_transforms(log: MissionLog, clock: MissionClock, counts: Counter[str], progress: Progress) -> TransformTree:
    """The trees of all transforms of the log, on the mission's clock; what cannot be used is added to `counts`.

    Odometry counts only for frames of which no transform tells.
    """
    samples: dict[Kind, SamplesByFrames] = {kind: {} for kind in get_args(Kind)}
    readers: dict[int, _Reader] = {}
    for channel in log.channels:
        if normalise_schema(channel.schema_name) in _FORMS:
            kind = _kind(channel)
            try:
                readers[channel.id] = _Reader(channel, kind, samples[kind], counts)
            except UndecodableChannel as error:
                counts["undecodable_transforms"] += channel.message_count or 0
                progress.note(f"extract: {error}")
    if not readers:
        return TransformTree()
    with progress.bar(log.size_bytes, "transforms", unit="B", scale=True) as bar:
        for raw in log.messages({reader.channel.topic for reader in readers.values()}, on_bytes=bar.update):
            if raw.channel.id in readers:
                readers[raw.channel.id].read(raw)
    links: list[Link] = []
    for kind, found in samples.items():
        known = {link.child for link in links} if kind == "vehicle" else set()
        links += [each.link(parent, child, kind, clock) for (parent, child), each in found.items() if child not in known]
    check_links(links, clock.suspicions)
    return tree_of(links)


def _kind(channel: Channel) -> Kind:
    package, _, name = normalise_schema(channel.schema_name).rpartition(".")
    if name == "Odometry":
        return "vehicle"
    if package == "foxglove":
        return "unmarked"
    return "static" if channel.topic.rsplit("/", 1)[-1] == STATIC_TOPIC else "moving"


def _number(item: Any, axis: str) -> float:
    return float(item[axis] if isinstance(item, dict) else getattr(item, axis))
