"""Tiny batches, run in processes that can be killed: they are forked from one that has imported everything already."""

import contextlib
import multiprocessing
import os
import signal
import subprocess
import sys
from multiprocessing.process import BaseProcess
from pathlib import Path

from logs_fixture import straight_line, write_log

import cli
from pipeline.batch import LogOutcome, LogTask
from pipeline.manifest import hash_file
from pipeline.progress import Progress

SETTINGS = {
    "infer.checkpoint": "none", "infer.num_hypotheses": 2, "infer.grid.stride_steps": 64, "infer.grid.history_steps": 8,
    "infer.grid.horizon_steps": 8, "infer.association.num_particles": 8, "infer.association.num_agents": 1,
}  # fmt: skip
FLAGS = [word for name, value in SETTINGS.items() for word in ("--set", f"{name}={value}")] + ["--quiet"]

_context = multiprocessing.get_context("forkserver")
_context.set_forkserver_preload(["pipeline.run"])


def write_tiny_logs(folder: Path, count: int) -> Path:
    """Logs of different length, named a.mcap, b.mcap, ..."""
    folder.mkdir()
    for i in range(count):
        write_log(folder / f"{chr(97 + i)}.mcap", straight_line(6 + i))
    return folder


def run_command(*arguments: object) -> None:
    """`cadence run` with tiny settings; leaves with its exit code."""
    raise SystemExit(cli.main(["run", *map(str, arguments), *FLAGS]))


def start(*arguments: object) -> BaseProcess:
    """`cadence run` in a process of its own; without `--workers` it has no others."""
    process = _context.Process(target=run_command, args=arguments if "--workers" in arguments else (*arguments, "--workers", 0))
    process.start()
    return process


MARK = "CADENCE_TEST_RUN"
"""Environment variable by which the processes of a command are found, whoever their parent is by now."""


def start_command(mark: str, *arguments: object) -> subprocess.Popen[str]:
    """`cadence run` with tiny settings from a shell of its own: Ctrl-C there reaches every process of it."""
    words = [sys.executable, str(Path(cli.__file__)), "run", *map(str, arguments), *FLAGS]
    environment = {**os.environ, MARK: mark}
    return subprocess.Popen(
        words, env=environment, stderr=subprocess.PIPE, text=True, start_new_session=True, preexec_fn=_heed_interrupts
    )


def _heed_interrupts() -> None:
    """What a shell starts in the background ignores Ctrl-C, and hands that down; a command from a terminal does not."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def processes_of(mark: str) -> list[str]:
    """What still runs of a command, and is no zombie."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if f"{MARK}={mark}".encode() in (process / "environ").read_bytes().split(b"\0"):
                found.append((process / "cmdline").read_text().replace("\0", " "))
    return found


def results_of(out: Path) -> dict[str, str]:
    """SHA-256 of every file below `out`, hidden ones too, but for batch.json, which holds times."""
    return {
        str(path.relative_to(out)): hash_file(path) for path in out.rglob("*") if path.is_file() and path.name != "batch.json"
    }


def hidden_in(out: Path) -> list[str]:
    """What begins with a dot, at any depth."""
    return sorted(str(path.relative_to(out)) for path in out.rglob(".*"))


def outcome_or_death(task: LogTask, progress: Progress) -> LogOutcome:
    """Stands in for `run_task`: the log's name says what becomes of the worker."""
    progress.note(f"at work as {os.getpid()}")
    if task.parts[0] == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if task.parts[0] == "exits":
        os._exit(9)
    return LogOutcome(task, message="" if task.parts[0] != "bad" else "bad: no", exit_code=3 * (task.parts[0] == "bad"))
