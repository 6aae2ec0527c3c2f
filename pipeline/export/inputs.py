"""What a side file is made of."""

from collections.abc import Sequence
from pathlib import Path

from pipeline.ask.question import Question
from pipeline.manifest import manifest_path
from pipeline.missions import CATALOGUE_NAME
from pipeline.obstacle_file import OBSTACLES_NAME

TABLES = ("hypotheses.parquet", "windows.parquet", "detections.parquet")
EARLIER_STAGES = ("ingest", "extract", "infer")


def mission_inputs(directory: Path, questions: Sequence[Question] = ()) -> list[Path]:
    """The files of `directory` that the side file depends on; those that every mission has, and others where they exist.

    Files with the areas and lines of `questions` are among them.
    """
    manifests = [manifest_path(stage, directory) for stage in EARLIER_STAGES]
    asked = [Path(text) for question in questions for text in (question.area, question.line) if text and len(text) < 1000]
    more = (directory / "associations.parquet", directory / "mission.parquet")
    there = [path for path in (*manifests, *more, *asked) if path.is_file()]
    return [*(directory / name for name in (CATALOGUE_NAME, *TABLES, OBSTACLES_NAME)), *there]
