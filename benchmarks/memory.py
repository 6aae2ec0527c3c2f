"""How much memory does `cadence run` take on real logs?

Every log is run once in a process of its own, all stages, with the shipped checkpoint; the operating system reports the peak
of the resident memory. A process that only imports the pipeline shows what the libraries alone take.

    python benchmarks/memory.py --publish docs/benchmarks
"""

import argparse
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

DATA = Path(__file__).resolve().parents[1].parent / "shared" / "data"
LIMIT_GB = 1.5
_UNIT = 1024 if sys.platform.startswith("linux") else 1
_COMMAND = "import sys, cli; sys.exit(cli.main())"
_IMPORTS = "import pipeline.batch.run"


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


def rows() -> tuple[list[str], bool]:
    """Lines of the table, and whether every claim holds."""
    libraries = peak_of([sys.executable, "-c", _IMPORTS])
    lines, holds = [f"| libraries alone | - | - | {libraries.bytes / 1e9:.2f} | - |"], True
    for case in CASES:
        log = DATA / case.path
        if not log.is_file():
            sys.stderr.write(f"memory: left out: {log} is absent\n")
            continue
        peak = peak_of_run(case, log)
        if peak.code != 0:
            raise SystemExit(f"memory: cadence run {log} ended with exit code {peak.code}")
        size = log.stat().st_size
        claim = "-" if case.limit_gb is None else f"under {case.limit_gb:g}: " + verdict(peak, case.limit_gb)
        holds = holds and (case.limit_gb is None or peak.bytes < case.limit_gb * 1e9)
        lines.append(f"| {case.name} | `{log.name}` | {size / 1e6:.1f} | {peak.bytes / 1e9:.2f} | {claim} |")
    return lines, holds


def verdict(peak: Peak, limit_gb: float) -> str:
    """Whether the claim holds, in a word."""
    return "holds" if peak.bytes < limit_gb * 1e9 else "does not hold"


def main() -> int:
    """The table, printed and published; 1 where a claim does not hold."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--publish", type=Path, help="folder for memory.md")
    arguments = parser.parse_args()
    lines, holds = rows()
    # only now: these bring torch with them, and this process has to be small while children start
    from pipeline.checkpoints import DEFAULT, checkpoint_hash, find_checkpoint
    from pipeline.files import write_atomic
    from pipeline.provenance import versions

    made_with = ", ".join(f"{name} {number}" for name, number in versions().items())
    text = HEAD.format(checkpoint=f"{DEFAULT}, {checkpoint_hash(find_checkpoint(DEFAULT))}", versions=made_with)
    text += "".join(line + "\n" for line in lines)
    text += "".join(f"\n`{case.path}` was run with `{'`, `'.join(case.settings)}`.\n" for case in CASES if case.settings)
    sys.stdout.write(text)
    if arguments.publish is not None:
        write_atomic(arguments.publish / "memory.md", text)
    return 0 if holds else 1


HEAD = """# How much memory does `cadence run` take?

    python benchmarks/memory.py

Peak of the resident memory of `cadence run` (all stages: ingest, extract, infer, export, report), each log once in a process of
its own, as the operating system counts it (ru_maxrss); one thread, no GPU. Settings are the defaults but for those named below.
The first row is a process that only imports the pipeline. GB are 10^9 bytes, MB 10^6.

Checkpoint: {checkpoint}. Versions: {versions}.

| log | file | size of the log, MB | peak, GB | claim, GB |
|---|---|---|---|---|
"""


if __name__ == "__main__":
    sys.exit(main())
