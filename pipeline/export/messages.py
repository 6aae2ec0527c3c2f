"""Messages of a side file: hypotheses (lossless), numbers a tick, detections, heat map, frames."""

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from pipeline.ask.events import Event
from pipeline.export import numbers
from pipeline.export.occupancy import Occupancy
from pipeline.export.playback import LiveAgent, Tick
from pipeline.logs.wire import field
from pipeline.logs.writer import foxglove_class
from pipeline.results import AgentHypotheses, WindowHypotheses
from pipeline.tables import Frame
from schemas import channels
from schemas.channels import message_class

_COLD, _HOT = np.array([70.0, 20.0, 130.0]), np.array([255.0, 215.0, 70.0])
_UINT8, _FLOAT32 = 1, 7  # foxglove.PackedElementField.NumericType


def encode_hypotheses(window: WindowHypotheses, frame: Frame, time_ns: int) -> bytes:
    """cadence.Hypotheses with everything that the tables hold of one window."""
    head = message_class("cadence.Hypotheses")(
        log_id=window.log_id,
        window=window.window,
        frame_id=frame.frame_id,
        origin_ns=window.origin_ns,
        step_ns=window.step_ns,
        origin_index=window.origin_index,
        num_steps=window.num_steps,
        hypothesis=window.hypothesis.tolist(),
        weight=window.weight.tolist(),
        latitude_deg=frame.latitude_deg,
        longitude_deg=frame.longitude_deg,
        vertical_datum=frame.vertical_datum,
    )
    head.timestamp.FromNanoseconds(time_ns)
    # Fields may come in any order. A packed field is its bytes: no number passes through Python.
    return b"".join([head.SerializeToString(), *(field(11, _encode_agent(agent)) for agent in window.agents)])


def _encode_agent(agent: AgentHypotheses) -> bytes:
    head = message_class("cadence.AgentHypotheses")(
        id=agent.agent_id,
        status=agent.status,
        advice=agent.advice or "",
        num_detections=agent.num_detections,
        age_s=agent.age_s,
        spread_m=agent.spread_m,
        datum_x_m=agent.datum_m[0],
        datum_y_m=agent.datum_m[1],
        probability=agent.probability,
        association_entropy_bits=agent.association_entropy_bits,
        num_effective=agent.num_effective,
    )
    position: bytes = np.ascontiguousarray(agent.position_m, dtype="<f4").tobytes()
    height = b"" if agent.height_m is None else np.ascontiguousarray(agent.height_m, dtype="<f4").tobytes()
    fields = [field(number, data) for number, data in ((9, position), (13, height)) if data]
    return b"".join([bytes(head.SerializeToString()), *fields])


def encode_agents(tick: Tick, time_ns: int) -> bytes:
    """cadence.Agents: every agent with a live window in numbers."""
    message = message_class("cadence.Agents")()
    message.timestamp.FromNanoseconds(time_ns)
    for live in tick.scene.live if tick.scene else ():
        _add_state(message.agents.add(), live, tick.time_ns)
    data: bytes = message.SerializeToString()
    return data


def _add_state(state: Any, live: LiveAgent, now_ns: int) -> None:
    agent, window = live.agent, live.window
    now_m = live.at(now_ns)
    state.id, state.status, state.window = agent.agent_id, agent.status, window.window
    state.num_detections = agent.num_detections
    if agent.age_s is not None:
        state.age_s = _to_plot(agent.age_s + (now_ns - window.origin_ns) * 1e-9)
    state.x_m, state.y_m = map(_to_plot, live.mean_at(now_ns).tolist())
    state.spread_m = _to_plot(numbers.spread_m(now_m, live.weight))
    state.horizon_spread_m = _to_plot(numbers.spread_m(live.position_m[:, -1], live.weight))
    state.speed_mps = _to_plot(live.speed_mps(now_ns))
    state.entropy = _to_plot(numbers.weight_entropy(live.weight))
    state.num_modes = live.num_modes
    height_m = live.height_at(now_ns)
    if height_m is not None:
        state.height_m = _to_plot(float(live.weight @ height_m))
        state.height_spread_m = _to_plot(numbers.spread_m(height_m[:, None], live.weight))
    for name in ("probability", "association_entropy_bits", "num_effective"):
        if getattr(agent, name) is not None:
            setattr(state, name, getattr(agent, name))


def _to_plot(value: float) -> float:
    """Rounded to a thousandth, as a power of two: the zero bits at the end compress well."""
    return round(value * 1024.0) / 1024.0


def encode_detection(row: dict[str, Any], frame: Frame, time_ns: int, sources: Sequence[dict[str, Any]] = ()) -> bytes:
    """cadence.Detection from a row of DETECTIONS, and where its origin is unknown from the rows of ASSOCIATIONS on it."""
    message = message_class("cadence.Detection")(frame_id=frame.frame_id)
    message.timestamp.FromNanoseconds(time_ns)
    for name in ("agent_id", "sensor_id", "x_m", "y_m", "num_merged", "topic", "log_time_ns", "sequence"):
        if row[name] is not None:
            setattr(message, name, row[name])
    for name in ("z_m", "cov_xx_m2", "cov_xy_m2", "cov_yy_m2", "cov_zz_m2", "score"):
        value = row.get(name)
        if value is not None and math.isfinite(value):
            setattr(message, name, value)
    if sources:
        _add_association(message.association, sources)
    data: bytes = message.SerializeToString()
    return data


def encode_occupancy(found: Occupancy | None, frame: Frame, time_ns: int, z_m: float) -> bytes:
    """foxglove.Grid: how likely each place is to be visited until the end of the future; one clear cell without an agent.

    A cell holds the probability (float32) and a colour for viewers that show colours by default (clear where never visited).
    """
    found = found or Occupancy(0.0, 0.0, 1.0, np.zeros((1, 1)))
    probability = found.probability
    cells = np.zeros(probability.shape, dtype=[("probability", "<f4"), ("rgb", "u1", (3,)), ("alpha", "u1")])
    cells["probability"] = probability
    cells["rgb"] = np.round(_COLD + np.sqrt(probability)[..., None] * (_HOT - _COLD))
    cells["alpha"] = np.where(probability > 0, np.round(60.0 + 160.0 * probability), 0.0)
    message = foxglove_class("foxglove.Grid")(
        frame_id=frame.frame_id,
        column_count=probability.shape[1],
        row_stride=cells.itemsize * probability.shape[1],
        cell_stride=cells.itemsize,
        data=cells.tobytes(),
    )
    message.timestamp.FromNanoseconds(time_ns)
    message.pose.position.x, message.pose.position.y, message.pose.position.z = found.x_m, found.y_m, z_m
    message.pose.orientation.w = 1.0
    message.cell_size.x = message.cell_size.y = found.cell_m
    for name, offset, kind in (("probability", 0, _FLOAT32), ("red", 4, _UINT8), ("green", 5, _UINT8), ("blue", 6, _UINT8)):
        message.fields.add(name=name, offset=offset, type=kind)
    message.fields.add(name="alpha", offset=7, type=_UINT8)
    data: bytes = message.SerializeToString()
    return data


def _add_association(association: Any, sources: Sequence[dict[str, Any]]) -> None:
    for row in sorted(sources, key=lambda row: -row["probability"]):
        if row["agent_id"] is None:
            association.clutter_probability = row["probability"]
        else:
            association.agents.add(
                id=row["agent_id"], probability=row["probability"], first_probability=row["first_probability"]
            )
    for name, column in (("entropy_bits", "probability"), ("first_entropy_bits", "first_probability")):
        setattr(association, name, numbers.entropy_bits(np.array([row[column] for row in sources])))


def encode_event(event: Event, offset_ns: int) -> bytes:
    """foxglove.Event with all columns of events.csv as its metadata."""
    message = foxglove_class("foxglove.Event")()
    message.start_time.FromNanoseconds(event.start_ns + offset_ns)
    message.end_time.FromNanoseconds(event.end_ns + offset_ns)
    for name, value in asdict(event).items():
        if value is not None and name not in ("start_ns", "end_ns"):
            message.metadata.add(key=name, value=f"{value:.6g}" if isinstance(value, float) else str(value))
    data: bytes = message.SerializeToString()
    return data


def encode_transform(frame: Frame, time_ns: int) -> bytes:
    """foxglove.FrameTransform that makes a mission frame known to the viewer: it lies in our root, not displaced."""
    message = foxglove_class("foxglove.FrameTransform")(parent_frame_id=channels.ROOT_FRAME_ID, child_frame_id=frame.frame_id)
    message.timestamp.FromNanoseconds(time_ns)
    message.translation.SetInParent()
    message.rotation.w = 1.0
    data: bytes = message.SerializeToString()
    return data
