"""Lengths for people."""

import math


def nice_length(length: float) -> float:
    """The largest 1, 2 or 5 times a power of ten that is not over `length`."""
    power = 10.0 ** math.floor(math.log10(length))
    return max(factor * power for factor in (1, 2, 5) if factor * power <= length * (1 + 1e-9))


def three_digits(value: float) -> str:
    """A number for people: 0.123, 12.3, 1,230; no powers of ten where thousands with commas will do."""
    rounded = float(f"{value:.3g}")
    return f"{rounded:,.0f}" if 100 <= abs(rounded) < 1e15 else f"{value:.3g}"


def metres(length_m: float) -> str:
    """A length for people: three digits, in km from 1000 m on; nobody cares for millimetres."""
    if not math.isfinite(length_m):
        return "unknown"
    if abs(length_m) < 0.01:
        return "under 1 cm"
    return (
        f"{length_m / 1000:,.3g} km"
        if 999.5 <= length_m < 999_500
        else f"{length_m / 1000:,.0f} km"
        if length_m >= 999_500
        else f"{length_m:.3g} m"
    )


def speed(speed_mps: float) -> str:
    """A speed for people: three digits."""
    return f"{speed_mps:,.0f} m/s" if speed_mps >= 100 else f"{speed_mps:.3g} m/s"
