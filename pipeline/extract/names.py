"""Names that cannot say who was seen, by what the messages say: detections that bear them are of unknown origin.

A name is believed as long as nothing contradicts it. What does, is said as a suspicion.
"""

import itertools
import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from cadence.arrays import Bools, Float64s, Int64s, Objects
from pipeline.counted import counted
from pipeline.extract.covariances import are_apart
from pipeline.extract.positions import Positions
from pipeline.suspicions import Suspicions, listed

_MAX_SHARED: Final = 0.05
"""Of the messages that hold a name: with more in which it stands at several places it is no name at all; with fewer the odd
message is at fault (a tracker that splits a track for a moment), and only what it says is nobody's."""
_MIN_FRESH: Final = 10
_FRESH: Final = 0.8
"""Of at least so many names: where more stand in one message each, names are counted anew for each message."""
_FRESH_MPS: Final = 100.0
"""Unless the next message has nothing near: many ships that are heard once each are far from each other."""
_EXCHANGED: Final = 0.3
_FURTHER: Final = 3.0
_MIN_EXCHANGED_M: Final = 10.0
_MAX_BEND_MPS2: Final = 10.0
"""One g: names that go from target to target bend by more, in three of ten messages."""
_HEXADECIMAL: Final = re.compile(r"(?=.*[a-f])(?=.*[0-9])[0-9a-f]{6,}")
"""Addresses of aircraft, and UUIDs."""
_FILL_INS: Final = {"4294967295", "2147483647", "18446744073709551615", "9223372036854775807"}
_CLASSES: Final = {
    "person", "persons", "people", "pedestrian", "human", "man", "woman", "child", "car", "vehicle", "truck", "bus", "van",
    "trailer", "motorcycle", "motorbike", "bicycle", "bike", "cyclist", "rider", "train", "tram", "tractor", "boat", "ship",
    "vessel", "sailboat", "buoy", "aircraft", "airplane", "plane", "helicopter", "drone", "uav", "bird", "animal", "dog", "cat",
    "horse", "deer", "cow", "sheep", "cone", "object", "obstacle", "other", "background",
}  # fmt: skip
"""Kinds of targets, as detectors are trained for them."""
_SCORE: Final = re.compile(r"[^a-z0-9.]*(?:[01]?\.[0-9]+|[01]\.|[0-9]{1,3}(?:\.[0-9]+)?\s*%)[^a-z0-9]*$")
"""What a picture has behind a kind: `car 0.87`, `person: 93%`."""
_CLASS_WORDS: Final = {"type", "class", "label", "category", "human", "adult", "movable", "static", "small", "large", "motor"}
"""What stands beside such a kind in the names of labels: `vehicle.car`, `TYPE_PEDESTRIAN`."""


@dataclass(frozen=True)
class Naming:
    """Which names are looked at.

    believed  topics whose names are not
    topical   topics that state the name themselves: only that one message gives it to several places
    stated    topics of which the user says where the name is: a kind of target may be the name of the only one of its kind
    """

    believed: Collection[str]
    topical: Collection[str]
    stated: Collection[str] = ()


def in_one_spelling(rows: Positions) -> Positions:
    """The rows with names of hexadecimal digits, which one receiver writes in capitals or with hyphens and another does not."""
    spelled: dict[str, str] = {}
    changed: dict[str, str] = {}
    for name in rows.agents.names:
        plain = name.lower().replace("-", "")
        if _HEXADECIMAL.fullmatch(plain) and spelled.setdefault(plain, name) != name:
            changed[name] = spelled[plain]
    if not changed:
        return rows
    return rows.changed(agent=np.array([changed.get(name, name) for name in rows.agent.tolist()], dtype=object))


def without_false_names(rows: Positions, tolerance_s: float, naming: Naming, suspicions: Suspicions) -> Positions:
    """The rows [N] of detections, in metres and by time, with the agent taken away where it is no identity.

    Moments are the same within `tolerance_s`.
    """
    if not suspicions.looks_for("identity"):
        return rows
    rows = _without_shared(rows, naming, round(tolerance_s * 1e9), suspicions)
    agent: Objects | None = None
    for topic, of_topic in zip(rows.topics.names, rows.topics.rows(), strict=True):
        if topic in naming.believed or topic in naming.topical:
            continue
        chosen = of_topic[rows.agents.number[of_topic] >= 0]
        for is_false, seen in _faults(rows[chosen], topic in naming.stated):
            agent = rows.agent.copy() if agent is None else agent
            agent[chosen[is_false]] = None
            _suspect(topic, seen, int(is_false.sum()), suspicions)
    return rows if agent is None else rows.changed(agent=agent)


def _faults(rows: Positions, is_stated: bool) -> Iterator[tuple[Bools, str]]:
    """Which rows [N] of a topic bear no name, and why, for each reason that there is."""
    names = rows.agents.names
    for is_chosen, why in (
        ([_is_fill_in(name) for name in names], "what stands where nothing was filled in"),
        ([not is_stated and _is_class(name) for name in names], "what was seen, not who"),
    ):
        chosen = list(itertools.compress(names, is_chosen))
        if chosen:
            yield np.array(is_chosen)[rows.agents.number], f"{listed(chosen)} {'are' if len(chosen) > 1 else 'is'} {why}"
    if _are_exchanged(rows):
        yield np.ones(len(rows), np.bool_), "names change places from message to message"
    elif _are_fresh(rows):
        yield np.ones(len(rows), np.bool_), f"{len(names)} names for {len(rows)} detections: they are new in each message"


def _is_fill_in(name: str) -> bool:
    digits = name.lower().replace("-", "").removeprefix("0x")
    return name in _FILL_INS or (len(digits) >= 8 and digits in ("0" * len(digits), "f" * len(digits)))


def _is_class(name: str) -> bool:
    words = [word for word in re.split(r"[^a-z0-9]+", _SCORE.sub("", name.lower())) if word]
    return not _CLASSES.isdisjoint(words) and _CLASSES.union(_CLASS_WORDS).issuperset(words)


def _are_fresh(rows: Positions) -> bool:
    """Whether names last for one message each, while targets do not."""
    num_names = len(rows.agents.names)
    if num_names < _MIN_FRESH or len(np.unique(rows.message)) < _MIN_FRESH:
        return False
    pairs = np.unique(np.column_stack([rows.agents.number, rows.message]), axis=0)
    if (np.bincount(pairs[:, 0], minlength=num_names) == 1).mean() < _FRESH:
        return False
    _, message = np.unique(rows.message, return_inverse=True)
    return float(np.median(_speeds_mps(rows, message))) < _FRESH_MPS


def _are_exchanged(rows: Positions) -> bool:
    """Whether what bears a name in the next message is, as a rule, another target, while its own is near.

    The names of targets that move on together stay smooth, however near others come to their places.
    """
    if not (np.diff(rows.message) == 0).any() or len(rows) < _MIN_FRESH:
        return False
    order = np.lexsort((rows.time_ns, rows.agents.number))
    name, place = rows.agents.number[order], (rows.first + 1j * rows.second)[order]
    step_s, is_next = np.diff(rows.time_ns[order]) * 1e-9, np.diff(name) == 0
    bend_m, is_triple = np.abs(np.diff(place, 2)), is_next[1:] & is_next[:-1]
    is_rough = is_triple & (bend_m > _MAX_BEND_MPS2 * np.minimum(step_s[1:], step_s[:-1]) ** 2) & (bend_m > _MIN_EXCHANGED_M)
    if is_rough.sum() <= _EXCHANGED * len(rows):
        return False
    own_m = np.full(len(rows), np.nan)
    own_m[order[:-1]] = np.where(is_next, np.abs(np.diff(place)), np.nan)
    messages, message = np.unique(rows.message, return_inverse=True)
    if len(messages) < _MIN_FRESH:
        return False
    by_message, nearest_m, _ = _nearest(rows, message)
    is_other = own_m[by_message] > np.maximum(_MIN_EXCHANGED_M, _FURTHER * nearest_m)
    return bool(is_other.sum() > _EXCHANGED * len(rows))


def _speeds_mps(rows: Positions, message: Int64s) -> np.ndarray:
    """How fast the nearest position of the next message would have been reached from each row [N] that has a next message."""
    _, distance_m, time_s = _nearest(rows, message)
    return distance_m / np.maximum(time_s, 1e-3)


def _nearest(rows: Positions, message: Int64s) -> tuple[Int64s, Float64s, Float64s]:
    """The rows that have a next message, how far its nearest position is from each, and how much later."""
    order = np.argsort(message, kind="stable")
    place = np.column_stack([rows.first, rows.second])[order]
    time_s = (rows.time_ns[order] - rows.time_ns[0]) * 1e-9
    borders = np.flatnonzero(np.diff(message[order], prepend=-1))
    distances_m, times_s = [], []
    for first, last, end in zip(borders[:-1], borders[1:], [*borders[2:], len(order)], strict=True):
        distance_m, nearest = cKDTree(place[last:end]).query(place[first:last])
        distances_m.append(distance_m)
        times_s.append(np.abs(time_s[last + nearest] - time_s[first:last]))
    return order[: borders[-1]], np.concatenate(distances_m), np.concatenate(times_s)


def _without_shared(rows: Positions, naming: Naming, tolerance_ns: int, suspicions: Suspicions) -> Positions:
    """Take names away that one message gives to several places at one moment."""
    is_shared = _is_shared(rows, tolerance_ns)
    if not is_shared.any():
        return rows
    agent = rows.agent.copy()
    for topic, of_topic in zip(rows.topics.names, rows.topics.rows(), strict=True):
        shared = of_topic[is_shared[of_topic]]
        if topic in naming.believed or len(shared) == 0:
            continue
        is_false = np.zeros(len(rows), np.bool_)
        numbers = list(dict.fromkeys(rows.agents.number[shared].tolist()))
        for number in numbers:
            of_name = of_topic[rows.agents.number[of_topic] == number]
            shares_name = of_name[is_shared[of_name]]
            is_false[
                of_name if _num_messages(rows, shares_name) > _MAX_SHARED * _num_messages(rows, of_name) else shares_name
            ] = True
        agent[is_false] = None
        names = listed([rows.agents.names[number] for number in numbers])
        seen = f"{_num_messages(rows, shared)} of {_num_messages(rows, of_topic)} messages have {names} at several places"
        _suspect(topic, seen, int(is_false.sum()), suspicions)
    return rows.changed(agent=agent)


def _num_messages(rows: Positions, chosen: Int64s) -> int:
    return len(np.unique(rows.message[chosen]))


def _is_shared(rows: Positions, tolerance_ns: int) -> Bools:
    """Which rows [N] bear a name that another row of the same message and moment bears at a place that does not agree."""
    found = np.zeros(len(rows), np.bool_)
    named = np.flatnonzero(rows.agents.number >= 0)
    if len(named) == 0 or np.bincount(rows.message[named]).max() < 2:
        return found
    name = rows.agents.number[named]
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
    suspicions.add(
        "identity",
        topic,
        seen=seen,
        done=f"{counted(num_false, 'detection is', 'detections are')} of unknown origin",
        setting=setting,
    )
