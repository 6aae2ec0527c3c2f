"""Messages of a side file: hypotheses, numbers a tick, detections, heat map, frames."""

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from cadence.arrays import Float32s, Floats
from pipeline.ask.events import Event
from pipeline.export import numbers
from pipeline.export.occupancy import Occupancy
from pipeline.export.playback import LiveAgent, Tick
from pipeline.export.quantized import quantize
from pipeline.logs.wire import field
from pipeline.logs.writer import foxglove_class
from pipeline.results import AgentHypotheses, WindowHypotheses
from pipeline.stories import MissionStories
from pipeline.tables import Frame
from schemas import channels
from schemas.channels import message_class

_COLD, _HOT = np.array([70.0, 20.0, 130.0]), np.array([255.0, 215.0, 70.0])
_UINT8, _FLOAT32 = 1, 7  # foxglove.PackedElementField.NumericType


def encode_hypotheses(window: WindowHypotheses, frame: Frame, time_ns: int) -> bytes:
    """cadence.Hypotheses with all that the tables hold of one window; tracks on grids far finer than their spread."""
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
    return b"".join([head.SerializeToString(), *(field(11, _encode_agent(agent, window.weight)) for agent in window.agents)])


def _encode_agent(agent: AgentHypotheses, weight: Float32s) -> bytes:
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
    parts = [bytes(head.SerializeToString()), _encode_tracks(agent.position_m, weight, 14, 9)]
    if agent.height_m is not None:
        parts.append(_encode_tracks(agent.height_m[..., None], weight, 15, 13))
    return b"".join(parts)


def _encode_tracks(track_m: Floats, weight: Floats, number: int, float_number: int) -> bytes:
    """Tracks [K, T, D] as the field `number` of whole numbers, or as that of floats where they have gaps; nothing of none."""
    if not track_m.size:
        return b""
    found = quantize(track_m, weight)
    if found is None:
        return field(float_number, np.ascontiguousarray(track_m, dtype="<f4").tobytes())
    return field(number, found.encode())


def encode_mission(mission: MissionStories, agent: int, number: int, time_ns: int) -> bytes | None:
    """cadence.MissionHypotheses of an agent in the block with this number; None where it is part of no story there."""
    block, stories = mission.blocks[number], mission.stories
    steps = slice(block.first, block.stop)
    position_m = stories.position_m[:, agent, steps]
    height_m = None if stories.height_m is None else stories.height_m[:, agent, steps]
    is_there = np.isfinite(position_m[..., 0])
    if not is_there.any():
        return None
    datum_m = np.round(position_m[is_there].mean(axis=0))
    message = message_class("cadence.MissionHypotheses")(
        log_id=mission.log_id,
        frame_id=mission.frame.frame_id,
        agent_id=stories.agent_ids[agent],
        block=number,
        start_ns=block.start_ns,
        step_ns=block.step_ns,
        num_steps=len(block),
        hypothesis=range(stories.num_hypotheses),
        weight=stories.weight.tolist(),
        datum_x_m=datum_m[0],
        datum_y_m=datum_m[1],
    )
    message.timestamp.FromNanoseconds(time_ns)
    parts = [bytes(message.SerializeToString()), _encode_tracks(position_m - datum_m, stories.weight, 13, 14)]
    if height_m is not None and not np.isnan(height_m).all():
        parts.append(_encode_tracks(height_m[..., None], stories.weight, 15, 16))
    return b"".join(parts)


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


def _to_accuracy(value_m: float, variance_m2: float | None) -> float:
    """Rounded by at most a hundredth of its standard deviation, as a power of two; as it is where that is not known."""
    if variance_m2 is None or not 0.0 < variance_m2 < math.inf:
        return value_m
    quantum_m = 2.0 ** math.floor(math.log2(0.02 * math.sqrt(variance_m2)))
    return round(value_m / quantum_m) * quantum_m


def _to_digits(value: float) -> float:
    """Rounded to sixteen binary digits, four decimal ones: covariances of correlation 0.999 stay positive definite."""
    fraction, exponent = math.frexp(value)
    return math.ldexp(round(fraction * 65536.0) / 65536.0, exponent)


def encode_detection(row: dict[str, Any], frame: Frame, time_ns: int, sources: Sequence[dict[str, Any]] = ()) -> bytes:
    """cadence.Detection from a row of DETECTIONS, and where its origin is unknown from the rows of ASSOCIATIONS on it."""
    message = message_class("cadence.Detection")(frame_id=frame.frame_id)
    message.timestamp.FromNanoseconds(time_ns)
    for name in ("agent_id", "sensor_id", "num_merged", "topic", "log_time_ns", "sequence"):
        if row[name] is not None:
            setattr(message, name, row[name])
    for name, variance in (("x_m", "cov_xx_m2"), ("y_m", "cov_yy_m2"), ("z_m", "cov_zz_m2")):
        if row[name] is not None and math.isfinite(row[name]):
            setattr(message, name, _to_accuracy(row[name], row.get(variance)))
    for name in ("cov_xx_m2", "cov_xy_m2", "cov_yy_m2", "cov_zz_m2", "score"):
        value = row.get(name)
        if value is not None and math.isfinite(value):
            setattr(message, name, _to_digits(value))
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
