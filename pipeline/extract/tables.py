"""Positions in the mission frame → the tables of the stage."""

from collections.abc import Mapping
from typing import Any

import pyarrow as pa

from cadence.arrays import Objects
from pipeline.extract.collapse import Collapsed
from pipeline.extract.positions import Positions
from schemas.tables import DETECTIONS, DETECTIONS_WITH_HEIGHT


def detection_table(log_id: str, collapsed: Collapsed, has_height: bool = False) -> pa.Table:
    """DETECTIONS of a log, with variances of heights where these are used."""
    rows = collapsed.positions
    columns = {
        "log_id": pa.array([log_id] * len(rows)), "time_ns": rows.time_ns, "sensor_id": rows.sensor, "agent_id": rows.agent,
        "x_m": rows.first, "y_m": rows.second, "z_m": rows.z_m, "cov_xx_m2": rows.covariance_m2[:, 0],
        "cov_xy_m2": rows.covariance_m2[:, 1], "cov_yy_m2": rows.covariance_m2[:, 2], "score": rows.score,
        "num_merged": collapsed.num_merged, "topic": rows.topic, "log_time_ns": rows.log_time_ns, "sequence": rows.sequence,
    }  # fmt: skip
    if not has_height:
        return _table(columns, DETECTIONS)
    return _table(columns | {"cov_zz_m2": rows.height_covariance_m2[:, 2]}, DETECTIONS_WITH_HEIGHT)


def track_table(log_id: str, rows: Positions, key: str, names: Objects, schema: pa.Schema) -> pa.Table:
    """TRUTH or POSES (`schema`) of a log, with `names` [N] in the column `key`."""
    columns = {
        "log_id": pa.array([log_id] * len(rows)), "time_ns": rows.time_ns, key: names,
        "x_m": rows.first, "y_m": rows.second, "z_m": rows.z_m,
    }  # fmt: skip
    return _table(columns, schema)


def _table(columns: Mapping[str, Any], schema: pa.Schema) -> pa.Table:
    """NaN becomes null."""
    return pa.table([pa.array(columns[item.name], type=item.type, from_pandas=True) for item in schema], schema=schema)
