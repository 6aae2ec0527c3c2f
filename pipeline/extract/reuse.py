"""Names that several targets bear, at once or one after the other.

A small number that a tracker gives out anew, sensors that count for themselves, a kind in place of a name.
"""

import re
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from cadence.arrays import Int64s, Objects
from pipeline.counted import counted
from pipeline.extract.names import Naming
from pipeline.extract.positions import Positions
from pipeline.extract.tracks import Jump, Track, apart_m, odd_share, pieces_of
from pipeline.suspicions import Suspicions, listed

_MAX_ODD: Final = 0.3
"""Of the steps of a name: noise alone makes a target seem to leave and come back in one step of twelve."""
_MIN_ROWS: Final = 4
_COUNTED: Final = re.compile(
    r"(?:(?:track|trk|object|obj|id|target|det|detection|cluster|blob|person|people|human|ped|pedestrian|car|truck|bus|van|"
    r"bicycle|bike|cyclist|motorcycle|motorbike)[^a-z0-9]*)?[0-9]{1,5}"
)
"""Numbers that a tracker counts, also behind a kind; those of ships and aircraft have more digits, and vehicles have names."""
_SETTING: Final = "has_identity (true: names are believed, false: none is) in its [[extract.detections]]"


@dataclass
class _Found:
    """What was found on one set of topics: names by fault, with the numbers of the worst case and of what became of them."""

    apart: dict[str, float] = field(default_factory=dict)
    odd: dict[str, int] = field(default_factory=dict)
    jumps: dict[str, Jump] = field(default_factory=dict)
    num_agents: int = 0

    def any(self) -> bool:
        """Whether there is anything to tell."""
        return bool(self.apart or self.odd or self.jumps)


def without_reused_names(rows: Positions, tolerance_s: float, naming: Naming, suspicions: Suspicions) -> Positions:
    """The rows [N] of detections, in metres and sorted by time, with names that mean one agent each.

    A name that several agents bear becomes several names; one that means no agent is taken away. Moments are the same within
    `tolerance_s`.
    """
    if not suspicions.looks_for("identity") or len(rows) == 0:
        return rows
    agent, found = rows.agent, defaultdict[str, _Found](_Found)
    track, taken, sensors = _track(rows), set(rows.agents.names), rows.sensors
    sources = rows.topics.number * (len(sensors.names) + 1) + sensors.number
    is_believed = np.array([topic in naming.believed for topic in rows.topics.names])[rows.topics.number]
    for name, chosen in zip(rows.agents.names, rows.agents.rows(), strict=True):
        if len(chosen) < _MIN_ROWS or is_believed[chosen].any():
            continue
        parts = {source: chosen[sources[chosen] == source] for source in np.unique(sources[chosen]).tolist()}
        told = found[", ".join(dict.fromkeys(rows.topic[[part[0] for part in parts.values()]]))]
        named = {_source(rows, part): part for part in parts.values()}
        for part_name, same in _apart(track, name, named, told).items():
            renamed = _renamed(track, part_name, same, tolerance_s, taken, told)
            if renamed is not None:
                agent = agent.copy() if agent is rows.agent else agent
                agent[np.sort(np.concatenate(same))] = renamed
            elif part_name != name:
                agent = agent.copy() if agent is rows.agent else agent
                agent[np.concatenate(same)] = part_name
    for topics, told in found.items():
        _tell(topics, told, suspicions)
    return rows.changed(agent=agent) if any(told.any() for told in found.values()) else rows


def reused(names: Collection[str]) -> set[str]:
    """Which names became several, by what they are called now."""
    return {name.removesuffix(mark) for name in names for mark in (".2", ".reused.2") if name.endswith(mark)} & set(names)


def _track(rows: Positions) -> Track:
    time_s = (rows.time_ns - rows.time_ns[0]).astype(np.float64) * 1e-9
    return Track(time_s, rows.first + 1j * rows.second, np.nan_to_num(rows.covariance_m2[:, [0, 2]].max(axis=1)))


def _source(rows: Positions, part: Int64s) -> str:
    """Who says so: topic and sensor."""
    return f"{rows.topic[part[0]].strip('/')} {rows.sensor[part[0]] or ''}".strip()


def _apart(track: Track, name: str, sources: Mapping[str, Int64s], told: _Found) -> dict[str, list[Int64s]]:
    """The row numbers of each source by the name of the agent: that of all, or one a source where they mean different ones."""
    distance_m = apart_m([track[part] for part in sources.values()]) if len(sources) > 1 else 0.0
    if not distance_m:
        return {name: list(sources.values())}
    told.apart[name] = distance_m
    return {f"{source}/{name}": [part] for source, part in sources.items()}


def _renamed(
    track: Track, name: str, parts: Sequence[Int64s], tolerance_s: float, taken: Collection[str], told: _Found
) -> Objects | None:
    """What each row [N] of an agent, seen by several sources, is called (None: nothing is known); None where it stays."""
    rows = parts[0] if len(parts) == 1 else np.sort(np.concatenate(parts))
    odd = sum(odd_share(track[part], tolerance_s, _MAX_ODD) * len(part) for part in parts)
    if odd > _MAX_ODD * len(rows):
        told.odd[name] = len(rows)
        return np.full(len(rows), None, dtype=object)
    piece, jump = pieces_of(track[rows], tolerance_s, _COUNTED.fullmatch(name.rpartition("/")[2].lower()) is not None)
    if jump is None:
        return None
    told.jumps[name] = jump
    told.num_agents += int(piece.max()) + 1
    mark = "." if f"{name}.2" not in taken else ".reused."
    return np.array([name if number == 0 else f"{name}{mark}{number + 1}" for number in piece.tolist()], dtype=object)


def _tell(topics: str, told: _Found, suspicions: Suspicions) -> None:
    if told.apart:
        far_m = max(told.apart.values())
        seen = f"sources put {listed(told.apart)} up to {far_m:.4g} m apart at one moment"
        suspicions.add("identity", topics, seen=seen, done="names of different sources are different agents", setting=_SETTING)
    if told.odd:
        seen = f"{listed(told.odd)} would be at several places at once, or leave and come back faster than anything moves"
        done = f"{counted(sum(told.odd.values()), 'detection is', 'detections are')} of unknown origin"
        suspicions.add("identity", topics, seen=seen, done=done, setting=_SETTING)
    if told.jumps:
        name, jump = max(told.jumps.items(), key=lambda item: item[1].ratio)
        far = f'"{name}" jumps {jump.length_m:.4g} m in {jump.time_s:.3g} s, {jump.ratio:.3g} times its speed'
        more = f", and {counted(len(told.jumps) - 1, 'more name jumps', 'more names jump')}" if len(told.jumps) > 1 else ""
        done = f"{counted(len(told.jumps), 'name')} became {counted(told.num_agents, 'agent')} ({name}, {name}.2, ...)"
        suspicions.add("identity", topics, seen=far + more, done=done, setting=_SETTING)
