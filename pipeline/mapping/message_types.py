"""Known message types: where the message types that robots, ships and aircraft commonly record keep what is read of them.

A type is found by the schema's name, whatever the encoding: `geometry_msgs/msg/PoseStamped` (CDR),
`geometry_msgs/PoseStamped` (JSON) and `geometry_msgs.PoseStamped` (protobuf) are one type.
"""

from typing import Final

from pipeline.mapping.camera_types import CAMERAS
from pipeline.mapping.fix_types import FIXES
from pipeline.mapping.message_type import MessageType
from pipeline.mapping.object_types import OBJECTS
from pipeline.mapping.pose_types import POSES
from pipeline.mapping.radar_types import RADARS

MESSAGE_TYPES: Final[dict[str, MessageType]] = {**POSES, **FIXES, **OBJECTS, **RADARS, **CAMERAS}

SETPOINTS: Final = {
    "mavros_msgs.GlobalPositionTarget", "mavros_msgs.PositionTarget", "px4_msgs.PositionSetpoint",
    "px4_msgs.PositionSetpointTriplet", "px4_msgs.TrajectorySetpoint", "px4_msgs.VehicleLocalPositionSetpoint",
    "geographic_msgs.GeoPath", "geographic_msgs.RoutePath",
}  # fmt: skip
"""Types of where a vehicle is told to be."""

POLAR: Final = {"radar_msgs.RadarReturn", "radar_msgs.RadarPoints", "radar_msgs.RadarPoint"}
"""Types of ranges and bearings that are used only where a source states their paths: drafts, and parts of a scan."""


def normalise_schema(name: str) -> str:
    """`package.Type`, whatever the encoding's way to write it."""
    parts = [part for part in name.replace("::", "/").replace(".", "/").split("/") if part and part != "msg"]
    if parts and parts[0] == "foxglove_msgs":
        parts[0] = "foxglove"
    return ".".join(parts)


def type_of_schema(schema_name: str | None) -> str | None:
    """The name of the known type of a schema; None where there is none. A bare type name matches any package."""
    wanted = normalise_schema(schema_name or "")
    return next((name for name, known in MESSAGE_TYPES.items() if wanted in known.schemas), None) or next(
        (name for name, known in MESSAGE_TYPES.items() if wanted in {schema.partition(".")[2] for schema in known.schemas}),
        None,
    )
