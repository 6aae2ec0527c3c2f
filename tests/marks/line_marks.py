"""Notes which lines of the project tests run, in every process of theirs, while this folder is on PYTHONPATH.

Tracing, which coverage.py does before Python 3.12, is asked at every line of every library too: tests took up to five times
as much processor time. Here each run of statements of the project's own files sets a byte of its own when its last statement
begins. The bytes lie in files that all processes map: nothing is to be saved at their end, and what is killed counts.

A line may be missing, never one too many: of a run that is left early (in `try`, each statement is a run of its own), and
`except` or `case` that was asked and did not fit. `report.py` makes of the bytes what coverage.py would have written.
"""

import ast
import hashlib
import marshal
import mmap
import os
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import CodeType

PROJECT = Path(__file__).resolve().parents[2]
SOURCES = ("cli.py", "cadence", "pipeline", "schemas")
MARKS = Path(os.environ.get("CADENCE_LINE_MARKS", PROJECT / "out" / "line_marks"))
STEADY = (
    *(ast.Expr, ast.Assign, ast.AugAssign, ast.AnnAssign, ast.Delete, ast.Assert, ast.Pass),
    *(ast.Import, ast.ImportFrom, ast.Global, ast.Nonlocal),
)
"""Statements that the next one follows; all others branch, repeat or leave."""


class Marked:
    """A module's syntax tree with marks; `lines[i]` are those that mark i stands for."""

    def __init__(self, source: bytes, name: str) -> None:
        self.tree = ast.parse(source)
        self.lines: list[list[int]] = []
        for node in ast.walk(self.tree):
            for field in ("body", "orelse", "finalbody"):
                statements = getattr(node, field, None)
                if isinstance(statements, list) and statements:
                    setattr(node, field, self._with_marks(node, field, statements))
        if self.lines:
            opening = f"_marks_ = __import__('line_marks').opened({name!r}, {len(self.lines)})"
            self.tree.body[_num_first(self.tree.body) : 0] = ast.parse(opening).body

    def _with_marks(self, node: ast.AST, field: str, statements: list[ast.stmt]) -> list[ast.stmt]:
        """The statements, with a mark before the last of each run."""
        is_alone = isinstance(node, ast.Try) and field == "body"
        lines = _head(node)
        marked: list[ast.stmt] = []
        for place, statement in enumerate(statements):
            lines += [statement.lineno, *(line.lineno for line in getattr(statement, "decorator_list", ()))]
            mark = []
            if is_alone or place == len(statements) - 1 or not isinstance(statement, STEADY):
                mark = self._mark(lines, statement)
                lines = []
            marked += [statement, *mark] if place < _num_first(statements) else [*mark, statement]
        return marked

    def _mark(self, lines: list[int], place: ast.stmt) -> list[ast.stmt]:
        mark = ast.parse(f"_marks_[{len(self.lines)}] = 1").body
        self.lines.append(lines)
        for node in ast.walk(mark[0]):
            ast.copy_location(node, place)
        return mark


def _head(node: ast.AST) -> list[int]:
    """The line of `except` or `case`, which counts with what follows it."""
    if isinstance(node, ast.ExceptHandler):
        return [node.lineno]
    return [node.pattern.lineno] if isinstance(node, ast.match_case) else []


def _num_first(statements: list[ast.stmt]) -> int:
    """How many must stay first: a docstring, imports from the future."""
    has_docstring = isinstance(statements[0], ast.Expr) and isinstance(statements[0].value, ast.Constant)
    return has_docstring + sum(isinstance(s, ast.ImportFrom) and s.module == "__future__" for s in statements)


def opened(name: str, count: int) -> mmap.mmap:
    """The bytes of a module, the same for all processes."""
    file = os.open(file_of(name), os.O_RDWR | os.O_CREAT)
    try:
        os.ftruncate(file, count)
        return mmap.mmap(file, count)
    finally:
        os.close(file)


def file_of(name: str) -> Path:
    """Where the bytes of a module lie."""
    return MARKS / name.replace("/", "+")


def install() -> None:
    """From now on the project's modules are imported with marks."""
    cache = MARKS / "code"
    cache.mkdir(parents=True, exist_ok=True)
    without_marks = SourceFileLoader.get_code

    def get_code(self: SourceFileLoader, fullname: str) -> CodeType | None:
        path = Path(self.path)
        name = path.relative_to(PROJECT).as_posix() if path.is_relative_to(PROJECT) else ""
        return _code(path, name, cache) if name.split("/")[0] in SOURCES else without_marks(self, fullname)

    SourceFileLoader.get_code = get_code  # type: ignore[method-assign]


def _code(path: Path, name: str, cache: Path) -> CodeType:
    """The module with marks, compiled once for all processes."""
    source = path.read_bytes()
    kept = cache / hashlib.sha256(name.encode() + source).hexdigest()
    if kept.exists():
        return marshal.loads(kept.read_bytes())
    code = compile(Marked(source, name).tree, path, "exec", dont_inherit=True)
    part = kept.with_name(f"{kept.name}.{os.getpid()}")
    part.write_bytes(marshal.dumps(code))
    part.replace(kept)
    return code
