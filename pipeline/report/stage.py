"""The stage: mission directory in, report.html out."""

from importlib import resources
from pathlib import Path

from pipeline.manifest import JsonObject, StageResult, run_stage
from pipeline.progress import Progress
from pipeline.report.config import ReportConfig
from pipeline.report.inputs import mission_inputs


def report(directory: Path, config: ReportConfig, progress: Progress, force: bool = False) -> StageResult:
    """Write `directory`/report.html from what the other stages left there.

    Raises `InputError` where the catalogue, the detections, the windows or the hypotheses are absent or damaged.
    """

    def body(work: Path) -> JsonObject:
        from pipeline.report.writing import write_report  # only now: a mission that is finished must not cost torch

        return write_report(directory, work, config, progress)

    return run_stage(
        "report", directory, config=config, inputs=[*mission_inputs(directory), *_assets()], body=body, force=force
    )


def _assets() -> list[Path]:
    # The look of the page is an input too: a newer style must not be skipped.
    folder = Path(str(resources.files("pipeline.report")))
    return [folder / "page.css", folder / "page.js", folder / "moving.js", folder / "explorer.html"]
