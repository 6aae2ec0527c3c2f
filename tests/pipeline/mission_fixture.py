"""A small mission directory as ingest, extract and infer would leave it: two agents, six windows, twelve hypotheses."""

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from mcap.writer import Writer

from pipeline.ingest import IngestConfig, ingest
from pipeline.manifest import hash_file
from pipeline.progress import Progress
from pipeline.tables import Frame, write_table
from schemas.tables import DETECTIONS, POSES, TRUTH, WINDOWS, hypotheses_schema

LOG_ID = "patrol"
START_NS = 1_700_000_000_000_000_000
AGENT_IDS = ("T0", "T1")
NUM_WINDOWS, NUM_HYPOTHESES, NUM_STEPS, ORIGIN_INDEX = 6, 12, 96, 63
STEP_NS, STRIDE_NS, FIRST_ORIGIN_NS = 1_000_000_000, 20_000_000_000, 40_000_000_000
DURATION_NS = 200_000_000_000
DATUM_M = (1500.0, -250.0)
FRAME = Frame("map")
GEOREFERENCED = Frame("local_enu", 50.8, -1.2)
OBSTACLES = {
    "version": 1,
    "obstacles": [
        {"kind": "circle", "x_m": 1700.0, "y_m": -100.0, "radius_m": 40.0, "name": "mast"},
        {
            "kind": "polygon",
            "rings_m": [
                [[1300.0, -400.0], [1400.0, -400.0], [1400.0, -300.0], [1300.0, -300.0]],
                [[1330.0, -370.0], [1360.0, -370.0], [1360.0, -340.0], [1330.0, -340.0]],
            ],
        },
    ],
}


def true_position_m(agent: int, time_s: np.ndarray) -> np.ndarray:
    """Where the agent really is, [..., 2]: a curve per agent."""
    phase = 0.02 * time_s + agent
    return np.stack([1500.0 + 3.0 * time_s + 60.0 * np.sin(phase), -250.0 + 90.0 * np.cos(phase) + 120.0 * agent], axis=-1)


def build_mission(parent: Path, *, frame: Frame = FRAME, num_hypotheses: int = NUM_HYPOTHESES, log: Path | None = None) -> Path:
    """Write the mission directory `parent`/patrol and return it; T1 has no hypotheses in the last window.

    `log` is the recorded log (default: `parent`/patrol.mcap, written where absent).
    """
    source = log or parent / f"{LOG_ID}.mcap"
    if not source.exists():
        _write_log(source)
    directory = parent / source.stem
    directory.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(7)
    detections = _detections(rng)
    write_table(detections, directory / "detections.parquet", "detections", frame)
    write_table(_states(TRUTH, "agent_id", AGENT_IDS), directory / "truth.parquet", "truth", frame)
    write_table(_states(POSES, "sensor_id", ("camera",)), directory / "poses.parquet", "poses", frame)
    hypotheses, windows = _hypotheses(rng, detections, num_hypotheses)
    write_table(hypotheses, directory / "hypotheses.parquet", "hypotheses", frame)
    write_table(windows, directory / "windows.parquet", "windows", frame)
    (directory / "obstacles.json").write_text(json.dumps(OBSTACLES))
    ingest(source, directory, IngestConfig(), Progress(quiet=True))
    manifest = {
        "stage": "infer",
        "config": {"seed": 11, "num_hypotheses": num_hypotheses, "checkpoint": "general"},
        "inputs": {"detections.parquet": hash_file(directory / "detections.parquet")},
        "versions": {"cadence": "source", "torch": "2.13.0"},
        "outputs": {},
        "summary": {"num_windows": NUM_WINDOWS, "checkpoint_sha256": "ab" * 32},
    }
    (directory / "infer.manifest.json").write_text(json.dumps(manifest))
    return directory


def _detections(rng: np.random.Generator) -> pa.Table:
    rows = []
    for agent, agent_id in enumerate(AGENT_IDS):
        times_ns = np.sort(rng.choice(DURATION_NS // 1_000_000_000, size=24, replace=False)) * 1_000_000_000
        for sequence, time_ns in enumerate(times_ns):
            x_m, y_m = true_position_m(agent, np.float64(time_ns / 1e9)) + rng.normal(0, 4.0, 2)
            row = {"log_id": LOG_ID, "time_ns": START_NS + int(time_ns), "sensor_id": "camera", "agent_id": agent_id}
            row |= {"x_m": x_m, "y_m": y_m, "z_m": None, "cov_xx_m2": 16.0, "cov_xy_m2": 0.0, "cov_yy_m2": 16.0, "score": 0.9}
            row |= {
                "num_merged": 1,
                "topic": f"/contacts/{agent_id}",
                "log_time_ns": START_NS + int(time_ns),
                "sequence": sequence,
            }
            rows.append(row)
    rows.sort(key=lambda row: (row["time_ns"], row["agent_id"]))
    return pa.Table.from_pylist(rows, schema=DETECTIONS)


def _states(schema: pa.Schema, id_column: str, ids: tuple[str, ...]) -> pa.Table:
    time_ns = np.arange(0, DURATION_NS + 1, 1_000_000_000)
    rows = []
    for index, name in enumerate(ids):
        for time, (x_m, y_m) in zip(time_ns, true_position_m(index, time_ns / 1e9), strict=True):
            rows.append(
                {"log_id": LOG_ID, "time_ns": START_NS + int(time), id_column: name, "x_m": x_m, "y_m": y_m, "z_m": None}
            )
    return pa.Table.from_pylist(rows, schema=schema)


def _hypotheses(rng: np.random.Generator, detections: pa.Table, num_hypotheses: int) -> tuple[pa.Table, pa.Table]:
    detected = {a: np.array(detections.filter(pc.equal(detections["agent_id"], a))["time_ns"]) for a in AGENT_IDS}
    rows, windows = [], []
    offset_s = (np.arange(NUM_STEPS) - ORIGIN_INDEX) * (STEP_NS / 1e9)
    for window in range(NUM_WINDOWS):
        origin_ns = START_NS + FIRST_ORIGIN_NS + window * STRIDE_NS
        weight = rng.dirichlet(np.full(num_hypotheses, 3.0)).astype(np.float32)
        for agent, agent_id in enumerate(AGENT_IDS):
            past_ns = detected[agent_id][detected[agent_id] <= origin_ns]
            is_lost = agent == 1 and window == NUM_WINDOWS - 1
            path_m = true_position_m(agent, (origin_ns - START_NS) / 1e9 + offset_s) - DATUM_M
            growth_m = np.where(offset_s < 0, 6.0, 6.0 + 1.5 * np.maximum(offset_s, 0))[None, :, None]
            wander_m = 0.3 * np.cumsum(rng.normal(0, 1, (num_hypotheses, NUM_STEPS, 2)), axis=1)
            position_m = (path_m + growth_m * rng.normal(0, 1, (num_hypotheses, 1, 2)) + wander_m).astype(np.float32)
            common = {"window": window, "origin_ns": origin_ns, "agent_id": agent_id}
            spread_m = float(np.sqrt(np.sum(np.var(position_m[:, ORIGIN_INDEX], axis=0))))
            windows.append(
                common
                | {"status": "no_detections" if is_lost else "ok", "advice": "widen the history" if is_lost else None}
                | {"num_detections": 0 if is_lost else len(past_ns), "spread_m": None if is_lost else spread_m}
                | {"age_s": None if is_lost else (origin_ns - int(past_ns[-1])) / 1e9}
            )
            common |= {"log_id": LOG_ID, "step_ns": STEP_NS, "origin_index": ORIGIN_INDEX}
            common |= {"datum_x_m": DATUM_M[0], "datum_y_m": DATUM_M[1]}
            for k in range(0 if is_lost else num_hypotheses):
                rows.append(common | {"hypothesis": k, "weight": float(weight[k]), "position_m": position_m[k].tolist()})
    table = pa.Table.from_pylist(rows, schema=hypotheses_schema(NUM_STEPS))
    return table, pa.Table.from_pylist(windows, schema=WINDOWS)


def _write_log(path: Path) -> None:
    """A small recorded log: the camera's poses, without hypotheses or truth."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=4096)
        writer.start("", "mission_fixture")
        schema = {"type": "object", "properties": {"frame_id": {"type": "string"}, "x": {"type": "number"}}}
        schema_id = writer.register_schema("foxglove.PoseInFrame", "jsonschema", json.dumps(schema).encode())
        channel_id = writer.register_channel("/camera/pose", "json", schema_id)
        for second in range(DURATION_NS // 1_000_000_000 + 1):
            time_ns = START_NS + second * 1_000_000_000
            data = json.dumps({"frame_id": FRAME.frame_id, "x": 3.0 * second}).encode()
            writer.add_message(channel_id, log_time=time_ns, data=data, publish_time=time_ns, sequence=second)
        writer.add_attachment(START_NS, START_NS, "notes.txt", "text/plain", b"calm sea")
        writer.add_metadata("mission", {"name": LOG_ID})
        writer.finish()
