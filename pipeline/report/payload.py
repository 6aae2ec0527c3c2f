"""What the interactive map draws, small enough to embed: positions as integers relative to a centre a fan, in base64.

Everything that is shown less finely than it was computed is named in `Payload.notes`.
"""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.report.analysis import FanShape
from pipeline.report.geodesy import GeodesyFit
from pipeline.report.mission import Fan, Floats, Mission, Points

QUANTA = 32_000
"""Integers either side of a fan's centre; int16 holds them."""

FAN_OVERHEAD_BYTES = 64
POINT_BYTES = 14
BASE64_GROWTH = 4 / 3


@dataclass(frozen=True)
class Detail:
    """How finely the fans are shown: numbers of windows, agents, hypotheses of a fan, and vertices of a hypothesis."""

    num_windows: int
    num_agents: int
    num_hypotheses: int
    num_vertices: int

    def num_bytes(self, fans_per_window_and_agent: float) -> float:
        """Size of the encoded fans in the page."""
        fan = FAN_OVERHEAD_BYTES + 4 * self.num_hypotheses + self.num_vertices * (2 + 12 + 4 * self.num_hypotheses)
        return self.num_windows * self.num_agents * fans_per_window_and_agent * fan * BASE64_GROWTH


def choose_detail(mission: Mission, budget_bytes: float, wanted: Detail) -> Detail:
    """The finest detail within the budget: first fewer hypotheses and vertices, then windows, then agents."""
    cells = max(1, len(mission.origins_ns) * len(mission.agents))
    density = len(mission.fans) / cells
    limits = [(1.0, 30, 40), (1.0, 20, 32), (1.0, 12, 28), (1.0, 10, 24), (0.5, 10, 24), (0.5, 8, 20), (0.25, 8, 20)]
    limits += [(0.25, 6, 16), (0.12, 6, 16), (0.06, 6, 16), (0.03, 5, 12)]
    detail = wanted
    for share, num_hypotheses, num_vertices in [(1.0, wanted.num_hypotheses, wanted.num_vertices), *limits]:
        detail = Detail(
            max(min(wanted.num_windows, 8), round(share * wanted.num_windows)),
            wanted.num_agents,
            min(wanted.num_hypotheses, num_hypotheses),
            min(wanted.num_vertices, num_vertices),
        )
        if detail.num_bytes(density) <= budget_bytes:
            return detail
    per_agent = Detail(detail.num_windows, 1, detail.num_hypotheses, detail.num_vertices).num_bytes(density)
    num_agents = max(1, min(detail.num_agents, int(budget_bytes / per_agent)))
    return Detail(detail.num_windows, num_agents, detail.num_hypotheses, detail.num_vertices)


def choose_vertices(track_m: Floats, origin_index: int, count: int) -> npt.NDArray[np.intp]:
    """At most `count` steps of [K, T, 2] tracks which together follow all of them best, ends and origin included.

    Greedy: the step farthest from the chords between its chosen neighbours, over all hypotheses, joins next.
    """
    num_steps = track_m.shape[1]
    if num_steps <= count:
        return np.arange(num_steps)
    chosen = sorted({0, min(max(origin_index, 0), num_steps - 1), num_steps - 1})
    deviation = np.zeros(num_steps)
    for first, last in zip(chosen, chosen[1:], strict=False):
        _measure(track_m, first, last, deviation)
    while len(chosen) < count:
        step = int(deviation.argmax())
        if deviation[step] <= 0:
            step = next(step for step in range(num_steps) if step not in chosen)
        place = int(np.searchsorted(chosen, step))
        chosen.insert(place, step)
        _measure(track_m, chosen[place - 1], step, deviation)
        _measure(track_m, step, chosen[place + 1], deviation)
    return np.array(chosen)


def _measure(track_m: Floats, first: int, last: int, deviation: Floats) -> None:
    deviation[[first, last]] = 0.0
    if last - first < 2:
        return
    share = (np.arange(first + 1, last) - first)[:, None] / (last - first)
    chord = track_m[:, first, None] + share * (track_m[:, last] - track_m[:, first])[:, None]
    deviation[first + 1 : last] = np.hypot(*np.moveaxis(track_m[:, first + 1 : last] - chord, -1, 0)).max(axis=0)


@dataclass(frozen=True, eq=False)
class FanCode:
    """One fan as the page holds it: header numbers, steps of its vertices, weights and quantised positions."""

    window: int
    agent: int
    centre_m: Floats
    scale_m: float
    step: npt.NDArray[np.int16]
    weight: npt.NDArray[np.float32]
    hypothesis: npt.NDArray[np.int16]
    summary: npt.NDArray[np.int16]


def encode_fan(fan: Fan, shape: FanShape, detail: Detail) -> FanCode:
    """The heaviest hypotheses and the envelopes of a fan, [K, S, 2] and [S, 6] (mean, 90 % axes, angle, 50 % / 90 %)."""
    heaviest = np.sort(np.argsort(-fan.weight, kind="stable")[: detail.num_hypotheses])
    track_m = fan.offset_m[heaviest].astype(np.float64)
    step = choose_vertices(track_m, fan.origin_index, detail.num_vertices)
    mean_m = shape.mean_m[step]
    reach_m = shape.axes_m[step] * shape.radius[1][step, None]
    position_m = track_m[:, step] + fan.datum_m
    low = np.minimum(position_m.min(axis=(0, 1)), mean_m.min(axis=0))
    high = np.maximum(position_m.max(axis=(0, 1)), mean_m.max(axis=0))
    centre_m = (low + high) / 2
    scale_m = max(float((high - low).max()) / 2, float(reach_m.max()), 1e-3) / QUANTA
    inner = np.divide(shape.radius[0][step], shape.radius[1][step], out=np.ones(len(step)), where=shape.radius[1][step] > 0)
    angle = np.mod(shape.angle_rad[step] + np.pi / 2, np.pi) - np.pi / 2
    summary = np.column_stack([(mean_m - centre_m) / scale_m, reach_m / scale_m, angle * 10_000, inner * 10_000])
    return FanCode(
        fan.window,
        fan.agent,
        centre_m,
        scale_m,
        step.astype(np.int16),
        fan.weight[heaviest].astype(np.float32),
        np.rint((position_m - centre_m) / scale_m).astype(np.int16),
        np.rint(summary).astype(np.int16),
    )


@dataclass(frozen=True, eq=False)
class Payload:
    """The JSON of the interactive map, and sentences on what it leaves out."""

    content: dict[str, Any]
    notes: tuple[str, ...]


def build_payload(
    mission: Mission,
    codes: Sequence[FanCode],
    windows: Sequence[int],
    agents: Sequence[int],
    geodesy: GeodesyFit | None,
    max_points: int,
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
        "window": [int(window) for window in windows],
        "origin_s": [_seconds(mission, mission.origins_ns[window]) for window in windows],
        "cells": [[_cell(rows.get((window, agent))) for agent in agents] for window in windows],
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
    for name, points, kept in (("detections", mission.detections, kept_detections), ("truth positions", mission.truth, kept_truth),
                               ("sensor positions", mission.poses, kept_poses)):  # fmt: skip
        if points is not None and kept < len(points):
            notes.append(f"{kept:,} of {len(points):,} {name}, evenly thinned")
    return Payload(content, tuple(notes))


def _notes(mission: Mission, codes: Sequence[FanCode], windows: Sequence[int], agents: Sequence[int]) -> list[str]:
    notes = []
    if len(windows) < len(mission.origins_ns):
        notes.append(f"{len(windows)} of {len(mission.origins_ns)} windows")
    if len(agents) < len(mission.agents):
        notes.append(f"{len(agents)} of {len(mission.agents)} agents, those with the most detections")
    if codes and mission.fans:
        shown, drawn = max(len(code.weight) for code in codes), max(len(fan.weight) for fan in mission.fans)
        if shown < drawn:
            notes.append(f"the {shown} heaviest of {drawn} hypotheses (means and envelopes use all)")
        shown, drawn = max(len(code.step) for code in codes), max(fan.offset_m.shape[1] for fan in mission.fans)
        if shown < drawn:
            notes.append(f"{shown} vertices for {drawn} steps a hypothesis")
    return notes


def _centre(mission: Mission) -> Floats:
    points = [found.position_m for found in (mission.detections, mission.truth) if found is not None and len(found)]
    if not points:
        return np.round(mission.fans[0].datum_m) if mission.fans else np.zeros(2)
    joined = np.concatenate(points)
    return np.round((joined.min(axis=0) + joined.max(axis=0)) / 2)


def _seconds(mission: Mission, time_ns: int) -> float:
    return round((time_ns - mission.start_ns) / 1e9, 3)


def _cell(row: Any) -> list[Any]:
    if row is None:
        return ["", 0, None, None]
    rounded = [None if value is None else float(f"{value:.4g}") for value in (row.age_s, row.spread_m)]
    return ["" if row.status == "ok" else row.status, row.num_detections, *rounded]


def _thin(points: Points | None, limit: int) -> tuple[Points | None, int]:
    if points is None or len(points) <= limit:
        return points, len(points) if points is not None else 0
    # Even in each owner's own sequence, so that a rare agent does not vanish behind a frequent one.
    order = np.lexsort((points.time_ns, points.owner))
    chosen = np.sort(order[np.unique(np.linspace(0, len(points) - 1, limit).astype(np.int64))])
    return Points(points.time_ns[chosen], points.owner[chosen], points.position_m[chosen]), len(chosen)


def _encode_points(mission: Mission, points: Points | None, origin_m: Floats) -> dict[str, Any] | None:
    if points is None:
        return None
    return {
        "time_s": _base64((points.time_ns - mission.start_ns) / 1e9, "<f4"),
        "owner": _base64(points.owner, "<i2"),
        "position_m": _base64(points.position_m - origin_m, "<f4"),
    }


def _encode_fans(codes: Sequence[FanCode], windows: Sequence[int], agents: Sequence[int], origin_m: Floats) -> dict[str, Any]:
    window_place = {window: index for index, window in enumerate(windows)}
    agent_place = {agent: index for index, agent in enumerate(agents)}
    return {
        "window": _base64([window_place[code.window] for code in codes], "<i2"),
        "agent": _base64([agent_place[code.agent] for code in codes], "<i2"),
        "num_hypotheses": _base64([len(code.weight) for code in codes], "<i2"),
        "num_vertices": _base64([len(code.step) for code in codes], "<i2"),
        "centre_m": _base64([code.centre_m - origin_m for code in codes], "<f4"),
        "scale_m": _base64([code.scale_m for code in codes], "<f4"),
        "step": _base64(np.concatenate([code.step for code in codes] or [np.empty(0)]), "<i2"),
        "weight": _base64(np.concatenate([code.weight for code in codes] or [np.empty(0)]), "<f4"),
        "hypothesis": _base64(np.concatenate([code.hypothesis.ravel() for code in codes] or [np.empty(0)]), "<i2"),
        "summary": _base64(np.concatenate([code.summary.ravel() for code in codes] or [np.empty(0)]), "<i2"),
    }


def _base64(values: npt.ArrayLike, kind: str) -> str:
    return base64.b64encode(np.ascontiguousarray(np.asarray(values).astype(kind)).tobytes()).decode("ascii")
