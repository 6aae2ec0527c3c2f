"""Extract: catalogue and log → detections.parquet, truth.parquet, poses.parquet, obstacles.json.

Decoded messages become rows in the mission frame, sorted by time; whatever is left out is counted in the summary.
What the result depends on stands here, what makes it in `writing`.
"""

from pathlib import Path
from typing import Any

from cadence.errors import ConfigError
from pipeline.catalogue import open_catalogued_log, read_catalogue
from pipeline.extract.config import ExtractConfig
from pipeline.manifest import StageResult, run_stage
from pipeline.missions import CATALOGUE_NAME
from pipeline.progress import Progress


def extract(directory: Path, config: ExtractConfig, progress: Progress, force: bool = False) -> StageResult:
    """Write the tables of the log that `directory` was ingested from.

    Raises `InputError` where no detection is left, of which `NothingDetectedError` where none was recorded, and
    `ImplausibleInputError` where something is suspected and `config.is_strict`.
    """
    catalogue = read_catalogue(directory)

    def body(work: Path) -> dict[str, Any]:
        from pipeline.extract.writing import write_tables  # only now: to find nothing to do must not cost what reading does

        return write_tables(open_catalogued_log(catalogue), work, config, progress)

    for path in config.obstacles.files:
        if not path.is_file():
            raise ConfigError(f"{path}: not a file; correct extract.obstacles.files")
    inputs = [directory / CATALOGUE_NAME, *config.obstacles.files]
    return run_stage("extract", directory, config=config, inputs=inputs, body=body, force=force)
