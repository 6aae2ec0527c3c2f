"""catalogue.json: what ingest found in a log, as every later stage reads it.

Every later stage finds the log through the catalogue, and `open_catalogued_log` sees to it that it is still the same log.
"""

import dataclasses
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from cadence.errors import ConfigError, InputError
from pipeline.config import read_config
from pipeline.documents import parse_json
from pipeline.files import hash_file
from pipeline.logs.parts import mission_name
from pipeline.logs.reader import Health, MissionLog, reopen
from pipeline.missions import CATALOGUE_NAME, no_mission

CATALOGUE_VERSION: Final = 1


@dataclass(frozen=True)
class CatalogueChannel:
    """One channel as the catalogue states it.

    mean_rate_hz, median_gap_s  None with fewer than two messages, or all at one time
    reason                      why the channel cannot be decoded, else None
    frame_id                    of its first message, where it states one
    """

    id: int
    topic: str
    encoding: str
    schema_name: str
    schema_encoding: str
    num_messages: int
    mean_rate_hz: float | None
    median_gap_s: float | None
    is_decodable: bool
    reason: str | None
    frame_id: str | None


@dataclass(frozen=True)
class CataloguePart:
    """One file of a recording in several files."""

    path: Path
    sha256: str
    size_bytes: int


@dataclass(frozen=True)
class Catalogue:
    """What `ingest` found. Times are log times; `roles` and `suggested_mapping` (TOML) come from `pipeline.mapping.guess`.

    parts   all files of a recording in several files, else empty
    path    the log; the first part where there are several
    sha256  of the log; where there are several parts, of their hashes in order
    """

    version: int
    path: Path
    sha256: str
    size_bytes: int
    start_ns: int
    end_ns: int
    duration_s: float
    library: str
    channels: tuple[CatalogueChannel, ...]
    health: Health
    metadata_names: tuple[str, ...]
    suggested_mapping: str
    roles: dict[str, str] = field(default_factory=dict)
    parts: tuple[CataloguePart, ...] = ()

    @property
    def files(self) -> tuple[CataloguePart, ...]:
        """Every file of the log, be it one or several."""
        return self.parts or (CataloguePart(self.path, self.sha256, self.size_bytes),)

    @property
    def name(self) -> str:
        """What the log is called: its stem, or what the stems of its parts have in common."""
        return mission_name([part.path for part in self.files])


def read_catalogue(directory: Path) -> Catalogue:
    """The catalogue in `directory`; `InputError` where it is absent, damaged or of another version."""
    path = directory / CATALOGUE_NAME
    try:
        data = parse_json(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError) as error:
        raise no_mission(directory) from error
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}); run `cadence ingest` again with --force") from error
    version = data.get("version") if isinstance(data, dict) else None
    if version != CATALOGUE_VERSION:
        raise InputError(
            f"{path}: has version {version}, expected {CATALOGUE_VERSION}; run `cadence ingest` again with --force"
        )
    try:
        catalogue = read_config(Catalogue, data, str(path))
    except ConfigError as error:
        raise InputError(f"{error}; run `cadence ingest` again with --force") from error
    here = directory.resolve()
    parts = tuple(dataclasses.replace(part, path=here / part.path) for part in catalogue.parts)
    return dataclasses.replace(catalogue, path=here / catalogue.path, parts=parts)


def open_catalogued_log(catalogue: Catalogue, on_bytes: Callable[[int], object] | None = None) -> MissionLog:
    """The log of the catalogue, opened; `InputError` where it is gone or no longer has the content that was ingested."""
    for part in catalogue.files:
        path = part.path
        if not path.is_file():
            raise InputError(
                f"{path}: the log that was ingested is not there any more; put it back, or ingest it where it is now"
            )
        if path.stat().st_size != part.size_bytes or hash_file(path) != part.sha256:
            raise InputError(f"{path}: was changed after it was ingested; run `cadence ingest` again")
    return reopen([part.path for part in catalogue.files], catalogue.health, on_bytes)


def write_catalogue(catalogue: Catalogue, folder: Path, directory: Path) -> None:
    """Write the catalogue of the mission in `directory` into `folder`, which will become part of it."""
    (folder / CATALOGUE_NAME).write_text(json.dumps(_plain(catalogue, directory), indent=1) + "\n", encoding="utf-8")


def _plain(catalogue: Catalogue, directory: Path) -> dict[str, Any]:
    parts = [{**dataclasses.asdict(part), "path": stated_path(part.path, directory)} for part in catalogue.parts]
    return dataclasses.asdict(catalogue) | {"path": stated_path(catalogue.path, directory), "parts": parts}


def stated_path(log: Path, directory: Path) -> str:
    """Absolute; relative to the mission directory for a log in it (fetched from elsewhere): the two may move together."""
    inside = directory.resolve()
    return str(log.relative_to(inside) if log.is_relative_to(inside) else log)
