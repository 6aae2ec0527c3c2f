"""Ingest: log → catalogue.json: channels, rates, time range, health, content hash, suggested mapping.

What the result depends on stands here, what makes it in `writing`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cadence.errors import InputError
from pipeline.catalogue import (
    read_catalogue,
    write_catalogue,
)
from pipeline.logs.parts import recorded_parts
from pipeline.logs.reader import open_log
from pipeline.manifest import StageResult, read_manifest, run_stage
from pipeline.progress import Progress


@dataclass(frozen=True)
class IngestConfig:
    """Nothing can be configured: the catalogue states facts."""


def ingest(
    log: Path | Sequence[Path], directory: Path, config: IngestConfig, progress: Progress, force: bool = False
) -> StageResult:
    """Write the catalogue of `log`: a file, the folder of a split recording, or the parts of one mission.

    Raises `InputError` where it is no MCAP or no message can be read.
    """
    paths = _files(log)

    def body(work: Path) -> dict[str, Any]:
        from pipeline.ingest.writing import summary_of, survey  # only now: to find nothing to do must not cost decoders

        catalogue = survey(paths, progress)
        write_catalogue(catalogue, work, directory)
        for problem in catalogue.health.problems:
            progress.note(f"{paths[0].name if len(paths) == 1 else catalogue.name}: {problem}")
        return summary_of(catalogue, directory)

    is_moved = _is_of_other_paths(directory, paths)
    return run_stage("ingest", directory, config=config, inputs=paths, body=body, force=force or is_moved)


def _files(log: Path | Sequence[Path]) -> tuple[Path, ...]:
    """The files of the log, absolute."""
    given = [log] if isinstance(log, Path) else log
    paths = tuple(part.resolve() for path in given for part in recorded_parts(path) or (path,))
    for path in paths:
        if not path.is_file():
            open_log(path)  # says what is wrong; the stage would try to hash it
    if len({path.name for path in paths}) < len(paths):  # manifests know inputs by their names
        raise InputError(f"{paths[0].parent}: two parts of one mission have the same name; rename one of them")
    return paths


def _is_of_other_paths(directory: Path, paths: Sequence[Path]) -> bool:
    """Whether the catalogue that is there names other files: equal content does not make it usable."""
    if read_manifest("ingest", directory) is None:
        return False
    try:
        return [part.path for part in read_catalogue(directory).files] != list(paths)
    except InputError:
        return True
