"""Objects in buckets and on web servers: find, fetch, read, write, list and remove them."""

import contextlib
import hashlib
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from cadence.errors import DeviceError, InputError
from pipeline.progress import Progress
from pipeline.stores.stores import MissingObject, attempt, open_store
from pipeline.stores.urls import WEB, is_url, scheme_of, shown, url_name

BLOCK_BYTES: Final = 8 * 1024 * 1024
"""Fetched at once: what a lost connection costs, and what is held in memory."""

_ETAGS: Final = ("ETag", "etag", "LastModified", "Last-Modified", "mtime", "created")


@dataclass(frozen=True)
class StoredObject:
    """An object as its store lists it.

    etag  what changes with the content, as the store states it; empty where it states nothing
    """

    url: str
    size_bytes: int
    etag: str

    @property
    def name(self) -> str:
        """The last part of the URL."""
        return url_name(self.url)


def find_objects(url: str, is_wanted: Callable[[str], bool]) -> tuple[StoredObject, ...]:
    """All objects that `url` means and whose name below it is wanted, sorted: one object, a prefix, or a pattern with `*`.

    An object that is named itself is wanted. One that is not there comes back with the size 0: its own failure will say so.
    """
    fs, path = open_store(url)
    if not _is_pattern(url):
        try:
            about = attempt(lambda: fs.info(path), url)
        except MissingObject:
            return (StoredObject(url, 0, ""),)
        if about["type"] != "directory":
            return (_stated(url, about),)
    listed = attempt(lambda: fs.glob(path, detail=True) if _is_pattern(url) else fs.find(path, detail=True), url)
    start = "" if _is_pattern(url) else fs._strip_protocol(path).rstrip("/") + "/"
    return tuple(
        _stated(_url_of(fs, url, name), about)
        for name, about in sorted(listed.items())
        if about["type"] != "directory" and is_wanted(name.removeprefix(start))
    )


def describe(url: str) -> StoredObject:
    """Size and etag of one object; `MissingObject` where it is not there."""
    fs, path = open_store(url)
    about = attempt(lambda: fs.info(path), url)
    if about["type"] == "directory":
        raise InputError(f"{shown(url)}: is a folder, not an object; name a log in it")
    return _stated(url, about)


def list_folder(url: str) -> dict[str, StoredObject]:
    """The objects directly in a folder by name; empty where there is no such folder."""
    fs, path = open_store(url)
    try:
        listed = attempt(lambda: fs.ls(path, detail=True), url)
    except MissingObject:
        return {}
    files = [about for about in listed if about["type"] == "file"]
    return {url_name(about["name"]): _stated(f"{url.rstrip('/')}/{url_name(about['name'])}", about) for about in files}


def read_bytes(url: str) -> bytes:
    """The content of a small object; `MissingObject` where it is not there."""
    fs, path = open_store(url)
    content: bytes = attempt(lambda: fs.cat_file(path), url)
    return content


def write_file(source: Path, url: str) -> None:
    """Write a local file to `url`; it is there as a whole or not at all where the store writes objects as a whole."""
    fs, path = open_store(url)
    attempt(lambda: fs.put_file(str(source), path), url, is_output=True)


def remove(url: str) -> None:
    """Remove an object; nothing happens where there is none."""
    fs, path = open_store(url)

    def act() -> None:
        with contextlib.suppress(FileNotFoundError):
            fs.rm_file(path)

    attempt(act, url, is_output=True)


def fetch(found: StoredObject, folder: Path, progress: Progress) -> Path:
    """The object, as `describe` found it, as a file in `folder`.

    What an interrupted call fetched of the same content is not fetched again. Raises `InputError` where the object is gone or
    changes meanwhile, `DeviceError` where the store does not answer or the disk is full.
    """
    identity = hashlib.sha256(f"{shown(found.url)} {found.size_bytes} {found.etag}".encode()).hexdigest()[:16]
    hidden = f".{hashlib.sha256(found.name.encode()).hexdigest()[:16]}"  # the name itself may be too long to be appended to
    target, part, mark = (folder / name for name in (found.name, f"{hidden}.{identity}.part", f"{hidden}.{identity}"))
    if target.is_file() and mark.is_file():
        return target
    for stale in (*folder.glob(f"{hidden}.*"), target):
        if stale != part:
            stale.unlink(missing_ok=True)
    _download(found, part, progress)
    if describe(found.url) != found:
        part.unlink(missing_ok=True)
        raise InputError(f"{shown(found.url)}: was changed while it was fetched; run again when it is complete")
    os.replace(part, target)
    mark.touch()
    return target


def _download(found: StoredObject, part: Path, progress: Progress) -> None:
    fs, path = open_store(found.url)
    is_ranged = _is_ranged(fs, path, found)
    if not is_ranged:
        part.unlink(missing_ok=True)
    blocks = _ranges(fs, path, found, part) if is_ranged else _stream(fs, path, found)
    try:
        with part.open("ab") as file, progress.bar(found.size_bytes or None, f"fetch {found.name}", "B", scale=True) as bar:
            bar.update(file.tell())
            for block in blocks:
                file.write(block)
                file.flush()
                bar.update(len(block))
            num_bytes = file.tell()
    except OSError as error:
        raise DeviceError(f"{part}: cannot write ({error.strerror}); free space, or set TMPDIR to a larger disk") from error
    if num_bytes != found.size_bytes and (found.size_bytes or is_ranged):
        part.unlink(missing_ok=True)
        raise DeviceError(
            f"{shown(found.url)}: {num_bytes} bytes came instead of {found.size_bytes}; run again, or check the server"
        )


def _ranges(fs: Any, path: str, found: StoredObject, part: Path) -> Iterator[bytes]:
    """What is missing of the object, block by block, each with attempts of its own."""
    start = part.stat().st_size if part.is_file() else 0
    while start < found.size_bytes:
        end = min(start + BLOCK_BYTES, found.size_bytes)

        def read(start: int = start, end: int = end) -> bytes:
            block: bytes = fs.cat_file(path, start=start, end=end)
            if len(block) != end - start:
                raise ConnectionError(f"{len(block)} bytes came instead of {end - start}")
            return block

        yield attempt(read, found.url)
        start = end


def _stream(fs: Any, path: str, found: StoredObject) -> Iterator[bytes]:
    """The whole object from a web server that knows no ranges: a lost connection cannot be continued."""
    stream = attempt(lambda: fs.open(path, "rb", block_size=0, size=found.size_bytes), found.url)
    with contextlib.closing(stream):
        while block := attempt(lambda: stream.read(BLOCK_BYTES), found.url, num_attempts=1):
            yield block


def _is_ranged(fs: Any, path: str, found: StoredObject) -> bool:
    """Whether parts of the object can be asked for: all stores can, web servers may."""
    if scheme_of(found.url) not in WEB:
        return True

    def ask() -> bool:
        with fs.open(path, "rb", block_size=0, size=found.size_bytes, headers={"Range": "bytes=0-0"}) as stream:
            return bool(stream.r.status == 206)

    return found.size_bytes > 0 and attempt(ask, found.url)


def _is_pattern(url: str) -> bool:
    return any(sign in url for sign in ("*" if scheme_of(url) in WEB else "*?["))


def _url_of(fs: Any, url: str, name: str) -> str:
    return name if is_url(name) else f"{scheme_of(url)}://{name.lstrip('/')}"


def _stated(url: str, about: Mapping[str, Any]) -> StoredObject:
    etag = next((about[key] for key in _ETAGS if about.get(key)), "")
    return StoredObject(url, int(about.get("size") or 0), str(etag).strip('"'))
