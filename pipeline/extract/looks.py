"""Stated sensors, their poses and detections → when and where each looked, and what it saw."""

import fnmatch
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from cadence.arrays import Bools, Float64s, Int64s
from cadence.errors import ConfigError
from cadence.evidence.fitting import LEAST_HITS, LEAST_LOOKS, fit_curve
from cadence.evidence.footprints import DetectionCurve, Polygon, detection_probability
from pipeline.extract.positions import Positions
from pipeline.extract.sensor_config import SensorConfig
from pipeline.looks import Footprint, LookRows, shape_of
from pipeline.suspicions import Suspicions
from pipeline.tracks import interpolated

_MOST_LOOKS: Final = 500_000
_NUM_BLOCKS: Final = 8
"""Fitted curves of even blocks of the log are used in odd ones, and the other way round."""
_BRACKET_LOOKS: Final = 2.5
"""An agent's place is known at a look between two detections, neither of which is further away than so many looks."""
_LEAST_TRUST: Final = 0.5
_NEAR_SIGMAS: Final = 3.0
_MIN_SEEN: Final = 10
"""Of so many detections one may lie where a table of P(detect) has ended before it is zero."""


@dataclass(frozen=True, eq=False)
class SensorLooks:
    """The looks of one sensor [L], by time."""

    name: str
    time_ns: Int64s
    position_m: Float64s
    heading_rad: Float64s
    is_standing: bool


def collect_looks(
    configs: Sequence[SensorConfig],
    poses: Positions,
    detections: Positions,
    span_ns: tuple[int, int],
    suspicions: Suspicions,
) -> tuple[LookRows, list[Footprint]]:
    """The looks of all stated sensors between the first and the last moment of the log, and their footprints.

    Raises `ConfigError` for a sensor that is nowhere, and for one whose P(detect) is neither stated nor to be found.

    Args:
        configs: the entries.
        poses: where sensors were, in the mission frame.
        detections: all of them, before any are merged.
        span_ns: of the log.
        suspicions: what is told where a footprint contradicts detections.
    """
    groups, footprints = [], []
    for number, config in enumerate(configs):
        sensors = [_looks_of(config, name, poses, span_ns) for name in _names(config, poses, detections)]
        seen = [_seen(config, sensor, detections) for sensor in sensors]
        curves = config.stated_curve()
        num_blocks = _NUM_BLOCKS if curves is None else 1
        part = [_part(sensor.time_ns, span_ns, num_blocks) for sensor in sensors]
        told: dict[str, Any] = {}
        if curves is None:
            fitted, told = _fitted(config, sensors, seen, part, detections)
        else:
            fitted = [curves]
        trust = _trust(config, sensors, fitted, detections, suspicions)
        pairs = tuple(tuple(zip(c.distance.tolist(), c.probability.tolist(), strict=True)) for c in fitted)
        told |= shape_of(config.area()) | {"is_standing": all(sensor.is_standing for sensor in sensors)}
        footprints.append(Footprint(config.sensor, pairs, is_hidden=config.is_hidden, trust=trust, **told))
        groups += [(number, *group) for group in zip(sensors, seen, part, strict=True)]
    rows = LookRows(
        np.concatenate([sensor.time_ns for _, sensor, _, _ in groups]),
        [sensor.name for _, sensor, _, _ in groups for _ in sensor.time_ns],
        np.concatenate([np.full(len(sensor.time_ns), number) for number, sensor, _, _ in groups]),
        np.concatenate([part for _, _, _, part in groups]),
        np.concatenate([sensor.position_m for _, sensor, _, _ in groups]),
        np.concatenate([sensor.heading_rad for _, sensor, _, _ in groups]),
        [names for _, _, seen, _ in groups for names in seen],
    )
    return _by_time(rows), footprints


def _names(config: SensorConfig, poses: Positions, detections: Positions) -> list[str]:
    """The sensors that an entry means; `ConfigError` where none has a place."""
    if config.position is not None or config.fixed_to == "ground":
        return [config.sensor]
    known = sorted({str(name) for name in poses.sensors.names if name is not None})
    found = [name for name in known if fnmatch.fnmatchcase(name, config.sensor)]
    if not found:
        there = ", ".join(known[:8]) or "none"
        raise ConfigError(
            f"extract.sensors: {config.sensor!r} has no pose in this log (sensors with poses: {there}); give its position, or "
            "the source of its poses in [[extract.poses]]"
        )
    return found


def _looks_of(config: SensorConfig, name: str, poses: Positions, span_ns: tuple[int, int]) -> SensorLooks:
    """When a sensor looked, where it was then and which way it faced; `ConfigError` where nothing says that."""
    if config.position is not None or config.fixed_to == "ground":
        pose_ns, place_m = np.array(span_ns), np.array([config.about_m()] * 2)
    else:
        rows = np.flatnonzero(poses.sensor == name)
        pose_ns, first = np.unique(poses.time_ns[rows], return_index=True)
        place_m = _places(poses, rows[first])
    is_standing = bool((np.ptp(place_m, axis=0) == 0).all())
    turns = config.angle_deg is not None or (bool(config.polygon) and config.fixed_to == "sensor")
    if turns and is_standing and config.heading_deg is None:
        raise ConfigError(f"extract.sensors: {config.sensor!r} stands, and nothing says which way it faces; give heading_deg")
    if is_standing or config.every_s is not None:
        begin, end = span_ns if is_standing else (int(pose_ns[0]), int(pose_ns[-1]))
        every_ns = _every_ns(config)
        if (end - begin) // every_ns > _MOST_LOOKS:
            raise ConfigError(f"extract.sensors: {config.sensor!r} looks over {_MOST_LOOKS} times; give a larger every_s")
        time_ns = np.arange(begin, end + 1, every_ns)
    else:
        time_ns = pose_ns
    since, at = (pose_ns - pose_ns[0]).astype(np.float64), (time_ns - pose_ns[0]).astype(np.float64)
    place = np.column_stack([np.interp(at, since, place_m[:, axis]) for axis in (0, 1)])
    heading = _course(place) if config.heading_deg is None else np.full(len(place), np.pi / 2 - np.radians(config.heading_deg))
    elapsed_s = (time_ns - span_ns[0]) * 1e-9
    on = np.full(len(time_ns), not config.on)
    for first_s, last_s in config.on:
        on |= (elapsed_s >= first_s) & (elapsed_s <= last_s)
    return SensorLooks(name, time_ns[on], place[on], heading[on], is_standing)


def _every_ns(config: SensorConfig) -> int:
    if config.every_s is None:
        raise ConfigError(f"extract.sensors: {config.sensor!r} stands, and nothing says how often it looks; give every_s")
    return max(1, round(config.every_s * 1e9))


def _course(place_m: Float64s) -> Float64s:
    """Which way a sensor moves [L], from east to north; while it stands, as it moved before."""
    if len(place_m) < 2:
        return np.zeros(len(place_m))
    step = np.gradient(place_m, axis=0)
    moves = (step != 0).any(axis=1)
    last = np.maximum.accumulate(np.where(moves, np.arange(len(step)), 0))
    course: Float64s = np.arctan2(step[last, 1], step[last, 0])
    return course


def _detects_as(config: SensorConfig, sensor: SensorLooks, detections: Positions) -> Bools:
    """Which detections [N] are of this sensor."""
    if not len(detections):
        return np.zeros(0, dtype=bool)
    if config.detects_as is None:
        return np.asarray(detections.sensor == sensor.name)
    names = {name: fnmatch.fnmatchcase(str(name), config.detects_as) for name in set(detections.sensor.tolist())}
    return np.array([names[name] for name in detections.sensor.tolist()], dtype=bool)


def _seen(config: SensorConfig, sensor: SensorLooks, detections: Positions) -> list[frozenset[str | None]]:
    """Who was detected at each look: a detection belongs to the look nearest in time."""
    seen: list[set[str | None]] = [set() for _ in sensor.time_ns]
    rows = np.flatnonzero(_detects_as(config, sensor, detections))
    if len(sensor.time_ns):
        for row, look in zip(rows.tolist(), _nearest(sensor.time_ns, detections.time_ns[rows]).tolist(), strict=True):
            agent = detections.agent[row]
            seen[look].add(None if agent is None else str(agent))
    return [frozenset(names) for names in seen]


def _nearest(time_ns: Int64s, asked_ns: Int64s) -> Int64s:
    right = np.clip(np.searchsorted(time_ns, asked_ns), 1, max(len(time_ns) - 1, 1)).clip(max=len(time_ns) - 1)
    left = np.maximum(right - 1, 0)
    return np.where(asked_ns - time_ns[left] <= time_ns[right] - asked_ns, left, right)


def _part(time_ns: Int64s, span_ns: tuple[int, int], num_blocks: int) -> Int64s:
    """0 in even blocks of the log, 1 in odd ones [L]."""
    share = (time_ns - span_ns[0]) / max(1, span_ns[1] - span_ns[0])
    return (np.clip(share * num_blocks, 0, num_blocks - 1).astype(np.int64)) % 2


def _fitted(
    config: SensorConfig, sensors: Sequence[SensorLooks], seen: Sequence[Sequence[frozenset[str | None]]],
    part: Sequence[Int64s], detections: Positions,
) -> tuple[list[DetectionCurve], dict[str, int]]:  # fmt: skip
    """The curve to be used in each part, fitted on the other one; `ConfigError` where the log does not tell it."""
    agents = sorted({str(name) for name in detections.agent.tolist() if name is not None})
    distance, hit, side = [np.zeros(0)], [np.zeros(0, dtype=bool)], [np.zeros(0, dtype=np.int64)]
    for sensor, names, which in zip(sensors, seen, part, strict=True):
        for agent in agents:
            distance.append(_distances(config, sensor, agent, detections))
            hit.append(np.array([agent in found for found in names], dtype=bool))
            side.append(which)
    away, is_hit, parts = np.concatenate(distance), np.concatenate(hit), np.concatenate(side)
    found = [fit_curve(away[parts != which], is_hit[parts != which]) for which in (0, 1)]
    is_known = np.isfinite(away)
    num_looks, num_hits = int(is_known.sum()), int(is_hit[is_known].sum())
    curves = [one.curve for one in found if one is not None]
    if len(curves) < len(found):
        raise ConfigError(
            f"extract.sensors: P(detect) of {config.sensor!r} is not stated, and the log does not tell it ({num_hits} hits in "
            f"{num_looks} looks at agents whose place is known; each half of the log needs {LEAST_HITS} in {LEAST_LOOKS}, and "
            "as many misses); give its probability"
        )
    return curves, {"num_looks": num_looks, "num_hits": num_hits}


def _distances(config: SensorConfig, sensor: SensorLooks, agent: str, detections: Positions) -> Float64s:
    """How far an agent was at each look [L]; NaN outside the footprint's area, and where its place is not known.

    It is known between two detections that are near in time; what this look itself detected does not count.
    """
    num = len(sensor.time_ns)
    rows = np.flatnonzero(detections.agent == agent)
    if num < 2 or not len(rows):
        return np.full(num, np.nan)
    is_own = _detects_as(config, sensor, detections)[rows]
    place_m, time_ns = _places(detections, rows), detections.time_ns[rows]
    own_look = np.where(is_own, _nearest(sensor.time_ns, time_ns), -1)
    most_ns = _BRACKET_LOOKS * float(np.median(np.diff(sensor.time_ns)))
    found = np.full((num, 2), np.nan)
    for look, at_ns in enumerate(sensor.time_ns.tolist()):
        near = np.flatnonzero((np.abs(time_ns - at_ns) <= most_ns) & (own_look != look))
        if len(near) and time_ns[near[0]] <= at_ns <= time_ns[near[-1]]:
            found[look] = interpolated(time_ns[near], place_m[near], np.array([at_ns]), np.inf)[0]
    offset_m, area = found - sensor.position_m, config.area()
    away: Float64s = np.hypot(offset_m[:, 0], offset_m[:, 1])
    if area is None:
        return away
    is_ground = isinstance(area, Polygon) and area.is_on_ground
    return np.where(area.holds(found if is_ground else offset_m, sensor.heading_rad), away, np.nan)


def _places(detections: Positions, rows: Int64s) -> Float64s:
    return np.column_stack([detections.first[rows], detections.second[rows]]).astype(np.float64)


def _trust(
    config: SensorConfig, sensors: Sequence[SensorLooks], curves: Sequence[DetectionCurve], detections: Positions,
    suspicions: Suspicions,
) -> float:  # fmt: skip
    """Share of the silence that is believed: the share of the sensor's detections that lie where it is said to detect."""
    num_seen = num_outside = 0
    farthest_m = 0.0
    for sensor in sensors:
        rows = np.flatnonzero(_detects_as(config, sensor, detections))
        if not len(rows) or not len(sensor.time_ns):
            continue
        look, place_m = _nearest(sensor.time_ns, detections.time_ns[rows]), _places(detections, rows)
        sigma_m = np.sqrt(np.nan_to_num(detections.covariance_m2[rows][:, [0, 2]]).max(axis=1))
        towards = sensor.position_m[look] - place_m
        away = np.hypot(towards[:, 0], towards[:, 1])
        # as near to the sensor as the detection's own noise allows
        nearer = place_m + towards * np.minimum(1.0, _NEAR_SIGMAS * sigma_m / np.maximum(away, 1e-9))[:, None]
        ways = [sensor.position_m[look], sensor.heading_rad[look], np.ones(len(look))]
        chance = np.max([detection_probability(curve, config.area(), nearer, *ways) for curve in curves], axis=0)
        num_seen, num_outside = num_seen + len(rows), num_outside + int((chance <= 0).sum())
        farthest_m = max(farthest_m, float(away[chance <= 0].max(initial=0.0)))
    is_chance = num_outside == 1 and num_seen >= _MIN_SEEN
    if not num_outside or is_chance or not suspicions.looks_for("place"):
        return 1.0
    share = 1.0 - num_outside / num_seen
    trust = share if share >= _LEAST_TRUST else 0.0
    suspicions.add(
        "place", f"sensor {config.sensor!r}",
        seen=f"{num_outside} of its {num_seen} detections lie where its footprint sees nothing, up to {farthest_m:.4g} m away",
        done="its silence is not believed" if trust == 0.0 else f"its silence counts {trust:.2f} of what it says",
        setting="probability, range_m or heading_deg in its [[extract.sensors]]",
    )  # fmt: skip
    return trust


def _by_time(rows: LookRows) -> LookRows:
    order = np.argsort(rows.time_ns, kind="stable")
    return LookRows(
        rows.time_ns[order], [rows.sensor[i] for i in order.tolist()], rows.footprint[order], rows.part[order],
        rows.position_m[order], rows.heading_rad[order], [rows.seen[i] for i in order.tolist()],
    )  # fmt: skip
