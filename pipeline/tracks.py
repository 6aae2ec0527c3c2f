"""Tables by agent: tracks sorted by time, and positions between their samples."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cadence.arrays import Bools, Float64s, Int64s

UNKNOWN_AGENT = "unknown"
"""Name of the one agent that detections of unknown origin are taken to belong to where they are not told apart
(`pipeline.associations` does that)."""


@dataclass(frozen=True, eq=False)
class DetectionTrack:
    """N detections of one agent, or of one stream, sorted by time: time_ns [N], position_m [N, 2], covariance_m2 [N, 2, 2].

    height_m, height_variance_m2  [N] NaN where unknown; None where heights are not used
    """

    time_ns: Int64s
    position_m: Float64s
    covariance_m2: Float64s
    height_m: Float64s | None = None
    height_variance_m2: Float64s | None = None

    @staticmethod
    def one_behind_the_other(tracks: Iterable["DetectionTrack"]) -> "DetectionTrack":
        """All detections of the tracks, sorted by time within each of them only."""
        columns = zip(*(vars(track).values() for track in tracks), strict=True)
        joined: list[Any] = [None if column[0] is None else np.concatenate(column) for column in columns]
        return DetectionTrack(*joined)

    def __getitem__(self, rows: slice | Int64s | Bools) -> "DetectionTrack":
        """A selection of the detections."""
        chosen: list[Any] = [None if column is None else column[rows] for column in vars(self).values()]
        return DetectionTrack(*chosen)

    def __len__(self) -> int:
        return len(self.time_ns)


def agent_tracks(table: pa.Table, default_sigma_m: float) -> Iterator[tuple[str, DetectionTrack]]:
    """Agents in the order of their names, each sorted by time."""
    agent = pc.fill_null(table["agent_id"], UNKNOWN_AGENT)
    for name in sorted(pc.unique(agent).to_pylist()):
        yield name, track_of(table.filter(pc.equal(agent, name)).sort_by("time_ns"), default_sigma_m)


def track_of(rows: pa.Table, default_sigma_m: float) -> DetectionTrack:
    """All rows of a table that is sorted by time, whoever caused them."""
    position = np.stack([rows["x_m"].to_numpy(), rows["y_m"].to_numpy()], axis=-1)
    covariance = np.zeros((len(position), 2, 2)) + default_sigma_m**2 * np.eye(2)
    if "cov_xx_m2" in rows.column_names:
        xx, xy, yy = (rows[f"cov_{axis}_m2"].to_numpy() for axis in ("xx", "xy", "yy"))
        given = np.isfinite(xx.astype(np.float64)) & np.isfinite(yy.astype(np.float64))
        stacked = np.stack([xx, np.nan_to_num(xy), np.nan_to_num(xy), yy], axis=-1).astype(np.float64).reshape(-1, 2, 2)
        covariance[given] = stacked[given]
    return DetectionTrack(rows["time_ns"].to_numpy(), position, covariance, *_heights(rows))


def _heights(rows: pa.Table) -> tuple[Float64s | None, Float64s | None]:
    """Heights and their variances [N], of a table that says that they are used."""
    if "cov_zz_m2" not in rows.column_names:
        return None, None
    height_m, variance_m2 = (rows[name].to_numpy().astype(np.float64) for name in ("z_m", "cov_zz_m2"))
    return height_m, variance_m2


def interpolated(time_ns: Int64s, position_m: Float64s, at_ns: Int64s, max_gap_ns: float) -> Float64s:
    """Positions [..., 2] at any times [...]: those of N samples at their times, linear between samples no further apart.

    Args:
        time_ns: [N] of the samples, not decreasing.
        position_m: [N, 2].
        at_ns: [...].
        max_gap_ns: between samples that are further apart nothing is known.

    Returns:
        NaN where nothing is known: in wide gaps, before the first sample and after the last.
    """
    if len(time_ns) == 0:
        return np.full((*at_ns.shape, 2), np.nan)
    after = np.searchsorted(time_ns, at_ns).clip(min(1, len(time_ns) - 1), len(time_ns) - 1)
    before = np.maximum(after - 1, 0)
    span_ns = time_ns[after] - time_ns[before]
    is_sample = (time_ns[after] == at_ns) | (time_ns[before] == at_ns)
    is_known = is_sample | ((time_ns[before] < at_ns) & (at_ns < time_ns[after]) & (span_ns <= max_gap_ns))
    share = (at_ns - time_ns[before]) / np.maximum(span_ns, 1)
    found = position_m[before] + share[..., None] * (position_m[after] - position_m[before])
    return np.where(is_known[..., None], found, np.nan)
