"""What sensors measured and is no position → measurements in the mission frame, which speak about whole tracks.

Bearings without ranges, ranges without bearings, range rates, and beams so wide that range and bearing together are no normal
position. On its way into the mission's frame a sighting is two places: that of the sensor, and one far along its line of sight,
which transforms and observers move like any other positions.
"""

import copy
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import ClassVar, Final

import numpy as np

from cadence.arrays import Bools, Float64s, Int64s
from pipeline.extract.cameras import Camera
from pipeline.extract.channel_reader import ChannelReader
from pipeline.extract.polar import Measured, as_positions, measured, seen, stand_still
from pipeline.extract.positions import Positions
from pipeline.measurements import MeasurementRows
from pipeline.suspicions import Suspicions

_FAR_M: Final = 1000.0
"""How far along the line of sight its second place lies: metres to a thousandth are angles to a millionth."""
_PACE_S: Final = 1.0
"""The velocity of an observer is that over so long before and after."""
_MOST_S: Final = 20.0

SIGHTINGS: Final = "measurements"
"""Their role among rows of detections, truth and poses."""

Part = tuple[ChannelReader, Positions]


@dataclass(frozen=True, eq=False)
class Sightings(Positions):
    """Sightings [N] in the axes of their sensor: first, second and z are a place far along the line of sight.

    numbers    [N, 8] the columns of `Measured`
    key        number of a sighting; is_sensor tells where it begins, once they are `paired`
    """

    PLACES: ClassVar[int] = 2

    numbers: Float64s
    key: Int64s
    is_sensor: Bools


def read_parts(
    readers: Sequence[ChannelReader], cameras: Mapping[int, Camera], counts: Counter[str], suspicions: Suspicions
) -> tuple[list[Part], list[Part]]:
    """The detections of every reader as positions, and what else they measured.

    Ranges with bearings of too wide a beam are sightings where some detection gives a position of the same agent, from which
    its tracks can be drawn; else they are positions all the same, as exact as they are.
    """
    raw = [(reader, reader.finish()) for reader in readers]
    found = {
        id(reader): seen(reader, rows, cameras[reader.channel.id]) if reader.is_camera else measured(reader, rows, suspicions)
        for reader, rows in raw
        if reader.is_polar and len(rows)
    }
    known: set[str | None] = set()
    for reader, rows in raw:
        each = found.get(id(reader))
        known |= set((rows if each is None else rows[each.is_place & ~each.is_bent]).agent)
    positions, sightings = list[Part](), list[Part]()
    for reader, rows in raw:
        each = found.get(id(reader))
        if each is None:
            positions += [(reader, rows)]
            continue
        is_named = np.array([name is not None and name in known for name in rows.agent], dtype=np.bool_)
        is_place = bool(reader.paths.range and reader.paths.bearing)
        has_name = np.array([name is not None for name in rows.agent], dtype=np.bool_)
        # of a source of both, somebody may send one alone; what cannot be meant is stated, and left out
        is_alone = has_name & (np.isnan(rows.first) != np.isnan(rows.second))
        is_apart = (each.is_bent & is_named) | is_alone
        if is_place:
            is_used = ~is_apart & ~stand_still(reader, rows, each, has_name)
            counts["static"] += int((~is_apart & ~is_used).sum())
            positions += [(reader, as_positions(rows, each)[is_used])]
        others = _sightings(rows, each, is_apart | (not is_place))
        counts["dropped_nonfinite"] += 0 if is_place else len(rows) - len(others)
        if reader.is_camera:
            others = _in_optical_axes(others, cameras[reader.channel.id].frame_id)
        if len(others):  # of a reader of its own: rows are known by theirs
            sightings += [(copy.copy(reader), others)]
    return positions, sightings


def _sightings(rows: Positions, found: Measured, is_apart: Bools) -> Sightings:
    """What of the rows [N] is no position. Of those that are one only the range rate is left, if it is somebody's."""
    numbers = np.column_stack(list(vars(found).values()))
    is_rate = np.array([name.startswith("range_rate") for name in vars(found)])
    numbers[~is_apart] = np.where(is_rate, numbers[~is_apart], np.nan)
    has_name = np.array([name is not None for name in rows.agent], dtype=np.bool_)
    kept = np.flatnonzero(np.isfinite(numbers[:, [0, 1, 3]]).any(axis=1) & (is_apart | (has_name & found.is_place)))
    bearing, elevation = np.nan_to_num(numbers[:, 1]), np.nan_to_num(numbers[:, 2])
    flat = _FAR_M * np.cos(elevation)
    along = rows.changed(
        first=flat * np.cos(bearing), second=flat * np.sin(bearing), z_m=_FAR_M * np.sin(elevation),
        covariance_m2=np.full((len(rows), 3), np.nan), height_covariance_m2=np.full((len(rows), 3), np.nan),
    )  # fmt: skip
    columns = {item.name: getattr(along, item.name) for item in fields(Positions)}
    return Sightings(**columns, numbers=numbers, key=np.arange(len(rows)), is_sensor=np.zeros(len(rows), np.bool_))[kept]


def _in_optical_axes(rows: Sightings, frame_id: str) -> Sightings:
    """What a camera saw ahead, left of it and above, in the axes of its optical frame: right, down and ahead (REP 103)."""
    if frame_id:
        rows = rows.changed(frame_id=np.full(len(rows), frame_id, dtype=object))
    return rows.changed(first=-rows.second, second=-rows.z_m, z_m=rows.first)


def in_pairs(rows: Positions) -> Sightings:
    """The sightings of a reader [N] with the places of their sensors [2 N]."""
    assert isinstance(rows, Sightings)
    whole, zero = rows.changed(key=np.arange(len(rows))), np.zeros(len(rows))
    sensors = whole.changed(first=zero, second=zero, z_m=zero, is_sensor=np.ones(len(whole), np.bool_))
    return Sightings.concatenate([sensors, whole])


def together(parts: Sequence[Positions]) -> Sightings:
    """The pairs of all readers, sorted by time."""
    some = [part for part in parts if isinstance(part, Sightings)]
    before = np.cumsum([0, *(int(part.key.max(initial=-1)) + 1 for part in some)]).tolist()
    both = Sightings.concatenate([part.changed(key=part.key + first) for part, first in zip(some, before, strict=False)])
    return both[np.argsort(both.time_ns, kind="stable")]


def without_names(rows: Sightings, names: Collection[str]) -> Sightings:
    """The sightings; those of names of which detections turned out not to mean one agent are about nobody knows whom."""
    if not names:
        return rows
    return rows.changed(agent=np.array([None if name in names else name for name in rows.agent], dtype=object))


def measurement_rows(placed: Sightings, poses: Positions, height_topics: Collection[str]) -> MeasurementRows:
    """Paired sightings in the mission frame as measurements [M]; those of which an end was lost on the way are left out.

    Heights of sensors count on `height_topics` only, where they are above what those of detections are.
    """
    sensors, ends = placed[placed.is_sensor], placed[~placed.is_sensor]
    _, at_sensor, at_end = np.intersect1d(sensors.key, ends.key, return_indices=True)
    order = np.argsort(sensors.time_ns[at_sensor], kind="stable")
    sensors, ends = sensors[at_sensor[order]], ends[at_end[order]]
    east, north, up = ends.first - sensors.first, ends.second - sensors.second, ends.z_m - sensors.z_m
    range_m, bearing, elevation, range_rate, *sigmas = sensors.numbers.T
    raised = np.where(np.isfinite(up), np.arctan2(up, np.hypot(east, north)), elevation)
    has_height = np.array([topic in height_topics for topic in sensors.topic], dtype=np.bool_)
    height_m = np.where(has_height, sensors.z_m, np.nan)
    place_m = np.column_stack([sensors.first, sensors.second, height_m])
    values = {
        "range_m": range_m, "bearing_rad": np.where(np.isfinite(bearing), np.arctan2(north, east), np.nan),
        "elevation_rad": np.where(np.isfinite(elevation), raised, np.nan), "range_rate_mps": range_rate,
    }  # fmt: skip
    names = ("range_sigma_m", "bearing_sigma_rad", "elevation_sigma_rad", "range_rate_sigma_mps")
    # across the line of sight it is as exact as before, wherever that points now; straight down it has no bearing
    with np.errstate(divide="ignore", invalid="ignore"):
        turned = np.minimum(sigmas[1] * np.cos(elevation) / np.abs(np.cos(raised)), np.pi)
    sigmas[1] = np.where(np.isfinite(turned), turned, sigmas[1])
    exact = {
        name: np.where(np.isfinite(value), sigma, np.nan)
        for name, value, sigma in zip(names, values.values(), sigmas, strict=True)
    }
    return MeasurementRows(
        sensors.time_ns, sensors.sensor, sensors.agent, place_m, _velocities(sensors, poses), **values, **exact,
        topic=sensors.topic, log_time_ns=sensors.log_time_ns, sequence=sensors.sequence,
    )  # fmt: skip


def _velocities(sensors: Positions, poses: Positions) -> Float64s:
    """How observers [N], by time, moved [N, 2], by their poses, else by where they measured; NaN where these do not tell."""
    found = np.full((len(sensors), 2), np.nan)
    keys = np.column_stack([sensors.topics.number, sensors.sensors.number])
    for key in np.unique(keys, axis=0):
        rows = np.flatnonzero((keys == key).all(axis=1))
        name = sensors.sensor[rows[0]]
        track = poses[np.array([name is not None and each == name for each in poses.sensor], dtype=np.bool_)]
        found[rows] = _velocity(track if len(track) > 1 else sensors[rows], sensors.time_ns[rows])
    return found


def _velocity(track: Positions, at_ns: Int64s) -> Float64s:
    """The velocity [M, 2] of a track [N] at moments [M], from a second before to a second after, as it has places there."""
    time_ns, first = np.unique(track.time_ns, return_index=True)
    place_m, pace_ns = np.column_stack([track.first, track.second])[first], round(_PACE_S * 1e9)
    before = np.maximum(np.searchsorted(time_ns, at_ns - pace_ns, "right") - 1, 0)
    after = np.minimum(np.searchsorted(time_ns, at_ns + pace_ns, "left"), len(time_ns) - 1)
    moved, span_s = place_m[after] - place_m[before], (time_ns[after] - time_ns[before]) * 1e-9
    is_known = ((span_s > 0) & (span_s <= _MOST_S)) | (place_m == place_m[0]).all()
    return np.where(is_known[:, None], moved / np.maximum(span_s, 1e-9)[:, None], np.nan)
