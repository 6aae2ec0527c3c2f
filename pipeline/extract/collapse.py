"""Simultaneous detections of one agent → one detection.

Several sensors that see an agent at one moment say one thing about where it is. Left apart they would look like motion
without time passing, and count as often as there are sensors.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from pipeline.arrays import Float64s, Int32s, Int64s
from pipeline.extract.positions import Positions


@dataclass(frozen=True, eq=False)
class Collapsed:
    """`positions` sorted by time, and how many detections became each of them [N]."""

    positions: Positions
    num_merged: Int32s


def collapse(positions: Positions, tolerance_s: float) -> Collapsed:
    """Merge what each known agent's detections, sorted by time, say within `tolerance_s` of the first of a group.

    Equal positions are copies of one: the first with a covariance stays. Different ones become their mean weighted by inverse
    covariance; those without covariance are exact, so where there are any the others say nothing more. Time, score and
    provenance are those of the group's first; sensors are joined by `+`. Detections of unknown origin stay as they are.
    """
    num_merged = np.ones(len(positions), dtype=np.int32)
    is_kept = np.ones(len(positions), dtype=np.bool_)
    first, second, z_m = positions.first.copy(), positions.second.copy(), positions.z_m.copy()
    covariance, sensor = positions.covariance_m2.copy(), positions.sensor.copy()
    for group in _groups(positions, round(tolerance_s * 1e9)):
        kept = group[0]
        is_kept[group[1:]] = False
        num_merged[kept] = len(group)
        (first[kept], second[kept]), covariance[kept] = _merge(
            np.column_stack([positions.first[group], positions.second[group]]), positions.covariance_m2[group]
        )
        heights = positions.z_m[group]
        z_m[kept] = heights[np.isfinite(heights)].mean() if np.isfinite(heights).any() else np.nan
        sensor[kept] = "+".join(sorted({name for name in positions.sensor[group] if name is not None})) or None
    merged = replace(positions, first=first, second=second, z_m=z_m, covariance_m2=covariance, sensor=sensor)
    return Collapsed(merged[is_kept], num_merged[is_kept])


def _groups(positions: Positions, tolerance_ns: int) -> Iterator[Int64s]:
    """Row numbers of every group of two or more."""
    for agent in sorted({agent for agent in positions.agent if agent is not None}):
        rows = np.flatnonzero(positions.agent == agent)
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
