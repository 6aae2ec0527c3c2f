"""The lines that count as tested, where slipcover notes them, are those that Python's own trace sees."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from coverage.parser import PythonParser

pytest.importorskip("slipcover", reason="lines are noted by Python itself from 3.12 on")

PROJECT = Path(__file__).resolve().parents[1]
TRACED = """
import sys
lines = set()
def trace(frame, event, _):
    if frame.f_code.co_filename.endswith("cadence/errors.py"):
        lines.add(frame.f_lineno)
        return trace
sys.settrace(trace)
import cadence.errors
sys.settrace(None)
"""
ENDS = {
    "return": ("", 0),
    "a fork": ("import os\nif not os.fork(): os._exit(0)\nos.wait()", 0),
    "a request": ("import os, signal\nos.kill(os.getpid(), signal.SIGTERM)", -signal.SIGTERM),
}


@pytest.mark.parametrize("end", ENDS)
def test_lines_of_a_process_are_written_however_it_ends(tmp_path, end):
    code, status = ENDS[end]
    path = os.pathsep.join((str(PROJECT / "tests/lines"), str(PROJECT)))
    environment = {**os.environ, "PYTHONPATH": path, "CADENCE_LINES": str(tmp_path)}
    program = f"import cadence.errors\n{code}"
    assert subprocess.run([sys.executable, "-c", program], env=environment, cwd=tmp_path).returncode == status
    parts = [json.loads(part.read_text()) for part in tmp_path.glob("*.json")]
    assert len(parts) == (2 if end == "a fork" else 1)
    assert all(part["cadence/errors.py"] == parts[0]["cadence/errors.py"] for part in parts)
    command = [sys.executable, "-c", TRACED + "print(sorted(lines - {0, None}))"]
    plain = {**os.environ, "PYTHONPATH": str(PROJECT)}
    shown = subprocess.run(command, env=plain, capture_output=True, text=True, check=True)
    traced = json.loads(shown.stdout)
    assert len(traced) > 5
    assert _statements(parts[0]["cadence/errors.py"]) == _statements(traced)


def _statements(lines: list[int]) -> set[int]:
    """The first lines of the statements that the lines are of, as reports have them."""
    parser = PythonParser(filename=str(PROJECT / "cadence/errors.py"))
    parser.parse_source()
    return parser.first_lines(lines) & parser.statements
