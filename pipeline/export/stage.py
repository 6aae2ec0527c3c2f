"""Export: hypotheses.parquet → `<log stem>.cadence.mcap`, which opens in Foxglove beside the log, and layouts for it.

What the result depends on stands here, what makes it in `writing`.
"""

from pathlib import Path
from typing import Any

from cadence.errors import InputError
from pipeline.catalogue import Catalogue, read_catalogue
from pipeline.export.config import ExportConfig
from pipeline.export.inputs import mission_inputs
from pipeline.files import hash_file
from pipeline.manifest import StageResult, run_stage
from pipeline.progress import Progress


def export(directory: Path, config: ExportConfig, progress: Progress, force: bool = False) -> StageResult:
    """Write the side file and its layouts into a mission directory, and with `config.combined` the combined file.

    Raises `InputError` where an earlier stage is missing or, for a combined file, where the source log is damaged.
    """
    catalogue = read_catalogue(directory)
    if config.combined:
        _check_combinable(catalogue)
    inputs = [*mission_inputs(directory, config.questions), *([catalogue.path] if config.combined else [])]

    def body(work: Path) -> dict[str, Any]:
        from pipeline.export.writing import write_files  # only now: to find nothing to do must not cost what drawing does

        return write_files(directory, work, catalogue, config, progress)

    return run_stage("export", directory, config=config, inputs=inputs, body=body, force=force)


def _check_combinable(catalogue: Catalogue) -> None:
    """Raise where a combined file would not hold the log as it was recorded; ingest has looked into every chunk."""
    path, health = catalogue.path, catalogue.health
    if catalogue.parts:
        raise InputError(f"{path}: is one part of {len(catalogue.parts)}, which cannot be combined; export without combined")
    if not health.is_complete:
        raise InputError(f"{path}: is damaged ({health.problems[0]}) and cannot be combined; export without combined")
    if hash_file(path) != catalogue.sha256:
        raise InputError(f"{path}: was changed after it was ingested and cannot be combined; run `cadence ingest` again")
