"""The settings of the report stage."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ReportConfig:
    """How much the page shows.

    max_megabytes   the interactive map is thinned until the page fits; what was left out is stated
    num_moments     small maps of chosen moments
    max_hypotheses, max_vertices  of one agent in one window on the interactive map
    max_points      detections, truth and sensor positions on the interactive map, each
    """

    max_megabytes: float = 5.0
    num_moments: int = 6
    max_hypotheses: int = 30
    max_vertices: int = 96
    max_points: int = 20_000

    def __post_init__(self) -> None:
        if (
            self.max_megabytes <= 0
            or self.num_moments < 0
            or self.max_hypotheses < 1
            or self.max_vertices < 3
            or self.max_points < 2
        ):
            raise ValueError(
                "max_megabytes must be > 0, num_moments >= 0, max_hypotheses >= 1, max_vertices >= 3, max_points >= 2"
            )
