"""Files that are whole or not there, and their hashes."""

import contextlib
import functools
import hashlib
import os
import secrets
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

from cadence.errors import DeviceError, InputError
from pipeline.locks import clear_abandoned, locked

_SETTLED_NS = 2_000_000_000
"""Stamps are as coarse as this on some file systems (FAT); most are finer."""


def hash_file(path: Path) -> str:
    """SHA-256 of the content; `InputError` where the file is absent or cannot be read.

    A file that was hashed before is read again only where its size, its stamps or its identity are others. The stamps of a
    file that has just been written say too little: it may be written again within one tick of its clock.
    """
    try:
        found = path.stat()
        changed_ns = max(found.st_mtime_ns, found.st_ctime_ns)
        read = _digest if time.time_ns() - changed_ns > _SETTLED_NS else _digest.__wrapped__
        return read(path, (found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns))
    except FileNotFoundError as error:
        raise InputError(f"{path}: not found; check the path, or run the stage that writes it first") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check that it is a file and its permissions") from error


@functools.lru_cache(maxsize=1024)
def _digest(path: Path, identity: tuple[int, ...]) -> str:
    """SHA-256 of what lies at `path`, read in blocks; `identity` is what the file system says of it."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_atomic(path: Path, text: str) -> None:
    """Write a small text file so that readers see the old or the new content, never a part."""
    with replacing(path) as draft:
        draft.write_text(text, encoding="utf-8")


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A draft to write to, which takes the place of `path` where the block ends without an exception.

    Readers see the old or the new content, never a part. What a killed process left is removed by the next one.
    Raises `DeviceError` where the folder or the disk does not take it.
    """
    clear_abandoned(path.parent, f".{path.name}.")
    with working_folder(path.parent, path.name) as work:
        draft = work / path.name
        try:
            yield draft
            os.replace(draft, path)
        except OSError as error:
            raise DeviceError(f"{path}: cannot write ({error.strerror}); check the folder and the free space") from error


@contextlib.contextmanager
def working_folder(directory: Path, name: str) -> Iterator[Path]:
    """A hidden folder of this process alone inside `directory`, which is made where it is absent; removed with all it holds.

    `clear_abandoned` knows it by `.NAME.` where a killed process left it. Raises `DeviceError` where it cannot be written to.
    """
    is_new = not directory.exists()
    work = directory / f".{name}.{secrets.token_hex(4)}"
    try:  # begins before the folder is there, as a signal may end it at any moment
        try:
            directory.mkdir(parents=True, exist_ok=True)
            work.mkdir(mode=0o700)
        except OSError as error:
            raise DeviceError(
                f"{directory}: cannot write there ({error.strerror}); choose another folder with --out"
            ) from error
        try:
            with locked(work):  # so that others know it from what a killed process left
                yield work
        except OSError as error:
            raise DeviceError(f"{directory}: {name} could not write its output ({error}); check the free space") from error
    finally:
        shutil.rmtree(work, ignore_errors=True)
        if is_new:
            with contextlib.suppress(OSError):  # the folder stays where it holds something
                directory.rmdir()
