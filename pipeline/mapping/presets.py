"""Presets: where the message types that robots and ships commonly record keep position, time, covariance and identity.

A preset is chosen by the schema's name, whatever the encoding: `geometry_msgs/msg/PoseStamped` (CDR),
`geometry_msgs/PoseStamped` (JSON) and `geometry_msgs.PoseStamped` (protobuf) are one type.
"""

from dataclasses import dataclass, replace
from typing import Literal

Paths = tuple[str, ...]
"""Alternatives (a type's versions and flattened forms): the first that a message has, and has filled in, is used."""

TIME_PATHS: Paths = ("header.stamp", "timestamp", "stamp")
FRAME_PATHS: Paths = ("header.frame_id", "frame_id")


@dataclass(frozen=True)
class Preset:
    """Message paths of one type: x and y (metres), or latitude and longitude (degrees); a message may lack all others.

    covariance       of numbers, row-major, x (east) and y (north) first, m²: 1, 4, 9 or 36 of them, or 6 of an upper triangle
    covariance_type  0 or a word with UNKNOWN: the covariance says nothing
    status           negative: no fix
    flags            even: the position is not valid
    alternatives     of positions; "first": the first that a message has. "filled": item by item the first that is not zero.
                     "all": every one of them holds positions of its own
    """

    schemas: tuple[str, ...]
    x: Paths = ()
    y: Paths = ()
    z: Paths = ()
    latitude: Paths = ()
    longitude: Paths = ()
    altitude: Paths = ()
    covariance: Paths = ()
    covariance_type: Paths = ()
    status: Paths = ()
    flags: Paths = ()
    time: Paths = TIME_PATHS
    frame_id: Paths = FRAME_PATHS
    agent: Paths = ()
    sensor: Paths = ()
    score: Paths = ()
    alternatives: Literal["first", "filled", "all"] = "first"


def _metric(schema: str, *points: str) -> Preset:
    x, y, z = (tuple(f"{point}.{axis}" for point in points) for axis in "xyz")
    return Preset((schema,), x, y, z)


def _geodetic(schema: str, fix: str = "") -> Preset:
    return Preset(
        (schema,),
        latitude=(f"{fix}latitude",),
        longitude=(f"{fix}longitude",),
        altitude=(f"{fix}altitude",),
        covariance=(f"{fix}position_covariance",),
        covariance_type=(f"{fix}position_covariance_type",),
        time=tuple(f"{fix}{path}" for path in TIME_PATHS),
        frame_id=tuple(f"{fix}{path}" for path in FRAME_PATHS),
    )


_RESULT = "detections[:].results[0]"
_KINEMATICS = "objects[:].kinematics"

PRESETS: dict[str, Preset] = {
    "PointStamped": _metric("geometry_msgs.PointStamped", "point"),
    "PoseStamped": _metric("geometry_msgs.PoseStamped", "pose.position"),
    "PoseWithCovarianceStamped": replace(
        _metric("geometry_msgs.PoseWithCovarianceStamped", "pose.pose.position"), covariance=("pose.covariance",)
    ),
    "PoseArray": _metric("geometry_msgs.PoseArray", "poses[:].position"),
    # Some JSON recorders leave out Odometry's PoseWithCovariance.
    "Odometry": replace(_metric("nav_msgs.Odometry", "pose.pose.position", "pose.position"), covariance=("pose.covariance",)),
    "NavSatFix": replace(_geodetic("sensor_msgs.NavSatFix"), status=("status.status",)),
    "GeoPointStamped": replace(_geodetic("geographic_msgs.GeoPointStamped", "position."), time=TIME_PATHS),
    "LocationFix": _geodetic("foxglove.LocationFix"),
    "LocationFixes": _geodetic("foxglove.LocationFixes", "fixes[:]."),
    "PointInFrame": _metric("foxglove.Point3InFrame", "point"),
    "PoseInFrame": _metric("foxglove.PoseInFrame", "pose.position"),
    "PosesInFrame": _metric("foxglove.PosesInFrame", "poses[:].position"),
    # A detector fills in the box, or only the pose of its best hypothesis. Foxy and ROS 1 have the score beside that pose.
    "Detection3DArray": replace(
        _metric("vision_msgs.Detection3DArray", "detections[:].bbox.center.position", f"{_RESULT}.pose.pose.position"),
        alternatives="filled",
        covariance=(f"{_RESULT}.pose.covariance",),
        time=(*TIME_PATHS, "detections[:].header.stamp"),
        frame_id=(*FRAME_PATHS, "detections[:].header.frame_id"),
        agent=("detections[:].id", "detections[:].tracking_id"),
        score=(f"{_RESULT}.hypothesis.score", f"{_RESULT}.score"),
    ),
    "RadarTracks": replace(
        _metric("radar_msgs.RadarTracks", "tracks[:].position"),
        covariance=("tracks[:].position_covariance",),
        agent=("tracks[:].uuid",),
    ),
    # The names of autoware's packages changed; its detected objects have no identity, its predicted ones another field.
    "TrackedObjects": replace(
        _metric(
            "autoware_perception_msgs.TrackedObjects",
            f"{_KINEMATICS}.pose_with_covariance.pose.position",
            f"{_KINEMATICS}.initial_pose_with_covariance.pose.position",
        ),
        schemas=tuple(
            f"{package}.{kind}Objects"
            for package in ("autoware_perception_msgs", "autoware_auto_perception_msgs")
            for kind in ("Tracked", "Detected", "Predicted")
        ),
        covariance=(
            f"{_KINEMATICS}.pose_with_covariance.covariance",
            f"{_KINEMATICS}.initial_pose_with_covariance.covariance",
        ),
        agent=("objects[:].object_id",),
        score=("objects[:].existence_probability",),
    ),
    "ADSBVehicle": Preset(
        ("mavros_msgs.ADSBVehicle",),
        latitude=("latitude",),
        longitude=("longitude",),
        altitude=("altitude",),
        flags=("flags",),
        agent=("icao_address", "ICAO_address"),
    ),
    "SceneUpdate": replace(
        _metric("foxglove.SceneUpdate", "entities[:].cubes[:].pose.position", "entities[:].spheres[:].pose.position"),
        alternatives="all",
        time=("entities[:].timestamp",),
        frame_id=("entities[:].frame_id",),
        agent=("entities[:].id",),
    ),
    "Detection": replace(
        _metric("mission.Detection", "position"),
        covariance=("position_covariance", "covariance"),
        agent=("agent_id",),
        sensor=("sensor_id",),
        score=("score",),
    ),
}

NAMES_AGENTS = {"Detection3DArray", "RadarTracks", "TrackedObjects", "ADSBVehicle", "SceneUpdate"}
"""Presets whose messages always have room for the identity of what was seen."""


def normalise_schema(name: str) -> str:
    """`package.Type`, whatever the encoding's way to write it."""
    parts = [part for part in name.replace("::", "/").replace(".", "/").split("/") if part and part != "msg"]
    if parts and parts[0] == "foxglove_msgs":
        parts[0] = "foxglove"
    return ".".join(parts)


def preset_for(schema_name: str | None) -> str | None:
    """The name of the preset for a schema; None where there is none. A bare type name matches any package."""
    wanted = normalise_schema(schema_name or "")
    for name, preset in PRESETS.items():
        if wanted in preset.schemas or wanted in {schema.partition(".")[2] for schema in preset.schemas}:
            return name
    return None
