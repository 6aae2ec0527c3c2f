"""Message types of what detectors and trackers say of many objects at once."""

from dataclasses import replace
from typing import Final

from pipeline.mapping.message_type import FRAME_PATHS, MessageType, metric, stamped_items

_RESULT = "results[0]"
_KINEMATICS = "objects[:].kinematics"


def _vision(schema: str, item: str) -> MessageType:
    """vision_msgs' detections: the box is filled in, or only the pose of the best hypothesis.

    Foxy and ROS 1 have the score beside that pose.
    """
    known = metric(schema, f"{item}bbox.center.position", f"{item}{_RESULT}.pose.pose.position")
    return replace(
        stamped_items(known, item) if item else known,
        alternatives="filled",
        covariance=(f"{item}{_RESULT}.pose.covariance",),
        agent=(f"{item}id", f"{item}tracking_id"),
        score=(f"{item}{_RESULT}.hypothesis.score", f"{item}{_RESULT}.score"),
        role="detections",
        names_agents=True,
    )


OBJECTS: Final[dict[str, MessageType]] = {
    "Detection3DArray": _vision("vision_msgs.Detection3DArray", "detections[:]."),
    "Detection3D": _vision("vision_msgs.Detection3D", ""),
    "RadarTracks": replace(
        metric("radar_msgs.RadarTracks", "tracks[:].position"),
        covariance=("tracks[:].position_covariance",),
        agent=("tracks[:].uuid", "tracks[:].track_id"),
        role="detections",
        names_agents=True,
    ),
    # The names of autoware's packages changed; its detected objects have no identity, its predicted ones another field.
    "TrackedObjects": replace(
        metric(
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
        role="detections",
        names_agents=True,
    ),
    # Its INVALID_COV_VALUE is 1e8.
    "RadarObjects": replace(
        metric("autoware_sensing_msgs.RadarObjects", "objects[:].position"),
        schemas=("autoware_sensing_msgs.RadarObjects", "autoware_perception_msgs.RadarObjects"),
        covariance=("objects[:].position_cov",),
        where=("objects[:].measurement_status != 255",),
        agent=("objects[:].object_id",),
        score=("objects[:].existence_probability",),
        role="detections",
        names_agents=True,
    ),
    "DetectedObjectArray": replace(
        metric("autoware_msgs.DetectedObjectArray", "objects[:].pose.position"),
        frame_id=("objects[:].space_frame", "objects[:].header.frame_id", *FRAME_PATHS),
        agent=("objects[:].id",),
        score=("objects[:].score",),
        role="detections",
        names_agents=True,
    ),
    "ObjectArray": replace(
        stamped_items(
            metric("derived_object_msgs.ObjectArray", "objects[:].pose.position", "objects[:].pose.pose.position"),
            "objects[:].",
        ),
        schemas=("derived_object_msgs.ObjectArray", "derived_object_msgs.ObjectWithCovarianceArray"),
        covariance=("objects[:].pose.covariance",),
        agent=("objects[:].id",),
        role="detections",
        names_agents=True,
    ),
    # label_id is the tracker's identity, label the class. States 2 and 3 are searched for: their place is a guess.
    "ObjectsStamped": MessageType(
        ("zed_msgs.ObjectsStamped", "zed_interfaces.ObjectsStamped"),
        x=("objects[:].position[0]",),
        y=("objects[:].position[1]",),
        z=("objects[:].position[2]",),
        vertical_datum="frame",
        covariance=("objects[:].position_covariance",),
        where=("objects[:].tracking_state != 2", "objects[:].tracking_state != 3"),
        agent=("objects[:].label_id",),
        score=("objects[:].confidence.@div(100)",),
        role="detections",
        names_agents=True,
    ),
    "SpatialDetectionArray": replace(
        metric("depthai_ros_msgs.SpatialDetectionArray", "detections[:].position"),
        agent=("detections[:].tracking_id",),
        score=("detections[:].results[0].score",),
        role="detections",
        names_agents=True,
    ),
    "BoundingBoxArray": replace(
        stamped_items(metric("jsk_recognition_msgs.BoundingBoxArray", "boxes[:].pose.position"), "boxes[:]."),
        score=("boxes[:].value",),
        role="detections",
    ),
    "Detection": replace(
        metric("mission.Detection", "position"),
        covariance=("position_covariance", "covariance"),
        agent=("agent_id",),
        sensor=("sensor_id",),
        score=("score",),
        role="detections",
    ),
}
