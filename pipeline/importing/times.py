"""Columns of times → int64 nanoseconds (UTC), or a refusal: nothing is taken for what it may not be.

Numbers are seconds, milliseconds, microseconds or nanoseconds since 1970, by their size, which has to say so for all rows
alike. Text is ISO 8601, or has a day, a month and a year in an order that the column itself shows. A time without a zone is
refused unless the column's name, its provider or the user says which.
"""

import zoneinfo
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Final

import numpy as np
import pyarrow as pa

from cadence.arrays import Bools, Int64s
from cadence.errors import InputError, UsageError
from pipeline.importing.moments import ISO, Moment, order_of, read_moment
from pipeline.importing.names import UNITS, unit_of, words_in
from pipeline.importing.numbers import parse_numbers
from pipeline.importing.table_file import TableFile, is_absent, is_text

_FACTORS: Final = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
_FIRST_S, _LAST_S = 1e8, 4.2e9
"""1973 and 2103: as seconds; other units have other sizes, and none of them meet."""
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)
ORDERS: Final = ("day-first", "month-first")


@dataclass(frozen=True)
class Clock:
    """What is told of times.

    form  "s", "ms", "us" or "ns" for numbers; "day-first" or "month-first", or a pattern as of strptime for text; empty: by
          what the column shows
    zone  of times that state none: "UTC", "+02:00", or a name such as "Europe/Paris"; empty: not known
    zero_ns  the moment from which numbers count
    order  of day and month where the provider says it
    """

    form: str = ""
    zone: str = ""
    zero_ns: int | None = None
    order: str = ""

    def __post_init__(self) -> None:
        if self.form and self.form not in (*UNITS["time"], *ORDERS) and "%" not in self.form:
            known = ", ".join((*UNITS["time"], *ORDERS))
            raise UsageError(f"--time {self.form}: not known; give {known}, or a pattern such as '%d/%m/%Y %H:%M:%S'")
        zone_of(self.zone)


@dataclass(frozen=True, eq=False)
class Times:
    """Times [N] of rows, which of them were read, and in words how."""

    time_ns: Int64s
    is_known: Bools
    words: str
    notes: tuple[str, ...] = ()


def zone_of(text: str) -> zoneinfo.ZoneInfo | timedelta | None:
    """A zone by its name or as an offset; None for an empty text; `UsageError` for one that is not known."""
    if not text:
        return None
    if text.upper() in ("UTC", "Z", "GMT"):
        return timedelta(0)
    offset = ISO.offset(text)
    if offset is not None:
        return offset
    try:
        return zoneinfo.ZoneInfo(text)
    except (zoneinfo.ZoneInfoNotFoundError, ValueError, OSError) as error:
        raise UsageError(
            f"--zone {text}: not known; give UTC, an offset such as +02:00, or a name such as Europe/Paris"
        ) from error


def read_times(table: TableFile, column: pa.ChunkedArray, name: str, clock: Clock) -> Times:
    """The times of a column; `InputError` where it is in doubt what they are."""
    if pa.types.is_timestamp(column.type):
        return _stamps(table, column, name, clock)
    if pa.types.is_date(column.type) or pa.types.is_time(column.type):
        raise InputError(
            f"{table.path}: column {name!r} holds {column.type}s only; name one with date and time of day: --column time="
        )
    if not is_text(column):
        return _numbers(table, column, name, clock)
    absent = is_absent(column)
    words = column.combine_chunks().dictionary_encode()
    words = words.chunk(0) if isinstance(words, pa.ChunkedArray) else words
    texts = [text.strip() for text in words.dictionary.to_pylist()]
    place = words.indices.fill_null(0).to_numpy(zero_copy_only=False)
    is_used = np.zeros(len(texts), np.bool_)
    is_used[place[~absent]] = True
    if not is_used.any():
        raise InputError(f"{table.path}: column {name!r} holds no time; name another: --column time=")
    is_plain = [text.replace(".", "", 1).lstrip("+-").isdigit() and not ISO.is_compact(text) for text in texts]
    if "%" not in clock.form and all(plain for plain, used in zip(is_plain, is_used, strict=True) if used):
        return _numbers(table, column, name, clock)
    return _texts(table, name, clock, texts, place, absent, is_used)


def _texts(table: TableFile, name: str, clock: Clock, texts: list[str], place: Int64s, absent: Bools, is_used: Bools) -> Times:
    """Times that are text: each distinct one is read once."""
    chosen = [text for text, used in zip(texts, is_used, strict=True) if used]
    order = clock.form if clock.form in ORDERS else clock.order or order_of(chosen)
    moments = [read_moment(text, order, clock.form) if used else None for text, used in zip(texts, is_used, strict=True)]
    first = {int(number): row for row, number in reversed(list(enumerate(place.tolist())))}
    found = [(number, moment) for number, moment in enumerate(moments) if moment is not None]

    def shown(number: int) -> str:
        return f"{texts[number]!r} in {table.place(first.get(number, 0))}"

    if any(moment.is_doubtful for _, moment in found):
        number = next(number for number, moment in found if moment.is_doubtful)
        raise InputError(
            f"{table.path}: column {name!r}: day and month of {shown(number)} may be either; "
            "give --time day-first or month-first"
        )
    if not any(moment.has_time for _, moment in found):
        example = shown(int(np.flatnonzero(is_used)[0]))
        raise InputError(f"{table.path}: column {name!r} holds no date with a time of day ({example}); {_WAYS}")
    zone, said = _zone(name, clock)
    bare = [(number, moment) for number, moment in found if moment.offset is None]
    if bare and zone is None:
        number = bare[0][0]
        raise InputError(
            f"{table.path}: column {name!r}: {shown(number)} has no time zone; give --zone UTC, or that of its clock "
            "(--zone Europe/Paris, --zone +02:00)"
        )
    value = np.zeros(len(texts) + 1, np.int64)
    is_read = np.zeros(len(texts) + 1, np.bool_)
    num_twice = 0
    for number, moment in found:
        ns = moment.time_ns(zone) if moment.has_time else None
        num_twice += ns is None and moment.has_time
        value[number], is_read[number] = ns or 0, ns is not None
    known = is_read[place] & ~absent
    is_ordered = any(moment.is_ordered for _, moment in found)
    words = clock.form if "%" in clock.form else f"{order} dates" if is_ordered and order else "dates"
    zones = "with their zones" if not bare else f"{said}"
    notes = (f"{num_twice} times that the clock shows twice, or never (a change to or from summer time)",) * (num_twice > 0)
    return Times(value[place], known, f"{words}, {zones}", notes)


def _zone(name: str, clock: Clock) -> tuple[zoneinfo.ZoneInfo | timedelta | None, str]:
    """The zone of times that state none, and how it is known."""
    if clock.zone:
        return zone_of(clock.zone), clock.zone
    if words_in(name) & {"utc", "gmt", "zulu"}:
        return timedelta(0), "UTC by its name"
    return None, ""


_WAYS = "give --column time= and --column date= where they are apart, or --time with a pattern such as '%d/%m/%Y %H:%M:%S'"


def _stamps(table: TableFile, column: pa.ChunkedArray, name: str, clock: Clock) -> Times:
    """Stamps as Parquet has them."""
    absent = column.is_null().to_numpy().astype(np.bool_)
    factor = _FACTORS[column.type.unit]
    whole = column.fill_null(0).cast(pa.int64()).to_numpy() * factor
    if column.type.tz is not None:
        return Times(whole, ~absent, "stamps, UTC")
    zone, said = _zone(name, clock)
    if zone is None:
        raise InputError(
            f"{table.path}: column {name!r} has no time zone; give --zone UTC, or that of its clock (--zone Europe/Paris)"
        )
    unique, place = np.unique(whole, return_inverse=True)
    found = [
        Moment(_EPOCH.replace(tzinfo=None) + timedelta(seconds=ns // 10**9), ns % 10**9).time_ns(zone) for ns in unique.tolist()
    ]
    value = np.array([ns or 0 for ns in found], np.int64)
    is_read = np.array([ns is not None for ns in found], np.bool_)
    num_twice = int((~is_read).sum())
    notes = (f"{num_twice} times that the clock shows twice, or never (a change to or from summer time)",) * (num_twice > 0)
    return Times(value[place], is_read[place] & ~absent, f"stamps, {said}", notes)


def _numbers(table: TableFile, column: pa.ChunkedArray, name: str, clock: Clock) -> Times:
    """Times that are numbers since 1970, or since a moment that is told."""
    whole, part, is_known = parse_numbers(column)
    is_known &= (whole != 0) | (part != 0) | (clock.zero_ns is not None)
    if not is_known.any():
        raise InputError(f"{table.path}: column {name!r} holds no time; name another: --column time=")
    stated = clock.form if clock.form in _FACTORS else unit_of(name, "time")
    if clock.zero_ns is not None:
        if not stated:
            raise InputError(f"{table.path}: column {name!r} does not say its unit; give --time s, ms, us or ns")
        return Times(clock.zero_ns + _ns(whole, part, stated), is_known, f"{stated} after --zero")
    if clock.form not in _FACTORS and words_in(name) & {"gps", "tow", "gpst", "gpstime"}:
        raise InputError(
            f"{table.path}: column {name!r} may count from 1980 (GPS time); give --time s where it counts from 1970, "
            "or --zero 1980-01-06T00:00:00Z --time s (and mind the leap seconds)"
        )
    unit = stated or _unit(table, name, whole, is_known)
    low, high = (limit * 1e9 / _FACTORS[unit] for limit in (_FIRST_S, _LAST_S))
    outside = np.flatnonzero(is_known & ((whole < low) | (whole > high)))
    if len(outside):
        row = int(outside[0])
        raise InputError(
            f"{table.path}: column {name!r}: {whole[row]} in {table.place(row)} is no time of 1973 to 2103 in {unit} since "
            "1970; give its unit (--time ms), or the moment from which it counts (--zero 2026-05-01T12:00:00Z)"
        )
    return Times(_ns(whole, part, unit), is_known, f"{unit} since 1970")


def _unit(table: TableFile, name: str, whole: Int64s, is_known: Bools) -> str:
    """The unit by the sizes of all numbers; `InputError` where they do not agree, or have no such size."""
    fits = {unit: is_known & (whole >= _FIRST_S * 1e9 / f) & (whole <= _LAST_S * 1e9 / f) for unit, f in _FACTORS.items()}
    found = [unit for unit, fit in fits.items() if fit.any()]
    if len(found) == 1:
        return found[0]
    if not found:
        row = int(np.flatnonzero(is_known)[0])
        raise InputError(
            f"{table.path}: column {name!r}: {whole[row]} in {table.place(row)} is no time since 1970 in s, ms, us or ns; "
            "give the moment from which it counts, and its unit: --zero 2026-05-01T12:00:00Z --time s"
        )
    rows = [table.place(int(np.flatnonzero(fits[unit])[0])) for unit in found]
    seen = " and ".join(f"{unit} ({row})" for unit, row in zip(found, rows, strict=True))
    raise InputError(f"{table.path}: column {name!r} mixes {seen} since 1970; correct the table")


def _ns(whole: Int64s, part: np.ndarray, unit: str) -> Int64s:
    """Nanoseconds of whole numbers and what is behind the point, apart: together they would not fit a float."""
    factor = _FACTORS[unit]
    found: Int64s = whole * factor + np.round(part * factor).astype(np.int64)
    return found
