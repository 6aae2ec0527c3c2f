"""What does `cadence run` cost, beside an earlier version of the same program?

Every log is run by both versions, one after the other on the same machine, all stages in one thread, and then once more with
nothing left to do. What counts is processor time as the operating system tells it, which other work on the machine lengthens
for both alike.

    git worktree add ../before b145a92; python -m benchmarks.run_cost --before ../before --publish docs
"""

import argparse
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from benchmarks import publishing
from benchmarks.publishing import Measurement, Row

HERE = Path(__file__).resolve().parents[1]
DATA = HERE.parent / "shared" / "data"
_THINNED = ("extract.thinning.enabled=true", "extract.thinning.mean_gap_s=8")
_COMMAND = "import sys, cli; sys.exit(cli.main())"


@dataclass(frozen=True)
class Case:
    """A log (`path` None: that of `make demo`), the share of the time before that is asked, and the settings it is run with."""

    path: str | None
    aim: float
    settings: tuple[str, ...] = ()


CASES = {
    "demo": Case(None, 0.25),
    "flight": Case(
        "flights/cubs2_cub_stabilize.mcap", 0.25, ("extract.thinning.enabled=true", "extract.thinning.mean_gap_s=8")
    ),
    "ships": Case("maritime/solent_ais_known.mcap", 0.2),
}


def cpu_s(code: Path, words: list[str]) -> float:
    """Processor seconds of a command of the version whose source lies at `code`; `SystemExit` where it fails."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(code)}
    with subprocess.Popen(
        [sys.executable, "-c", _COMMAND, *words], stdout=subprocess.DEVNULL, env=environment, cwd=code
    ) as child:
        _, status, usage = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        raise SystemExit(f"run_cost: cadence {' '.join(words)} of {code} ended with exit code {child.returncode}")
    return usage.ru_utime + usage.ru_stime


def row_of(name: str, case: Case, before: Path, folder: Path) -> Row:
    """Both versions on one log."""
    if case.path is None:
        cpu_s(HERE, ["simulate", "--out", str(folder / "logs"), "--seed", "13", "--quiet"])
        (log,) = (folder / "logs").glob("*.mcap")
    else:
        log = DATA / case.path
    row: Row = {"log": name, "aim": case.aim}
    for version, code in (("before", before), ("now", HERE)):
        out = folder / f"{name}-{version}"
        words = ["run", str(log), "--out", str(out), "--quiet", *(w for s in case.settings for w in ("--set", s))]
        row[f"{version}_s"], row[f"{version}_again_s"] = cpu_s(code, words), cpu_s(code, words)
        (side,) = out.glob("*/*.cadence.mcap")
        row[f"{version}_mb"] = side.stat().st_size / 1e6
    return row


def _commit(code: Path) -> str:
    """The commit of the version whose source lies at `code`."""
    command = ["git", "-C", str(code), "rev-parse", "--short", "HEAD"]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def section(measured: Measurement) -> str:
    """A line a log."""
    heads = [
        "`cadence run`",
        "before, CPU-s",
        "now",
        "share (asked)",
        "again, before, CPU-s",
        "now",
        "side file before, MB",
        "now",
    ]
    lines = []
    for row in measured.rows():
        share = f"{row['now_s'] / row['before_s']:.2f} ({row['aim']:g})"
        again = [f"{row[f'{version}_again_s']:.1f}" for version in ("before", "now")]
        sizes = [f"{row[f'{version}_mb']:.2f}" for version in ("before", "now")]
        lines.append([row["log"], f"{row['before_s']:.0f}", f"{row['now_s']:.0f}", share, *again, *sizes])
    return publishing.table(heads, lines)


def main() -> int:
    """Measure, print and publish."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--before", type=Path, required=True, metavar="FOLDER", help="source of the earlier version")
    parser.add_argument("--logs", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--publish", type=Path, metavar="DOCS", help="write numbers and section below this folder")
    arguments = parser.parse_args()
    before = arguments.before.resolve()
    with tempfile.TemporaryDirectory() as folder:
        found = {"run_cost": [row_of(name, CASES[name], before, Path(folder)) for name in arguments.logs]}
    facts = publishing.facts_of("run_cost", ["--before", "../before", "--logs", *arguments.logs]) | {"before": _commit(before)}
    publishing.publish(Measurement("run_cost", facts, found), section, arguments.publish)
    return 0


if __name__ == "__main__":
    sys.exit(main())
