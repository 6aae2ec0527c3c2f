"""Infer: detections → hypotheses: the model fitted to the log, all windows batched, constraints kept.

What the result depends on stands here, what makes it in `writing` and `plan`.
"""

from pathlib import Path
from typing import Any

from pipeline.catalogue import read_catalogue
from pipeline.checkpoints import read_info
from pipeline.estimators.presets import find_weights, refuse_unread
from pipeline.infer.config import InferConfig
from pipeline.look_files import LOOK_FILES
from pipeline.manifest import StageResult, run_stage
from pipeline.measurement_words import MEASUREMENTS_NAME
from pipeline.missions import CATALOGUE_NAME, no_mission
from pipeline.obstacle_file import OBSTACLES_NAME
from pipeline.progress import Progress
from pipeline.tables import read_table


def infer(
    directory: Path, config: InferConfig, progress: Progress, force: bool = False, num_threads: int | None = None
) -> StageResult:
    """Draw hypotheses for every window of the mission in `directory`: hypotheses.parquet and windows.parquet.

    Where detections of unknown origin were told apart, associations, labels and pasts.parquet hold how. A checkpoint that the
    log shows not to fit is not used but suspected; `ImplausibleInputError` where `config.is_strict`. Windows are drawn in
    `num_threads` threads, by default one a core; their number changes no byte.
    """
    weights = find_weights(config.checkpoint)
    inputs = [directory / "detections.parquet", directory / OBSTACLES_NAME]
    inputs += [directory / name for name in (*LOOK_FILES, MEASUREMENTS_NAME) if (directory / name).is_file()]
    if weights is not None:
        read_info(weights)  # names what is wrong with it more plainly than an input that is missing
        inputs += [weights, weights.with_suffix(".json")]
    refuse_unread(config.checkpoint, config)
    start_ns = _mission_start_ns(directory)

    def body(folder: Path) -> dict[str, Any]:
        progress.doing("infer: getting ready")
        from pipeline.infer.writing import write_tables  # only now: a mission that is finished must not cost torch

        return write_tables(directory, folder, config, start_ns, num_threads, progress)

    # the catalogue itself is no input: it names the place of the log, and a log that was moved is not inferred again
    facts = {"start_ns": start_ns}
    return run_stage("infer", directory, config=config, inputs=inputs, body=body, force=force, facts=facts)


def _mission_start_ns(directory: Path) -> int:
    """When the log begins; without a catalogue the first detection. `InputError` where nothing was extracted."""
    path, has_catalogue = directory / "detections.parquet", (directory / CATALOGUE_NAME).is_file()
    if not has_catalogue and not path.is_file():
        raise no_mission(directory)
    if has_catalogue and path.is_file():
        return read_catalogue(directory).start_ns
    detections, _ = read_table(path, "detections")
    return int(detections["time_ns"].to_numpy().min()) if detections.num_rows else 0
