"""Frames of detections that nothing joins to the world: a sensor's coordinates are not taken for places."""

import re
from collections.abc import Callable, Collection, Mapping
from typing import Final

import numpy as np

from cadence.errors import InputError
from pipeline.counted import told
from pipeline.extract.positions import Positions
from pipeline.extract.transform_messages import LogTransforms
from pipeline.extract.transforms import TransformTree
from pipeline.frames import DEGREE_M, stands_still
from pipeline.logs.parts import missing_parts, recorded_parts
from pipeline.logs.reader import MissionLog
from pipeline.suspicions import Suspicions

_BODIES: Final = {"base_link", "base_footprint", "base", "body", "chassis", "vehicle"}
"""Frames that move with a vehicle, by REP 105 and custom."""
_NUMBERED: Final = re.compile(r"(.+)_(\d+)(\.mcap.*)")
"""Names of the parts of a split recording."""
_MAX_NAMED: Final = 6
_MIN_MOVED_M: Final = 30.0
"""What a receiver that stands scatters by stays below."""


def check_joined(
    rows: Mapping[str, Positions], role: str, transforms: LogTransforms, read_tree: Callable[[], TransformTree],
    log: MissionLog, suspicions: Suspicions, framed: Collection[str] = (),
) -> None:  # fmt: skip
    """Refuse rows of `role` in metres of a frame that none of the log's transforms joins, and of a camera's optical frame.

    Raises `InputError` with the way out. A vehicle's frame in a log without transforms is told as a suspicion, and so is any
    frame beside a sensor that moves in another. Messages of the topics `framed` have a field for the frame; where it is empty
    and something moves, that is told as well.
    """
    names = sorted({name for name in _metric_frames(rows[role]) if name and not stands_still(name)})
    unnamed = _without_frame(rows[role], framed)
    if not (names or unnamed) or not suspicions.looks_for("place"):
        return
    tree = read_tree()
    if unnamed and (mover := _mover(rows["poses"], [""]) or _moving(tree)):
        suspicions.add(
            "place", ", ".join(unnamed), seen=f"the messages name no frame, and {mover}", done="taken as places of the world",
            setting='extract.frame = "map" (they are), or let the messages say whose coordinates they are',
        )  # fmt: skip
    worlds = {name: tree.world(name) for name in (*tree.links, *(link.parent for link in tree.links.values()))}
    are_still = {world for world in worlds.values() if stands_still(world)}
    apart = [name for name in names if name not in worlds or (are_still and worlds[name] not in are_still)]
    if apart and (tree.links or tree.problems or transforms.counts):
        known = "; ".join(_links(tree)) or "none that can be used"
        reason = f"{role} are in the frame {', '.join(apart)}, which no transform of the log joins to another ({known}"
        lost = "".join(f"; {told(count, fault)}" for fault, count in transforms.faults())
        raise InputError(f"{reason}{lost}); {_way_out(apart[0], log)}")
    optical = [name for name in apart if "optical" in name.lower()]
    if optical:
        raise InputError(
            f"{role} are in the optical frame {optical[0]}, whose x and y are those of the image and whose z is the distance, "
            f"and the log has no transforms; {_way_out(optical[0], log)}"
        )
    for body in sorted({name for name in (worlds.get(name, name) for name in names) if name.rpartition("/")[2] in _BODIES}):
        suspicions.add(
            "place", f"frame {body}", seen="by its name it moves with a vehicle, and no transform of the log says how",
            done=f"{role} are taken as if it stood still", setting=f'extract.frame = "{body}"',
        )  # fmt: skip
    others = [name for name in apart if name.rpartition("/")[2] not in _BODIES]
    if others and role != "poses" and (mover := _mover(rows["poses"], others)):
        suspicions.add(
            "place", f"frame {others[0]}", seen=f"no transform of the log says where it is, and {mover}",
            done=f"{role} are taken as if it stood still", setting=f'extract.frame = "{others[0]}"',
        )  # fmt: skip


def _metric_frames(rows: Positions) -> set[str]:
    return {rows.frames.names[number] for number in np.unique(rows.frames.number[~rows.is_geodetic]).tolist()}


def _without_frame(rows: Positions, framed: Collection[str]) -> list[str]:
    """Which of the topics `framed` hold metres of a frame without a name."""
    if "" not in rows.frames.names or not framed:
        return []
    is_open = (rows.frames.number == rows.frames.names.index("")) & ~rows.is_geodetic
    return sorted({rows.topics.names[number] for number in np.unique(rows.topics.number[is_open]).tolist()} & set(framed))


def _moving(tree: TransformTree) -> str:
    """Which frame moves in another one; empty where none does."""
    for link in tree.links.values():
        way_m = float(np.hypot(*np.ptp(link.translation_m[:, :2], axis=0)))
        if way_m > _MIN_MOVED_M:
            return f"{link.child} moves by {way_m:.4g} m in {link.parent}"
    return ""


def _mover(poses: Positions, names: Collection[str]) -> str:
    """Which sensor moves, in another frame than `names`; empty where none does."""
    for topic, of_topic in zip(poses.topics.names, poses.topics.rows(), strict=True):
        found = poses[of_topic]
        unit_m = DEGREE_M if found.is_geodetic[0] else 1.0
        way_m = unit_m * np.hypot(np.ptp(found.first), np.ptp(found.second))
        if way_m > _MIN_MOVED_M and _metric_frames(found).isdisjoint(names):
            return f"{topic} moves by {way_m:.4g} m"
    return ""


def _links(tree: TransformTree) -> list[str]:
    found = [f"{link.parent} → {link.child}" for link in tree.links.values()]
    return [*found[:_MAX_NAMED], *([f"{len(found) - _MAX_NAMED} more"] if len(found) > _MAX_NAMED else []), *tree.problems]


def _way_out(frame: str, log: MissionLog) -> str:
    folder, absent = log.path.parent, missing_parts([log.path])
    others = [part for part in recorded_parts(folder) if part not in log.parts]
    stated = f'if it stands still, state extract.frame = "{frame}"'
    if log.path in recorded_parts(folder) and (others or absent):
        where = f"run the folder {folder}" if others else f"find {', '.join(map(str, absent))}"
        return f"this is a part of a split recording, whose first part alone has the static transforms: {where}; or {stated}"
    if numbered := _NUMBERED.fullmatch(log.path.name):
        beside = folder / f"{numbered[1]}_0{numbered[3]}"
        if int(numbered[2]) > 0 and beside.is_file():
            made = f"`ros2 bag reindex {folder}` writes the metadata.yaml by which the folder is one recording"
            return f"{beside.name} beside it may be its first part, with the static transforms: {made}; or {stated}"
    return f"record its transforms with it; or {stated}"
