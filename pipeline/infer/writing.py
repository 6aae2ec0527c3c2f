"""A mission's detections to the tables of hypotheses and windows: all that costs something when the stage runs."""

import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from cadence.evidence.estimator import CONTRADICTED, FEW_FIT
from pipeline.checkpoints import checkpoint_hash
from pipeline.counted import counted
from pipeline.estimators.presets import find_weights
from pipeline.infer.config import InferConfig
from pipeline.infer.draws import Drawn
from pipeline.infer.plan import Beside, Plan
from pipeline.infer.rows import ADVICE, hypothesis_rows, window_rows, with_association, with_effective
from pipeline.looks import read_looks
from pipeline.measurements import read_measurements
from pipeline.obstacle_file import OBSTACLES_NAME, read_obstacles
from pipeline.pasts import write_pasts
from pipeline.progress import Progress
from pipeline.tables import Frame, read_table, write_table
from pipeline.threads import in_order, num_cores, one_thread

_MANY_NAMELESS = 2000
_FIRST_S, _LONG_S = 5.0, 120.0
"""After how long one knows what is ahead, and from when on somebody who waits wants to have been told."""


def write_tables(
    directory: Path, folder: Path, config: InferConfig, start_ns: int, num_threads: int | None, progress: Progress
) -> dict[str, Any]:
    """Write the files of the stage for the mission in `directory`, which began at `start_ns`, into `folder`; the summary."""
    detections, frame = read_table(directory / "detections.parquet", "detections")
    if config.is_associated and detections["agent_id"].null_count > _MANY_NAMELESS:
        progress.note(
            f"infer: {detections['agent_id'].null_count} detections do not say whose they are and are told apart one after "
            'the other, which takes a while; agent = "NAME" in [[extract.detections]] means one target, --start and --end '
            "take a part"
        )
    looks, measurements = read_looks(directory, start_ns), read_measurements(directory, start_ns)
    beside = Beside(start_ns, read_obstacles(directory / OBSTACLES_NAME), looks=looks, measurements=measurements)
    with one_thread():
        plan = Plan.of(config, detections, beside, progress)
        for line in plan.suspicions.lines():
            progress.note(f"infer: suspected {line}")
        drawn = in_order(plan.draws, num_threads or num_cores())
        summary = _draw(plan, drawn, str(detections["log_id"][0]), folder, frame, plan.left)
    if plan.seen.sources.association is not None:
        found = plan.seen.sources.association.rows(detections)
        write_table(found, folder / "associations.parquet", "associations", frame)
        labels = plan.seen.sources.association.labels(plan.seen.sources.grid)
        write_table(labels, folder / "labels.parquet", "labels", frame)
        write_pasts(plan.seen.sources.association, folder, frame)
    return {
        **summary,
        "step_s": plan.seen.sources.grid.step_s,
        "remarks": [*plan.seen.sources.grid.remarks, *plan.found, *_set_aside(summary["status"])],
        "context_steps": plan.seen.sources.grid.context_steps,
        "checkpoint": plan.checkpoint,
        "checkpoint_sha256": _hash(plan.checkpoint),
        "seed": config.seed,
        **plan.about,
        "suspicions": plan.suspicions.records(),
    }


def _set_aside(status: Mapping[str, int]) -> list[str]:
    """What to tell where evidence was set aside in most windows in which it could be weighed: a source is misread, likely."""
    num = status.get(CONTRADICTED, 0)
    num_weighed = num + status.get(FEW_FIT, 0) + status.get("ok", 0)
    if 2 * num <= num_weighed:
        return []
    return [f"in {num} of {num_weighed} pairs of a window and an agent {ADVICE[CONTRADICTED]}"]


def _hash(checkpoint: str) -> str | None:
    weights = find_weights(checkpoint)
    return None if weights is None else checkpoint_hash(weights)


def _draw(plan: Plan, draws: Iterable[Drawn], log_id: str, folder: Path, frame: Frame, progress: Progress) -> dict[str, Any]:
    """All windows into the two tables; what the summary says of them."""
    parts, statuses = [], []
    num_windows, begun_s, is_told, num_done = plan.windows.batch.num_windows, time.monotonic(), False, 0
    with progress.bar(num_windows, "infer", unit="window") as bar:
        for part, drawn in draws:
            parts.append(hypothesis_rows(log_id, plan.windows, plan.seen.sources.grid, part, drawn))
            rows = window_rows(plan.windows, part, drawn, plan.max_speed_mps)
            rows = rows if plan.seen.associated is None else with_association(rows, plan.seen.associated, part)
            statuses.append(with_effective(rows, drawn) if plan.has_evidence else rows)
            bar.update(len(part))
            num_done, taken_s = num_done + len(part), time.monotonic() - begun_s
            if not is_told and taken_s > _FIRST_S:
                is_told = True
                _tell_cost(num_windows, num_windows * taken_s / num_done, progress)
    tracks, windows = pa.concat_tables(parts), pa.concat_tables(statuses)
    write_table(tracks, folder / "hypotheses.parquet", "hypotheses", frame)
    write_table(windows, folder / "windows.parquet", "windows", frame)
    counts = windows["status"].value_counts().to_pylist()
    return {
        "num_windows": num_windows,
        "num_agents": pc.count_distinct(tracks["agent_id"]).as_py(),
        "num_tracks": tracks.num_rows,
        "status": {str(item["values"]): int(item["counts"]) for item in counts},
    }


def _tell_cost(num_windows: int, seconds: float, progress: Progress) -> None:
    """What is ahead, by what the first windows took, where one might wish to have fewer."""
    if seconds > _LONG_S:
        progress.note(
            f"infer: {counted(num_windows, 'window')}, about {seconds / 60.0:.0f} min by the first ones; "
            "a larger infer.grid.stride_steps takes fewer"
        )
