"""Positions as read (metres in some frame, or degrees) → metres in one mission frame."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cadence.errors import InputError
from pipeline.frames import DEFAULT_FRAME_ID, georeferenced_frame, to_local
from pipeline.positions import Positions
from pipeline.tables import Frame


def mission_frame(primary: Positions, others: Sequence[Positions], datum: tuple[float, float] | None) -> Frame:
    """The frame that `primary` (what becomes detections) is in: its own for metres, about a datum for degrees.

    Raises `InputError` where it comes in several frames: their transforms are not applied.
    """
    kinds = {("", True) if is_geodetic else (name, False) for name, is_geodetic in _frames(primary)}
    if len(kinds) > 1:
        parts = ", ".join(f"{topic} ({frame})" for topic, frame in sorted(_topics_with_frames(primary))[:6])
        raise InputError(
            f"detections come in different frames: {parts}; transforms between frames are not applied: "
            "keep the topics of one frame under [[extract.detections]]"
        )
    frame_id, is_geodetic = kinds.pop()
    if not frame_id:  # nameless metres are taken to be in the one frame that the rest of the log names
        names = {name for positions in others for name, geodetic in _frames(positions) if name and not geodetic}
        frame_id = names.pop() if len(names) == 1 else DEFAULT_FRAME_ID
    if is_geodetic:
        rows = [positions[positions.is_geodetic] for positions in (primary, *others)]
        latitude, longitude = np.concatenate([r.first for r in rows]), np.concatenate([r.second for r in rows])
        return georeferenced_frame(latitude, longitude, datum)
    return Frame(frame_id, *(datum or (None, None)))


def place(positions: Positions, frame: Frame) -> tuple[Positions, int]:
    """The rows that can be given in `frame`, with first and second its x_m and y_m; and how many cannot."""
    if len(positions) == 0:
        return positions, 0
    is_same = np.isin(positions.frame_id.astype(np.str_), (frame.frame_id, ""))
    is_placed = np.where(positions.is_geodetic, frame.is_georeferenced, is_same)
    placed = positions[is_placed]
    first, second = placed.first.copy(), placed.second.copy()
    rows = placed.is_geodetic
    if rows.any():
        first[rows], second[rows] = to_local(frame, placed.first[rows], placed.second[rows])
    return replace(placed, first=first, second=second, is_geodetic=np.zeros_like(rows)), int((~is_placed).sum())


def _frames(positions: Positions) -> set[tuple[str, bool]]:
    """(frame id, is geodetic) of metric and geodetic rows; metric rows without a frame id are taken to be in the others'."""
    found = {
        (str(name), bool(is_geodetic)) for name, is_geodetic in zip(positions.frame_id, positions.is_geodetic, strict=True)
    }
    is_named = any(name and not is_geodetic for name, is_geodetic in found)
    return {(name, is_geodetic) for name, is_geodetic in found if is_geodetic or name or not is_named}


def _topics_with_frames(positions: Positions) -> set[tuple[str, str]]:
    return {
        (str(topic), "latitude and longitude" if is_geodetic else str(name) or "no frame id")
        for topic, name, is_geodetic in zip(positions.topic, positions.frame_id, positions.is_geodetic, strict=True)
    }
