"""What the names in tables of scores mean, in words for people."""

import math
from collections.abc import Mapping
from typing import Final

ESTIMATORS: Final[Mapping[str, str]] = {
    "bank": "bank of smoothers",
    "cv": "constant velocity",
    "ou": "fading velocity",
    "linear": "straight lines",
    "hold": "stays where seen",
    "ring": "distance rings",
    "mission": "mission hypotheses (all detections)",
}
"""Rivals and mission hypotheses of `cadence evaluate`; others are called by their names."""

METRICS: Final[Mapping[str, str]] = {
    "energy_score_m": "energy score",
    "ade_m": "mean error",
    "coverage_90": "in 90 % region",
}
"""Headline metrics: the distance of all hypotheses together from the truth (Gneiting and Raftery, 2007; less is better), the
mean distance of one hypothesis, and the share of the truth that lies in the region of 90 % of the weight (90 % is right)."""


SCORE_LEGEND: Final = (
    "energy score: how far all hypotheses together are from the truth, less is better; mean error: one of them; "
    "of the truth 90 % should lie in the 90 % region"
)
"""The same for people."""

_RIGHT = 0.9


def away_words(ratio: float) -> str:
    """`12 % below that` of a score that is .88 of another."""
    percent = round(100 * abs(1 - ratio))
    return f"{percent} % {'below' if ratio < 1 else 'above'} that" if percent else "within half a per cent of that"


def estimator_words(name: str) -> str:
    """What an estimator is called in a table."""
    return ESTIMATORS.get(name, name)


def coverage_words(held: float, low: float = math.nan, high: float = math.nan) -> str:
    """What a region of 90 % is worth that holds this share of the truth; `low` and `high` are the interval of the share."""
    limits = ((0.5, "do not believe it"), (0.83, "it is too narrow"), (0.96, "as it should"), (math.inf, "it is too wide"))
    words = next(words for limit, words in limits if held <= limit)
    is_chance = low <= _RIGHT <= high and not words.startswith("as")
    return f"{words}, which may be chance" if is_chance else words


def value_words(metric: str, value: float | None) -> str:
    """A value with its unit: shares in per cent, lengths in metres; `-` where there is none."""
    if value is None:
        return "-"
    if metric.startswith("coverage"):
        return f"{100 * value:.0f} %"
    number = f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return f"{number} m" if metric.endswith("_m") else number
