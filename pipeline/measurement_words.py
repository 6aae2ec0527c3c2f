"""The file of measurements by name, and in words what it holds; asked for where nothing heavy may be imported."""

from collections.abc import Mapping
from typing import Any, Final

from pipeline.counted import counted

MEASUREMENTS_NAME = "measurements.parquet"
_KINDS: Final = {
    "bearing_rad": ("bearing", "bearings"),
    "range_m": ("range", "ranges"),
    "range_rate_mps": ("range rate", "range rates"),
    "elevation_rad": ("elevation", "elevations"),
}
_MAX_NAMED: Final = 4


def measurement_words(record: Mapping[str, Any]) -> str:
    """One sentence on the `measurements` of extract's summary; empty where it has none."""
    if not record.get("num"):
        return ""
    kinds = ", ".join(counted(record[kind], *words) for kind, words in _KINDS.items() if record.get(kind))
    about = [f"{name} ({num})" for name, num in record["agents"].items()]
    nameless = record["num"] - sum(record["agents"].values())
    shown = [*about[:_MAX_NAMED], *([f"{len(about) - _MAX_NAMED} more"] if len(about) > _MAX_NAMED else [])]
    shown += [f"nobody knows whom ({nameless})"] if nameless else []
    return f"{kinds} of {', '.join(record['topics'])}, which are no positions, may weigh windows; about {', '.join(shown)}"
