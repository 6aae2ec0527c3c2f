"""Presets: where the message types that robots, ships and aircraft commonly record keep what is read of them.

A preset is chosen by the schema's name, whatever the encoding: `geometry_msgs/msg/PoseStamped` (CDR),
`geometry_msgs/PoseStamped` (JSON) and `geometry_msgs.PoseStamped` (protobuf) are one type.
"""

from typing import Final

from pipeline.mapping.preset import Preset
from pipeline.mapping.preset_fixes import FIXES
from pipeline.mapping.preset_objects import OBJECTS
from pipeline.mapping.preset_poses import POSES

PRESETS: Final[dict[str, Preset]] = {**POSES, **FIXES, **OBJECTS}

SETPOINTS: Final = {
    "mavros_msgs.GlobalPositionTarget", "mavros_msgs.PositionTarget", "px4_msgs.PositionSetpoint",
    "px4_msgs.PositionSetpointTriplet", "px4_msgs.TrajectorySetpoint", "px4_msgs.VehicleLocalPositionSetpoint",
    "geographic_msgs.GeoPath", "geographic_msgs.RoutePath",
}  # fmt: skip
"""Types of where a vehicle is told to be."""


def normalise_schema(name: str) -> str:
    """`package.Type`, whatever the encoding's way to write it."""
    parts = [part for part in name.replace("::", "/").replace(".", "/").split("/") if part and part != "msg"]
    if parts and parts[0] == "foxglove_msgs":
        parts[0] = "foxglove"
    return ".".join(parts)


def preset_for(schema_name: str | None) -> str | None:
    """The name of the preset for a schema; None where there is none. A bare type name matches any package."""
    wanted = normalise_schema(schema_name or "")
    return next((name for name, preset in PRESETS.items() if wanted in preset.schemas), None) or next(
        (name for name, preset in PRESETS.items() if wanted in {schema.partition(".")[2] for schema in preset.schemas}), None
    )
