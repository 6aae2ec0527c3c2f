"""The names of topics: their words, and which part of them is who was seen or who saw it."""

import re
from collections.abc import Sequence
from typing import Final

TRUTH_WORDS: Final = {"truth", "groundtruth", "gt", "mocap", "vicon", "optitrack", "qualisys"}
DETECTION_WORDS: Final = {
    "contact", "contacts", "detection", "detections", "detected", "track", "tracks", "target", "targets", "sighting",
    "sightings", "observation", "observations", "measurement", "measurements", "ais", "adsb", "radar", "report", "reports",
}  # fmt: skip
POSE_WORDS: Final = {
    "pose", "poses", "odom", "odometry", "fix", "gps", "gnss", "navsat", "location", "position", "tracker", "trackers",
    "sensor", "sensors", "ownship", "own", "ego", "platform", "platforms", "observer", "observers",
}  # fmt: skip
_SEEN: Final = {"contact", "contacts", "target", "targets", "track", "tracks"}
_KNOWN: Final = TRUTH_WORDS | DETECTION_WORDS | POSE_WORDS | {"ground"}
_STAGES: Final = {
    "raw", "filtered", "filter", "fused", "fusion", "merged", "combined", "tracked", "tracking", "object", "objects",
    "recognition", "perception", "detector", "prediction", "predictions", "predicted", "estimated", "estimate", "estimates",
    "estimator", "smoothed", "corrected", "processed", "preprocessed", "validated", "confirmed", "cluster", "clusters",
    "clustered", "segmented", "classified", "transformed", "synced", "synchronized", "throttled", "throttle", "relay",
    "output", "out", "input", "in", "result", "results", "list", "array", "all", "data", "msg", "msgs", "info", "state",
    "states", "status", "point", "points", "box", "boxes", "bbox", "marker", "markers", "stamped", "covariance", "cov",
    "with", "global", "local", "world", "map", "enu", "ned", "ecef", "utm", "final", "new", "debug", "viz", "visualization",
    "latest", "update", "updates", "history", "online", "offline", "sim", "current", "unfiltered", "smooth", "smoothing",
    "stabilized", "stabilised", "dedup", "deduplicated", "nms", "gated", "gating", "associated", "association", "compensated",
    "calibrated", "rectified", "aligned", "projected", "interpolated", "resampled", "downsampled", "refined", "selected",
    "clean", "cleaned", "decoded", "parsed", "converted", "annotated", "labeled", "labelled", "valid", "invalid", "active",
    "candidate", "candidates", "hypothesis", "hypotheses", "stage", "step", "level", "model", "network", "inference",
    "kalman", "ekf", "ukf", "imm", "jpda", "gnn", "mht", "sort", "deepsort", "bytetrack", "yolo", "yolov", "ssd", "rcnn",
    "centerpoint", "pointpillars", "stream", "feed", "published", "publisher", "replay", "recorded", "simulated", "synthetic",
    "test", "main", "primary", "secondary", "default", "full", "partial", "best", "measured", "observed", "fov", "roi",
}  # fmt: skip
"""Words for a step of work on detections, or for their form: a part of a name that has no others is no name."""
_SENSORS: Final = {
    "lidar", "laser", "camera", "cam", "rgb", "rgbd", "thermal", "infrared", "ir", "eo", "eoir", "sonar", "radar", "ars", "esr",
    "srr", "mrr", "lrr", "velodyne", "ouster", "livox", "realsense", "zed", "stereo", "mono", "depth", "front", "rear", "back",
    "left", "right", "center", "centre", "middle", "top", "bottom", "forward", "port", "starboard", "bow", "stern", "mast",
    "gps", "gnss", "rtk", "ublox", "novatel", "septentrio", "trimble", "ins", "receiver", "antenna", "transponder", "navpvt",
    "bestpos", "flir", "lwir", "swir", "nir", "uv", "acoustic", "hydrophone", "ladar", "hesai", "robosense", "v2x",
}  # fmt: skip
"""Words for who saw, or for where on a vehicle that is: the name of a sensor, wherever it stands."""


def words_of(topic: str) -> list[str]:
    """The words of a name, in small letters: `/frontCamera/raw_2` has four."""
    spaced = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", topic)
    return [word.lower() for word in re.split(r"[^A-Za-z0-9]+", spaced) if word]


_LOOKS: Final = {
    "contact", "contacts", "detection", "detections", "detected", "track", "tracks", "target", "targets", "sighting",
    "sightings", "observation", "observations", "measurement", "measurements", "report", "reports", "pose", "poses", "position",
    "positions", "location", "det", "dets", "obs", "meas",
}  # fmt: skip
"""Words that say only that something is somewhere."""


def family_of(topic: str) -> frozenset[str]:
    """The words of a name that say what it is about: not that something was detected, nor how far the work on it is."""
    return frozenset(words_of(topic)) - _STAGES - _LOOKS


def pattern_of(topic: str, role: str, needs_agent: bool, topics: Sequence[str]) -> str:
    """The topic with placeholders where names stand beside words of roles.

    /truth/A7 → /truth/{agent}, /cub1/pose → /{agent}/pose; of a detection the name before the word is who sees, the name
    after it who is seen: /camera/contacts/A7 → /{sensor}/contacts/{agent}. Names in `topics` tell which part varies. A stage of
    work (/contacts/filtered) is no name, and a sensor (/contacts/lidar_front) never an agent. Messages that name agents
    themselves, or hold several, need none of the topic.
    """
    parts = topic.split("/")
    is_word = [bool(part) and not _KNOWN.isdisjoint(words_of(part)) for part in parts]
    names = [i for i, part in enumerate(parts) if part and not is_word[i] and not _is_stage(part)]
    if not any(is_word) or not names:
        return topic
    varying = _varying(parts, names, topics)
    if role == "detections":
        words = [i for i, known in enumerate(is_word) if known]
        # /contacts/A7/pose: what stands behind the name only says what is told of it.
        word = max((i for i in words if not _SEEN.isdisjoint(words_of(parts[i]))), default=words[-1])
        word = words[-1] if any(not DETECTION_WORDS.isdisjoint(words_of(parts[i])) for i in words if i > word) else word
        sensors = [i for i in names if i < word or _is_sensor(parts[i])]
        agents = [i for i in names if i not in sensors] if needs_agent else []
        for placeholder, places in (("sensor", sensors), ("agent", agents)):
            if places:
                parts[next((i for i in reversed(places) if i in varying), places[-1])] = f"{{{placeholder}}}"
    elif role == "poses" or needs_agent:
        parts[varying[-1] if varying else names[-1]] = "{sensor}" if role == "poses" else "{agent}"
    return "/".join(parts)


def _is_stage(part: str) -> bool:
    words = [word.rstrip("0123456789") for word in words_of(part)]  # /contacts/raw_2, but /contacts/2
    return any(words) and all(word in _STAGES for word in words if word)


def _is_sensor(part: str) -> bool:
    return any(word.rstrip("0123456789") in _SENSORS for word in words_of(part))


def _varying(parts: Sequence[str], names: Sequence[int], topics: Sequence[str]) -> list[int]:
    """The places of `names` in which some other topic differs from this one, and in no other part."""
    found: set[int] = set()
    for other in (topic.split("/") for topic in topics):
        if len(other) == len(parts):
            different = [i for i, (mine, its) in enumerate(zip(parts, other, strict=True)) if mine != its]
            found.update(different if len(different) == 1 else ())
    return [i for i in names if i in found]
