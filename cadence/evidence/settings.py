"""How evidence is used: read long before anything is weighed, so that it costs no torch."""

from dataclasses import dataclass


@dataclass(frozen=True)
class WeighingConfig:
    """How hypotheses are weighed by evidence.

    is_used    false: evidence is left out
    most_draws where fewer than four fifths of the hypotheses of a window count, more are drawn to choose from: as many as are
               missing, but no more than so many times as many
    exponent   of silence, 0 (it says nothing) to 1 (looks are independent); by default chosen where withheld detections tell
    reach_m    a target of which only bearings or ranges tell was first within about so many metres of who measured them; by
               default three hundred steps at the log's typical speed
    is_equal   hypotheses are drawn again by their weights, so that all count the same and some are there several times
    """

    is_used: bool = True
    most_draws: int = 8
    exponent: float | None = None
    reach_m: float | None = None
    is_equal: bool = False

    def __post_init__(self) -> None:
        if self.exponent is not None and not 0 <= self.exponent <= 1:
            raise ValueError(f"exponent must lie between 0 and 1, got {self.exponent}")
        if self.reach_m is not None and not self.reach_m > 0:
            raise ValueError(f"reach_m must be positive, got {self.reach_m}")
        if self.most_draws < 1:
            raise ValueError(f"most_draws must be at least 1, got {self.most_draws}")
