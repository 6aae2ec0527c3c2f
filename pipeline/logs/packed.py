"""Logs that are compressed as a whole, as rosbag2 does in its compression mode FILE: unpacked while they are read.

MCAP is read at many places, a zstd stream from its beginning only. The copies lie in a folder of this process, which is gone
when the process ends; the last few are kept, because every stage reads its log again.
"""

import contextlib
import functools
import hashlib
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO, Final

import zstandard

from cadence.errors import DeviceError, InputError
from pipeline.logs.compression import ZSTD_MAGIC
from pipeline.logs.records import MAGIC, TEXT_MAGIC

_MAX_COPIES: Final = 8
_STEP_BYTES: Final = 2**16
"""At a damaged place the step is lost."""
_MIN_FREE_BYTES: Final = 2**29
"""So much of the disk is left to others: a small file may unpack to more than any disk holds."""


def unpacked(path: Path, on_bytes: Callable[[int], object] | None = None) -> Path:
    """`path`, or an unpacked copy where it is compressed; `on_bytes` is called with the bytes of it that are done.

    Of a file that is damaged or cut off the copy holds what stands before. Raises OSError where it cannot be read,
    `InputError` where it holds no MCAP, `DeviceError` where there is no room for the copy.
    """
    with path.open("rb") as file:
        if file.read(len(ZSTD_MAGIC)) != ZSTD_MAGIC:
            return path
        found = path.stat()
        key = hashlib.sha256(f"{path.resolve()} {found.st_size} {found.st_mtime_ns}".encode()).hexdigest()
        copy = Path(_folder(os.getpid()).name) / key
        if copy.is_file():
            os.utime(copy)
            if on_bytes is not None:
                on_bytes(found.st_size)
            return copy
        _forget(copy.parent)
        draft = copy.with_suffix(".draft")
        file.seek(0)
        try:
            with draft.open("wb") as target:
                _unpack(path, file, target, on_bytes)
            return draft.replace(copy)
        except OSError as error:
            raise DeviceError(f"{path}: cannot be unpacked into {draft.parent} ({error.strerror}); set TMPDIR") from error
        finally:
            draft.unlink(missing_ok=True)


def in_proportion(on_bytes: Callable[[int], object] | None, total: int, share: int) -> Callable[[int], None]:
    """Calls `on_bytes` with steps that add up to `share` where its own add up to `total`."""
    done = reported = 0

    def advance(step: int) -> None:
        nonlocal done, reported
        done += step
        reach = share * done // max(1, total)
        if on_bytes is not None and reach > reported:
            on_bytes(reach - reported)
            reported = reach

    return advance


@functools.cache
def _folder(process: int) -> tempfile.TemporaryDirectory[str]:
    """The folder of this process: one that was forked does not use that of its parent, which is not its own to remove."""
    return tempfile.TemporaryDirectory(prefix=f"cadence-{process}-")


def _forget(folder: Path) -> None:
    """Remove the copies that were used longest ago; a file that is open stays readable."""
    copies = sorted(folder.iterdir(), key=lambda copy: copy.stat().st_mtime_ns, reverse=True)
    for copy in copies[_MAX_COPIES - 1 :]:
        copy.unlink()


def _unpack(path: Path, source: BinaryIO, target: BinaryIO, on_bytes: Callable[[int], object] | None) -> None:
    reader = zstandard.ZstdDecompressor().stream_reader(source, read_across_frames=True)
    is_empty, reported = True, 0
    with contextlib.suppress(zstandard.ZstdError):  # what was read before the damage is what there is
        while step := reader.read(_STEP_BYTES):
            if is_empty and not step.startswith((MAGIC, TEXT_MAGIC)):
                break
            if shutil.disk_usage(Path(target.name).parent).free < _MIN_FREE_BYTES:
                words = f"unpacks to more than fits into {Path(target.name).parent}"
                raise DeviceError(f"{path}: {words}; set TMPDIR to a folder with room, or unpack it yourself")
            is_empty = False
            target.write(step)
            if on_bytes is not None:
                on_bytes(source.tell() - reported)
                reported = source.tell()
    if is_empty:
        raise InputError(f"{path}: is compressed with zstd, and holds no MCAP that can be read; unpack it and look")
    if on_bytes is not None:
        on_bytes(path.stat().st_size - reported)
