"""Positions about an observer → where they are: its place by its poses at their stamps, or where the source says it stands."""

from collections import Counter
from typing import TypeVar

import numpy as np
from pyproj import Geod

from cadence.arrays import Bools, Float64s, Int64s
from cadence.errors import ConfigError
from pipeline.extract.channel_reader import ChannelReader
from pipeline.extract.positions import Positions
from pipeline.extract.transforms import Limits
from pipeline.mapping.message_type import OWN_SENSOR

RowsLike = TypeVar("RowsLike", bound=Positions)


def from_observer(reader: ChannelReader, rows: RowsLike, poses: Positions, limits: Limits, counts: Counter[str]) -> RowsLike:
    """The rows [N] of a reader, which are metres east and north of its observer, at their places.

    Those without a pose of it near enough in time are left out and counted (`no_observer`).

    Args:
        reader: of a source with an observer.
        rows: of it.
        poses: of all sensors, in true units and on one clock.
        limits: how far from its samples a pose is believed.
        counts: of what was not used.

    Raises:
        ConfigError: for an observer without a pose.
    """
    if (stated := reader.source.observer_place) is not None:
        is_geodetic = reader.source.observer_latitude is not None
        return _moved(rows, np.tile(np.array([*stated, 0.0]), (len(rows), 1)), is_geodetic, is_ned=False, frame_id="")
    if reader.paths.observer != OWN_SENSOR:
        return _from_poses(reader, str(reader.paths.observer), rows, poses, limits, counts)
    names = rows.sensors
    num_nameless = int((names.number < 0).sum())
    if num_nameless:
        raise ConfigError(
            f"topic {reader.source.topic}: {num_nameless // rows.PLACES} of its messages name no sensor, and it is from the "
            "poses of that one that they are; state observer, or sensor_path"
        )
    parts = [
        _from_poses(reader, name, rows[each], poses, limits, counts)
        for name, each in zip(names.names, names.rows(), strict=True)
    ]
    return type(rows).concatenate(parts) if parts else rows


def _from_poses(
    reader: ChannelReader, observer: str, rows: RowsLike, poses: Positions, limits: Limits, counts: Counter[str]
) -> RowsLike:
    """Rows that one observer measured, at its places."""
    of_observer = poses[np.array([name == observer for name in poses.sensor], dtype=np.bool_)]
    if not len(of_observer):
        known = ", ".join(sorted({str(name) for name in poses.sensors.names})[:8]) or "none"
        raise ConfigError(
            f"topic {reader.source.topic}: its observer {observer!r} has no pose in this log (sensors with poses: {known}); "
            "correct observer, name the source of its poses in [[extract.poses]], or give observer_x_m and observer_y_m"
        )
    found = of_observer[np.argsort(of_observer.time_ns, kind="stable")]
    is_geodetic = bool(found.is_geodetic[0])
    second = np.unwrap(found.second, period=360.0) if is_geodetic else found.second
    about, is_known = _at(found.time_ns, np.column_stack([found.first, second, found.z_m]), rows.time_ns, limits)
    counts["no_observer"] += int((~is_known).sum()) // rows.PLACES
    rows = rows.changed(sensor=np.array([observer if name is None else name for name in rows.sensor], dtype=object))
    return _moved(rows[is_known], about[is_known], is_geodetic, bool(found.is_ned[0]), str(found.frame_id[0]))


def _at(time_ns: Int64s, place: Float64s, at_ns: Int64s, limits: Limits) -> tuple[Float64s, Bools]:
    """Places [M, 3] at moments [M] of N samples [N, 3], as transforms are interpolated; and which are known.

    What is at one place before and after a gap, however long, stood there.
    """
    last = len(time_ns) - 1
    after = np.clip(np.searchsorted(time_ns, at_ns, side="right"), min(1, last), last)
    before = np.maximum(after - 1, 0)
    gap_ns, since_ns = time_ns[after] - time_ns[before], at_ns - time_ns[before]
    stands = (place[after, :2] == place[before, :2]).all(axis=1)
    is_between = (since_ns >= 0) & (since_ns <= gap_ns) & (stands | (gap_ns <= limits.max_gap_s * 1e9))
    nearest = (2 * since_ns > gap_ns).astype(np.float64)
    share = np.where(is_between, since_ns / np.maximum(gap_ns, 1), nearest)[:, None]
    distance_ns = np.minimum(np.abs(since_ns), np.abs(time_ns[after] - at_ns))
    found = place[before] + np.where(share > 0, share * (place[after] - place[before]), 0.0)
    return found, is_between | (distance_ns <= limits.max_extrapolation_s * 1e9)


def _moved(rows: RowsLike, about: Float64s, is_geodetic: bool, is_ned: bool, frame_id: str) -> RowsLike:
    """Rows [N] at metres east, north and up of `about` [N, 3], which is metres or degrees with a height."""
    east, north = rows.first, rows.second
    columns = {"frame_id": np.full(len(rows), frame_id, dtype=object), "is_ned": np.full(len(rows), is_ned)}
    if is_geodetic:
        azimuth, distance = np.degrees(np.arctan2(east, north)), np.hypot(east, north)
        second, first, _ = Geod(ellps="WGS84").fwd((about[:, 1] + 180.0) % 360.0 - 180.0, about[:, 0], azimuth, distance)
        return rows.changed(
            first=np.asarray(first, np.float64), second=np.asarray(second, np.float64), z_m=about[:, 2] + rows.z_m,
            is_geodetic=np.ones(len(rows), np.bool_), **columns,
        )  # fmt: skip
    if not is_ned:
        return rows.changed(first=about[:, 0] + east, second=about[:, 1] + north, z_m=about[:, 2] + rows.z_m, **columns)
    upright = rows.height_covariance_m2[:, [1, 0, 2]] * [-1.0, -1.0, 1.0]
    return rows.changed(
        first=about[:, 0] + north, second=about[:, 1] + east, z_m=about[:, 2] - rows.z_m,
        covariance_m2=rows.covariance_m2[:, [2, 1, 0]], height_covariance_m2=upright, **columns,
    )  # fmt: skip
