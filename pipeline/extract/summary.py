"""What the stage says of its work: a line for each kind of thing that was left out, and the numbers of the manifest."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from pipeline.counted import told
from pipeline.extract.channel_reader import ChannelReader
from pipeline.extract.positions import Positions
from pipeline.extract.selection import ROLES
from pipeline.logs.reader import MissionLog
from pipeline.mapping.message_types import MESSAGE_TYPES, type_of_schema
from pipeline.progress import Progress
from pipeline.suspicions import Suspicions, few
from pipeline.tables import Frame

_STAMPS_APART_S = 3600.0


def tell(counts: Counter[str], suspicions: Suspicions, detections: Positions, log: MissionLog, progress: Progress) -> None:
    """One line for each kind of thing that was left out, and for each suspicion."""
    meanings = {
        "dropped_nonfinite": "positions are NaN, infinite or off the earth and were skipped",
        "incomplete": "messages have no position where the mapping looks for it and were skipped",
        "undecodable": "messages cannot be decoded and were skipped",
        "no_fix": "positions are marked as having no fix, or as not valid, and were skipped",
        "unmet": "positions do not meet the conditions of `where` and were skipped",
        "unread_stamps": "stamps are no times that can be read and were replaced by the log's (see a source's time)",
        "bad_covariance": "covariances are not positive definite and were replaced by the default",
        "disowned_covariance": "covariances are called unknown by their type and were not used (see a source's covariance)",
        "out_of_order": "stamps were out of order and were sorted",
        "disagreeing": "detections do not agree with the most accurate one of their agent at the same moment, and were skipped",
        "spikes": "positions lie far off their track (see extract.max_speed_mps) and were skipped",
        "other_frame": "positions are in another frame than the detections, which no transform joins, and were skipped",
        "no_transform": "positions have no transform near enough in time (see extract.max_extrapolation_s) and were skipped",
        "north_by_name": "positions are north, east, down by their frame's name and were turned (see frame_convention)",
        "ground_heights": "altitudes are 0 where a track begins or ends, as on the ground, and were left out",
        "static": "returns stand, by the Doppler of their scans, and were left out (see is_static_used of a source)",
        "no_observer": "measurements have no pose of their observer near enough in time and were skipped",
        "outside_time_cut": "messages lie outside extract.start and extract.end and were not used",
        "unselected_topics": "topics fit none of extract.topics and were not used",
    }
    for name, meaning in meanings.items():
        if counts[name]:
            progress.note(f"extract: {told(counts[name], meaning)}")
    apart_s = float(np.median(np.abs(detections.time_ns - detections.log_time_ns))) * 1e-9
    if apart_s > _STAMPS_APART_S:
        advice = 'to use the log times give the source time = "log_time"'
        progress.note(f"extract: stamps and log times are {apart_s:.0f} s apart; the stamps are used; {advice}")
    for line in few(suspicions.lines()):
        progress.note(f"extract: suspected {line}")
    for problem in log.health.problems:
        progress.note(f"extract: {problem}")


def _sources(role: str, readers: Sequence[ChannelReader], detections: Positions) -> list[str]:
    """The topics of a role; of detections those of which some are left."""
    left = set(detections.topic)
    return sorted({r.source.topic for r in readers if r.role == role and (role != "detections" or r.channel.topic in left)})


def summarise(
    log: MissionLog, readers: Sequence[ChannelReader], detections: Positions, truth: Positions, poses: Positions, frame: Frame,
    counts: Counter[str], suspicions: Suspicions, num_obstacles: int,
) -> dict[str, Any]:  # fmt: skip
    """The numbers of the stage."""
    agents = {agent for agent in detections.agent if agent is not None}
    span_s = float(detections.time_ns[-1] - detections.time_ns[0]) * 1e-9
    names = (
        "undecodable",
        "incomplete",
        "no_fix",
        "unmet",
        "dropped_nonfinite",
        "unread_stamps",
        "bad_covariance",
        "disowned_covariance",
        "out_of_order",
        "outside_time_cut",
    )
    return {
        "num_detections": len(detections),
        "num_truth": len(truth),
        "num_poses": len(poses),
        "num_obstacles": num_obstacles,
        "num_agents": len(agents),
        "num_unknown_origin": sum(agent is None for agent in detections.agent),
        "span_s": span_s,
        "frame": {"frame_id": frame.frame_id, "latitude_deg": frame.latitude_deg, "longitude_deg": frame.longitude_deg},
        "unnamed": _unnamed(readers, detections),
        "sources": {role: _sources(role, readers, detections) for role in ROLES},
        **{
            name: counts[name]
            for name in (*names, "other_frame", "spikes", "collapsed", "disagreeing", "duplicate_truth", "unselected_topics")
        },
        "lost_spans_ns": [list(span) for span in log.health.lost_spans_ns],
        "is_complete": log.health.is_complete,
        "suspicions": suspicions.records(),
    }


def _unnamed(readers: Sequence[ChannelReader], detections: Positions) -> dict[str, str | None]:
    """Topics with detections that do not say whose they are, and where messages of their type usually do; None: nowhere."""
    topics = {str(topic) for topic, agent in zip(detections.topic, detections.agent, strict=True) if agent is None}
    found = {}
    for reader in readers:
        if reader.role == "detections" and reader.channel.topic in topics:
            known = MESSAGE_TYPES.get(type_of_schema(reader.channel.schema_name) or "")
            is_read = "agent" in reader.fields
            found[reader.channel.topic] = known.agent[0] if known is not None and known.agent and not is_read else None
    return found
