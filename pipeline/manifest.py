"""Stages that are atomic, repeatable and skippable: work in a temporary folder, rename, manifest last.

A mission directory holds the files of one log, and one `<stage>.manifest.json` a stage: its resolved configuration,
the hashes of its inputs and outputs, the versions and a summary — enough to repeat the run, and to know that it need not be.
"""

import itertools
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

from cadence.errors import InputError
from pipeline.config import config_as_dict
from pipeline.documents import parse_json
from pipeline.files import hash_file, working_folder, write_atomic
from pipeline.locks import clear_abandoned
from pipeline.provenance import versions

JsonObject = Mapping[str, Any]

CHAIN: Final[Mapping[str, str]] = {
    "ingest": "the catalogue", "extract": "the detections", "infer": "the hypotheses", "retrospect": "the mission hypotheses",
}  # fmt: skip
"""The stages whose results later ones read, in their order, and what their results are called."""


@dataclass(frozen=True)
class StageResult:
    """What one stage did for one log; `summary` is JSON-able and printed by `--json`. Published outputs are URLs."""

    stage: str
    status: Literal["done", "skipped"]
    outputs: tuple[Path | str, ...]
    summary: JsonObject


def manifest_path(stage: str, directory: Path) -> Path:
    """Where the manifest of `stage` lies."""
    return directory / f"{stage}.manifest.json"


def read_manifest(stage: str, directory: Path) -> dict[str, Any] | None:
    """The manifest of an earlier run of `stage`; None where there is none, or none that can be read."""
    try:
        manifest = parse_json(manifest_path(stage, directory).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return manifest if isinstance(manifest, dict) else None


def run_stage(
    stage: str,
    directory: Path,
    *,
    config: object,
    inputs: Sequence[Path],
    body: Callable[[Path], JsonObject],
    force: bool = False,
    facts: JsonObject | None = None,
) -> StageResult:
    """Run `body` for `stage` unless an earlier run with the same inputs, configuration and versions left its outputs intact.

    `body` gets an empty temporary folder inside `directory`, writes its output files there and returns the summary. Its
    files are then renamed into `directory`, the manifest last: a killed run leaves nothing that looks finished. Files that
    an earlier run of the stage left and this one did not write again are removed: nobody shall read a mixture.
    `facts` are what the results depend on of files that are no inputs as a whole, as the time at which the log begins.
    Raises `InputError` where an input is stale (`check_chain`).
    """
    digests = {path.name: hash_file(path) for path in inputs}
    check_chain(stage, directory, digests)
    key = {
        "stage": stage,
        "config": config_as_dict(config),
        "inputs": digests,
        "versions": versions(),
        **({"facts": dict(facts)} if facts else {}),
    }
    clear_abandoned(directory, f".{stage}.")
    earlier = read_manifest(stage, directory)
    if not force and earlier is not None:
        skipped = _still_valid(stage, directory, earlier, key)
        if skipped is not None:
            return skipped
    with working_folder(directory, stage) as work:
        summary = body(work)
        names = sorted(path.name for path in work.iterdir())
        manifest = {**key, "outputs": {name: hash_file(work / name) for name in names}, "summary": dict(summary)}
        # While the earlier manifest is there, it knows which files to remove; it must not vouch for a mixture of old and new.
        for name in set((earlier or {}).get("outputs", ())) - set(names):
            (directory / Path(name).name).unlink(missing_ok=True)
        manifest_path(stage, directory).unlink(missing_ok=True)
        for name in names:
            os.replace(work / name, directory / name)
        write_atomic(manifest_path(stage, directory), json.dumps(manifest, indent=1, sort_keys=True) + "\n")
    return StageResult(stage, "done", tuple(directory / name for name in names), summary)


def check_chain(stage: str, directory: Path, inputs: Mapping[str, str]) -> None:
    """Raise `InputError` where what `stage` reads in `directory` does not belong together.

    Each stage before it must have been made from what is there now, and `inputs` (SHA-256 by name) must be what they wrote.
    Files that no manifest vouches for are taken as they are: somebody else made them.
    """
    made: dict[str, str] = {}
    for earlier, results in itertools.takewhile(lambda item: item[0] != stage, CHAIN.items()):
        manifest = read_manifest(earlier, directory)
        again = f"run `cadence {earlier}` again, or `cadence run`, which does what is missing"
        for name, digest in _digests(manifest, "inputs").items():
            if made.get(name, digest) != digest:
                raise InputError(f"{directory}: {results} were made from another {name} than the one that is there; {again}")
        for name, digest in _digests(manifest, "outputs").items():
            if inputs.get(name, digest) != digest:
                raise InputError(f"{directory / name}: was changed after `cadence {earlier}` had written it; {again}")
            made[name] = digest


def _digests(manifest: JsonObject | None, kind: str) -> Mapping[str, str]:
    """SHA-256 by name of the inputs or the outputs that a manifest vouches for."""
    found = (manifest or {}).get(kind)
    return found if isinstance(found, dict) else {}


def _still_valid(stage: str, directory: Path, earlier: JsonObject, key: JsonObject) -> StageResult | None:
    """The earlier result where it was made from the same key and its files still have the content it had written."""
    outputs, summary = earlier.get("outputs"), earlier.get("summary")
    if not isinstance(outputs, dict) or not isinstance(summary, dict):
        return None
    if any(earlier.get(name) != value for name, value in key.items()):
        return None
    if any(not (directory / name).is_file() or hash_file(directory / name) != digest for name, digest in outputs.items()):
        return None
    return StageResult(stage, "skipped", tuple(directory / name for name in outputs), summary)
