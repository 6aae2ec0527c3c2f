"""The heat map as foxglove.VoxelGrid, one layer high, for viewers that know no foxglove.Grid.

A byte a cell, and half as many cells along each side: it stands beside the Grid, which says it exactly.
"""

import numpy as np

from cadence.arrays import Float64s
from pipeline.export.occupancy import Occupancy
from pipeline.logs.writer import foxglove_class
from pipeline.tables import Frame

_UINT8 = 1  # foxglove.PackedElementField.NumericType
_FULL = 255


def encode_voxels(found: Occupancy | None, frame: Frame, time_ns: int, z_m: float) -> bytes:
    """foxglove.VoxelGrid of how likely each place is to be visited, 0 to 255; one empty cell without an agent."""
    found = found or Occupancy(0.0, 0.0, 1.0, np.zeros((1, 1)))
    cells = np.round(_FULL * np.sqrt(_halved(found.probability))).astype(np.uint8)
    cell_m = 2.0 * found.cell_m
    message = foxglove_class("foxglove.VoxelGrid")(
        frame_id=frame.frame_id,
        row_count=cells.shape[0],
        column_count=cells.shape[1],
        cell_stride=1,
        row_stride=cells.shape[1],
        slice_stride=cells.size,
        data=cells.tobytes(),
    )
    message.timestamp.FromNanoseconds(time_ns)
    message.pose.position.x, message.pose.position.y, message.pose.position.z = found.x_m, found.y_m, z_m
    message.pose.orientation.w = 1.0
    message.cell_size.x = message.cell_size.y = message.cell_size.z = cell_m
    message.fields.add(name="occupancy", offset=0, type=_UINT8)
    data: bytes = message.SerializeToString()
    return data


def _halved(probability: Float64s) -> Float64s:
    """The largest of each two by two cells: a way must not fade where it is narrow."""
    height, width = probability.shape
    even = np.pad(probability, ((0, height % 2), (0, width % 2)))
    found: Float64s = even.reshape(even.shape[0] // 2, 2, -1, 2).max(axis=(1, 3))
    return found
