"""How evidence is used: read long before anything is weighed, so that it costs no torch."""

from dataclasses import dataclass


@dataclass(frozen=True)
class WeighingConfig:
    """How hypotheses are weighed by evidence.

    is_used    false: evidence is left out
    most_draws where fewer than half of the hypotheses of a window count, so many times as many are drawn to choose from
    is_equal   hypotheses are drawn again by their weights, so that all count the same and some are there several times
    """

    is_used: bool = True
    most_draws: int = 8
    is_equal: bool = False

    def __post_init__(self) -> None:
        if self.most_draws < 1:
            raise ValueError(f"most_draws must be at least 1, got {self.most_draws}")
