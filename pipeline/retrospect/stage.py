"""Retrospect: detections → mission hypotheses: whole tracks of all agents, one unbroken story each, given all detections.

What the result depends on stands here, what makes it in `writing`.
"""

from pathlib import Path
from typing import Any

from pipeline.config import config_as_dict
from pipeline.manifest import StageResult, run_stage
from pipeline.missions import CATALOGUE_NAME, no_mission
from pipeline.obstacle_file import OBSTACLES_NAME
from pipeline.progress import Progress
from pipeline.retrospect.config import RetrospectConfig
from pipeline.retrospect.told import Told


def retrospect(
    directory: Path, config: RetrospectConfig, progress: Progress, force: bool = False, num_threads: int | None = None
) -> StageResult:
    """Draw the mission hypotheses of the mission in `directory`: mission.parquet.

    Detections, limits and associations are those of infer, which must have run. Tracks are drawn in `num_threads` threads, by
    default one a core; their number changes no byte.
    """
    inputs = [directory / name for name in ("detections.parquet", "hypotheses.parquet", "windows.parquet", OBSTACLES_NAME)]
    if not inputs[0].is_file() and not (directory / CATALOGUE_NAME).is_file():
        raise no_mission(directory)
    inputs += [path for path in [directory / "pasts.parquet"] if path.is_file()]
    told, summary = Told.of(directory)

    def body(folder: Path) -> dict[str, Any]:
        if not config.enabled:
            return {"num_hypotheses": 0, "remarks": []}
        from pipeline.retrospect.writing import write_mission  # only now: a mission that is finished must not cost torch

        return write_mission(directory, folder, config, num_threads, progress)

    facts = {"infer": config_as_dict(told), "checkpoint": summary.get("checkpoint")}
    return run_stage("retrospect", directory, config=config, inputs=inputs, body=body, force=force, facts=facts)
