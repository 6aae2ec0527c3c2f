"""Messages for the Map panel of georeferenced logs: fixes of means and detections, regions as GeoJSON."""

import json
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from cadence.arrays import Float64s, Indices
from pipeline.export import numbers
from pipeline.export.display import Style
from pipeline.export.playback import LiveAgent, Scene, Tick, shows_new_scene
from pipeline.frames import to_geodetic
from pipeline.logs.writer import foxglove_class
from pipeline.presence import with_presence
from pipeline.tables import Frame
from pipeline.tracks import UNKNOWN_AGENT

_APPROXIMATED, _KNOWN = 1, 3  # foxglove.LocationFix.PositionCovarianceType
_REGION_STEPS = 24
_SHARES = (0.9, 0.5)


class MovingFixes:
    """foxglove.LocationFix of the weighted mean of each agent, with the covariance of its hypotheses, in the order of time.

    One that would lie where the last one did, as far as can be seen, is left out: half of the ships of a harbour do not move.
    """

    def __init__(self, frame: Frame, style: Style) -> None:
        self._frame, self._style = frame, style
        self._shown: dict[str, tuple[Scene, Float64s]] = {}

    def at(self, scene: Scene, now_ns: int, time_ns: int) -> Iterator[tuple[str, bytes]]:
        """The agents of a scene that are new in it or have moved by now, each with its message."""
        for live in scene.live:
            agent_id = live.agent.agent_id
            mean_m = live.mean_at(now_ns)
            last_scene, last_m = self._shown.get(agent_id, (None, mean_m))
            if last_scene is not scene or np.linalg.norm(mean_m - last_m) > 0.5 * self._style.size_m(agent_id):
                self._shown[agent_id] = scene, mean_m
                covariance = numbers.covariance_m2(live.at(now_ns), live.weight)
                color, z_m, variance_m2 = self._style.color(agent_id), self._style.z_m, 0.0
                height_m = live.height_at(now_ns)
                if height_m is not None:
                    z_m, variance_m2 = float(live.weight @ height_m), numbers.spread_m(height_m[:, None], live.weight) ** 2
                yield (
                    agent_id,
                    _encode_fix(mean_m, z_m, covariance, self._frame, color, time_ns, _APPROXIMATED, variance_m2),
                )


def encode_detection_fix(row: dict[str, Any], frame: Frame, style: Style, time_ns: int) -> bytes:
    """foxglove.LocationFix of a row of DETECTIONS."""
    xx, xy, yy = (row[name] for name in ("cov_xx_m2", "cov_xy_m2", "cov_yy_m2"))
    is_known = xx is not None and yy is not None
    covariance = np.array([[xx, xy or 0.0], [xy or 0.0, yy]]) if is_known else None
    position_m, z_m = np.array([row["x_m"], row["y_m"]]), row["z_m"] if row["z_m"] is not None else style.z_m
    color = style.color(row["agent_id"] or UNKNOWN_AGENT)
    kind = _KNOWN if is_known else 0
    return _encode_fix(position_m, z_m, covariance, frame, color, time_ns, kind, row.get("cov_zz_m2") or 0.0)


def _encode_fix(
    position_m: Float64s, z_m: float, covariance: Float64s | None, frame: Frame, color: Float64s, time_ns: int, kind: int,
    height_variance_m2: float,
) -> bytes:  # fmt: skip
    latitude, longitude = to_geodetic(frame, position_m[:1], position_m[1:])
    message = foxglove_class("foxglove.LocationFix")(
        frame_id=frame.frame_id,
        latitude=latitude[0],
        longitude=longitude[0],
        altitude=z_m,
        position_covariance_type=kind,
    )
    if covariance is not None:
        (xx, xy), (_, yy) = covariance.tolist()
        message.position_covariance.extend([xx, xy, 0.0, xy, yy, 0.0, 0.0, 0.0, height_variance_m2])
    message.timestamp.FromNanoseconds(time_ns)
    if "color" in message.DESCRIPTOR.fields_by_name:
        message.color.r, message.color.g, message.color.b, message.color.a = color
    data: bytes = message.SerializeToString()
    return data


def plan_map(ticks: Sequence[Tick], period_s: float | None) -> dict[int, int]:
    """Which ticks put regions on the map, and since when: a period (a history) after the last ones, and with the last scene.

    Viewers draw all GeoJSON of a file at once. So no message tells of the future, and none of what another has told.
    """
    starts: dict[int, int] = {}
    told_ns = None
    shown = [(i, tick.scene) for i, tick in enumerate(ticks) if tick.scene and tick.scene.live and shows_new_scene(ticks, i)]
    for index, scene in shown:
        period_ns = scene.origin_ns - scene.start_ns if period_s is None else round(period_s * 1e9)
        if told_ns is None or scene.origin_ns - told_ns >= period_ns or index == shown[-1][0]:
            starts[index] = scene.start_ns if told_ns is None else max(told_ns, scene.start_ns)
            told_ns = scene.origin_ns
    return starts


def encode_map(scene: Scene, start_ns: int, frame: Frame, style: Style) -> bytes:
    """foxglove.GeoJSON: for every live agent its mean track between a time and the origin, and the regions around it.

    They hold 90 % and 50 % at each step; where heights are known the line has them, and the regions say between which they lie.
    What lies after the origin is left to what moves: viewers draw all of a file's
    GeoJSON at once, whatever the time.
    """
    features = []
    for live in scene.live:
        hue = style.hue(live.agent.agent_id)
        name = with_presence(live.agent.agent_id, live.agent.probability)
        steps = _steps(live, start_ns)
        for share in _SHARES:
            style_90 = {"color": hue, "weight": 1, "opacity": 0.6, "fillColor": hue, "fillOpacity": 0.25 - 0.15 * share}
            region = _feature(_region(live, steps, share), frame, f"{name} {share:.0%}", style_90)
            region["properties"] |= _heights(live, steps, share)
            features.append(region)
        if len(steps) > 1:
            mean = {"color": hue, "weight": 3, "opacity": 1.0}
            line = _feature(shapely.LineString(live.mean_m[steps]), frame, f"{name} mean", mean)
            if live.height_m is not None:
                mean_m = np.round(live.weight @ live.height_m[:, steps], 1).tolist()
                points = zip(line["geometry"]["coordinates"], mean_m, strict=True)
                line["geometry"]["coordinates"] = [[*point, height_m] for point, height_m in points]
            features.append(line)
    text = json.dumps({"type": "FeatureCollection", "features": features}, separators=(",", ":"), ensure_ascii=False)
    data: bytes = foxglove_class("foxglove.GeoJSON")(geojson=text).SerializeToString()
    return data


def _heights(live: LiveAgent, steps: Indices, share: float) -> dict[str, list[float]]:
    """Between which heights `share` of the weight lies at every one of the steps, least and greatest of all; or nothing."""
    if live.height_m is None:
        return {}
    ends = [numbers.weighted_quantile(live.height_m[:, steps], live.weight, 0.5 + side * share / 2) for side in (-1, 1)]
    return {"height_m": [round(float(ends[0].min()), 1), round(float(ends[1].max()), 1)]}


def _region(live: LiveAgent, steps: Indices, share: float) -> BaseGeometry:
    """The union of discs about the mean, each holding `share` of the weight at its step, joined from step to step."""
    away = np.linalg.norm(live.position_m[:, steps] - live.mean_m[steps], axis=-1)
    radius = np.maximum(numbers.weighted_quantile(away, live.weight, share), 1e-3 * max(1.0, float(away.max())))
    discs = shapely.buffer(shapely.points(live.mean_m[steps]), radius, quad_segs=4)
    if len(discs) == 1:
        return discs[0]
    pairs = shapely.geometrycollections(np.stack([discs[:-1], discs[1:]], axis=-1))
    return shapely.simplify(shapely.union_all(shapely.convex_hull(pairs)), float(np.median(radius)) * 0.05)


def _steps(live: LiveAgent, start_ns: int) -> Indices:
    """Steps from a time to the origin, both included, thinned."""
    window = live.window
    first = int(np.clip(window.origin_index + (start_ns - window.origin_ns) // window.step_ns, 0, window.origin_index))
    num_steps = window.origin_index - first + 1
    return np.unique(np.round(np.linspace(first, window.origin_index, min(num_steps, _REGION_STEPS)))).astype(np.intp)


def _feature(shape_m: BaseGeometry, frame: Frame, name: str, style: dict[str, Any]) -> dict[str, Any]:
    def degrees(x_m: Float64s, y_m: Float64s) -> tuple[Float64s, Float64s]:
        latitude, longitude = to_geodetic(frame, x_m, y_m)
        return np.round(longitude, 6), np.round(latitude, 6)  # GeoJSON (RFC 7946): longitude first; 0.1 m

    shape = shapely.transform(shape_m, lambda point: np.stack(degrees(point[:, 0], point[:, 1]), axis=-1))
    geometry = json.loads(shapely.to_geojson(shape))
    return {"type": "Feature", "properties": {"name": name, "style": style}, "geometry": geometry}
