"""How much memory do many agents take: ten agents, thirty hypotheses, a hundred windows?

A log of ten simulated smugglers is written once. `cadence run` takes it in processes of their own, on two threads, once with
the bank alone and once with the network; the operating system reports the peak of the resident memory.

    python -m benchmarks.many_agents --publish docs
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from benchmarks import publishing
from benchmarks.publishing import Measurement

LIMIT_GB = 2.0
NUM_AGENTS, NUM_HYPOTHESES, NUM_WINDOWS = 10, 30, 100
NUM_THREADS = 2
STEP_S, STRIDE_STEPS = 10.0, 7
_UNIT = 1024 if sys.platform.startswith("linux") else 1
_COMMAND = "import sys, cli; sys.exit(cli.main())"
PRESETS = ("none", "general")


@dataclass(frozen=True)
class Peak:
    """What one run took."""

    preset: str
    num_windows: int
    num_agents: int
    num_tracks: int
    bytes: int


def simulated(folder: Path) -> Path:
    """A log of ten agents; `cadence simulate` in a process of its own, as a child starts with its parent's peak."""
    duration_s = STEP_S * STRIDE_STEPS * NUM_WINDOWS
    settings = {
        "num_agents": NUM_AGENTS, "duration_s": duration_s, "step_s": STEP_S, "detection_rate": 0.3, "num_boats": 6,
        "num_masts": 6,
    }  # fmt: skip
    words = [word for key, value in settings.items() for word in ("--set", f"simulate.patrol.{key}={value}")]
    _run(["simulate", "--out", str(folder), "--seed", "1", "--quiet", *words])
    return next(folder.glob("*.mcap"))


def peak_of(log: Path, preset: str) -> Peak:
    """`cadence run` of the log into a folder that goes away."""
    with tempfile.TemporaryDirectory() as out:
        settings = {
            "infer.checkpoint": preset, "infer.num_hypotheses": NUM_HYPOTHESES, "infer.grid.step_s": STEP_S,
            "infer.grid.stride_steps": STRIDE_STEPS,
        }  # fmt: skip
        words = [word for key, value in settings.items() for word in ("--set", f"{key}={value}")]
        usage = _run(["run", str(log), "--out", out, "--quiet", *words])
        summary = json.loads((Path(out) / log.stem / "infer.manifest.json").read_text())["summary"]
    counts = (summary["num_windows"], summary["num_agents"], summary["num_tracks"])
    return Peak(preset, *counts, usage)


def _run(words: list[str]) -> int:
    """Peak of the resident memory of one call of the command line, in bytes."""
    environment = {**os.environ, "OMP_NUM_THREADS": str(NUM_THREADS)}
    command = [sys.executable, "-c", _COMMAND, *words]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, env=environment) as child:
        _, status, usage = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode != 0:
        raise SystemExit(f"many_agents: cadence {words[0]} ended with exit code {child.returncode}")
    return usage.ru_maxrss * _UNIT


def main() -> int:
    """Measured, printed and published; 1 where the claim does not hold."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--presets", nargs="+", default=list(PRESETS), help="checkpoints; none: the bank alone")
    parser.add_argument("--publish", type=Path, metavar="DOCS", help="write numbers and section below this folder")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        log = simulated(Path(folder))
        peaks = [peak_of(log, preset) for preset in arguments.presets]
    holds = all(peak.bytes < LIMIT_GB * 1e9 and peak.num_windows >= NUM_WINDOWS for peak in peaks)
    rows = [
        {
            "checkpoint": "bank alone" if peak.preset == "none" else peak.preset, "num_agents": peak.num_agents,
            "num_windows": peak.num_windows, "num_tracks": peak.num_tracks, "peak_gb": peak.bytes / 1e9,
        }
        for peak in peaks
    ]  # fmt: skip
    facts = publishing.facts_of("many_agents")
    facts |= {"num_hypotheses": NUM_HYPOTHESES, "num_threads": NUM_THREADS, "aim_gb": LIMIT_GB}
    publishing.publish(Measurement("many_agents", facts, {"many_agents": rows}), section, arguments.publish)
    return 0 if holds else 1


def section(measured: Measurement) -> str:
    """Peaks of all checkpoints."""
    rows = measured.rows()
    peaks = ", ".join(f"{row['peak_gb']:.2f} GB ({row['checkpoint']})" for row in rows)
    first, num_hypotheses = rows[0], measured.facts["num_hypotheses"]
    return f"{first['num_agents']} agents, {num_hypotheses} hypotheses, {first['num_windows']} windows: {peaks}."


if __name__ == "__main__":
    sys.exit(main())
