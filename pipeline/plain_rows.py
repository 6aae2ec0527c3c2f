"""Rows of results as CSV, and as JSON that every reader takes."""

import csv
import dataclasses
import io
import math
from collections.abc import Iterable
from typing import Any


def rows_as_csv(kind: type[Any], rows: Iterable[Any]) -> str:
    """Instances of the dataclass `kind`, a line each under the names of its fields; None is an empty cell."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([field.name for field in dataclasses.fields(kind)])
    for row in rows:
        writer.writerow(["" if value is None else value for value in dataclasses.astuple(row)])
    return text.getvalue()


def without_nan(value: Any) -> Any:
    """The same JSON-able value with null for what is not a finite number."""
    if isinstance(value, dict):
        return {key: without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
