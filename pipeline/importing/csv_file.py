"""CSV as it is found: separators, encodings, lines before the names, rows that are too short; cells stay text."""

import csv
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.csv

from cadence.errors import InputError

_SEPARATORS = (",", ";", "\t", "|")
_HEAD_BYTES = 1 << 16
_MAX_LINES_BEFORE = 50
_MIN_COLUMNS = 3
_MAX_BAD = 0.05
"""Of rows that have another number of cells: with more the table is not what it seems."""


@dataclass(frozen=True)
class CsvFile:
    """A file whose first row stands in line `line`."""

    path: Path
    names: tuple[str, ...]
    separator: str
    encoding: str
    line: int
    bad_lines: list[int] = field(default_factory=list)

    def read(self, names: Sequence[str]) -> dict[str, pa.ChunkedArray]:
        """Columns as text; rows with another number of cells than the names are left out, and refused where they are many."""
        self.bad_lines.clear()
        try:
            with pa.input_stream(str(self.path), compression="detect") as stream:
                table = pyarrow.csv.read_csv(
                    stream,
                    pyarrow.csv.ReadOptions(
                        use_threads=False, skip_rows=self.line - 1, column_names=list(self.names), encoding=self.encoding
                    ),
                    pyarrow.csv.ParseOptions(delimiter=self.separator, newlines_in_values=True, invalid_row_handler=self._skip),
                    pyarrow.csv.ConvertOptions(
                        column_types={name: pa.string() for name in names},
                        include_columns=list(names),
                        strings_can_be_null=False,
                    ),
                )
        except (pa.ArrowInvalid, OSError, UnicodeError) as error:
            raise InputError(f"{self.path}: cannot be read as CSV ({_first_line(error)}); export it again") from error
        num_rows = len(table) + len(self.bad_lines)
        if len(self.bad_lines) > _MAX_BAD * num_rows:
            raise InputError(
                f"{self.path}: {len(self.bad_lines)} of {num_rows} rows have not the {len(self.names)} cells of its line of "
                f"names (the first is line {self.bad_lines[0]}); correct it"
            )
        if not len(table):
            raise InputError(f"{self.path}: has names of columns and no rows; export it again")
        return {name: table[name] for name in names}

    def bad_rows(self) -> tuple[str, ...]:
        """What was left out of it."""
        if not self.bad_lines:
            return ()
        return (f"{len(self.bad_lines)} rows have another number of cells (first: line {self.bad_lines[0]})",)

    def _skip(self, row: Any) -> str:
        self.bad_lines.append(row.number or self.line)  # counted from the first line of the file
        return "skip"


def open_csv(path: Path) -> CsvFile:
    """The separator, the encoding and the line of names of a file; `InputError` where there is no such line."""
    try:
        with pa.input_stream(str(path), compression="detect") as stream:
            head = stream.read(_HEAD_BYTES)
    except (pa.ArrowException, OSError) as error:
        raise InputError(f"{path}: cannot be read ({_first_line(error)}); copy it again") from error
    text, encoding = _decoded(head)
    lines = text.splitlines()[:_MAX_LINES_BEFORE]
    for number, line in enumerate(lines):
        separator = max(_SEPARATORS, key=lambda mark: len(next(csv.reader([line], delimiter=mark), [])))
        cells = [cell.strip() for cell in next(csv.reader([line], delimiter=separator), [])]
        if len(cells) < _MIN_COLUMNS:
            continue
        names = tuple(cell.lstrip("#").strip() for cell in cells)
        if any(_is_number(name) for name in names):
            raise InputError(f"{path}: line {number + 1} should name the columns, but holds {line[:60]!r}; put names in front")
        return CsvFile(path, _unique(names), separator, encoding, number + 2)
    raise InputError(f"{path}: no line of it names three columns or more (time and a position); check that it is a table")


def _decoded(head: bytes) -> tuple[str, str]:
    for mark, encoding in ((b"\xff\xfe", "utf-16"), (b"\xfe\xff", "utf-16"), (b"\xef\xbb\xbf", "utf-8-sig")):
        if head.startswith(mark):
            return head.decode(encoding, "ignore"), encoding if encoding == "utf-16" else "utf8"
    try:
        return head[: head.rfind(b"\n") + 1 or None].decode("utf-8"), "utf8"
    except UnicodeDecodeError:
        return head.decode("cp1252", "replace"), "cp1252"


def _unique(names: Sequence[str]) -> tuple[str, ...]:
    """Names with a number where one stands twice, or has none."""
    found: list[str] = []
    for index, name in enumerate(names):
        plain = name or f"column {index + 1}"
        found.append(plain if plain not in found else f"{plain} ({index + 1})")
    return tuple(found)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return text.lower() not in ("nan", "inf", "infinity")


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
