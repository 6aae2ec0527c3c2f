"""What is known of the heights of a log, in words."""

from collections.abc import Mapping
from typing import Any, Final

from pipeline.counted import counted

DATA: Final[Mapping[str, str]] = {
    "ellipsoid": "above the WGS 84 ellipsoid",
    "sea level": "above sea level",
    "ground": "above the ground",
    "start": "above where it started",
    "frame": "above the zero of their frame",
    "not stated": "above a datum that the log does not state",
}


def height_words(record: Mapping[str, Any]) -> str:
    """One sentence on the `height` record of extract's summary."""
    words = f"heights are used of {counted(record['num_detections'], 'detection')}, in metres {DATA[record['vertical_datum']]}"
    if record["num_without"]:
        words += f"; {record['num_without']} have none"
    for noise in record["noise"]:
        if noise.get("is_taken"):
            rounded = f", rounded to {noise['rounded_to_m']:.3g} m" if noise["rounded_to_m"] else ""
            low_m, high_m = noise["interval_m"]
            interval = f"95 %: {low_m:.2g} to {high_m:.2g} m"
            words += f"; {noise['source']}: standard deviation {noise['sigma_m']:.2g} m ({interval}){rounded}"
    return words
