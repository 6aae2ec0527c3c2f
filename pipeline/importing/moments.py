"""Dates with a time of day, as text."""

import re
import zoneinfo
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Final

DAY_FIRST: Final = "day-first"
MONTH_FIRST: Final = "month-first"
_CLOCK = r"(?:(?:[T ]\s*|,\s*|:)(\d{1,2}):(\d{2})(?::(\d{2})(?:[.,](\d{1,9})\d*)?)?\s*([AaPp][Mm])?)?"
_ZONE = r"\s*(Z|z|UTC|GMT|[+-]\d{2}(?::?\d{2})?)?(?: UTC)?"
_YEAR_FIRST = re.compile(r"(\d{4})[-/.](\d{1,2})[-/.](\d{1,2})" + _CLOCK + _ZONE)
_YEAR_LAST = re.compile(r"(\d{1,2})[-/.](\d{1,2})[-/.](\d{4})" + _CLOCK + _ZONE)
_NAMED = re.compile(r"(\d{1,2})[- ]([A-Za-z]{3})[a-z]*[- ,]+(\d{4})" + _CLOCK + _ZONE)
_COMPACT = re.compile(r"((?:19|20)\d{2})(\d{2})(\d{2})[T ]?(\d{2})(\d{2})(\d{2})(?:\.(\d{1,9}))?\s*(Z|z|UTC|[+-]\d{2}:?\d{2})?")
_OFFSET = re.compile(r"([+-])(\d{2})(?::?(\d{2}))?")
_MONTHS: Final = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_EPOCH: Final = datetime(1970, 1, 1)


@dataclass(frozen=True)
class Moment:
    """A date and a time of day on some clock.

    local         without a zone, whole seconds
    nanosecond    behind them
    offset        of the clock from UTC; None where the text does not state it
    is_ordered    whether the order of day and month had to be known
    is_doubtful   whether it is not known
    """

    local: datetime
    nanosecond: int = 0
    offset: timedelta | None = None
    has_time: bool = True
    is_ordered: bool = False
    is_doubtful: bool = False

    def time_ns(self, zone: zoneinfo.ZoneInfo | timedelta | None) -> int | None:
        """Nanoseconds since 1970, UTC; None where a clock of that zone shows this time twice, or never."""
        offset = self.offset if self.offset is not None else zone
        if isinstance(offset, zoneinfo.ZoneInfo):
            early, late = (self.local.replace(tzinfo=offset, fold=fold).utcoffset() for fold in (0, 1))
            if early != late:
                return None
            offset = early
        whole = self.local - _EPOCH - (offset or timedelta(0))
        return (whole.days * 86400 + whole.seconds) * 10**9 + self.nanosecond


class ISO:
    """What is read of ISO 8601 apart from dates."""

    @staticmethod
    def offset(text: str) -> timedelta | None:
        """An offset such as +02:00, Z or UTC; None for what is none."""
        if text.upper() in ("Z", "UTC", "GMT"):
            return timedelta(0)
        match = _OFFSET.fullmatch(text)
        if match is None:
            return None
        size = timedelta(hours=int(match[2]), minutes=int(match[3] or 0))
        return -size if match[1] == "-" else size

    @staticmethod
    def is_compact(text: str) -> bool:
        """Whether a text of digits is a date: 20260501T120000."""
        match = _COMPACT.fullmatch(text)
        return match is not None and 1 <= int(match[2]) <= 12 and 1 <= int(match[3]) <= 31 and int(match[4]) < 24


def order_of(texts: Sequence[str]) -> str:
    """The order of day and month that dates with the year last show, by a number over 12; empty where none shows it."""
    pairs = [(int(match[1]), int(match[2])) for text in texts if (match := _YEAR_LAST.fullmatch(text))]
    is_day_first, is_month_first = any(first > 12 for first, _ in pairs), any(second > 12 for _, second in pairs)
    if is_day_first == is_month_first:
        return ""
    return DAY_FIRST if is_day_first else MONTH_FIRST


def read_moment(text: str, order: str, pattern: str = "") -> Moment | None:
    """The moment that a text states; None where it states none.

    `order` is that of day and month in dates with the year last; `pattern` is one of strptime, by which the text is read.
    """
    try:
        if "%" in pattern:
            return _by_pattern(text, pattern)
        if match := _YEAR_FIRST.fullmatch(text):
            return _moment((match[1], match[2], match[3]), match.groups()[3:])
        if match := _NAMED.fullmatch(text):
            month = match[2].lower()
            return (
                _moment((match[3], str(_MONTHS.index(month) + 1), match[1]), match.groups()[3:]) if month in _MONTHS else None
            )
        if match := _YEAR_LAST.fullmatch(text):
            day, month = (match[2], match[1]) if order == MONTH_FIRST else (match[1], match[2])
            is_alike = match[1] == match[2]
            if not order and not is_alike and max(int(match[1]), int(match[2])) <= 12:
                return Moment(_EPOCH, is_ordered=True, is_doubtful=True)
            return _moment((match[3], month, day), match.groups()[3:], is_ordered=True)
        if ISO.is_compact(text) and (match := _COMPACT.fullmatch(text)):
            return _moment((match[1], match[2], match[3]), (match[4], match[5], match[6], match[7], None, match[8]))
    except (ValueError, OverflowError):  # a day that no month has
        return None
    return None


def _moment(date: Sequence[str], rest: Sequence[str | None], is_ordered: bool = False) -> Moment:
    year, month, day = map(int, date)
    hour, minute, second, fraction, half, zone = rest
    number = int(hour or 0)
    if half is not None:
        if not 1 <= number <= 12:
            raise ValueError("an hour of 12 is from 1 to 12")
        number = number % 12 + 12 * (half.lower() == "pm")
    leap = int(second or 0) == 60
    local = datetime(year, month, day, number, int(minute or 0), 59 if leap else int(second or 0)) + timedelta(seconds=leap)
    offset = None if zone is None else ISO.offset(zone)
    return Moment(local, int((fraction or "0").ljust(9, "0")), offset, hour is not None, is_ordered)


def _by_pattern(text: str, pattern: str) -> Moment:
    found = datetime.strptime(text, pattern)
    nanosecond = found.microsecond * 1000
    local = found.replace(tzinfo=None, microsecond=0)
    return Moment(local, nanosecond, found.utcoffset(), any(mark in pattern for mark in ("%H", "%I", "%X", "%c", "%T")))


def moment_of(text: str) -> int | None:
    """Nanoseconds since 1970 of a moment with its zone, as a user states it; None where it has none, or is none."""
    moment = read_moment(text.strip(), "")
    return None if moment is None or moment.offset is None or not moment.has_time else moment.time_ns(None)
