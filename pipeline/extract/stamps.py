"""Time stamps as messages state them → int64 nanoseconds."""

import math
from typing import Any

from pipeline.moments import LIMIT_NS, is_iso, iso_ns

_SECONDS = ("sec", "secs", "seconds")
_NANOSECONDS = ("nanosec", "nsec", "nsecs", "nanos")


def stamp_ns(value: Any) -> int | None:
    """Nanoseconds since the epoch of a stamp; None where it is unset (zero, absent) or cannot be understood.

    Understood are ROS 1, ROS 2 and protobuf times (objects or dicts of seconds and nanoseconds), ISO 8601 text (UTC where it
    states no zone) and plain numbers: seconds, milliseconds, microseconds or nanoseconds since 1970, told apart by size.
    """
    if isinstance(value, str):
        found = _text_ns(value.strip())
    elif isinstance(value, int | float):
        found = _number_ns(value)
    else:
        found = _pair_ns(value)
    return None if found is None or found == 0 or abs(found) >= LIMIT_NS else found


def _pair_ns(value: Any) -> int | None:
    seconds, nanoseconds = _first(value, _SECONDS), _first(value, _NANOSECONDS)
    if seconds is None:
        return None
    try:
        return int(seconds) * 10**9 + int(nanoseconds or 0)  # JSON forms of protobuf state int64 as text
    except (TypeError, ValueError):
        return None


def _first(value: Any, names: tuple[str, ...]) -> Any:
    for name in names:
        found = value.get(name) if isinstance(value, dict) else getattr(value, name, None)
        if found is not None:
            return found
    return None


def _text_ns(text: str) -> int | None:
    if is_iso(text):
        return iso_ns(text)
    try:
        return _number_ns(int(text))
    except ValueError:
        pass
    try:
        return _number_ns(float(text))
    except ValueError:
        return None


def _number_ns(value: float) -> int | None:
    """Seconds reach to the year 5138 below 1e11; the next unit begins where the one before would lie beyond that."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    for limit, factor in ((1e11, 10**9), (1e14, 10**6), (1e17, 10**3)):
        if abs(value) < limit:
            # Whole and fractional part apart: a float cannot hold today's nanoseconds exactly.
            whole = math.floor(value)
            return whole * factor + round((value - whole) * factor)
    return int(value)
