"""Do local workers and Ray give the same hypotheses, and what does Ray cost?

Simulated logs are run through the local engine and through Ray, each with the same number of workers and the same settings.
Every published file is hashed; the wall time of each engine includes the start of its workers.

    python benchmarks/batch_engines.py --publish docs/benchmarks
"""

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

from pipeline.batch.config import RunConfig
from pipeline.batch.outcome import LogOutcome, exit_code
from pipeline.batch.run import run
from pipeline.config import stage_config
from pipeline.files import hash_file, write_atomic
from pipeline.progress import Progress
from pipeline.provenance import versions
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
    """The table, printed and published; 1 where the engines differ."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num-logs", type=int, default=100)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--checkpoint", default="none", help="name of a checkpoint; none: the bank alone")
    parser.add_argument("--publish", type=Path, help="folder for batch_engines.md")
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
    made_with = ", ".join(f"{name} {number}" for name, number in versions().items())
    text = HEAD.format(
        num_logs=len(logs), workers=arguments.workers, checkpoint=arguments.checkpoint, versions=made_with,
        cpus=len(os.sched_getaffinity(0)), num_running=num_running, seed=SEED, num_windows=num_windows(local),
        settings="`, `".join((*SIMULATED, *SETTINGS)),
    )  # fmt: skip
    for outcome in (*local, *ray):
        if outcome.message:
            sys.stderr.write(f"{outcome.message}\n")
    text += f"| missions that went through, local and Ray | {done(local)} and {done(ray)} of {len(logs)} |\n"
    text += f"| hypotheses.parquet with the same bytes | {num_same} of {len(logs)} |\n"
    text += f"| all files with the same bytes | {num_files} of {len(files[0])} |\n"
    text += f"| wall time of Ray against local workers | {ray_s / local_s:.2f} |\n"
    sys.stdout.write(text)
    if arguments.publish is not None:
        write_atomic(arguments.publish / "batch_engines.md", text)
    return 0 if is_equal and not exit_code(local) and not exit_code(ray) else 1


def done(outcomes: tuple[LogOutcome, ...]) -> int:
    """Missions that were finished."""
    return sum(outcome.status == "done" for outcome in outcomes)


def num_windows(outcomes: tuple[LogOutcome, ...]) -> int:
    """Windows of all missions together."""
    return sum(stage.summary["num_windows"] for outcome in outcomes for stage in outcome.stages if stage.stage == "infer")


HEAD = """# Do local workers and Ray give the same hypotheses, and what does Ray cost?

    python benchmarks/batch_engines.py --num-logs {num_logs} --workers {workers} --checkpoint {checkpoint}

{num_logs} simulated missions of half an hour (seed {seed}, {num_windows} windows) through `cadence run`, once with `--engine
local` and then with `--engine ray` on the same machine: {cpus} hyperthreads, load by other work at the start {num_running:.1f},
{workers} workers each, one thread a worker. Every file of every mission is hashed. The wall times include the start of the
workers, and for Ray that of Ray itself; where other work goes on, their ratio is rough. Settings:
`{settings}`.
Checkpoint: {checkpoint}. Versions: {versions}.

| what | value |
|---|---|
"""


if __name__ == "__main__":
    sys.exit(main())
