"""Probabilities, times and places for people: what is not known is said; nothing is certain for not being seen."""

import math
from dataclasses import asdict
from typing import Any

import numpy as np

from cadence.answers.estimates import Law, Probability
from pipeline.clock import Clock, duration
from pipeline.frames import to_geodetic
from pipeline.lengths import three_digits
from pipeline.tables import Frame

_FINE_M = 50.0
"""What is known more exactly than this has more digits than fit ten metres."""


def percent(found: Probability) -> str:
    """`73 % (68 to 78 %)`, the 95 % interval of more stories; `less than 1 %` where it is so in none of them."""
    if math.isnan(found.value):
        return "unknown"
    if found.value == 0.0:
        return f"less than {_up(100 * found.high)} %"
    if found.value == 1.0:
        return f"more than {_down(100 * found.low)} %"
    return f"{_share(found.value)} % ({_share(found.low)} to {_share(found.high)} %)"


def is_likely(found: Probability) -> bool:
    """Whether more than half of the belief is for it."""
    return found.value > 0.5


def moment_words(clock: Clock, start_ns: int, found: Law) -> str:
    """`at 10:12:30 (10:08:00 to 10:31:10)`: the median, and in brackets where 90 % lie."""
    low, median, high = (clock.moment(start_ns + round(at * 1e9)) for at in (found.low, found.median, found.high))
    return median if low == median == high else f"{median} ({low} to {high})"


def span_words(found: Law) -> str:
    """The same of a length of time."""
    low, median, high = map(duration, (found.low, found.median, found.high))
    return median if low == median == high else f"{median} ({low} to {high})"


def place_words(frame: Frame, place_m: tuple[float, float], within_m: float = math.inf) -> str:
    """`50.7612° N, 1.2033° W`, or metres where the log is not georeferenced; with more digits where it is known `within_m`."""
    if not frame.is_georeferenced:
        digits = 0 if within_m > _FINE_M / 10 else 2
        return f"x {place_m[0]:,.{digits}f} m, y {place_m[1]:,.{digits}f} m"
    latitude, longitude = (float(found[0]) for found in to_geodetic(frame, np.array([place_m[0]]), np.array([place_m[1]])))
    north, east, digits = "S" if latitude < 0 else "N", "W" if longitude < 0 else "E", 4 if within_m > _FINE_M else 6
    return f"{abs(latitude):.{digits}f}° {north}, {abs(longitude):.{digits}f}° {east}"


def area_words(area_m2: float) -> str:
    """An area for people, three digits, in km² from a tenth on."""
    return f"{three_digits(area_m2 / 1e6)} km²" if area_m2 >= 1e5 else f"{three_digits(area_m2)} m²"


def numbers(found: Any) -> Any:
    """Probabilities and laws as plain values for JSON."""
    return None if found is None else {key: value for key, value in asdict(found).items()}


def time_numbers(found: Law | None, start_ns: int) -> dict[str, Any] | None:
    """A law of times as nanoseconds since 1970."""
    if found is None:
        return None
    names = ("low", "median", "high", "median_low", "median_high")
    times = {f"{name}_ns": start_ns + round(getattr(found, name) * 1e9) for name in names}
    return {**times, "num_effective": found.num_effective}


def _share(share: float) -> str:
    """In per cent: whole numbers, digits only near 0 and 100, and never one of those two."""
    value = 100.0 * share
    if 1.0 <= value <= 99.0 or value in (0.0, 100.0):
        return f"{value:.0f}"
    near = min(value, 100.0 - value)
    digits = 1 if near >= 0.1 else 2 if near >= 0.01 else 4
    return f"{value:.{digits}f}"


def _up(value: float) -> str:
    """Rounded up to what people read."""
    return f"{math.ceil(value):.0f}"


def _down(value: float) -> str:
    return f"{math.floor(value):.0f}"
