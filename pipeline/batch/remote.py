"""One mission whose log or directory is a URL: fetch the log, run it here, publish the results with the manifests last.

A log lies on the local disk only while it is worked on. A receipt, `run.manifest.json`, is written when everything else is
there: it says from which object with which etag the results were made, and what was published. While it agrees, nothing is
fetched or computed again.
"""

import contextlib
import dataclasses
import hashlib
import json
import os
import shutil
import tempfile
import time
import traceback
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final, Literal

from cadence.errors import CadenceError, DeviceError
from pipeline.batch.outcome import LogOutcome, LogTask
from pipeline.batch.tasks import run_task
from pipeline.config import config_as_dict
from pipeline.documents import parse_json
from pipeline.files import hash_file, write_atomic
from pipeline.locks import locked
from pipeline.manifest import StageResult, manifest_path, read_manifest
from pipeline.progress import Progress
from pipeline.provenance import versions
from pipeline.stores.objects import StoredObject, describe, fetch, list_folder, read_bytes, remove, write_file
from pipeline.stores.stores import MissingObject
from pipeline.stores.urls import is_url, masked, shown

RECEIPT_NAME: Final = "run.manifest.json"
SOURCE_NAME: Final = ".source"
"""Folder in the mission directory for the fetched log; catalogue.json names the log as lying there."""

_MANIFEST_ENDING = ".manifest.json"
_FETCHED, _COMPUTED = 0.2, 0.9  # shares of a task


def run_anywhere(task: LogTask, progress: Progress) -> LogOutcome:
    """`run_task`, also where parts or directory are URLs. Failures are in the outcome."""
    if not any(is_url(text) for text in (*task.parts, task.directory)):
        return run_task(task, progress)
    started_s, trace = time.monotonic(), ""
    try:
        outcome = _run(task, progress)
        return dataclasses.replace(outcome, elapsed_s=time.monotonic() - started_s)
    except CadenceError as error:
        message, code = str(error), error.exit_code
    except Exception as error:  # as in `run_task`: one log must not cost the results of the others
        trace, code = masked(traceback.format_exc()), CadenceError.exit_code
        message = f"{task.log}: defect ({type(error).__name__}: {error}); please report its traceback"
    return LogOutcome(task, (), masked(" ".join(message.split())), code, time.monotonic() - started_s, trace)


def write_text(where: str, text: str) -> None:
    """Write a small file to a path or a URL, as a whole or not at all."""
    if not is_url(where):
        write_atomic(Path(where), text)
        return
    with tempfile.TemporaryDirectory(prefix="cadence-") as folder:
        draft = Path(folder) / "draft"
        draft.write_text(text, encoding="utf-8")
        write_file(draft, where)


def _run(task: LogTask, progress: Progress) -> LogOutcome:
    is_published = is_url(task.directory)
    key = {"stage": "run", "config": config_as_dict(task.config), "versions": versions(), "sources": _sources(task)}
    receipt = _read_receipt(task.directory)
    if not task.force and receipt is not None and _agrees(receipt, key, task.directory):
        return _skipped(task, receipt)
    with _home(task) as home, locked(home / SOURCE_NAME, progress.note):
        if is_published and not any(home.glob(f"*{_MANIFEST_ENDING}")):
            _pull(task.directory, home)
        earlier = _outputs(home)
        parts = _fetch(task, home / SOURCE_NAME, progress.part(0.0, _FETCHED))
        here = dataclasses.replace(task, parts=tuple(map(str, parts)), directory=str(home))
        outcome = run_task(here, progress.part(_FETCHED, _COMPUTED))
        files = _files(outcome, home)
        _forget_receipt(task.directory)
        if is_published:
            _publish(home, task.directory, files, sorted(earlier - set(files)), receipt, progress.part(_COMPUTED, 1.0))
        told = _told(outcome, task, here)
        if not told.exit_code:
            _write_receipt(task.directory, key, told, files)
        shutil.rmtree(home / SOURCE_NAME, ignore_errors=True)
        if is_published:
            shutil.rmtree(home, ignore_errors=True)
    return told


def _sources(task: LogTask) -> list[dict[str, Any]]:
    """What the results are made from, as far as it can be known without reading it all from afar."""
    found = []
    for part in task.parts:
        if is_url(part):
            stored = describe(part)
            found.append({"url": shown(part), "size_bytes": stored.size_bytes, "etag": stored.etag})
        else:
            digest = hash_file(Path(part))
            found.append({"url": Path(part).name, "size_bytes": Path(part).stat().st_size, "etag": digest})
    return found


@contextlib.contextmanager
def _home(task: LogTask) -> Iterator[Path]:
    """The mission directory; for one that is a URL, a folder of the same name here, the same for each run of this user."""
    if not is_url(task.directory):
        yield Path(task.directory)
        return
    root = Path(tempfile.gettempdir()) / f"cadence-{os.getuid()}"
    try:
        root.mkdir(mode=0o700, exist_ok=True)
        if root.stat().st_uid != os.getuid() or root.is_symlink():
            raise DeviceError(f"{root}: belongs to somebody else; set TMPDIR to a folder of yours")
        home = root / hashlib.sha256(task.directory.encode()).hexdigest()[:16] / task.name
        home.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DeviceError(f"{root}: cannot write there ({error.strerror}); set TMPDIR to a folder with space") from error
    try:
        yield home
    finally:
        with contextlib.suppress(OSError):  # it stays where an interrupted run can go on
            home.rmdir()
        with contextlib.suppress(OSError):
            home.parent.rmdir()


def _fetch(task: LogTask, folder: Path, progress: Progress) -> list[Path]:
    """The parts as local files, the remote ones in `folder`."""
    parts = []
    for number, part in enumerate(task.parts):
        share = progress.part(number / len(task.parts), (number + 1) / len(task.parts))
        parts.append(fetch(describe(part), folder, share) if is_url(part) else Path(part))
    return parts


def _files(outcome: LogOutcome, home: Path) -> dict[str, str]:
    """SHA-256 by name of what the finished stages left, manifests included."""
    names = {path.name for stage in outcome.stages for path in map(Path, stage.outputs)}
    names |= {manifest_path(stage.stage, home).name for stage in outcome.stages}
    return {name: hash_file(home / name) for name in sorted(names)}


def _outputs(home: Path) -> set[str]:
    """Names of the files that the manifests in `home` vouch for."""
    stages = [path.name.removesuffix(_MANIFEST_ENDING) for path in home.glob(f"*{_MANIFEST_ENDING}")]
    return {name for stage in stages for name in (read_manifest(stage, home) or {}).get("outputs", ())}


def _publish(
    home: Path, url: str, files: Mapping[str, str], stale: list[str], receipt: Mapping[str, Any] | None, progress: Progress
) -> None:
    """Upload what is new, the manifests last: they vouch for what lies there, and never for a mixture."""
    there = list_folder(url)
    known = (receipt or {}).get("files", {})
    new = [name for name, digest in files.items() if not _is_there(name, digest, known, there)]
    manifests = [name for name in new if name.endswith(_MANIFEST_ENDING)]
    for name in manifests:
        if name in there:
            remove(f"{url}/{name}")
    for name in stale:
        if name in there and not (home / name).is_file():  # else it is of a later stage, whose manifest stays, too
            remove(f"{url}/{name}")
    contents = [name for name in new if name not in manifests]
    with progress.bar(sum((home / name).stat().st_size for name in new), f"publish {home.name}", "B", scale=True) as bar:
        for name in (*contents, *manifests):
            write_file(home / name, f"{url}/{name}")
            bar.update((home / name).stat().st_size)


def _is_there(name: str, digest: str, known: Mapping[str, Any], there: Mapping[str, StoredObject]) -> bool:
    """Whether the store still holds what was published as `name` with this hash."""
    entry = known.get(name)
    return entry is not None and entry["sha256"] == digest and name in there and _is_same(entry, there[name])


def _is_same(entry: Mapping[str, Any], found: StoredObject) -> bool:
    return bool(entry["size_bytes"] == found.size_bytes and entry["etag"] == found.etag and found.etag)


def _pull(url: str, home: Path) -> None:
    """Bring the results of an earlier run here: stages that still agree are then skipped."""
    there = list_folder(url)
    for name in [name for name in there if name.endswith(_MANIFEST_ENDING) and name != RECEIPT_NAME]:
        (home / name).write_bytes(read_bytes(f"{url}/{name}"))
    for name in sorted(_outputs(home) & set(there)):
        shutil.move(fetch(describe(there[name].url), home / SOURCE_NAME, Progress(quiet=True)), home / name)


def _read_receipt(directory: str) -> dict[str, Any] | None:
    """The receipt of an earlier run; None where there is none, or none that can be read."""
    try:
        text = read_bytes(f"{directory}/{RECEIPT_NAME}") if is_url(directory) else (Path(directory) / RECEIPT_NAME).read_bytes()
        receipt = parse_json(text)
    except (MissingObject, OSError, ValueError):
        return None
    is_whole = isinstance(receipt, dict) and isinstance(receipt.get("files"), dict) and isinstance(receipt.get("stages"), list)
    return receipt if is_whole else None


def _agrees(receipt: Mapping[str, Any], key: Mapping[str, Any], directory: str) -> bool:
    """Whether the results were made from the same sources, and are still there as they were written."""
    if any(receipt.get(name) != json.loads(json.dumps(value)) for name, value in key.items()):
        return False
    if not all(source["etag"] for source in key["sources"]):
        return False
    files = receipt["files"]
    if is_url(directory):
        there = list_folder(directory)
        return all(_is_there(name, entry["sha256"], files, there) for name, entry in files.items())
    here = Path(directory)
    return all((here / name).is_file() and hash_file(here / name) == entry["sha256"] for name, entry in files.items())


def _forget_receipt(directory: str) -> None:
    if is_url(directory):
        remove(f"{directory}/{RECEIPT_NAME}")
    else:
        (Path(directory) / RECEIPT_NAME).unlink(missing_ok=True)


def _write_receipt(directory: str, key: Mapping[str, Any], outcome: LogOutcome, files: Mapping[str, str]) -> None:
    there = list_folder(directory) if is_url(directory) else {}
    entries: dict[str, dict[str, Any]] = {name: {"sha256": digest} for name, digest in files.items()}
    for name, entry in entries.items():
        if is_url(directory):
            if name not in there:
                raise DeviceError(f"{directory}/{name}: is gone after it was written; does another run write there, too?")
            entry |= {"size_bytes": there[name].size_bytes, "etag": there[name].etag}
    stages = [
        {"stage": stage.stage, "outputs": [Path(path).name for path in stage.outputs], "summary": stage.summary}
        for stage in outcome.stages
    ]
    content = {**key, "files": entries, "stages": stages, "message": outcome.message}
    write_text(f"{directory}/{RECEIPT_NAME}", json.dumps(content, indent=1, sort_keys=True) + "\n")


def _skipped(task: LogTask, receipt: Mapping[str, Any]) -> LogOutcome:
    stages = tuple(_stage(task, "skipped", **entry) for entry in receipt["stages"])
    return LogOutcome(task, stages, message=receipt.get("message", ""))


def _told(outcome: LogOutcome, task: LogTask, here: LogTask) -> LogOutcome:
    """The outcome with the places that the user knows instead of those on this machine."""
    stages = tuple(
        _stage(task, stage.status, stage.stage, [Path(path).name for path in stage.outputs], stage.summary)
        for stage in outcome.stages
    )
    message, trace = outcome.message, outcome.trace
    for local, part in zip(here.parts, task.parts, strict=True):
        message = message.replace(local, shown(part))
    message = message.replace(here.directory, shown(task.directory))
    return dataclasses.replace(outcome, task=task, stages=stages, message=message, trace=trace)


def _stage(
    task: LogTask, status: Literal["done", "skipped"], stage: str, outputs: list[str], summary: Mapping[str, Any]
) -> StageResult:
    return StageResult(stage, status, tuple(_place(task.directory, name) for name in outputs), summary)


def _place(directory: str, name: str) -> Path | str:
    return f"{shown(directory)}/{name}" if is_url(directory) else Path(directory) / name
