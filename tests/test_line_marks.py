"""The lines that count as tested are those that Python itself says it ran."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import line_marks
from line_marks import PROJECT, Marked

SAMPLE = '''"""What the module is."""
from __future__ import annotations
import contextlib
import functools

@functools.cache
def cached(n):
    """What it is for."""
    total = 0
    for i in range(n):
        if i == 1:
            continue
        elif i == 3:
            break
        else:
            total += i
    else:
        total = -1
    while total > 9:
        total -= 1
    return total

class Thing:
    """A class of nothing else."""

class Other(Thing):
    number: int = 3
    @property
    def half(self): return self.number / 2

def fails(value):
    first = 1
    try:
        first = 2
        int(value)
        first = 3
    except ValueError:
        first = 4
    finally:
        first += 1
    with contextlib.suppress(KeyError):
        {}[first]
        first = 5
    match value:
        case "a":
            return [x for x in range(first)]
        case _:
            pass
    return (lambda: first)()

def lazy():
    yield 1
    yield 2

cached(5)
cached(5)
fails("a")
fails("7")
next(lazy())
Other().half
'''


def test_marks_are_the_lines_that_python_traces(monkeypatch):
    marked = Marked(SAMPLE.encode(), "sample.py")
    marks = bytearray(len(marked.lines))
    monkeypatch.setattr(line_marks, "opened", lambda name, count: marks if (name, count) == ("sample.py", len(marks)) else None)
    module: dict = {}
    exec(compile(marked.tree, "sample.py", "exec"), module)
    assert module["__doc__"] == "What the module is." and module["cached"].__doc__ == "What it is for."
    found = {line for lines, mark in zip(marked.lines, marks, strict=True) if mark for line in lines}
    lines = SAMPLE.splitlines()
    assert [lines[line - 1].strip() for line in _traced(SAMPLE) - found] == ["{}[first]", "yield 1"], (
        "left before the run's end"
    )
    assert [lines[line - 1].strip() for line in found - _traced(SAMPLE)] == ['"""What it is for."""'], "no statement"


def _traced(source: str) -> set[int]:
    lines = set()

    def trace(frame, event, _):
        if frame.f_code.co_filename != "traced.py":
            return None
        if event == "line":
            lines.add(frame.f_lineno)
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        exec(compile(source, "traced.py", "exec"), {})
    finally:
        sys.settrace(before)
    return lines


def test_what_a_killed_process_ran_counts(tmp_path):
    folder = str(Path(line_marks.__file__).parent)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((folder, str(PROJECT))), "CADENCE_LINE_MARKS": str(tmp_path)}
    program = "import os, cadence.errors\nif not os.fork(): os._exit(0)\nos.wait()\nos.kill(os.getpid(), 9)"
    for _ in range(2):  # the second takes the code from the cache
        assert subprocess.run([sys.executable, "-c", program], env=environment).returncode == -signal.SIGKILL
    runs = Marked((PROJECT / "cadence/errors.py").read_bytes(), "cadence/errors.py").lines
    marks = (tmp_path / "cadence+errors.py").read_bytes()
    assert len(marks) == len(runs) and 1 in marks
    assert any((tmp_path / "code").iterdir())
