"""The settings of the export stage."""

from dataclasses import dataclass

from pipeline.ask.question import Question
from pipeline.logs.recorder import Compression


@dataclass(frozen=True)
class ExportConfig:
    """How results are written.

    tick_s                seconds between two moments at which marks move; by default 1, or the step of the windows where that
                          is longer, or more where the marks would exceed max_scene_mb
    max_scene_mb          megabytes before compression, of lines and of marks each: what a viewer has to read
    num_scene_hypotheses  hypotheses drawn for each agent, the heaviest first; all are in /cadence/hypotheses
    max_vertices          points of a drawn hypothesis, in the mean at most: what cannot be seen is left out; by default 48, or
                          fewer where the lines would exceed max_scene_mb
    occupancy_cells       cells along the longer side of the heat map, at most
    map_period_s          seconds between two regions on the map (viewers draw all at once); by default a window's history
    combined              also write the source log and our channels into one file
    compression           of the chunks: zstd, lz4 or none
    questions             asked of the mission: answers.json, events.csv and the report have the answers
    meeting_m             agents that came nearer than this may have met; by default a two-hundredth of the mission's extent
    """

    tick_s: float | None = None
    max_scene_mb: float = 400.0
    num_scene_hypotheses: int = 30
    max_vertices: int | None = None
    occupancy_cells: int = 384
    map_period_s: float | None = None
    combined: bool = False
    compression: Compression = "zstd"
    questions: tuple[Question, ...] = ()
    meeting_m: float | None = None

    def __post_init__(self) -> None:
        if self.meeting_m is not None and not self.meeting_m > 0:
            raise ValueError(f"meeting_m must be above zero, got {self.meeting_m}")
        for name in ("tick_s", "map_period_s"):
            value = getattr(self, name)
            if value is not None and not 0.001 <= value < 1e9:
                raise ValueError(f"{name} must be at least 0.001 s, got {value}")
        if not self.max_scene_mb > 0:
            raise ValueError(f"max_scene_mb must be positive, got {self.max_scene_mb}")
        if self.max_vertices is not None and not 4 <= self.max_vertices <= 1000:
            raise ValueError(f"max_vertices must be 4 to 1000, got {self.max_vertices}")
        if self.num_scene_hypotheses < 1 or not 4 <= self.occupancy_cells <= 2048:
            raise ValueError("num_scene_hypotheses must be at least 1, occupancy_cells 4 to 2048")
