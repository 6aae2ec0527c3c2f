"""Presets: where the message types that robots and ships commonly record keep position, time, covariance and identity.

A preset is chosen by the schema's name, whatever the encoding: `geometry_msgs/msg/PoseStamped` (CDR),
`geometry_msgs/PoseStamped` (JSON) and `geometry_msgs.PoseStamped` (protobuf) are one type.
"""

from dataclasses import dataclass, replace

Paths = tuple[str, ...]
"""Alternatives (a type's versions and flattened forms): the first that a message has is used."""

TIME_PATHS: Paths = ("header.stamp", "timestamp", "stamp")
FRAME_PATHS: Paths = ("header.frame_id", "frame_id")


@dataclass(frozen=True)
class Preset:
    """Message paths of one type: x and y (metres), or latitude and longitude (degrees); a message may lack all others."""

    schemas: tuple[str, ...]
    x: Paths = ()
    y: Paths = ()
    z: Paths = ()
    latitude: Paths = ()
    longitude: Paths = ()
    altitude: Paths = ()
    covariance: Paths = ()  # 4, 9 or 36 numbers, row-major, x (east) and y (north) first, m²
    covariance_type: Paths = ()  # 0 or a word with UNKNOWN: the covariance says nothing
    status: Paths = ()  # negative: no fix
    time: Paths = TIME_PATHS
    frame_id: Paths = FRAME_PATHS
    agent: Paths = ()
    sensor: Paths = ()
    score: Paths = ()


def _metric(schema: str, *points: str) -> Preset:
    return Preset((schema,), *(tuple(f"{point}.{axis}" for point in points) for axis in "xyz"))


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
    "Detection3DArray": replace(
        _metric("vision_msgs.Detection3DArray", "detections[:].bbox.center.position"),
        covariance=(f"{_RESULT}.pose.covariance",),
        agent=("detections[:].id", "detections[:].tracking_id"),
        score=(f"{_RESULT}.hypothesis.score", f"{_RESULT}.score"),
    ),
    "Detection": replace(
        _metric("mission.Detection", "position"),
        covariance=("position_covariance", "covariance"),
        agent=("agent_id",),
        sensor=("sensor_id",),
        score=("score",),
    ),
}


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
