"""Message types of what cameras detect: boxes in an image, which are directions once it is known how the camera sees."""

from typing import Final

from pipeline.mapping.message_type import MessageType, stamped_items


def _boxes(schema: str, item: str) -> MessageType:
    """vision_msgs' boxes; their centre is a pose since Galactic, before it was a Pose2D.

    They are used only when told: mostly they show everything of some class, and nothing says whom.
    """
    known = MessageType(
        (schema,),
        pixel_x=(f"{item}bbox.center.position.x", f"{item}bbox.center.x"),
        pixel_y=(f"{item}bbox.center.position.y", f"{item}bbox.center.y"),
        box_width=(f"{item}bbox.size_x",),
        box_height=(f"{item}bbox.size_y",),
        agent=(f"{item}id", f"{item}tracking_id"),
        score=(f"{item}results[0].hypothesis.score", f"{item}results[0].score"),
        role="detections",
        names_agents=True,
        is_suggested=False,
    )
    return stamped_items(known, item) if item else known


CAMERAS: Final[dict[str, MessageType]] = {
    "Detection2DArray": _boxes("vision_msgs.Detection2DArray", "detections[:]."),
    "Detection2D": _boxes("vision_msgs.Detection2D", ""),
}
