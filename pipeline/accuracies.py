"""What is taken for the accuracy of detections that state none, as results hold it, and in words."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from cadence.measurement.noise import MeasurementNoise

ADVICE = "sigma_m of the source, or extract.default_sigma_m, states another"


@dataclass(frozen=True)
class Accuracy:
    """What is taken for the accuracy of sources that state none.

    names           the sources: TOPIC, or TOPIC sensor SENSOR
    num_detections  of them
    noise           None: they hold too little to tell
    """

    names: tuple[str, ...]
    num_detections: int
    noise: MeasurementNoise | None

    @property
    def is_taken(self) -> bool:
        """Whether detections get this noise; without it they count as exact."""
        return self.noise is not None and self.noise.is_sure

    def record(self) -> dict[str, Any]:
        """For the manifest."""
        found = {"sources": list(self.names), "num_detections": self.num_detections, "is_taken": self.is_taken}
        if self.noise is None:
            return found
        noise = self.noise
        return found | {
            "sigma_m": noise.sigma_m, "sigma_interval_m": list(noise.sigma_interval_m), "timing_s": noise.timing_s,
            "timing_interval_s": list(noise.timing_interval_s), "along_m": noise.along_m, "speed_mps": noise.speed_mps,
        }  # fmt: skip


def in_words(record: Mapping[str, Any]) -> tuple[str, str]:
    """Of one record: which sources, and what their detections tell of their accuracy."""
    names = record["sources"]
    who = names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more together"
    if "sigma_m" not in record:
        return who, "too few detections follow each other closely to tell; they count as exact"
    low_m, high_m = record["sigma_interval_m"]
    if not record["is_taken"]:
        return who, f"no noise of the detections can be told from motion (95 %: at most {high_m:.2g} m); they count as exact"
    if record["sigma_interval_m"][0] <= 0:
        sigma = f"a standard deviation of at most {high_m:.2g} m (95 %)"
    else:
        sigma = f"a standard deviation of {record['sigma_m']:.3g} m (95 %: {low_m:.2g} to {high_m:.2g} m)"
    if record["timing_interval_s"][0] <= 0:
        return who, f"{sigma}, by the likelihood of the detections"
    timing = "times are off by {:.2g} s ({:.2g} to {:.2g} s)".format(record["timing_s"], *record["timing_interval_s"])
    along = f"{record['along_m']:.3g} m along the course at {record['speed_mps']:.3g} m/s"
    return who, f"{sigma}, and {timing}, which makes {along}; by the likelihood of the detections"


def lines(records: Sequence[Mapping[str, Any]]) -> list[str]:
    """One a record: SOURCE states no accuracy: ..."""
    found = []
    for record in records:
        who, words = in_words(record)
        found.append(f"{who}: no accuracy is stated; {words}; {ADVICE}")
    return found
