"""Drawn hypotheses as rows of the tables HYPOTHESES and WINDOWS."""

import numpy as np
import pyarrow as pa
import torch
from torch import Tensor

from cadence import metrics
from cadence.arrays import Float32s
from cadence.bearings.estimator import MEASURED
from cadence.constraints.speed import needed_speed
from cadence.evidence.estimator import CONTRADICTED, FEW_FIT
from cadence.types import Detections, HypothesisSet
from pipeline.associations import AssociatedWindows
from pipeline.grids import Grid
from pipeline.windows import MissionWindows
from schemas.tables import NUM_EFFECTIVE, WINDOWS, hypotheses_schema

ADVICE = {
    "ok": None,
    "no_detections": "not detected within this window's history; infer.grid.history_steps or step_s would widen it",
    "infeasible": "no way between detections keeps all limits; check obstacles and infer.guidance (margin_m, max_...)",
    "scarce": "hardly a draw keeps all limits, so these are narrower than what is known; check obstacles and infer.guidance",
    CONTRADICTED: "what else is known (silence of sensors, bearings, ...) speaks against every track and was left out here; "
    "check the sensors' footprints and clocks, how their bearings count, or whether the target is another one",
    MEASURED: "no position is known within this window's history: these tracks rest on bearings or ranges alone",
    FEW_FIT: "hardly any track fits what else is known, so these few may miss the target; a larger infer.evidence.most_draws "
    "or infer.num_hypotheses draws more",
    "guidance_diverged": "sampling did not stay finite, so the bank's samples stand in; report this log",
}
"""What to do about each status of a window."""


def hypothesis_rows(log_id: str, windows: MissionWindows, grid: Grid, part: Tensor, drawn: HypothesisSet) -> pa.Table:
    """HYPOTHESES rows of the active agents, and of those drawn without a position, by window, hypothesis, agent."""
    position, weight = drawn.position_m, drawn.weight
    b, k, a, t = position.shape[:4]
    active = windows.batch.is_active[part] | position.isfinite().any(-1).any(-1).any(1)
    is_row = active[:, None, :].expand(b, k, a)
    window, hypothesis, agent = (index.numpy() for index in is_row.nonzero(as_tuple=True))
    which = part.numpy()[window]
    flat = pa.array(position[is_row].float().numpy().reshape(-1))
    pairs = pa.FixedSizeListArray.from_arrays(pa.FixedSizeListArray.from_arrays(flat, 2), t)
    num = len(window)
    agents = pa.DictionaryArray.from_arrays(pa.array(agent.astype(np.int32)), pa.array(windows.agent_ids)).cast(pa.string())
    columns = [
        pa.array([log_id] * num, pa.string()),
        pa.array(which.astype(np.int32)),
        pa.array(windows.origins_ns[which]),
        pa.array(np.full(num, grid.step_ns)),
        pa.array(np.full(num, grid.origin_index, dtype=np.int32)),
        agents,
        pa.array(hypothesis.astype(np.int32)),
        pa.array(weight.numpy()[window, hypothesis].astype(np.float32)),
        pa.array(windows.datum_m[which, 0]),
        pa.array(windows.datum_m[which, 1]),
        pairs,
    ]
    if drawn.height_m is not None:
        columns.append(_height_column(drawn.height_m[is_row].float().numpy()))
    schema = hypotheses_schema(t, drawn.height_m is not None)
    return pa.Table.from_arrays([column.cast(item.type) for column, item in zip(columns, schema, strict=True)], schema=schema)


def _height_column(height_m: Float32s) -> pa.Array:
    """Heights [N, T] as a list a row; null where nothing is known."""
    flat = pa.array(height_m.reshape(-1))
    return pa.FixedSizeListArray.from_arrays(flat, height_m.shape[1], mask=pa.array(np.isnan(height_m).all(axis=1)))


def window_rows(windows: MissionWindows, part: Tensor, drawn: HypothesisSet, max_speed_mps: float | None = None) -> pa.Table:
    """WINDOWS rows of every agent; what is infeasible because detections ask for more than `max_speed_mps` says so.

    Where the log holds evidence they have one more column, the effective sample size.
    """
    position, weight, status = drawn.position_m, drawn.weight, drawn.status
    now = windows.batch.origin_index
    spread = metrics.spread(position[:, :, :, now : now + 1], weight)[..., 0]
    detections = windows.batch.detections[part]
    age = -torch.where(detections.is_observed, detections.time_s, -torch.inf).amax(-1)
    rows = []
    for index, window in enumerate(part.tolist()):
        for a, agent in enumerate(windows.agent_ids):
            is_active = bool(detections.is_observed[index, a].any())
            rows.append(
                {
                    "window": window,
                    "origin_ns": int(windows.origins_ns[window]),
                    "agent_id": agent,
                    "status": status[index][a],
                    "advice": _advice(status[index][a], detections[index : index + 1], a, max_speed_mps),
                    "num_detections": int(detections.count[index, a]),
                    "age_s": float(age[index, a]) if is_active else None,
                    "spread_m": float(spread[index, a]) if is_active or status[index][a] == MEASURED else None,
                }
            )
    return pa.Table.from_pylist(rows, schema=WINDOWS)


def with_effective(rows: pa.Table, drawn: HypothesisSet) -> pa.Table:
    """WINDOWS rows of some windows with the effective sample size of each agent's tracks; null where nothing weighs them."""
    num = np.full(rows.num_rows, np.nan) if drawn.num_effective is None else drawn.num_effective.numpy().reshape(-1)
    num = num.astype(np.float32).astype(np.float64)  # as exact as weights are written; the last bits depend on the process
    return rows.append_column(NUM_EFFECTIVE, pa.array(num, pa.float64(), from_pandas=True))


def _advice(status: str, seen: Detections, agent: int, max_speed_mps: float | None) -> str | None:
    """What to do about the status of an agent in one window, whose detections are `seen`."""
    if status != "infeasible" or max_speed_mps is None:
        return ADVICE[status]
    sigma_m = seen.covariance_m2.diagonal(dim1=-2, dim2=-1).mean(-1).sqrt()
    speed, gap_s = needed_speed(*(value[:, agent] for value in (seen.time_s, seen.position_m, sigma_m, seen.is_observed)))
    if float(speed[0]) <= max_speed_mps:
        return ADVICE[status]
    return (
        f"two detections {float(gap_s[0]):.3g} s apart need {float(speed[0]):.3g} m/s, and infer.guidance.max_speed_mps is "
        f"{max_speed_mps:g}; raise it, or state in sigma_m how rough the positions are"
    )


def with_association(rows: pa.Table, associated: AssociatedWindows, part: Tensor) -> pa.Table:
    """WINDOWS rows of some windows with what is said of agents whose detections are of unknown origin."""
    window = part.numpy()
    for name, value in (("probability", associated.probability), ("association_entropy_bits", associated.entropy_bits)):
        index = WINDOWS.get_field_index(name)
        rows = rows.set_column(index, WINDOWS.field(name), pa.array(value[window].reshape(-1), from_pandas=True))
    return rows
