"""Positions as read (metres in some frame, or degrees) → metres in one mission frame, east and north."""

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cadence.errors import ConfigError, InputError
from pipeline.extract.covariances import rotated
from pipeline.extract.positions import Positions
from pipeline.extract.transforms import Limits, TransformTree, is_of_earth
from pipeline.frames import (
    DEFAULT_FRAME_ID,
    EARTH_CENTRED,
    east_north_up,
    from_earth_centred,
    georeferenced_frame,
    to_local,
    words_of_frame,
)
from pipeline.tables import Frame

FIXED_FRAMES = {"map", "odom", "world", "mission", "enu", "local", "local_origin", "fixed"}
"""Names of frames that are fixed by convention: what lies in one alone is never moved by transforms."""

_MAX_TURN = 1e-3
"""By how much the axes of a frame may be off from east, north and up; 1e-3 is a metre in a kilometre."""
_NED_TO_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@dataclass(frozen=True)
class Placing:
    """How positions come into the mission frame.

    frame    name of the fixed frame that is wanted; None: chosen by `target_frame`
    limits   how far from their samples transforms are believed
    """

    frame: str | None
    limits: Limits


def bring_together(
    rows: Mapping[str, Positions], primary: str, placing: Placing, read_tree: Callable[[], TransformTree], counts: Counter[str]
) -> dict[str, Positions]:
    """The rows of every role, those in other frames moved by transforms into the one of the role `primary`, at their stamps.

    The transforms are read only where they are needed. Rows whose frame no transform joins to that one stay as they are; those
    at moments without a transform are left out and counted.
    """
    named = {name for positions in rows.values() for name, is_geodetic in _frames(positions) if name and not is_geodetic}
    is_metric = placing.frame is not None or any(name and not is_geodetic for name, is_geodetic in _frames(rows[primary]))
    if not named or not is_metric or (placing.frame is None and len(named) == 1 and named <= FIXED_FRAMES):
        return dict(rows)
    tree = read_tree()
    target = target_frame(rows[primary], tree, placing.frame)
    if target is None:
        return dict(rows)
    return {role: _moved(positions, target, tree, placing.limits, counts) for role, positions in rows.items()}


def target_frame(primary: Positions, tree: TransformTree, wanted: str | None) -> str | None:
    """The fixed frame for detections: their own one where it does not move, else the one in which all of theirs move.

    None where they are not in metres or have none in common. Raises `ConfigError` where the wanted frame is in no transform.
    """
    names = sorted({name for name, is_geodetic in _frames(primary) if name and not is_geodetic})
    if wanted is not None:
        known = {*names, *tree.links, *(link.parent for link in tree.links.values())}
        if wanted not in known:
            listed = ", ".join(sorted(known)[:12]) or "none"
            raise ConfigError(f"extract.frame: no position and no transform of the log is in {wanted!r}; known: {listed}")
        return wanted
    if len(names) == 1 and (names[0] in FIXED_FRAMES or tree.is_fixed(names[0])):
        return names[0]
    worlds = {tree.world(name) for name in names}
    if len(worlds) > 1:  # what is in a frame of the whole earth joins the only mission's frame below it
        worlds -= {name for name in worlds if is_of_earth(name)}
        worlds = {world for world in worlds if all(tree.is_joined(name, world) for name in names)}
    return worlds.pop() if len(worlds) == 1 else None


def mission_frame(primary: Positions, others: Sequence[Positions], datum: tuple[float, float] | None) -> Frame:
    """The frame that `primary` (what becomes detections) is in: its own for metres, about a datum for degrees.

    Degrees and metres come together only where the datum of the metres is stated. Raises `InputError` where it comes in
    several frames.
    """
    kinds = {("", True) if is_geodetic else (name, False) for name, is_geodetic in _frames(primary)}
    if datum is not None and len(kinds) > 1:
        kinds.discard(("", True))
    if len(kinds) > 1:
        raise InputError(_several_frames(primary))
    frame_id, is_geodetic = kinds.pop()
    if not frame_id:  # nameless metres are taken to be in the one frame that the rest of the log names
        names = {name for positions in others for name, geodetic in _frames(positions) if name and not geodetic}
        frame_id = names.pop() if len(names) == 1 else DEFAULT_FRAME_ID
    if is_geodetic:
        rows = [positions[positions.is_geodetic] for positions in (primary, *others)]
        latitude, longitude = np.concatenate([r.first for r in rows]), np.concatenate([r.second for r in rows])
        return georeferenced_frame(latitude, longitude, datum)
    return Frame(frame_id, *(datum or (None, None)))


def datum_of_transforms(positions: Positions, read_tree: Callable[[], TransformTree]) -> tuple[float, float] | None:
    """Where on the earth the zero of the metres lies, by the transforms; None where no degrees come beside them.

    None as well where nothing joins their only frame to the centre of the earth, or its axes are not east, north and up.
    """
    names = {name for name, is_geodetic in _frames(positions) if name and not is_geodetic}
    if len(names) != 1 or not positions.is_geodetic.any():
        return None
    (name,), tree = names, read_tree()
    centre = next((known for known in tree.ancestors(name) if known.lower() in EARTH_CENTRED), None)
    if centre is None or not all(tree.links[link].is_static for link in tree.ancestors(name)[:-1]):
        return None
    motion = tree.motion(name, centre, np.zeros(1, np.int64), Limits(0.0, 0.0))
    if motion is None:
        return None
    latitude, longitude, _ = from_earth_centred(*motion.translation_m.T)
    turn = east_north_up(latitude, longitude) @ motion.rotation - np.eye(3)
    return (float(latitude[0]), float(longitude[0])) if np.abs(turn).max() < _MAX_TURN else None


def _several_frames(positions: Positions) -> str:
    """What to do about positions in frames that nothing joins."""
    found = sorted(_topics_with_frames(positions))
    shown = ", ".join(f"{topic} ({frame})" for topic, frame in found[:6]) + (" and so on" if len(found) > 6 else "")
    ways = ["keep the topics of one frame under [[extract.detections]]"]
    frames = [frame for topic, frame in found if sum(topic == other for other, _ in found) > 1 and frame in positions.frame_id]
    if frames:
        ways.append(f"one frame of a topic by where = 'header.frame_id == \"{frames[0]}\"'")
    if positions.is_geodetic.any():
        ways.append("state extract.datum, the place of the metres' zero, which joins them to latitude and longitude")
    return f"detections come in different frames: {shown}; no transform of the log joins them: {', or '.join(ways)}"


def place(positions: Positions, frame: Frame) -> tuple[Positions, int]:
    """The rows that can be given in `frame`, with first and second its x_m and y_m; and how many cannot."""
    if len(positions) == 0:
        return positions, 0
    is_same = np.array([name in (frame.frame_id, "") for name in positions.frames.names])[positions.frames.number]
    is_placed = np.where(positions.is_geodetic, frame.is_georeferenced, is_same)
    placed = positions[is_placed]
    first, second = placed.first.copy(), placed.second.copy()
    rows = placed.is_geodetic
    if rows.any():
        first[rows], second[rows] = to_local(frame, placed.first[rows], placed.second[rows])
    num_elsewhere = int((~is_placed).sum()) // positions.PLACES
    return placed.changed(first=first, second=second, is_geodetic=np.zeros_like(rows)), num_elsewhere


def in_enu(positions: Positions, are_enu: Collection[str], counts: Counter[str]) -> Positions:
    """The rows with x east, y north and z up; their frame, if it has a name, gets another one.

    What is in a frame that is north, east, down by its name is so, but for the topics `are_enu`.
    """
    rows = positions.is_ned & ~positions.is_geodetic
    are_ned = np.array(["ned" in words_of_frame(name) for name in positions.frames.names], np.bool_)
    if are_ned.any():
        is_open = np.array([topic not in are_enu for topic in positions.topics.names])[positions.topics.number]
        is_named = are_ned[positions.frames.number] & (positions.frames.number >= 0) & is_open & ~rows & ~positions.is_geodetic
        counts["north_by_name"] += int(is_named.sum()) // positions.PLACES
        rows |= is_named
    if not rows.any():
        return positions
    turned = _turned(positions, rows, np.broadcast_to(_NED_TO_ENU, (int(rows.sum()), 3, 3)), np.zeros(3))
    frame_id = positions.frame_id.copy()
    frame_id[rows] = [f"{name}_enu" if name else "" for name in frame_id[rows]]
    return turned.changed(frame_id=frame_id)


def _moved(positions: Positions, target: str, tree: TransformTree, limits: Limits, counts: Counter[str]) -> Positions:
    frame_id = positions.frame_id.copy()
    is_kept = np.ones(len(positions), dtype=np.bool_)
    for name in sorted({name for name, is_geodetic in _frames(positions) if name and not is_geodetic and name != target}):
        rows = np.flatnonzero((positions.frame_id == name) & ~positions.is_geodetic)
        motion = tree.motion(name, target, positions.time_ns[rows], limits)
        if motion is None:
            continue
        positions = _turned(positions, rows, motion.rotation, motion.translation_m)
        frame_id[rows] = target
        is_kept[rows] = motion.is_known
        counts["transformed"] += int(motion.is_known.sum()) // positions.PLACES
        counts["no_transform"] += int((~motion.is_known).sum()) // positions.PLACES
    return positions.changed(frame_id=frame_id)[is_kept]


def _turned(positions: Positions, rows: np.ndarray, rotation: np.ndarray, translation_m: np.ndarray) -> Positions:
    """The positions with those of `rows` (a mask or numbers) turned and moved, and their covariances turned."""
    columns = {
        name: getattr(positions, name).copy() for name in ("first", "second", "z_m", "covariance_m2", "height_covariance_m2")
    }
    heights = columns["z_m"][rows]
    points = np.column_stack([columns["first"][rows], columns["second"][rows], np.nan_to_num(heights)])
    moved = np.einsum("nij,nj->ni", rotation, points) + translation_m
    columns["first"][rows], columns["second"][rows] = moved[:, 0], moved[:, 1]
    columns["z_m"][rows] = np.where(np.isnan(heights), np.nan, moved[:, 2])
    full = np.concatenate([columns["covariance_m2"][rows], columns["height_covariance_m2"][rows]], axis=1)
    full = rotated(full, rotation)
    columns["covariance_m2"][rows], columns["height_covariance_m2"][rows] = full[:, :3], full[:, 3:]
    return positions.changed(**columns)


def _frames(positions: Positions) -> set[tuple[str, bool]]:
    """(frame id, is geodetic) of metric and geodetic rows; metric rows without a frame id are taken to be in the others'."""
    kinds = np.unique(2 * positions.frames.number + positions.is_geodetic).tolist()
    found = {(positions.frames.names[kind // 2], bool(kind % 2)) for kind in kinds}
    is_named = any(name and not is_geodetic for name, is_geodetic in found)
    return {(name, is_geodetic) for name, is_geodetic in found if is_geodetic or name or not is_named}


def _topics_with_frames(positions: Positions) -> set[tuple[str, str]]:
    return {
        (str(topic), "latitude and longitude" if is_geodetic else str(name) or "no frame id")
        for topic, name, is_geodetic in zip(positions.topic, positions.frame_id, positions.is_geodetic, strict=True)
    }
