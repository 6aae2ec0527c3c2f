"""Columns of numbers, which tables also write as text: with a decimal comma, a hemisphere, in degrees, minutes and seconds."""

import re
from decimal import Decimal, InvalidOperation

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cadence.arrays import Bools, Float64s, Int64s
from pipeline.importing.table_file import is_absent, is_text

_LIMIT = 9.2e18
_HEMISPHERE = re.compile(r"([NSEWnsew])?\s*([-+]?\d+(?:\.\d*)?)\s*°?\s*([NSEWnsew])?")
_SEXAGESIMAL = re.compile(
    r"([NSEWnsew])?\s*(\d{1,3})\s*[°d: ]\s*(\d{1,2}(?:\.\d*)?)"
    r"\s*(?:['′m: ]\s*(?:(\d{1,2}(?:\.\d*)?)\s*(?:\"|″|''|s)?)?)?\s*([NSEWnsew])?"
)


def read_numbers(column: pa.ChunkedArray) -> tuple[Float64s, Bools]:
    """The numbers [N], NaN where a cell holds none, and which cells hold something that is no number."""
    if not is_text(column):
        if not (pa.types.is_integer(column.type) or pa.types.is_floating(column.type) or pa.types.is_decimal(column.type)):
            return np.full(len(column), np.nan), np.ones(len(column), np.bool_)
        return column.cast(pa.float64(), safe=False).to_numpy().astype(np.float64), np.zeros(len(column), np.bool_)
    absent = is_absent(column)
    try:
        filled = pc.if_else(pa.array(absent), "nan", pc.utf8_trim_whitespace(column))
        return pc.cast(filled, pa.float64()).to_numpy().astype(np.float64), np.zeros(len(column), np.bool_)
    except pa.ArrowInvalid:  # some are written otherwise
        words = column.combine_chunks().dictionary_encode()
        words = words.chunk(0) if isinstance(words, pa.ChunkedArray) else words
        found = np.array([_number(text.strip()) for text in words.dictionary.to_pylist()], np.float64)
        values = np.where(absent, np.nan, found[words.indices.to_numpy(zero_copy_only=False)])
        return values, np.isnan(values) & ~absent


def parse_numbers(column: pa.ChunkedArray) -> tuple[Int64s, Float64s, Bools]:
    """Whole numbers [N] and what is behind the point, apart, and which cells hold a number that fits."""
    if not is_text(column) and pa.types.is_integer(column.type):
        known = ~column.is_null().to_numpy().astype(np.bool_)
        return column.fill_null(0).cast(pa.int64(), safe=False).to_numpy(), np.zeros(len(column)), known
    if not is_text(column):
        value, is_bad = read_numbers(column)
        known = np.isfinite(value) & ~is_bad & (np.abs(value) < _LIMIT)
        value = np.where(known, value, 0.0)
        whole = np.floor(value)
        return whole.astype(np.int64), value - whole, known
    absent = is_absent(column)
    words = column.combine_chunks().dictionary_encode()
    words = words.chunk(0) if isinstance(words, pa.ChunkedArray) else words
    parts = [_exact(text.strip()) for text in words.dictionary.to_pylist()]
    place = words.indices.fill_null(0).to_numpy(zero_copy_only=False)
    whole = np.array([int(part[0]) for part in parts], np.int64)[place]
    rest, is_number = np.array([part[1] for part in parts])[place], np.array([part[2] for part in parts], np.bool_)[place]
    return whole, rest, is_number & ~absent


def _exact(text: str) -> tuple[int, float, bool]:
    try:
        value = Decimal(text)
        if not value.is_finite() or abs(value) >= Decimal(_LIMIT):
            return 0, 0.0, False
    except InvalidOperation:
        return 0, 0.0, False
    whole = int(value.to_integral_value("ROUND_FLOOR"))
    return whole, float(value - whole), True


def _number(text: str) -> float:
    """A number as text in any of the ways; NaN for none."""
    plain = text.replace(",", ".", 1) if "." not in text else text
    try:
        return float(plain)
    except ValueError:
        pass
    match = _HEMISPHERE.fullmatch(plain)
    if match is not None and (match[1] is None) != (match[3] is None):
        return float(match[2]) * _sign(match[1] or match[3])
    match = _SEXAGESIMAL.fullmatch(plain)
    if match is None or (match[1] is None) == (match[5] is None):
        return float("nan")
    degrees, minutes, seconds = float(match[2]), float(match[3]), float(match[4] or 0)
    if minutes >= 60 or seconds >= 60:
        return float("nan")
    return (degrees + minutes / 60 + seconds / 3600) * _sign(match[1] or match[5])


def _sign(letter: str) -> float:
    return -1.0 if letter.upper() in "SW" else 1.0
