"""Measurements between the stages: measurements.parquet, a row a bearing, range or range rate that is no position.

It is there only where a log has any. `read_measurements` makes of it what `cadence.evidence.measurements` weighs by.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from cadence.arrays import Float64s, Int64s, Objects
from cadence.evidence.measurements import KINDS, Measurements
from pipeline.measurement_words import MEASUREMENTS_NAME
from pipeline.tables import Frame, read_table, write_table
from schemas.tables import MEASUREMENTS

_VALUES = (
    "bearing_rad", "bearing_sigma_rad", "elevation_rad", "elevation_sigma_rad", "range_m", "range_sigma_m", "range_rate_mps",
    "range_rate_sigma_mps",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class MeasurementRows:
    """Measurements as columns [M], by time: NaN and None stand for what is not known. `observer_m` is [M, 3]."""

    time_ns: Int64s
    sensor: Objects
    agent: Objects
    observer_m: Float64s
    observer_velocity_mps: Float64s
    range_m: Float64s
    bearing_rad: Float64s
    elevation_rad: Float64s
    range_rate_mps: Float64s
    range_sigma_m: Float64s
    bearing_sigma_rad: Float64s
    elevation_sigma_rad: Float64s
    range_rate_sigma_mps: Float64s
    topic: Objects
    log_time_ns: Int64s
    sequence: Int64s

    def __len__(self) -> int:
        return len(self.time_ns)

    def counts(self) -> dict[str, Any]:
        """How many of each kind, of which topics, and about whom; for the summary of the stage."""
        kinds = {kind: int(np.isfinite(getattr(self, kind)).sum()) for kind in KINDS}
        topics, agents = Counter(self.topic.tolist()), Counter(name for name in self.agent.tolist() if name is not None)
        return {"num": len(self), **kinds, "topics": dict(sorted(topics.items())), "agents": dict(sorted(agents.items()))}

    def table(self, log_id: str) -> pa.Table:
        """MEASUREMENTS."""
        x_m, y_m, z_m = self.observer_m.T
        east_mps, north_mps = self.observer_velocity_mps.T
        columns = {
            "log_id": [log_id] * len(self), "time_ns": self.time_ns, "sensor_id": self.sensor, "agent_id": self.agent,
            "observer_x_m": x_m, "observer_y_m": y_m, "observer_z_m": z_m, "observer_vx_mps": east_mps,
            "observer_vy_mps": north_mps, "topic": self.topic, "log_time_ns": self.log_time_ns, "sequence": self.sequence,
        }  # fmt: skip
        columns |= {name: getattr(self, name) for name in _VALUES}
        arrays = [pa.array(columns[item.name], type=item.type, from_pandas=True) for item in MEASUREMENTS]
        return pa.table(arrays, schema=MEASUREMENTS)


def write_measurements(folder: Path, log_id: str, rows: MeasurementRows, frame: Frame) -> None:
    """Write the file."""
    write_table(rows.table(log_id), folder / MEASUREMENTS_NAME, "measurements", frame)


def read_measurements(directory: Path, start_ns: int) -> Measurements | None:
    """All measurements of a mission, in seconds from `start_ns`; None where it has none."""
    if not (directory / MEASUREMENTS_NAME).is_file():
        return None
    table, _ = read_table(directory / MEASUREMENTS_NAME, "measurements")
    table = table.sort_by("time_ns")

    def column(name: str) -> Float64s:
        return np.asarray(table[name].to_numpy(), dtype=np.float64)

    def columns(names: Sequence[str]) -> Float64s:
        return np.column_stack([column(name) for name in names])

    return Measurements(
        time_s=(table["time_ns"].to_numpy() - start_ns) * 1e-9,
        observer_m=columns(("observer_x_m", "observer_y_m")),
        observer_velocity_mps=columns(("observer_vx_mps", "observer_vy_mps")),
        observer_height_m=column("observer_z_m"),
        bearing_rad=column("bearing_rad"),
        bearing_sigma_rad=column("bearing_sigma_rad"),
        elevation_rad=column("elevation_rad"),
        elevation_sigma_rad=column("elevation_sigma_rad"),
        range_m=column("range_m"),
        range_sigma_m=column("range_sigma_m"),
        range_rate_mps=column("range_rate_mps"),
        range_rate_sigma_mps=column("range_rate_sigma_mps"),
        agent_ids=tuple(table["agent_id"].to_pylist()),
    )
