"""Python imports this at its start while this folder is on PYTHONPATH: the process notes which lines of the project it runs.

One way for all: pytest, its workers, the commands that tests start, and forks. Before Python 3.12 coverage.py is called at
every line of every library, which took tests up to five times as much processor time; slipcover puts its calls into the
project's own modules as they are imported. What ran is written when the process ends, also where it is a fork or SIGTERM
ends it; of one that is killed nothing is known. A module that runs as `__main__` does not count: nothing imports it.
"""

import atexit
import json
import os
import signal
import sys
import time
from pathlib import Path
from types import FrameType

from slipcover import FileMatcher, ImportManager, Slipcover

PROJECT = Path(__file__).resolve().parents[2]
FOLDER = Path(os.environ["CADENCE_LINES"])
SOURCES = ("cli.py", "cadence", "pipeline", "schemas")

# Calls stay: taking them out again stops at modules that change meanwhile.
_lines = Slipcover(d_miss_threshold=-1, exclude_lines=[])
_end_at_once = os._exit


def _write() -> None:
    if not _lines.code_lines:
        return
    os.chdir(PROJECT)  # names are relative to it, and where the process was may be gone
    ran = {name: file["executed_lines"] for name, file in _lines.get_coverage()["files"].items()}
    part = FOLDER / f"{os.getpid()}-{time.time_ns()}"
    part.write_text(json.dumps(ran), encoding="utf-8")
    os.replace(part, part.with_suffix(".json"))  # whole or not at all, if the process is killed here


def _end_forked(status: int) -> None:
    _write()  # forks end by os._exit, which runs nothing at exit
    _end_at_once(status)


def _end_asked(number: int, frame: FrameType | None) -> None:
    _write()
    signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)


ImportManager(_lines, FileMatcher(sources=[PROJECT / name for name in SOURCES])).__enter__()
atexit.register(_write)
os._exit = _end_forked  # type: ignore[assignment]
if sys.platform != "win32":
    signal.signal(signal.SIGTERM, _end_asked)
