"""Do local workers and Ray give the same hypotheses, and what does Ray cost?

Simulated logs are run through the local engine and through Ray, each with the same number of workers and the same settings.
Every published file is hashed; the wall time of each engine includes the start of its workers.

    python -m benchmarks.batch_engines --publish docs
"""

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

from benchmarks import publishing
from benchmarks.publishing import Measurement
from pipeline.batch.config import RunConfig
from pipeline.batch.outcome import LogOutcome, exit_code
from pipeline.batch.run import run
from pipeline.config import stage_config
from pipeline.files import hash_file
from pipeline.progress import Progress
from pipeline.simulate.stage import SimulateConfig, simulate

QUIET = Progress(quiet=True)
SEED = 7
SIMULATED = ("simulate.patrol.duration_s=1800", "simulate.patrol.detection_rate=0.4")  # long enough that all are detected
SETTINGS = ("infer.num_hypotheses=5", "infer.grid.stride_steps=64", "export.tick_s=30")


def make_logs(folder: Path, num_logs: int) -> list[str]:
    """Simulated missions of half an hour."""
    config = stage_config(SimulateConfig, "simulate", None, [*SIMULATED, f"simulate.num_episodes={num_logs}"], SEED)
    return [str(path) for path in simulate(folder, config, QUIET).outputs]


def timed(logs: list[str], out: Path, engine: str, num_workers: int, checkpoint: str) -> tuple[float, tuple[LogOutcome, ...]]:
    """Seconds that a batch took, and what became of its logs."""
    config = stage_config(RunConfig, None, None, [*SETTINGS, f"infer.checkpoint={checkpoint}"])
    started_s = time.monotonic()
    outcomes = run(logs, str(out), config, QUIET, engine=engine, num_workers=num_workers)
    return time.monotonic() - started_s, outcomes


def hashes(out: Path, name: str) -> dict[str, str]:
    """SHA-256 of the files of that name (or pattern) by mission and name."""
    return {str(path.relative_to(out)): hash_file(path) for path in sorted(out.glob(f"*/{name}"))}


def main() -> int:
    """Measured, printed and published; 1 where the engines differ."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num-logs", type=int, default=100)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--checkpoint", default="none", help="name of a checkpoint; none: the bank alone")
    parser.add_argument("--publish", type=Path, metavar="DOCS", help="write numbers and section below this folder")
    arguments = parser.parse_args()
    num_running = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work)
        logs = make_logs(folder / "logs", arguments.num_logs)
        local_s, local = timed(logs, folder / "local", "local", arguments.workers, arguments.checkpoint)
        ray_s, ray = timed(logs, folder / "ray", "ray", arguments.workers, arguments.checkpoint)
        tables, files = (
            [hashes(folder / engine, name) for engine in ("local", "ray")] for name in ("hypotheses.parquet", "[!.]*")
        )
    is_equal = tables[0] == tables[1] and len(tables[0]) == len(logs) and files[0] == files[1]
    num_same = sum(tables[1].get(name) == digest for name, digest in tables[0].items())
    num_files = sum(files[1].get(name) == digest for name, digest in files[0].items())
    for outcome in (*local, *ray):
        if outcome.message:
            sys.stderr.write(f"{outcome.message}\n")
    row = {
        "num_missions": len(logs), "num_finished_local": done(local), "num_finished_ray": done(ray),
        "num_same_hypotheses": num_same, "num_files": len(files[0]), "num_same_files": num_files,
        "ray_over_local_wall": ray_s / local_s,
    }  # fmt: skip
    facts = publishing.facts_of("batch_engines") | {
        "seed": SEED, "num_windows": num_windows(local), "num_workers": arguments.workers,
        "num_hyperthreads": len(os.sched_getaffinity(0)), "load_at_start": num_running,
        "settings": [*SIMULATED, *SETTINGS, f"infer.checkpoint={arguments.checkpoint}"],
    }  # fmt: skip
    publishing.publish(Measurement("batch_engines", facts, {"batch_engines": [row]}), section, arguments.publish)
    return 0 if is_equal and not exit_code(local) and not exit_code(ray) else 1


def done(outcomes: tuple[LogOutcome, ...]) -> int:
    """Missions that were finished."""
    return sum(outcome.status == "done" for outcome in outcomes)


def num_windows(outcomes: tuple[LogOutcome, ...]) -> int:
    """Windows of all missions together."""
    return sum(stage.summary["num_windows"] for outcome in outcomes for stage in outcome.stages if stage.stage == "infer")


def section(measured: Measurement) -> str:
    """Whether the files are the same, and how long Ray takes."""
    (row,) = measured.rows()
    return (
        f"Of {row['num_missions']} missions {row['num_finished_local']} finish by local workers and {row['num_finished_ray']} "
        f"on Ray; {row['num_same_files']} of {row['num_files']} files have the same bytes. Ray takes "
        f"{row['ray_over_local_wall']:.2f} times as long, its start included."
    )


if __name__ == "__main__":
    sys.exit(main())
