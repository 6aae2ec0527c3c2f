"""Where the report of a log or of results is, after what it lacks has been run."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cadence.errors import InputError
from pipeline.batch.config import RunConfig
from pipeline.batch.outcome import LogOutcome, LogTask
from pipeline.batch.tasks import run_task
from pipeline.catalogue import read_catalogue
from pipeline.config import load_tables, read_settings
from pipeline.files import hash_file
from pipeline.manifest import read_manifest
from pipeline.missions import find_missions, is_mission_directory, no_mission
from pipeline.progress import Progress
from pipeline.stores.urls import is_url
from pipeline.threads import num_cores

PAGE_NAME = "report.html"


@dataclass(frozen=True)
class Pages:
    """A folder whose pages are to be seen.

    folder   a mission directory, or one that holds several
    pages    reports, relative to the folder, in the order of their names
    outcome  of what had to be run; None where nothing had to be
    """

    folder: Path
    pages: tuple[str, ...]
    outcome: LogOutcome | None = None


def find_pages(
    target: str, out: str, path: Path | None, overrides: Sequence[str], progress: Progress, force: bool = False
) -> Pages:
    """The report of a log, of a mission directory, or the reports of a folder of these; what is missing is run.

    Results of a log go to `out`/<its name>. Settings are those of the file at `path` and of `overrides`, and for what they do
    not state those with which earlier stages ran. Raises `InputError` where `target` is none of these.
    """
    if is_url(target):
        raise InputError(
            f"{target}: is a URL; `cadence run {target} --out results` makes a report on this machine, then view it"
        )
    place = Path(target)
    if is_mission_directory(place):
        return _of_mission(place, path, overrides, progress, force)
    found = tuple(sorted(page.relative_to(place).as_posix() for page in place.glob(f"*/{PAGE_NAME}"))) if place.is_dir() else ()
    if found:
        return Pages(place, found)
    missions = find_missions([target], out) if place.exists() else ()
    if not missions:
        raise no_mission(place)
    if len(missions) > 1:
        raise InputError(
            f"{target}: holds {len(missions)} logs; `cadence run {target} --out {out}` runs them, "
            f"`cadence view {out}` shows them"
        )
    (mission,) = missions
    directory = Path(mission.directory)
    if not force and _is_current(directory, mission.parts):
        return Pages(directory, (PAGE_NAME,))
    return _run(directory, mission.parts, path, overrides, progress, force)


def _of_mission(directory: Path, path: Path | None, overrides: Sequence[str], progress: Progress, force: bool) -> Pages:
    if (directory / PAGE_NAME).is_file() and not (force or path or overrides):
        return Pages(directory, (PAGE_NAME,))
    parts = tuple(str(part.path) for part in read_catalogue(directory).files)
    return _run(directory, parts, path, overrides, progress, force)


def _is_current(directory: Path, parts: Sequence[str]) -> bool:
    """Whether there is a report of these very files."""
    if not (directory / PAGE_NAME).is_file() or not is_mission_directory(directory):
        return False
    known = {part.sha256 for part in read_catalogue(directory).files}
    return known == {hash_file(Path(part)) for part in parts}


def _run(
    directory: Path, parts: Sequence[str], path: Path | None, overrides: Sequence[str], progress: Progress, force: bool
) -> Pages:
    tables = _merged(_earlier_settings(directory), load_tables(path, overrides))
    config = read_settings(
        RunConfig, {name: value for name, value in tables.items() if name in RunConfig.__dataclass_fields__}, ""
    )
    outcome = run_task(LogTask(0, tuple(parts), str(directory), 0, config, force, num_cores()), progress)
    pages = (PAGE_NAME,) if (directory / PAGE_NAME).is_file() and not outcome.message else ()
    return Pages(directory, pages, outcome)


def _earlier_settings(directory: Path) -> dict[str, Any]:
    """With what the stages ran whose results are there: looking at them must not make others of them."""
    manifests = {stage: read_manifest(stage, directory) for stage in RunConfig.__dataclass_fields__}
    return {
        stage: manifest["config"]
        for stage, manifest in manifests.items()
        if manifest and isinstance(manifest.get("config"), dict)
    }


def _merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Tables with those of `over` in front."""
    found = dict(base)
    for name, value in over.items():
        inner = found.get(name)
        found[name] = _merged(inner, value) if isinstance(inner, Mapping) and isinstance(value, Mapping) else value
    return found
