"""Associations of the whole stream: what infer hands on of who caused which detection, when all of them are known."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cadence.arrays import Int64s
from cadence.association.types import CLUTTER, AssociationHypotheses
from pipeline.associations import DataAssociation
from pipeline.tables import Frame, read_table, write_table
from pipeline.tracks import track_of
from schemas.tables import PASTS

PASTS_NAME = "pasts.parquet"


def write_pasts(association: DataAssociation, directory: Path, frame: Frame) -> None:
    """PASTS: whose each detection is under every association of the last window."""
    found = association.at_origins[-1]
    names = pa.array([*association.agent_ids, None], pa.string())  # the label of clutter, -1, is the last
    number = np.repeat(np.arange(found.num_associations, dtype=np.int32), found.num_detections)
    columns = [
        pa.array(number),
        pa.array(found.weight[number]),
        pa.array(np.tile(association.row[: found.num_detections], found.num_associations)),
        names.take(pa.array(found.label.reshape(-1) % (len(association.agent_ids) + 1))),
    ]
    write_table(pa.Table.from_arrays(columns, schema=PASTS), directory / PASTS_NAME, "pasts", frame)


def read_pasts(directory: Path, detections: pa.Table, origins_ns: Int64s, default_sigma_m: float) -> DataAssociation | None:
    """The associations of the last window alone; None where the log says whose its detections are.

    Raises `InputError` where the table cannot be read.
    """
    path = directory / PASTS_NAME
    if not path.is_file():
        return None
    pasts, _ = read_table(path, "pasts")
    agent_ids = tuple(sorted(name for name in pasts["agent_id"].unique().to_pylist() if name is not None))
    num = int(pc.max(pasts["association"]).as_py()) + 1
    agent = pc.index_in(pasts["agent_id"], value_set=pa.array(agent_ids, pa.string())).fill_null(CLUTTER).to_numpy()
    label = agent.astype(np.int64).reshape(num, -1)
    row = pasts["detection"].to_numpy()[: label.shape[1]]
    found = AssociationHypotheses(label, pasts["weight"].to_numpy()[:: label.shape[1]], len(agent_ids))
    stream = track_of(detections.take(pa.array(row)), default_sigma_m)
    return DataAssociation(stream, row, origins_ns[-1:], (found,), agent_ids)
