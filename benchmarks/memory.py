"""How much memory does `cadence run` take on real logs?

Every log is run once in a process of its own, all stages, with the shipped checkpoint; the operating system reports the peak
of the resident memory. A process that only imports the pipeline shows what the libraries alone take.

    python -m benchmarks.memory --publish docs
"""

import argparse
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from benchmarks import publishing
from benchmarks.publishing import Measurement

DATA = Path(__file__).resolve().parents[1].parent / "shared" / "data"
LIMIT_GB = 1.5
_UNIT = 1024 if sys.platform.startswith("linux") else 1
_COMMAND = "import sys, cli; sys.exit(cli.main())"
_IMPORTS = "import importlib; from pipeline.batch.engines.local import PRELOADED; [*map(importlib.import_module, PRELOADED)]"


@dataclass(frozen=True)
class Case:
    """A log and the settings it is run with; `limit_gb` is what is claimed, if anything is."""

    name: str
    path: str
    settings: tuple[str, ...] = ()
    limit_gb: float | None = None


CASES = (
    Case(
        "flight, motion capture",
        "flights/cubs2_cub_stabilize.mcap",
        ("extract.thinning.enabled=true", "extract.thinning.mean_gap_s=8"),
        LIMIT_GB,
    ),
    Case("ships, radio reports", "maritime/solent_ais_known.mcap"),
)


@dataclass(frozen=True)
class Peak:
    """Exit code of a child process, and the peak of its resident memory."""

    code: int
    bytes: int


def peak_of(command: list[str]) -> Peak:
    """Run `command` and wait for it. This process must stay small: a child starts with its parent's peak."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, env=environment) as child:
        _, status, usage = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
        return Peak(child.returncode, usage.ru_maxrss * _UNIT)


def peak_of_run(case: Case, log: Path) -> Peak:
    """`cadence run` of one log into a folder that goes away."""
    with tempfile.TemporaryDirectory() as out:
        settings = [word for setting in case.settings for word in ("--set", setting)]
        return peak_of([sys.executable, "-c", _COMMAND, "run", str(log), "--out", out, "--quiet", *settings])


def rows_of() -> list[publishing.Row]:
    """A row a log, after that of a process that only imports the pipeline."""
    libraries = peak_of([sys.executable, "-c", _IMPORTS]).bytes / 1e9
    empty = {"file": None, "size_mb": None, "peak_gb": libraries, "aim_gb": None, "settings": None}
    rows = [{"log": "libraries alone", **empty}]
    for case in CASES:
        log = DATA / case.path
        if not log.is_file():
            sys.stderr.write(f"memory: left out: {log} is absent\n")
            continue
        peak = peak_of_run(case, log)
        if peak.code != 0:
            raise SystemExit(f"memory: cadence run {log} ended with exit code {peak.code}")
        rows.append({
            "log": case.name, "file": log.name, "size_mb": log.stat().st_size / 1e6, "peak_gb": peak.bytes / 1e9,
            "aim_gb": case.limit_gb, "settings": " ".join(case.settings),
        })  # fmt: skip
    return rows


def main() -> int:
    """Measured, printed and published; 1 where a log takes more than it should."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--publish", type=Path, metavar="DOCS", help="write numbers and section below this folder")
    arguments = parser.parse_args()
    rows = rows_of()
    from pipeline.checkpoints import DEFAULT, checkpoint_hash, find_checkpoint  # only now: this process has to be small before

    facts = publishing.facts_of("memory") | {"checkpoint": {DEFAULT: checkpoint_hash(find_checkpoint(DEFAULT))}}
    publishing.publish(Measurement("memory", facts, {"memory": rows}), section, arguments.publish)
    return 0 if all(row["aim_gb"] is None or row["peak_gb"] < row["aim_gb"] for row in rows) else 1


def section(measured: Measurement) -> str:
    """Peaks of all logs."""
    lines = []
    for row in measured.rows():
        size = "–" if row["size_mb"] is None else f"{row['size_mb']:.1f}"
        lines.append([row["log"], size, f"{row['peak_gb']:.2f}"])
    return publishing.table(["`cadence run`", "log, MB", "peak, GB"], lines)


if __name__ == "__main__":
    sys.exit(main())
