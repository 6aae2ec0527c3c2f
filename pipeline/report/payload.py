"""What the interactive map draws, small enough to embed: numbers in base64.

Everything that is shown less finely than it was computed is named in `Payload.notes`.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cadence.arrays import Float64s
from pipeline.arrays import Column
from pipeline.report.fans import FanCode
from pipeline.report.geodesy import GeodesyFit
from pipeline.report.markup import numbers_as_base64
from pipeline.report.mission import LIKELY, Mission, Points, WindowRow
from pipeline.report.modes import DIRECTIONS


@dataclass(frozen=True, eq=False)
class Payload:
    """The JSON of the interactive map, sentences on what it leaves out, and in how many of how many fans ways part."""

    content: dict[str, Any]
    notes: tuple[str, ...]
    num_parted: tuple[int, int]


def build_payload(
    mission: Mission,
    codes: Sequence[FanCode],
    windows: Sequence[int],
    agents: Sequence[int],
    geodesy: GeodesyFit | None,
    max_points: int,
    shown_share: float,
) -> Payload:
    """Everything that the map's script needs for the windows and agents shown."""
    origin_m = _centre(mission)
    detections, kept_detections = _thin(mission.detections, max_points)
    truth, kept_truth = _thin(mission.truth, max_points)
    poses, kept_poses = _thin(mission.poses, max_points)
    first = mission.fans[0] if mission.fans else None
    rows = {(row.window, row.agent): row for row in mission.rows}
    content = {
        "start_ns": str(mission.start_ns),
        "origin_m": origin_m.tolist(),
        "agents": [mission.agents[agent] for agent in agents],
        "agent": [int(agent) for agent in agents],
        "all_agents": list(mission.agents),
        "sensors": list(mission.sensors),
        "directions": list(DIRECTIONS),
        "unlikely": _unlikely(mission, agents),
        "window": [int(window) for window in windows],
        "origin_s": [_seconds(mission, mission.origins_ns[window]) for window in windows],
        "cells": [[_cell(rows.get((window, agent))) for agent in agents] for window in windows],
        "shown_share": shown_share,
        "first_window": _fullest(codes, windows),
        "step_s": first.step_ns / 1e9 if first else 1.0,
        "origin_index": first.origin_index if first else 0,
        "num_steps": int(first.offset_m.shape[1]) if first else 1,
        "fans": _encode_fans(codes, windows, agents, origin_m),
        "detections": _encode_points(mission, detections, origin_m),
        "truth": _encode_points(mission, truth, origin_m),
        "poses": _encode_points(mission, poses, origin_m),
        "obstacles": [
            {"name": item.name, "circle": [*(np.array(item.centre_m) - origin_m).tolist(), item.radius_m]}
            if item.centre_m is not None
            else {"name": item.name, "rings": [np.round(ring - origin_m, 2).tolist() for ring in item.rings_m]}
            for item in mission.obstacles
        ],
        "geodesy": geodesy.as_json() if geodesy else None,
    }
    notes = _notes(mission, codes, windows, agents)
    kinds = ("detections", "truth positions", "sensor positions")
    kept = (kept_detections, kept_truth, kept_poses)
    for name, points, count in zip(kinds, (mission.detections, mission.truth, mission.poses), kept, strict=True):
        if points is not None and count < len(points):
            notes.append(f"{count:,} of {len(points):,} {name}, evenly thinned")
    num_parted = sum(bool((code.strand[:, 3] < 1000).any()) for code in codes)
    return Payload(content, tuple(notes), (num_parted, len(codes)))


def _unlikely(mission: Mission, agents: Sequence[int]) -> list[int]:
    """Places of agents that are rather none than there in every window; empty where that would be all."""
    found = [place for place, agent in enumerate(agents) if (chance := mission.presence(agent)) is not None and chance < LIKELY]
    return found if len(found) < len(agents) else []


def _notes(mission: Mission, codes: Sequence[FanCode], windows: Sequence[int], agents: Sequence[int]) -> list[str]:
    notes = []
    drawn = mission.drawn_windows
    if len(windows) < len(drawn):
        notes.append(f"{len(windows)} of {len(drawn)} windows")
    if len(agents) < len(mission.told_agents):
        notes.append(f"{len(agents)} of {len(mission.told_agents)} agents, those with the most detections")
    if codes and mission.fans:
        shown, computed = max(len(code.weight) for code in codes), max(len(fan.weight) for fan in mission.fans)
        if shown < computed:
            notes.append(f"the {shown} heaviest of {computed} hypotheses (means, bands and shares use all)")
        shown, computed = max(len(code.step) for code in codes), max(fan.offset_m.shape[1] for fan in mission.fans)
        if shown < computed:
            notes.append(f"lines of {shown} points for {computed} steps")
    return notes


def _fullest(codes: Sequence[FanCode], windows: Sequence[int]) -> int:
    """Place of the window with the most agents; of several the one nearest to the middle of the mission."""
    count = Counter(code.window for code in codes)
    middle = (len(windows) - 1) / 2
    return max(range(len(windows)), key=lambda place: (count[windows[place]], -abs(place - middle)), default=0)


def _centre(mission: Mission) -> Float64s:
    points = [found.position_m for found in (mission.detections, mission.truth) if found is not None and len(found)]
    if not points:
        return np.round(mission.fans[0].datum_m) if mission.fans else np.zeros(2)
    joined = np.concatenate(points)
    return np.asarray(np.round((joined.min(axis=0) + joined.max(axis=0)) / 2))


def _seconds(mission: Mission, time_ns: int) -> float:
    return round((time_ns - mission.start_ns) / 1e9, 3)


def _cell(row: WindowRow | None) -> list[Any]:
    if row is None:
        return ["", 0, None, None, None]
    rounded = [None if value is None else float(f"{value:.4g}") for value in (row.age_s, row.spread_m, row.probability)]
    return ["" if row.status == "ok" else row.status, row.num_detections, *rounded]


def _thin(points: Points | None, limit: int) -> tuple[Points | None, int]:
    if points is None or len(points) <= limit:
        return points, len(points) if points is not None else 0
    # Even in each owner's own sequence, so that a rare agent does not vanish behind a frequent one.
    order = np.lexsort((points.time_ns, points.owner))
    chosen = np.sort(order[np.unique(np.linspace(0, len(points) - 1, limit).astype(np.int64))])
    return Points(points.time_ns[chosen], points.owner[chosen], points.position_m[chosen]), len(chosen)


def _encode_points(mission: Mission, points: Points | None, origin_m: Float64s) -> dict[str, Any] | None:
    if points is None:
        return None
    return {
        "time_s": numbers_as_base64((points.time_ns - mission.start_ns) / 1e9, "<f8"),
        "owner": numbers_as_base64(points.owner, "<i2"),
        "position_m": numbers_as_base64(points.position_m - origin_m, "<f4"),
    }


def _encode_fans(codes: Sequence[FanCode], windows: Sequence[int], agents: Sequence[int], origin_m: Float64s) -> dict[str, Any]:
    window_place = {window: index for index, window in enumerate(windows)}
    agent_place = {agent: index for index, agent in enumerate(agents)}
    return {
        "window": numbers_as_base64([window_place[code.window] for code in codes], "<i2"),
        "agent": numbers_as_base64([agent_place[code.agent] for code in codes], "<i2"),
        "num_hypotheses": numbers_as_base64([len(code.weight) for code in codes], "<i2"),
        "num_vertices": numbers_as_base64([len(code.step) for code in codes], "<i2"),
        "centre_m": numbers_as_base64([code.centre_m - origin_m for code in codes], "<f4"),
        "scale_m": numbers_as_base64([code.scale_m for code in codes], "<f4"),
        "step": _joined([code.step for code in codes], "<i2"),
        "weight": _joined([code.weight for code in codes], "<f4"),
        "hypothesis": _joined([code.hypothesis for code in codes], "<i2"),
        "num_strands": numbers_as_base64([len(code.strand) for code in codes], "<i2"),
        "strand": _joined([code.strand for code in codes], "<i2"),
        "summary": _joined([code.summary for code in codes], "<i2"),
    }


def _joined(arrays: Sequence[Column], kind: str) -> str:
    return numbers_as_base64(np.concatenate([np.empty(0), *(array.ravel() for array in arrays)]), kind)
