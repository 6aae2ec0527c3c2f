"""What infer left in a mission directory, as numpy views: one `WindowHypotheses` a window, all agents in it."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa

from cadence.arrays import Float32s, Float64s, Int32s, Int64s
from cadence.errors import InputError
from pipeline.tables import Frame, read_table


@dataclass(frozen=True, eq=False)
class AgentHypotheses:
    """One agent in one window.

    datum_m     (x, y) in the mission frame
    position_m  [K, T, 2] float32 metres relative to the datum; K is 0 where nothing could be drawn; NaN in hypotheses
                that the agent is no part of
    num_effective  effective sample size of its tracks; None where no evidence weighs them
    probability, association_entropy_bits  of its being there, and of who caused its detections; None: their origin is known
    height_m    [K, T] float32 metres up from the vertical datum of the mission's frame; None where its height is unknown
    """

    agent_id: str
    status: str
    advice: str | None
    num_detections: int
    age_s: float | None
    spread_m: float | None
    datum_m: tuple[float, float]
    position_m: Float32s
    probability: float | None = None
    association_entropy_bits: float | None = None
    num_effective: float | None = None
    height_m: Float32s | None = None

    @property
    def is_live(self) -> bool:
        """Whether there is anything to show."""
        return len(self.position_m) > 0


@dataclass(frozen=True, eq=False)
class WindowHypotheses:
    """One window; step i of every track lies at origin_ns + (i - origin_index) * step_ns.

    hypothesis [K] number and weight [K] float32 of each joint hypothesis, shared by all agents; agents in order of their names.
    """

    log_id: str
    window: int
    origin_ns: int
    step_ns: int
    origin_index: int
    num_steps: int
    hypothesis: Int32s
    weight: Float32s
    agents: tuple[AgentHypotheses, ...]

    @property
    def end_ns(self) -> int:
        """Time of the last step."""
        return self.origin_ns + (self.num_steps - 1 - self.origin_index) * self.step_ns

    @property
    def start_ns(self) -> int:
        """Time of the first step."""
        return self.origin_ns - self.origin_index * self.step_ns


@dataclass(frozen=True, eq=False)
class MissionHypotheses:
    """All windows of a mission by origin, and the frame of their positions."""

    frame: Frame
    agent_ids: tuple[str, ...]
    windows: tuple[WindowHypotheses, ...]


def read_hypothesis_tables(directory: Path) -> MissionHypotheses:
    """Windows and hypotheses of a mission directory; positions are views into the table, not copies.

    Raises `InputError` where a table is missing, damaged, or does not hold every agent's full set of hypotheses.
    """
    path = directory / "hypotheses.parquet"
    table, frame = read_table(path, "hypotheses")
    windows, _ = read_table(directory / "windows.parquet", "windows")
    rows = _Rows.of(table, path)
    found = tuple(_window(group, rows, path) for group in _status_groups(windows))
    agent_ids = tuple(sorted({agent.agent_id for window in found for agent in window.agents}))
    return MissionHypotheses(frame, agent_ids, tuple(sorted(found, key=lambda window: (window.origin_ns, window.window))))


@dataclass(frozen=True, eq=False)
class _Rows:
    """The columns of HYPOTHESES sorted by window, agent and hypothesis, and where each (window, agent) begins and ends."""

    origin: Int32s
    step_ns: Int64s
    hypothesis: Int32s
    weight: Float32s
    datum_m: Float64s
    position_m: Float32s
    height_m: Float32s | None
    log_id: str
    spans: dict[tuple[int, str], tuple[int, int]]

    @staticmethod
    def of(table: pa.Table, path: Path) -> "_Rows":
        window, hypothesis = table["window"].to_numpy(), table["hypothesis"].to_numpy()
        agents = table["agent_id"].combine_chunks().dictionary_encode()
        if isinstance(agents, pa.ChunkedArray):
            agents = agents.chunk(0) if agents.num_chunks else pa.array([], pa.string()).dictionary_encode()
        names, agent = agents.dictionary.to_pylist(), agents.indices.to_numpy()
        rank = np.argsort(np.argsort(names))[agent] if names else agent
        order = np.lexsort((hypothesis, rank, window))
        if not np.array_equal(order, np.arange(len(order))):
            table = table.take(order)
            window, agent = window[order], agent[order]
        cuts = np.flatnonzero((np.diff(window) != 0) | (np.diff(agent) != 0)) + 1
        bounds = [0, *cuts.tolist(), len(window)] if len(window) else [0]
        pairs = itertools.pairwise(bounds)
        spans = {(int(window[begin]), names[agent[begin]]): (begin, end) for begin, end in pairs}
        return _Rows(
            table["origin_index"].to_numpy(),
            table["step_ns"].to_numpy(),
            table["hypothesis"].to_numpy(),
            table["weight"].to_numpy(),
            np.stack([table["datum_x_m"].to_numpy(), table["datum_y_m"].to_numpy()], axis=-1),
            _positions(table, path),
            _heights(table),
            table["log_id"][0].as_py() if table.num_rows else "",
            spans,
        )


def _positions(table: pa.Table, path: Path) -> Float32s:
    column = table["position_m"].combine_chunks()
    if isinstance(column, pa.ChunkedArray):  # an empty table keeps its chunks
        column = column.chunk(0) if column.num_chunks else pa.array([], type=column.type)
    if column.null_count:
        raise InputError(f"{path}: position_m holds nulls; run infer again with --force")
    flat = column.flatten().flatten().to_numpy(zero_copy_only=True)
    views: Float32s = flat.reshape(-1, column.type.list_size, 2)
    return views


def _heights(table: pa.Table) -> Float32s | None:
    """Heights [N, T], NaN where null; None of a table without them."""
    if "height_m" not in table.column_names:
        return None
    column, num_steps = table["height_m"].combine_chunks(), table.schema.field("height_m").type.list_size
    if isinstance(column, pa.ChunkedArray):  # an empty table keeps its chunks
        return np.zeros((0, num_steps), np.float32)
    heights: Float32s = column.values.slice(column.offset * num_steps, len(column) * num_steps).to_numpy(zero_copy_only=False)
    heights = heights.reshape(-1, num_steps)
    return np.where(column.is_valid().to_numpy(zero_copy_only=False)[:, None], heights, np.float32(np.nan))


def _status_groups(windows: pa.Table) -> Iterator[list[dict[str, object]]]:
    """The rows of WINDOWS, a list a window, agents in order of their names."""
    group: list[dict[str, object]] = []
    for row in windows.sort_by([("window", "ascending"), ("agent_id", "ascending")]).to_pylist():
        if group and row["window"] != group[0]["window"]:
            yield group
            group = []
        group.append(row)
    if group:
        yield group


def _window(group: list[dict[str, object]], rows: _Rows, path: Path) -> WindowHypotheses:
    number, origin_ns = _int(group[0]["window"]), _int(group[0]["origin_ns"])
    spans = [rows.spans.get((number, str(row["agent_id"]))) for row in group]
    held = [span for span in spans if span is not None]
    first = held[0] if held else (0, 0)
    for begin, end in held:
        same = end - begin == first[1] - first[0] and all(
            np.array_equal(column[begin:end], column[first[0] : first[1]])
            for column in (rows.hypothesis, rows.weight, rows.step_ns, rows.origin)
        )
        if not same or (rows.datum_m[begin:end] != rows.datum_m[begin]).any():
            raise InputError(
                f"{path}: window {number} does not hold the same hypotheses for every agent; run infer with --force"
            )
    has_rows = len(rows.step_ns) > 0
    return WindowHypotheses(
        log_id=rows.log_id,
        window=number,
        origin_ns=origin_ns,
        # A window without any hypothesis has no grid of its own: that of the mission's first row will do.
        step_ns=int(rows.step_ns[first[0]]) if has_rows else 0,
        origin_index=int(rows.origin[first[0]]) if has_rows else 0,
        num_steps=rows.position_m.shape[1],
        hypothesis=rows.hypothesis[first[0] : first[1]],
        weight=rows.weight[first[0] : first[1]],
        agents=tuple(_agent(row, span, rows) for row, span in zip(group, spans, strict=True)),
    )


def _agent(row: dict[str, object], span: tuple[int, int] | None, rows: _Rows) -> AgentHypotheses:
    begin, end = span or (0, 0)
    height_m = None if rows.height_m is None else rows.height_m[begin:end]
    datum = rows.datum_m[begin] if span else np.zeros(2)
    return AgentHypotheses(
        agent_id=str(row["agent_id"]),
        status=str(row["status"]),
        advice=None if row["advice"] is None else str(row["advice"]),
        num_detections=_int(row["num_detections"]),
        age_s=_optional_float(row["age_s"]),
        spread_m=_optional_float(row["spread_m"]),
        datum_m=(float(datum[0]), float(datum[1])),
        position_m=rows.position_m[begin:end],
        probability=_optional_float(row.get("probability")),
        association_entropy_bits=_optional_float(row.get("association_entropy_bits")),
        num_effective=_optional_float(row.get("num_effective")),
        height_m=None if height_m is None or np.isnan(height_m).all() else height_m,
    )


def _int(value: object) -> int:
    assert isinstance(value, int)
    return value


def _optional_float(value: object) -> float | None:
    return value if isinstance(value, float) else None
