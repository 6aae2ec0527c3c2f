"""A table in a file: the names of its columns, and the columns themselves, as text or in the types that the file states."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa

from cadence.arrays import Bools
from cadence.errors import InputError
from pipeline.importing.csv_file import open_csv
from pipeline.importing.geojson_file import read_features
from pipeline.importing.parquet_file import open_parquet
from pipeline.logs.foreign import HEAD_BYTES, kind_of

NO_VALUES = ("", "na", "n/a", "nan", "null", "none", "nil", "-", "--", "#n/a", "<na>", "nat", "\\n")
"""How tables say that a cell holds nothing, in small letters."""

_PACKED = (".gz", ".zst", ".bz2")
_WIDE = (b"\xff\xfe", b"\xfe\xff")

Columns = dict[str, pa.ChunkedArray]


@dataclass(frozen=True)
class TableFile:
    """A table whose columns are read when they are asked for.

    kind      CSV, Parquet or GeoJSON
    read      the columns of some names; rows that cannot be read are left out
    bad_rows  what was left out, one line a reason; filled by `read`
    line      in which line of the file row 0 stands; None: rows are counted
    """

    path: Path
    kind: str
    names: tuple[str, ...]
    read: Callable[[Sequence[str]], Columns]
    bad_rows: Callable[[], tuple[str, ...]]
    line: int | None = None

    def place(self, row: int) -> str:
        """Where a row stands, for people."""
        return f"row {row + 1}" if self.line is None else f"line {self.line + row}"


def open_table(path: Path) -> TableFile:
    """The table at `path`, by its content; `InputError` where it is none, with the way on."""
    try:
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path and its permissions") from error
    if not head:
        raise InputError(f"{path}: is empty; export the table again")
    if head.startswith(b"\x89MCAP0"):
        raise InputError(f"{path}: is a log already; `cadence run {path} --out results` reads it")
    if head.startswith(b"PAR1"):
        names, read_columns = open_parquet(path)
        return TableFile(path, "Parquet", names, read_columns, tuple)
    if head.lstrip(b"\xef\xbb\xbf\x1e \t\r\n").startswith((b"{", b"[")):
        columns, notes = read_features(path)
        return TableFile(path, "GeoJSON", tuple(columns), lambda names: {name: columns[name] for name in names}, lambda: notes)
    if not (path.suffix in _PACKED or head.startswith(_WIDE) or all(byte >= 32 or byte in b"\t\r\n" for byte in head)):
        raise InputError(f"{path}: is no table (CSV, Parquet, GeoJSON) but {kind_of(path, head)}")
    found = open_csv(path)
    return TableFile(path, "CSV", found.names, found.read, found.bad_rows, found.line)


def is_absent(column: pa.ChunkedArray) -> Bools:
    """Which cells [N] hold nothing."""
    absent: Bools = column.is_null().to_numpy().astype(np.bool_)
    if not is_text(column):
        return absent
    words = column.combine_chunks().dictionary_encode() if isinstance(column, pa.ChunkedArray) else column.dictionary_encode()
    words = words.chunk(0) if isinstance(words, pa.ChunkedArray) else words
    empty = np.array([word.strip().lower() in NO_VALUES for word in words.dictionary.to_pylist()] + [True], np.bool_)
    found: Bools = empty[words.indices.fill_null(len(empty) - 1).to_numpy(zero_copy_only=False)]
    return found


def is_text(column: pa.ChunkedArray) -> bool:
    """Whether the cells are text."""
    return bool(pa.types.is_string(column.type) or pa.types.is_large_string(column.type))
