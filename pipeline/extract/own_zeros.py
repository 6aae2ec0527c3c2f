"""Metres that count from a place of their own: where each vehicle was switched on, or the zero of another grid.

Two vehicles that both count from where they began look as if they had begun together, and a source in the metres of a map grid
(UTM) lies thousands of kilometres from one about a local zero.
"""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from pipeline.counted import counted
from pipeline.extract.channel_reader import AXES, ORIGIN, ChannelReader
from pipeline.extract.positions import Positions
from pipeline.frames import words_of_frame
from pipeline.suspicions import Suspicions, listed

_MAX_BEGIN_M: Final = 0.1
"""No two vehicles are at one place; what begins nearer to zero than this counts from where it began."""
_MIN_MOVED_M: Final = 1.0
_MIN_APART_M: Final = 1e5
_APART_RATIO: Final = 20.0
"""Of the larger extent of two sources: nobody records what lies so much further apart than all that it does."""
_MOST: Final = (0.05, 0.95)
_TRUSTED: Final = 'extract.trusted = ["place"]'

Parts = Mapping[str, Sequence[tuple[ChannelReader, Positions]]]


def check_own_zeros(parts: Parts, suspicions: Suspicions) -> None:
    """Tell of detections [N] of several vehicles in metres of one frame that each count from a place which nothing tells.

    PX4's local positions do by their type, unless they say where that is; of others it shows where they begin at zero. Tell as
    well of x that is not north by what messages say of their axes.
    """
    if not suspicions.looks_for("place"):
        return
    begun: dict[str, dict[str, str]] = {}
    known: set[str] = set()
    for reader, rows in parts["detections"]:
        if reader.is_geodetic or reader.is_polar or len(rows) < 2:
            continue
        if reader.more == AXES and reader.source.frame_convention is None:
            _check_axes(reader, suspicions)
        if len(rows.agents.names) == 1 and len(rows.frames.names) == 1:
            if _is_own(reader, rows):
                begun.setdefault(rows.frames.names[0], {}).setdefault(rows.agents.names[0], reader.channel.topic)
            elif reader.more == ORIGIN:
                known.add(rows.frames.names[0])
    for frame, topics in begun.items():
        if len(topics) > 1 or frame in known:
            suspicions.add(
                "place", ", ".join(list(topics.values())[:3]),
                seen=f"{listed(topics)} counts metres from where it began, as others do, and nothing says where that is",
                done="taken as if all counted from one place",
                setting=f"the topics of one vehicle alone in [[extract.detections]], or {_TRUSTED}",
            )  # fmt: skip


def _is_own(reader: ChannelReader, rows: Positions) -> bool:
    """Whether rows count from where their vehicle began."""
    if reader.more == AXES:
        return True
    if reader.more == ORIGIN:
        measured = reader.measured()
        return not np.isfinite(measured[ORIGIN[0]]).any() or not np.any(measured[ORIGIN[0]])
    if "odom" not in words_of_frame(rows.frames.names[0]):  # by REP 105 that frame begins where the robot does
        return False
    first = int(np.argmin(rows.time_ns))
    moved_m = np.hypot(np.ptp(rows.first), np.ptp(rows.second))
    return bool(np.hypot(rows.first[first], rows.second[first]) < _MAX_BEGIN_M and moved_m > _MIN_MOVED_M)


def _check_axes(reader: ChannelReader, suspicions: Suspicions) -> None:
    axes = reader.measured()[AXES[0]]
    num = int((axes[np.isfinite(axes)] != 0).sum())
    if num:
        suspicions.add(
            "place", reader.channel.topic,
            seen=f"{counted(num, 'message says', 'messages say')} that x is not north but ahead, or anything",
            done="read as north, east and down", setting='frame_convention = "ned" or "enu" in its [[extract.detections]]',
        )  # fmt: skip


def check_far_zeros(rows: Positions, suspicions: Suspicions) -> None:
    """Tell of a topic whose detections, in metres of the same frame, lie far from those of all others [N]."""
    metric = rows[~rows.is_geodetic]
    if not suspicions.looks_for("place") or len(metric.topics.names) < 2:
        return
    places, extents_m = {}, {}
    for topic, chosen in zip(metric.topics.names, metric.topics.rows(), strict=True):
        place_m = np.column_stack([metric.first[chosen], metric.second[chosen]])
        places[topic] = np.median(place_m, axis=0)
        extents_m[topic] = float(np.hypot(*np.ptp(np.quantile(place_m, _MOST, axis=0), axis=0)))
    nearest = {
        topic: min((float(np.hypot(*(place - other))), name) for name, other in places.items() if name != topic)
        for topic, place in places.items()
    }
    for topic, (apart_m, name) in sorted(nearest.items(), key=lambda item: -float(np.hypot(*places[item[0]]))):
        if apart_m > max(_MIN_APART_M, _APART_RATIO * max(extents_m[topic], extents_m[name])):
            suspicions.add(
                "place", topic,
                seen=f"its metres lie {apart_m / 1e3:.4g} km from those of {name} in the same frame: another zero, as of UTM",
                done="used as they stand", setting=f"x and y in its [[extract.detections]] (with .@sub(n)), or {_TRUSTED}",
            )  # fmt: skip
            return
