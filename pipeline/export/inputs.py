"""What a side file is made of."""

from pathlib import Path

from pipeline.manifest import manifest_path
from pipeline.missions import CATALOGUE_NAME
from pipeline.obstacle_file import OBSTACLES_NAME

TABLES = ("hypotheses.parquet", "windows.parquet", "detections.parquet")
EARLIER_STAGES = ("ingest", "extract", "infer")


def mission_inputs(directory: Path) -> list[Path]:
    """The files of `directory` that the side file depends on; those that every mission has, and others where they exist."""
    manifests = [manifest_path(stage, directory) for stage in EARLIER_STAGES]
    there = [path for path in (*manifests, directory / "associations.parquet") if path.is_file()]
    return [*(directory / name for name in (CATALOGUE_NAME, *TABLES, OBSTACLES_NAME)), *there]
