"""Settings of the stage."""

from dataclasses import dataclass, field

import numpy as np

from pipeline.extract.obstacle_config import ObstacleSources
from pipeline.extract.sensor_config import SensorConfig
from pipeline.extract.thinning import ThinningConfig
from pipeline.mapping.sources import SourceConfig
from pipeline.moments import moment_ns
from pipeline.suspicions import LogKind


@dataclass(frozen=True)
class ExtractConfig:
    """What to take from a log.

    detections, truth, poses   the sources of each role
    suggest          fill roles that are left empty by what the names of topics suggest
    thinning         make sparse detections out of a dense channel
    simultaneity_s   detections of one agent within this time are collapsed into one
    topics           patterns ("/radar/*"); take positions only from topics that fit one of them; empty: from all
    start, end       use only messages logged in this part: seconds after the log's first message, or a moment (ISO 8601)
    max_detections   a log with more is refused, before it is read where its message counts tell: a million takes a gigabyte
    frame            name of the fixed frame to bring detections into, by the log's transforms; by default their own where it
                     does not move, else the one that it moves in
    max_extrapolation_s   how long before its first and after its last sample a transform holds; later positions are refused
    max_transform_gap_s   longest time between two samples over which a transform is interpolated
    default_sigma_m  standard deviation of detections that state none; without it that of their own likelihood, where they show
                     any noise, else they count as exact
    max_speed_mps    single positions that could only be reached and left again faster are recorder faults (see `spikes`)
    is_height_used   z or altitude is inferred as well, where detections have it
    trusted          kinds of suspicion that are not looked for: what the log says of them counts as it stands (docs/formats.md)
    is_strict        refuse a log of which something is suspected (`--strict`)
    datum            [latitude, longitude] in degrees of x = y = 0; by default the median of all positions, and unknown for
                     logs in metres
    obstacles        where obstacles come from; by default what the log says
    sensors          what sensors look at, so that their silence counts; by default what the log says (`cadence.sensors`)
    """

    detections: tuple[SourceConfig, ...] = ()
    truth: tuple[SourceConfig, ...] = ()
    poses: tuple[SourceConfig, ...] = ()
    suggest: bool = True
    thinning: ThinningConfig = field(default_factory=ThinningConfig)
    simultaneity_s: float = 0.001
    topics: tuple[str, ...] = ()
    start: float | str | None = None
    end: float | str | None = None
    max_detections: int = 1_000_000
    frame: str | None = None
    max_extrapolation_s: float = 0.5
    max_transform_gap_s: float = 10.0
    default_sigma_m: float | None = None
    max_speed_mps: float | None = 1000.0
    datum: tuple[float, float] | None = None
    obstacles: ObstacleSources = field(default_factory=ObstacleSources)
    sensors: tuple[SensorConfig, ...] = ()
    is_height_used: bool = True
    trusted: tuple[LogKind, ...] = ()
    is_strict: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.simultaneity_s < np.inf:
            raise ValueError("simultaneity_s must not be negative")
        if self.max_detections < 1:
            raise ValueError(f"max_detections must be at least 1, got {self.max_detections}")
        if self.default_sigma_m is not None and not 0 < self.default_sigma_m < np.inf:
            raise ValueError("default_sigma_m must be positive")
        if self.max_speed_mps is not None and not self.max_speed_mps > 0:
            raise ValueError("max_speed_mps must be positive")
        if not (0 <= self.max_extrapolation_s < np.inf and 0 < self.max_transform_gap_s < np.inf):
            raise ValueError("max_extrapolation_s must not be negative, and max_transform_gap_s must be positive")
        for name in ("start", "end"):
            value = getattr(self, name)
            if value is not None and moment_ns(value, 0) is None:
                raise ValueError(f'{name} = {value!r}: expected seconds after the start of the log, or "2024-05-01T12:30:00Z"')
        if self.datum is not None and not (abs(self.datum[0]) <= 90 and abs(self.datum[1]) <= 180):
            raise ValueError(f"datum {list(self.datum)}: expected [latitude, longitude] in degrees")
