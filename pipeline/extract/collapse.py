"""Simultaneous detections of one agent → one detection.

Several sensors that see an agent at one moment say one thing about where it is. Left apart they would look like motion
without time passing, and count as often as there are sensors.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from cadence.arrays import Bools, Float64s, Int32s, Int64s
from pipeline.extract.covariances import are_apart
from pipeline.extract.positions import Positions


@dataclass(frozen=True, eq=False)
class Collapsed:
    """`positions` sorted by time, how many detections became each of them [N], and how many were left out as they disagree."""

    positions: Positions
    num_merged: Int32s
    num_disagreeing: int = 0


def collapse(positions: Positions, tolerance_s: float) -> Collapsed:
    """Merge what each known agent's detections, sorted by time, say within `tolerance_s` of the first of a group.

    Equal positions are copies of one: the first with a covariance stays. Different ones become their mean weighted by inverse
    covariance, those apart that do not agree with the most accurate one within their covariances: they are left out. Those
    without covariance are exact, so where there are any the others say nothing more. Time, score and provenance are those of
    the first that is merged; sensors are joined by `+`. Of detections of unknown origin only copies are merged: of equal
    places at one and the same moment.
    """
    num_merged = np.ones(len(positions), dtype=np.int32)
    is_kept = np.ones(len(positions), dtype=np.bool_)
    first, second, z_m = positions.first.copy(), positions.second.copy(), positions.z_m.copy()
    covariance, sensor = positions.covariance_m2.copy(), positions.sensor.copy()
    num_disagreeing = 0
    for whole in itertools.chain(_groups(positions, round(tolerance_s * 1e9)), _copies(positions)):
        group = whole[_agree(positions, whole)]
        num_disagreeing += len(whole) - len(group)
        kept = group[0]
        is_kept[whole] = False
        is_kept[kept] = True
        num_merged[kept] = len(group)
        (first[kept], second[kept]), covariance[kept] = _merge(
            np.column_stack([positions.first[group], positions.second[group]]), positions.covariance_m2[group]
        )
        heights = positions.z_m[group]
        z_m[kept] = heights[np.isfinite(heights)].mean() if np.isfinite(heights).any() else np.nan
        sensor[kept] = "+".join(sorted({name for name in positions.sensor[group] if name is not None})) or None
    merged = positions.changed(first=first, second=second, z_m=z_m, covariance_m2=covariance, sensor=sensor)
    return Collapsed(merged[is_kept], num_merged[is_kept], num_disagreeing)


def _groups(positions: Positions, tolerance_ns: int) -> Iterator[Int64s]:
    """Row numbers of every group of two or more."""
    for rows in positions.agents.rows():
        times = positions.time_ns[rows]
        if not (np.diff(times) <= tolerance_ns).any():
            continue
        # From the first of a group, not from neighbour to neighbour: a dense track must not collapse into one point.
        ends = np.searchsorted(times, times + tolerance_ns, side="right")
        place = 0
        while place < len(rows):
            end = int(ends[place])
            if end - place > 1:
                yield rows[place:end]
            place = end


def _copies(positions: Positions) -> Iterator[Int64s]:
    """Row numbers of every group of detections of unknown origin that are one detection, told several times."""
    rows = np.flatnonzero(positions.agents.number < 0)
    columns = (positions.second[rows], positions.first[rows], positions.time_ns[rows])
    rows = rows[np.lexsort(columns)]
    is_same = np.ones(max(len(rows) - 1, 0), np.bool_)
    for column in (positions.time_ns, positions.first, positions.second):
        is_same &= np.diff(column[rows]) == 0
    for group in np.split(rows, np.flatnonzero(~is_same) + 1):
        if len(group) > 1:
            yield np.sort(group)


def _agree(positions: Positions, group: Int64s) -> Bools:
    """Which rows of a group [n] agree with the most accurate of them; all where some state no accuracy."""
    covariance = positions.covariance_m2[group]
    if np.isnan(covariance[:, 0]).any():
        return np.ones(len(group), np.bool_)
    best = int(np.argmin(covariance[:, 0] + covariance[:, 2]))
    place = np.column_stack([positions.first[group], positions.second[group]])
    return ~are_apart(place - place[best], covariance, np.broadcast_to(covariance[best], covariance.shape))


def _merge(position_m: Float64s, covariance_m2: Float64s) -> tuple[Float64s, Float64s]:
    """Position [2] and covariance [3] of detections [n, 2], [n, 3]."""
    is_exact = np.isnan(covariance_m2[:, 0])
    if (position_m == position_m[0]).all():
        return position_m[0], covariance_m2[int(np.argmin(is_exact))]
    if is_exact.any():
        return position_m[is_exact].mean(axis=0), np.full(3, np.nan)
    information = np.linalg.inv(covariance_m2[:, [0, 1, 1, 2]].reshape(-1, 2, 2))
    total = np.linalg.inv(information.sum(axis=0))
    mean = total @ np.einsum("nij,nj->i", information, position_m)
    return mean, np.array([total[0, 0], (total[0, 1] + total[1, 0]) / 2, total[1, 1]])
