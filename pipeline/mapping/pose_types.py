"""Message types of positions in metres: ROS, Foxglove, PX4, motion capture, and what viewers are given to draw."""

from dataclasses import replace
from typing import Final

from pipeline.mapping.message_type import FRAME_PATHS, TIME_PATHS, MessageType, metric, stamped_items

_TRANSFORM = "transform.translation"
_MARKERS = "markers[:]"
_LISTS = (4, 5, 6, 7, 8, 11)
"""Types of markers that draw a list of points: their pose is where these count from."""

POSES: Final[dict[str, MessageType]] = {
    "PointStamped": metric("geometry_msgs.PointStamped", "point"),
    "PoseStamped": metric("geometry_msgs.PoseStamped", "pose.position"),
    "PoseWithCovarianceStamped": replace(
        metric("geometry_msgs.PoseWithCovarianceStamped", "pose.pose.position"), covariance=("pose.covariance",)
    ),
    "PoseArray": metric("geometry_msgs.PoseArray", "poses[:].position"),
    # Some JSON recorders leave out Odometry's PoseWithCovariance, and Foxglove's type of that name has none.
    "Odometry": replace(
        metric("nav_msgs.Odometry", "pose.pose.position", "pose.position"),
        schemas=("nav_msgs.Odometry", "foxglove.Odometry"),
        covariance=("pose.covariance", "pose_covariance"),
    ),
    "Point": metric("geometry_msgs.Point", ""),
    "Pose": metric("geometry_msgs.Pose", "position"),
    "PointInFrame": replace(
        metric("foxglove.Point3InFrame", "point"), schemas=("foxglove.Point3InFrame", "foxglove.Point2InFrame")
    ),
    "PoseInFrame": metric("foxglove.PoseInFrame", "pose.position"),
    "PosesInFrame": metric("foxglove.PosesInFrame", "poses[:].position"),
    # PX4: north, east, down.
    "VehicleLocalPosition": replace(
        metric("px4_msgs.VehicleLocalPosition", ""),
        schemas=("px4_msgs.VehicleLocalPosition", "px4_msgs.VehicleLocalPositionGroundtruth"),
        sigma=("eph",),
        where=("xy_valid",),
        origin_latitude=("ref_lat",),
        origin_longitude=("ref_lon",),
        frame_convention="ned",
    ),
    # The position was three fields before it was an array; its covariance an upper triangle before it was a diagonal.
    "VehicleOdometry": MessageType(
        ("px4_msgs.VehicleOdometry", "px4_msgs.VehicleVisualOdometry", "px4_msgs.VehicleMocapOdometry"),
        x=("position[0]", "x"),
        y=("position[1]", "y"),
        z=("position[2]", "z"),
        covariance=("position_variance", "pose_covariance"),
        axes=("pose_frame.@sub(1)", "local_frame"),
        frame_convention="ned",
        vertical_datum="frame",
    ),
    # Motion capture.
    "RigidBodies": replace(
        metric("mocap4r2_msgs.RigidBodies", "rigidbodies[:].pose.position"),
        schemas=("mocap4r2_msgs.RigidBodies", "mocap_msgs.RigidBodies", "mocap_interfaces.RigidBodies"),
        agent=("rigidbodies[:].rigid_body_name",),
        role="truth",
        names_agents=True,
    ),
    "NamedPoseArray": replace(
        metric("motion_capture_tracking_interfaces.NamedPoseArray", "poses[:].pose.position"),
        agent=("poses[:].name",),
        role="truth",
        names_agents=True,
    ),
    # Used where a topic of motion capture holds it; elsewhere it tells where a frame is.
    "TransformStamped": replace(
        metric("geometry_msgs.TransformStamped", _TRANSFORM), agent=("child_frame_id",), is_suggested=False
    ),
    # What is drawn may be anything: only when told.
    "Path": replace(
        metric("nav_msgs.Path", "poses[:].pose.position"),
        time=("poses[:].header.stamp", *TIME_PATHS),
        frame_id=("poses[:].header.frame_id", *FRAME_PATHS),
        is_suggested=False,
    ),
    "Marker": replace(
        metric("visualization_msgs.Marker", "pose.position"),
        where=("action == 0", *(f"type != {number}" for number in _LISTS)),
        agent=("id",),
        names_agents=True,
        is_suggested=False,
    ),
    "MarkerArray": replace(
        stamped_items(metric("visualization_msgs.MarkerArray", f"{_MARKERS}.pose.position"), f"{_MARKERS}."),
        where=(f"{_MARKERS}.action == 0", *(f"{_MARKERS}.type != {number}" for number in _LISTS)),
        agent=(f"{_MARKERS}.id",),
        names_agents=True,
        is_suggested=False,
    ),
    "SceneUpdate": replace(
        metric("foxglove.SceneUpdate", *(f"entities[:].{kind}[:].pose.position" for kind in ("cubes", "spheres", "models"))),
        alternatives="all",
        time=("entities[:].timestamp",),
        frame_id=("entities[:].frame_id",),
        agent=("entities[:].id",),
        names_agents=True,
    ),
}
