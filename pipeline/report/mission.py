"""A mission directory as arrays: what every part of the page draws from.

Letters of the shapes: K hypothesis, A agent, T time step, N point. Positions are float64 metres in the mission frame
unless a name says otherwise.
"""

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from cadence.errors import InputError
from pipeline.manifest import read_manifest
from pipeline.tables import Frame, read_table

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
JsonDict = dict[str, Any]

STAGES = ("ingest", "extract", "infer", "export", "evaluate")
"""Stages whose manifests the page shows, in the order of the work."""


@dataclass(frozen=True, eq=False)
class Points:
    """Timed positions with an owner: detections and truth of agents, poses of sensors; sorted by time.

    time_ns [N], owner [N] index into the names that belong to it (-1: unknown), position_m [N, 2]
    """

    time_ns: Ints
    owner: Ints
    position_m: Floats

    def of(self, owner: int) -> "Points":
        """The points of one owner."""
        chosen = self.owner == owner
        return Points(self.time_ns[chosen], self.owner[chosen], self.position_m[chosen])

    def between(self, start_ns: int, end_ns: int) -> "Points":
        """The points with start_ns <= time_ns <= end_ns."""
        first, last = np.searchsorted(self.time_ns, [start_ns, end_ns + 1])
        chosen = slice(int(first), int(last))
        return Points(self.time_ns[chosen], self.owner[chosen], self.position_m[chosen])

    def __len__(self) -> int:
        return len(self.time_ns)


@dataclass(frozen=True, eq=False)
class Fan:
    """All hypotheses of one agent in one window.

    weight [K] sums to one; offset_m [K, T, 2] float32 relative to datum_m [2]; step i lies at
    origin_ns + (i - origin_index) * step_ns
    """

    window: int
    agent: int
    origin_ns: int
    step_ns: int
    origin_index: int
    weight: Floats
    datum_m: Floats
    offset_m: npt.NDArray[np.float32]

    @property
    def time_ns(self) -> Ints:
        """Times of the steps [T]."""
        steps = np.arange(self.offset_m.shape[1], dtype=np.int64) - self.origin_index
        return self.origin_ns + steps * self.step_ns


@dataclass(frozen=True, eq=False)
class WindowRow:
    """What is known of one agent in one window, also where nothing could be drawn."""

    window: int
    agent: int
    origin_ns: int
    status: str
    advice: str
    num_detections: int
    age_s: float | None
    spread_m: float | None


@dataclass(frozen=True, eq=False)
class Obstacle:
    """Rings [N, 2] of a polygon (outline first, then holes); a circle has no rings but a radius."""

    name: str
    rings_m: tuple[Floats, ...]
    centre_m: tuple[float, float] | None = None
    radius_m: float = 0.0


@dataclass(frozen=True, eq=False)
class Mission:
    """Everything that the page tells of one mission."""

    name: str
    catalogue: JsonDict
    frame: Frame
    agents: tuple[str, ...]
    sensors: tuple[str, ...]
    detections: Points
    truth: Points | None
    poses: Points | None
    rows: tuple[WindowRow, ...]
    fans: tuple[Fan, ...]
    obstacles: tuple[Obstacle, ...]
    manifests: dict[str, JsonDict]
    scores: JsonDict | None
    start_ns: int
    end_ns: int

    @property
    def origins_ns(self) -> dict[int, int]:
        """Origin by window, in the order of time."""
        return dict(sorted({row.window: row.origin_ns for row in self.rows}.items(), key=lambda item: (item[1], item[0])))


def mission_inputs(directory: Path) -> list[Path]:
    """The files of `directory` that the page depends on, as far as they exist."""
    names = ["catalogue.json", "detections.parquet", "hypotheses.parquet", "windows.parquet", "obstacles.json"]
    names += ["truth.parquet", "poses.parquet", "scores.json", *(f"{stage}.manifest.json" for stage in STAGES)]
    return [directory / name for name in names if (directory / name).is_file()]


def load_mission(directory: Path) -> Mission:
    """The mission in `directory`; `InputError` where a file that the page cannot do without is absent or damaged."""
    catalogue = _read_json(directory / "catalogue.json")
    detections, frame = read_table(directory / "detections.parquet", "detections")
    windows, _ = read_table(directory / "windows.parquet", "windows")
    hypotheses, _ = read_table(directory / "hypotheses.parquet", "hypotheses")
    truth = _optional_table(directory, "truth")
    poses = _optional_table(directory, "poses")
    tables = [table for table in (detections, windows, hypotheses, truth) if table is not None]
    agents = _names(*(table["agent_id"] for table in tables))
    sensors = _names(poses["sensor_id"]) if poses is not None else ()
    rows = _window_rows(windows, agents)
    scores = directory / "scores.json"
    detection_points = _points(detections, "agent_id", agents)
    truth_points = _points(truth, "agent_id", agents) if truth is not None else None
    start_ns, end_ns = _time_range(catalogue, [points for points in (detection_points, truth_points) if points], rows)
    return Mission(
        name=_log_name(catalogue, directory),
        catalogue=catalogue,
        frame=frame,
        agents=agents,
        sensors=sensors,
        detections=detection_points,
        truth=truth_points,
        poses=_points(poses, "sensor_id", sensors) if poses is not None else None,
        rows=rows,
        fans=_fans(hypotheses, agents),
        obstacles=_obstacles(directory / "obstacles.json"),
        manifests={stage: found for stage in STAGES if (found := read_manifest(stage, directory)) is not None},
        scores=_read_json(scores) if scores.is_file() else None,
        start_ns=start_ns,
        end_ns=end_ns,
    )


def _read_json(path: Path) -> JsonDict:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise InputError(f"{path}: not found; run the stage that writes it first (cadence run does all of them)") from error
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not readable JSON ({error}); run its stage again with --force") from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: expected a JSON object; run its stage again with --force")
    return content


def _optional_table(directory: Path, name: str) -> pa.Table | None:
    path = directory / f"{name}.parquet"
    return read_table(path, name)[0] if path.is_file() else None


def _names(*columns: pa.ChunkedArray) -> tuple[str, ...]:
    """Every name once, numbers inside names in the order of numbers (T2 before T10)."""
    found = {name for column in columns for name in column.unique().to_pylist() if name is not None}
    return tuple(sorted(found, key=_natural))


def _natural(name: str) -> tuple[list[str | int], str]:
    # Splitting at captured digits alternates text and number, so that keys always compare like with like.
    parts = re.split(r"([0-9]{1,15})", name)
    return [int(part) if index % 2 else part for index, part in enumerate(parts)], name


def _index(column: pa.ChunkedArray, names: tuple[str, ...]) -> Ints:
    order = {name: index for index, name in enumerate(names)}
    encoded = column.combine_chunks().dictionary_encode()
    lookup = np.array([order[name] for name in encoded.dictionary.to_pylist()] + [-1], dtype=np.int64)
    return lookup[encoded.indices.fill_null(len(lookup) - 1).to_numpy(zero_copy_only=False)]


def _points(table: pa.Table, column: str, names: tuple[str, ...]) -> Points:
    position_m = np.column_stack([table["x_m"].to_numpy(), table["y_m"].to_numpy()]).astype(np.float64).reshape(-1, 2)
    time_ns = table["time_ns"].to_numpy().astype(np.int64)
    owner = _index(table[column], names)
    usable = np.isfinite(position_m).all(axis=1)
    order = np.argsort(time_ns[usable], kind="stable")
    return Points(time_ns[usable][order], owner[usable][order], position_m[usable][order])


def _window_rows(table: pa.Table, agents: tuple[str, ...]) -> tuple[WindowRow, ...]:
    agent = _index(table["agent_id"], agents)
    rows = []
    for index, row in zip(agent.tolist(), table.to_pylist(), strict=True):
        age_s, spread_m = (None if row[key] is None or not np.isfinite(row[key]) else row[key] for key in ("age_s", "spread_m"))
        rows.append(
            WindowRow(
                row["window"],
                index,
                row["origin_ns"],
                row["status"],
                row["advice"] or "",
                row["num_detections"],
                age_s,
                spread_m,
            )
        )
    return tuple(sorted(rows, key=lambda row: (row.origin_ns, row.window, row.agent)))


def _fans(table: pa.Table, agents: tuple[str, ...]) -> tuple[Fan, ...]:
    if len(table) == 0:
        return ()
    column = table["position_m"].combine_chunks()
    num_steps = column.type.list_size
    offset_m = column.flatten().flatten().to_numpy().reshape(len(table), num_steps, 2)
    agent = _index(table["agent_id"], agents)
    window, origin_ns = table["window"].to_numpy(), table["origin_ns"].to_numpy()
    step_ns, origin_index = table["step_ns"].to_numpy(), table["origin_index"].to_numpy()
    weight = table["weight"].to_numpy().astype(np.float64)
    datum_m = np.column_stack([table["datum_x_m"].to_numpy(), table["datum_y_m"].to_numpy()])
    order = np.lexsort((table["hypothesis"].to_numpy(), agent, window, origin_ns))
    starts = np.flatnonzero(np.diff(window[order], prepend=-1) | np.diff(agent[order], prepend=-1))
    fans = []
    for rows in np.split(order, starts[1:]):
        # One window and agent share their datum; hypotheses with a hole in them cannot be drawn.
        rows = rows[np.isfinite(offset_m[rows]).all(axis=(1, 2))]
        if len(rows) == 0:
            continue
        first = rows[0]
        total = weight[rows].sum()
        share = weight[rows] / total if total > 0 else np.full(len(rows), 1.0 / len(rows))
        fans.append(
            Fan(
                int(window[first]), int(agent[first]), int(origin_ns[first]), int(step_ns[first]), int(origin_index[first]),
                share, datum_m[first], offset_m[rows],
            )
        )  # fmt: skip
    return tuple(fans)


def _obstacles(path: Path) -> tuple[Obstacle, ...]:
    if not path.is_file():
        return ()
    try:
        return tuple(_obstacle(entry) for entry in _read_json(path).get("obstacles", []))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path}: not a list of obstacles ({error}); run extract again with --force") from error


def _obstacle(entry: JsonDict) -> Obstacle:
    name = str(entry.get("name") or "")
    if entry["kind"] == "circle":
        return Obstacle(name, (), (float(entry["x_m"]), float(entry["y_m"])), float(entry["radius_m"]))
    return Obstacle(name, tuple(np.asarray(ring, dtype=np.float64).reshape(-1, 2) for ring in entry["rings_m"]))


def _log_name(catalogue: JsonDict, directory: Path) -> str:
    for key in ("log", "path", "source", "source_path"):
        value = catalogue.get(key)
        value = value.get("path") if isinstance(value, dict) else value
        if isinstance(value, str) and value:
            return Path(value).name
    return directory.name


def _time_range(catalogue: JsonDict, points: list[Points], rows: tuple[WindowRow, ...]) -> tuple[int, int]:
    """Start and end of what is drawn; the log's own range only where it agrees, since its clocks may be others."""
    times = [int(time) for found in points if len(found) for time in (found.time_ns[0], found.time_ns[-1])]
    times += [rows[0].origin_ns, rows[-1].origin_ns] if rows else []
    return (min(times), max(times)) if times else (int(catalogue.get("start_ns") or 0), int(catalogue.get("end_ns") or 0))
