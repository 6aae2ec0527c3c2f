"""What a page is made of."""

from pathlib import Path

from pipeline.look_files import LOOK_FILES
from pipeline.missions import CATALOGUE_NAME, no_mission
from pipeline.obstacle_file import OBSTACLES_NAME
from pipeline.stories import MISSION_NAME

STAGES = ("ingest", "extract", "infer", "retrospect", "export", "evaluate")
"""Stages whose manifests the page shows, in the order of the work."""


def mission_inputs(directory: Path) -> list[Path]:
    """The files of `directory` that the page depends on, as far as they exist; `InputError` for no mission directory."""
    if not (directory / CATALOGUE_NAME).is_file():
        raise no_mission(directory)
    names = [CATALOGUE_NAME, "detections.parquet", "hypotheses.parquet", "windows.parquet", OBSTACLES_NAME]
    names += [
        "associations.parquet",
        "labels.parquet",
        "truth.parquet",
        "poses.parquet",
        MISSION_NAME,
        *LOOK_FILES,
        "scores.json",
        "answers.json",
        "events.csv",
        *(f"{stage}.manifest.json" for stage in STAGES),
    ]
    return [directory / name for name in names if (directory / name).is_file()]
