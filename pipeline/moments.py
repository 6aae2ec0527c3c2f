"""Moments as people state them → int64 nanoseconds: ISO 8601, or seconds after a beginning."""

import math
import re
from datetime import UTC, datetime

_ISO = re.compile(
    r"(\d{4}-\d\d-\d\d[T ]\d\d:\d\d(?::\d\d)?)(?:(?<=:\d\d:\d\d)\.(\d{1,9})\d*)?(?: ?(Z|UTC|[+-]\d\d:?\d\d)(?: UTC)?)?"
)
"""ISO 8601, and as Go writes times: `2023-11-14 22:13:20.123456789 +0000 UTC`."""
LIMIT_NS = 2**63


def moment_ns(value: float | str, start_ns: int) -> int | None:
    """The moment that a user states: seconds after `start_ns` (also as text), or ISO 8601; None where it is neither."""
    if isinstance(value, str):
        if is_iso(value):
            found = iso_ns(value)
            return None if not found or abs(found) >= LIMIT_NS else found
        try:
            value = float(value)
        except ValueError:
            return None
    return start_ns + round(value * 1e9) if math.isfinite(value) else None


def is_iso(text: str) -> bool:
    """Whether a text is written like a date and time."""
    return _ISO.fullmatch(text.strip()) is not None


def iso_ns(text: str) -> int | None:
    """Nanoseconds since 1970 of an ISO 8601 text, UTC where it states no zone; None where it is none, or no such day."""
    match = _ISO.fullmatch(text.strip())
    if match is None:
        return None
    try:
        moment = datetime.fromisoformat(match[1].replace(" ", "T") + (match[3] or "Z").replace("UTC", "Z"))
    except ValueError:
        return None
    whole = moment - datetime(1970, 1, 1, tzinfo=UTC)
    return (whole.days * 86400 + whole.seconds) * 10**9 + int((match[2] or "0").ljust(9, "0"))
