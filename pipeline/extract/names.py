"""Names that cannot say who was seen, by what the messages say: detections that bear them are of unknown origin.

A name is believed as long as nothing contradicts it. What does, is said as a suspicion.
"""

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from pipeline.arrays import Bools, Int64s
from pipeline.extract.covariances import are_apart
from pipeline.extract.plausibility import Suspicions, listed
from pipeline.extract.positions import Positions, numbered

_MAX_SHARED: Final = 0.05
"""Of the messages that hold a name: with more in which it stands at several places it is no name at all; with fewer the odd
message is at fault (a tracker that splits a track for a moment), and only what it says is nobody's."""
_MIN_FRESH: Final = 10
_FRESH: Final = 0.8
"""Of at least so many names: where more stand in one message each, names are counted anew for each message."""
_FRESH_MPS: Final = 100.0
"""Unless the next message has nothing near: many ships that are heard once each are far from each other."""
_FILL_INS: Final = {"4294967295", "2147483647", "18446744073709551615", "9223372036854775807"}
_CLASSES: Final = {
    "person", "persons", "people", "pedestrian", "human", "man", "woman", "child", "car", "vehicle", "truck", "bus", "van",
    "trailer", "motorcycle", "motorbike", "bicycle", "bike", "cyclist", "rider", "train", "tram", "tractor", "boat", "ship",
    "vessel", "sailboat", "buoy", "aircraft", "airplane", "plane", "helicopter", "drone", "uav", "bird", "animal", "dog", "cat",
    "horse", "deer", "cow", "sheep", "cone", "object", "obstacle", "other", "background",
}  # fmt: skip
"""Kinds of targets, as detectors are trained for them."""


@dataclass(frozen=True)
class Naming:
    """Which names are looked at.

    believed  topics whose names are not
    topical   topics that state the name themselves: only that one message gives it to several places
    """

    believed: Collection[str]
    topical: Collection[str]


def without_false_names(rows: Positions, tolerance_s: float, naming: Naming, suspicions: Suspicions) -> Positions:
    """The rows [N] of detections, in metres and by time, with the agent taken away where it is no identity.

    Moments are the same within `tolerance_s`.
    """
    if not suspicions.looks_for("identity"):
        return rows
    rows = _without_shared(rows, naming, round(tolerance_s * 1e9), suspicions)
    agent = rows.agent.copy()
    for topic in dict.fromkeys(rows.topic):
        if topic in naming.believed or topic in naming.topical:
            continue
        chosen = np.flatnonzero((rows.topic == topic) & (rows.agent != None))  # noqa: E711 (elementwise)
        for is_false, seen in _faults(rows[chosen]):
            agent[chosen[is_false]] = None
            _suspect(str(topic), seen, int(is_false.sum()), suspicions)
    return replace(rows, agent=agent)


def _faults(rows: Positions) -> Iterator[tuple[Bools, str]]:
    """Which rows [N] of a topic bear no name, and why, for each reason that there is."""
    names = list(dict.fromkeys(rows.agent))
    for chosen, why in (
        ([name for name in names if _is_fill_in(name)], "what stands where nothing was filled in"),
        ([name for name in names if name.lower() in _CLASSES], "what was seen, not who"),
    ):
        if chosen:
            yield np.isin(rows.agent.astype(np.str_), chosen), f"{listed(chosen)} {'are' if len(chosen) > 1 else 'is'} {why}"
    if _are_fresh(rows):
        yield np.ones(len(rows), np.bool_), f"{len(names)} names for {len(rows)} detections: they are new in each message"


def _is_fill_in(name: str) -> bool:
    digits = name.lower().replace("-", "").removeprefix("0x")
    return name in _FILL_INS or (len(digits) >= 8 and digits in ("0" * len(digits), "f" * len(digits)))


def _are_fresh(rows: Positions) -> bool:
    """Whether names last for one message each, while targets do not."""
    number = numbered(rows.agent)
    if len(rows) == 0 or number.max() + 1 < _MIN_FRESH or len(np.unique(rows.message)) < _MIN_FRESH:
        return False
    pairs = np.unique(np.column_stack([number, rows.message]), axis=0)
    if (np.bincount(pairs[:, 0]) == 1).mean() < _FRESH:
        return False
    _, message = np.unique(rows.message, return_inverse=True)
    return float(np.median(_speeds_mps(rows, message))) < _FRESH_MPS


def _speeds_mps(rows: Positions, message: Int64s) -> np.ndarray:
    """How fast the nearest position of the next message would have been reached from each row [N] that has a next message."""
    order = np.argsort(message, kind="stable")
    place = np.column_stack([rows.first, rows.second])[order]
    time_s = (rows.time_ns[order] - rows.time_ns[0]) * 1e-9
    borders = np.flatnonzero(np.diff(message[order], prepend=-1))
    found = []
    for first, last, end in zip(borders[:-1], borders[1:], [*borders[2:], len(order)], strict=True):
        distance_m, nearest = cKDTree(place[last:end]).query(place[first:last])
        found.append(distance_m / np.maximum(np.abs(time_s[last + nearest] - time_s[first:last]), 1e-3))
    return np.concatenate(found)


def _without_shared(rows: Positions, naming: Naming, tolerance_ns: int, suspicions: Suspicions) -> Positions:
    """Take names away that one message gives to several places at one moment."""
    agent = rows.agent.copy()
    is_shared = _is_shared(rows, tolerance_ns) & np.array([topic not in naming.believed for topic in rows.topic], np.bool_)
    for topic in dict.fromkeys(rows.topic[is_shared]):
        of_topic = rows.topic == topic
        names = list(dict.fromkeys(rows.agent[of_topic & is_shared]))
        is_false = np.zeros(len(rows), np.bool_)
        for name in names:
            of_name = of_topic & (rows.agent == name)
            num_shared, num_messages = (len(np.unique(rows.message[found])) for found in (of_name & is_shared, of_name))
            is_false |= of_name if num_shared > _MAX_SHARED * num_messages else of_name & is_shared
        agent[is_false] = None
        num_messages = len(np.unique(rows.message[of_topic & is_shared]))
        seen = f"{num_messages} of {len(np.unique(rows.message[of_topic]))} messages have {listed(names)} at several places"
        _suspect(str(topic), seen, int(is_false.sum()), suspicions)
    return replace(rows, agent=agent)


def _is_shared(rows: Positions, tolerance_ns: int) -> Bools:
    """Which rows [N] bear a name that another row of the same message and moment bears at a place that does not agree."""
    found = np.zeros(len(rows), np.bool_)
    name = numbered(rows.agent)
    named = np.flatnonzero(name >= 0)
    name = name[named]
    order = np.lexsort((rows.time_ns[named], name, rows.message[named]))
    name, ordered = name[order], named[order]
    before, after = ordered[:-1], ordered[1:]
    is_one = (rows.message[before] == rows.message[after]) & (name[:-1] == name[1:])
    is_one &= rows.time_ns[after] - rows.time_ns[before] <= tolerance_ns
    before, after = before[is_one], after[is_one]
    offset_m = np.column_stack([rows.first[after] - rows.first[before], rows.second[after] - rows.second[before]])
    apart = are_apart(offset_m, rows.covariance_m2[before], rows.covariance_m2[after])
    found[before[apart]] = found[after[apart]] = True
    return found


def _suspect(topic: str, seen: str, num_false: int, suspicions: Suspicions) -> None:
    setting = "agent_path or has_identity (false: so be it, true: they are believed) in its [[extract.detections]]"
    suspicions.add("identity", topic, seen=seen, done=f"{num_false} detections are of unknown origin", setting=setting)
