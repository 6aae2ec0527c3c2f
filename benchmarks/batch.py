"""What do workers, and windows drawn together, bring to a batch, and do results depend on them?

Simulated logs and five broken ones among them are run twice, by one worker and by several, into folders of their own, one run
right after the other. Then windows of one log are drawn by the shipped `prison` checkpoint alone and together.

    python -m benchmarks.batch --publish docs
"""

import argparse
import os
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import torch

from benchmarks import publishing
from benchmarks.publishing import Measurement
from cadence.constraints.obstacles import Obstacles
from pipeline.batch.config import RunConfig
from pipeline.batch.run import run
from pipeline.checkpoints import checkpoint_hash, find_checkpoint
from pipeline.config import stage_config
from pipeline.estimators.place import load_place_model, place_grid
from pipeline.files import hash_file
from pipeline.grids import plan_grid
from pipeline.progress import Progress
from pipeline.simulate.stage import SimulateConfig, simulate
from pipeline.tables import read_table
from pipeline.windows import build_windows

NUM_BROKEN = 5
SIZES = (1, 2, 4, 8, 16)
SEED = 0
SIMULATE = ("simulate.patrol.duration_s=1800", "simulate.patrol.detection_rate=0.4")  # long enough that all are detected
SETTINGS = (
    "infer.checkpoint=none", "infer.num_hypotheses=4", "infer.grid.history_steps=16", "infer.grid.horizon_steps=16",
    "infer.grid.stride_steps=32", "infer.guidance.mode=none",
)  # fmt: skip
_QUIET = Progress(quiet=True)


def write_logs(folder: Path, count: int) -> None:
    """`count` simulated logs, and broken ones between them."""
    config = stage_config(SimulateConfig, "simulate", None, [*SIMULATE, f"simulate.num_episodes={count}"], SEED)
    simulate(folder, config, _QUIET)
    sound = sorted(folder.glob("*.mcap"))[0].read_bytes()
    for number in range(NUM_BROKEN):
        content = (b"", b"not an MCAP", sound[:50], bytes(5000), sound[:8] + bytes(3000))[number]
        (folder / f"patrol-{SEED}-{number * count // NUM_BROKEN:04d}-broken.mcap").write_bytes(content)


@dataclass(frozen=True)
class Batches:
    """The runs with one worker and with several: a row each, a row for every log that failed, and what was compared."""

    rows: list[publishing.Row]
    failures: list[publishing.Row]
    num_files: int
    num_windows: int


def run_batches(folder: Path, num_workers: int) -> Batches:
    """Run the logs by one worker and by several; raises `SystemExit` where the runs differ, or other logs fail."""
    config = stage_config(RunConfig, None, None, SETTINGS)
    rows, failures, first_s, first = [], list[publishing.Row](), 0.0, dict[str, str]()
    run(
        [str(folder / f"logs/patrol-{SEED}-0000.mcap")], str(folder / "warm"), config, _QUIET, num_workers=1
    )  # imports once for all
    for workers in (1, num_workers):
        out, begin_s = folder / f"workers-{workers}", time.monotonic()
        outcomes = run([str(folder / "logs")], str(out), config, _QUIET, num_workers=workers)
        elapsed_s = time.monotonic() - begin_s
        found = {str(path.relative_to(out)): hash_file(path) for path in out.glob("*/*")}
        first_s, first = first_s or elapsed_s, first or found
        told = {o.task.name: o.message.replace(f"{folder / 'logs'}/", "") for o in outcomes if o.status != "done"}
        counts = {"num_workers": workers, "num_finished": len(outcomes) - len(told), "num_failed": len(told)}
        rows.append({**counts, "speed": first_s / elapsed_s, "same_bytes": "yes"})
        failures = failures or [{"log": name, "message": message} for name, message in told.items()]
        if found != first or len(told) != NUM_BROKEN or not all(name.endswith("-broken") for name in told):
            raise SystemExit("\n".join([f"batch: {workers} workers gave other files, or other logs failed:", *told]))
    windows = [stage.summary["num_windows"] for o in outcomes for stage in o.stages if stage.stage == "infer"]
    return Batches(rows, failures, len(first), sum(windows))


def window_rows(detections_path: Path, num_hypotheses: int = 30) -> list[publishing.Row]:
    """A row for each number of windows that are drawn together: processor time a window, and whether the bits are the same."""
    detections, _ = read_table(detections_path, "detections")
    model = load_place_model(find_checkpoint("prison"))
    windows = build_windows(detections, plan_grid(detections, place_grid(model.config, 1)), 0)
    batch = windows.located(int(detections["time_ns"][0].as_py()), Obstacles.none()).batch
    count = min(max(SIZES), windows.batch.num_windows)

    def draw(part: torch.Tensor) -> torch.Tensor:
        return model.sample(batch[part], num_hypotheses).position_m.nan_to_num()

    together = draw(torch.arange(count))
    rows, alone_s = [], 0.0
    for size in [size for size in SIZES if size <= count]:
        begin_s, difference_m = time.process_time(), 0.0
        for part in torch.arange(count).split(size):
            difference_m = max(difference_m, float((draw(part) - together[part]).abs().max()))
        elapsed_s = time.process_time() - begin_s
        alone_s = alone_s or elapsed_s
        rows.append({"windows_together": size, "speed": alone_s / elapsed_s, "difference_m": difference_m})
    return rows


def main() -> int:
    """Measure, print and publish."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--publish", type=Path, metavar="DOCS", help="write numbers and section below this folder")
    parser.add_argument("--logs", type=int, default=100, help="logs, the broken ones included")
    parser.add_argument("--workers", type=int, default=max(2, len(os.sched_getaffinity(0))), help="of the second run")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    num_running = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_logs(folder / "logs", arguments.logs - NUM_BROKEN)
        batches = run_batches(folder, arguments.workers)
        detections = max((folder / "workers-1").glob("*/detections.parquet"), key=lambda path: (path.stat().st_size, path))
        windows = window_rows(detections)
    facts = publishing.facts_of("batch") | {
        "checkpoint": {"prison": checkpoint_hash(find_checkpoint("prison"))}, "seed": SEED, "num_logs": arguments.logs,
        "num_broken": NUM_BROKEN, "num_hyperthreads": len(os.sched_getaffinity(0)), "load_at_start": num_running,
        "num_windows": batches.num_windows, "num_files": batches.num_files, "settings": [*SIMULATE, *SETTINGS],
    }  # fmt: skip
    tables = {"batch": batches.rows, "batch_failures": batches.failures, "batch_windows": windows}
    publishing.publish(Measurement("batch", facts, tables), section, arguments.publish)
    return 0


def section(measured: Measurement) -> str:
    """What workers bring, and windows drawn together."""
    facts = measured.facts
    one, several = measured.rows()
    together = ", ".join(f"{row['speed']:.2f} ({row['windows_together']})" for row in measured.rows("windows"))
    return "\n\n".join([
        f"{facts['num_logs']} logs, {facts['num_broken']} of them broken, {facts['num_windows']} windows: "
        f"{several['num_workers']} workers are {several['speed']:.2f} times as fast as one. {one['num_finished']} logs finish, "
        f"{one['num_failed']} fail with a reason each, and all {facts['num_files']} files are the same to the byte.",
        f"Speed of drawing so many windows of one log together, over one by one: {together}.",
    ])  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
