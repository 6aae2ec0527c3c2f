"""One process at a time in a folder. The kernel frees what a killed process held: nothing stale is ever left."""

import contextlib
import fcntl
import glob
import os
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from cadence.errors import DeviceError

_POLL_S = 0.1
_NUM_RETRIES, _RETRY_S = 100, 0.001


@contextlib.contextmanager
def locked(folder: Path, on_wait: Callable[[str], object] = len) -> Iterator[None]:
    """Hold `folder`, made where it is absent, alone among all processes; where it stays empty, it is removed again.

    Waits while another process holds it, and says so once through `on_wait`. A file system that knows no locks is said
    there too, and the work goes on. Raises `DeviceError` where the folder cannot be made.
    """
    handle = _hold(folder, on_wait)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # the folder stays where it holds something
            folder.rmdir()
        os.close(handle)


def clear_abandoned(folder: Path, prefix: str) -> None:
    """Remove what in `folder` begins with `prefix` and is held by no process: a killed one left it."""
    for path in folder.glob(f"{glob.escape(prefix)}*"):
        if not _is_held(path):
            shutil.rmtree(path, ignore_errors=True)


def _is_held(folder: Path) -> bool:
    """Whether a process holds `folder`, or may hold it where the file system knows no locks."""
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:
        return True
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(handle)
    return False


def _hold(folder: Path, on_wait: Callable[[str], object]) -> int:
    has_told = False
    while True:
        handle = _opened(folder)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if _is_same(folder, handle):
                return handle
        except BlockingIOError:
            if not has_told:
                on_wait(f"{folder}: another process works there; waiting for it")
                has_told = True
            time.sleep(_POLL_S)
        except OSError as error:
            on_wait(f"{folder}: cannot be locked ({error.strerror}); do not run two at a time on it")
            return handle
        os.close(handle)


def _opened(folder: Path) -> int:
    """A handle on the folder, made where it is absent."""
    failure: OSError | None = None
    for _ in range(_NUM_RETRIES):
        try:
            folder.mkdir(parents=True, exist_ok=True)
            return os.open(folder, os.O_RDONLY)
        except FileNotFoundError as error:  # who had it before us may remove it or its parent; in /proc it stays so
            failure = error
            time.sleep(_RETRY_S)
        except OSError as error:
            failure = error
            break
    reason = failure.strerror if failure is not None else ""
    raise DeviceError(f"{folder}: cannot write there ({reason}); choose another folder with --out") from failure


def _is_same(folder: Path, handle: int) -> bool:
    """Whether the path still leads to what was locked."""
    try:
        return os.path.samestat(folder.stat(), os.fstat(handle))
    except FileNotFoundError:
        return False
