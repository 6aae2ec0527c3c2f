"""The channels of a side file: topics, message types, and the descriptors of our own messages (`cadence.proto`)."""

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

ROOT_FRAME_ID = "cadence_root"
"""Parent of a mission frame that the source log does not know."""

METADATA_NAME = "cadence"
"""Name of the Metadata record that tells what made the file."""

DESCRIPTOR_PATH = Path(__file__).with_name("cadence.binpb")


@dataclass(frozen=True)
class Channel:
    """A topic and the full name of its protobuf message."""

    topic: str
    message: str


HYPOTHESES = Channel("/cadence/hypotheses", "cadence.Hypotheses")
SCENE = Channel("/cadence/scene", "foxglove.SceneUpdate")
PRESENT = Channel("/cadence/present", "foxglove.SceneUpdate")
OBSTACLES = Channel("/cadence/obstacles", "foxglove.SceneUpdate")
AGENTS = Channel("/cadence/agents", "cadence.Agents")
OCCUPANCY = Channel("/cadence/occupancy", "foxglove.Grid")
VOXELS = Channel("/cadence/occupancy_voxels", "foxglove.VoxelGrid")
CLOUD = Channel("/cadence/cloud", "foxglove.PointCloud")
FIXES = Channel("/cadence/fixes", "foxglove.LocationFixes")
DETECTIONS = Channel("/cadence/detections", "cadence.Detection")
TRANSFORM = Channel("/cadence/tf", "foxglove.FrameTransform")
MAP = Channel("/cadence/map", "foxglove.GeoJSON")
MISSION = Channel("/cadence/mission", "cadence.MissionHypotheses")
MISSION_SCENE = Channel("/cadence/mission_scene", "foxglove.SceneUpdate")
EVENTS = Channel("/cadence/events", "foxglove.Event")


def fix_channel(agent_id: str) -> Channel:
    """Latitude and longitude of the weighted mean of one agent."""
    return Channel(f"/cadence/fix/{_topic_word(agent_id)}", "foxglove.LocationFix")


def detection_fix_channel(agent_id: str | None) -> Channel:
    """Latitude and longitude of the detections of one agent; None: of unknown origin."""
    return Channel(f"/cadence/detection_fix/{_topic_word(agent_id or 'unknown')}", "foxglove.LocationFix")


@functools.cache
def message_class(name: str) -> Any:
    """The protobuf class of one of our own messages, for example "cadence.Hypotheses"; `KeyError` for an unknown name."""
    return message_factory.GetMessageClass(_pool().FindMessageTypeByName(name))


@functools.cache
def _pool() -> Any:
    # A pool of our own: the default one is shared by the whole process, and names in it may clash.
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(DESCRIPTOR_PATH.read_bytes()).file:
        pool.Add(file)
    return pool


def _topic_word(agent_id: str) -> str:
    """The identity as one part of a topic: a slash would make another level, spaces and quotes break message paths."""
    return "".join(letter if letter.isalnum() or letter in "_-" else "_" for letter in agent_id)
