"""Files behind URLs: find, fetch, write and list objects in buckets and on web servers, with retries and plain failures.

Everything that fsspec and the libraries below it can raise becomes one kind of failure here. What a URL may hold as a secret
(a user's name, a signature in the query) is used and never shown.
"""

import contextlib
import glob
import hashlib
import os
import re
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeVar
from urllib.parse import unquote, urlsplit

from cadence.errors import CadenceError, ConfigError, DeviceError, InputError
from pipeline.progress import Progress

T = TypeVar("T")

BLOCK_BYTES: Final = 8 * 1024 * 1024
"""Fetched at once: what a lost connection costs, and what is held in memory."""

NUM_ATTEMPTS: Final = 5
CONNECT_TIMEOUT_S: Final = 10.0
READ_TIMEOUT_S: Final = 60.0
_FIRST_PAUSE_S = 0.5
_URL: Final = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+://")
_WEB: Final = ("http", "https")
_EXTRAS: Final = {"s3": "cadence[s3]", "s3a": "cadence[s3]", "http": "cadence[s3]", "https": "cadence[s3]"}
_PACKAGES: Final = {"gs": "gcsfs", "gcs": "gcsfs", "abfs": "adlfs", "az": "adlfs"}
_LIBRARIES: Final = ("aiobotocore", "aiohttp", "botocore", "fsspec", "gcsfs", "google", "s3fs")
_PERMANENT_ERRNOS: Final = (1, 22, 36, 38, 78)  # not permitted, invalid, name too long, no such function, other region


class MissingObject(InputError):
    """There is no such object or folder, where its bucket is there."""


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


def is_url(text: str) -> bool:
    """Whether `text` is a URL and not a path."""
    return _URL.match(text) is not None


def shown(url: str) -> str:
    """The URL without what may be secret: a user and its password, and the query of web addresses, which may be a signature."""
    url = re.sub(r"^([^/]+//)[^/@]*@", r"\1", url)
    return re.sub(r"[?#].*$", "", url) if _scheme(url) in _WEB else url


def url_name(url: str) -> str:
    """The last part of a URL as the name of a file."""
    path = unquote(urlsplit(shown(url)).path) if _scheme(url) in _WEB else url
    return path.rstrip("/").rpartition("/")[2]


def find_objects(url: str, is_wanted: Callable[[str], bool]) -> tuple[StoredObject, ...]:
    """All objects that `url` means and whose name below it is wanted, sorted: one object, a prefix, or a pattern with `*`.

    An object that is named itself is wanted. One that is not there comes back with the size 0: its own failure will say so.
    """
    fs, path = _open(url)
    if not _is_pattern(url):
        try:
            about = _attempt(lambda: fs.info(path), url)
        except MissingObject:
            return (StoredObject(url, 0, ""),)
        if about["type"] != "directory":
            return (_stated(url, about),)
    listed = _attempt(lambda: fs.glob(path, detail=True) if _is_pattern(url) else fs.find(path, detail=True), url)
    start = "" if _is_pattern(url) else fs._strip_protocol(path).rstrip("/") + "/"
    return tuple(
        _stated(_url_of(fs, url, name), about)
        for name, about in sorted(listed.items())
        if about["type"] != "directory" and is_wanted(name.removeprefix(start))
    )


def describe(url: str) -> StoredObject:
    """Size and etag of one object; `MissingObject` where it is not there."""
    fs, path = _open(url)
    about = _attempt(lambda: fs.info(path), url)
    if about["type"] == "directory":
        raise InputError(f"{shown(url)}: is a folder, not an object; name a log in it")
    return _stated(url, about)


def list_folder(url: str) -> dict[str, StoredObject]:
    """The objects directly in a folder by name; empty where there is no such folder."""
    fs, path = _open(url)
    try:
        listed = _attempt(lambda: fs.ls(path, detail=True), url)
    except MissingObject:
        return {}
    files = [about for about in listed if about["type"] == "file"]
    return {url_name(about["name"]): _stated(f"{url.rstrip('/')}/{url_name(about['name'])}", about) for about in files}


def read_bytes(url: str) -> bytes:
    """The content of a small object; `MissingObject` where it is not there."""
    fs, path = _open(url)
    content: bytes = _attempt(lambda: fs.cat_file(path), url)
    return content


def write_file(source: Path, url: str) -> None:
    """Write a local file to `url`; it is there as a whole or not at all where the store writes objects as a whole."""
    fs, path = _open(url)
    _attempt(lambda: fs.put_file(str(source), path), url, is_output=True)


def remove(url: str) -> None:
    """Remove an object; nothing happens where there is none."""
    fs, path = _open(url)

    def act() -> None:
        with contextlib.suppress(FileNotFoundError):
            fs.rm_file(path)

    _attempt(act, url, is_output=True)


def fetch(found: StoredObject, folder: Path, progress: Progress) -> Path:
    """The object, as `describe` found it, as a file in `folder`.

    What an interrupted call fetched of the same content is not fetched again. Raises `InputError` where the object is gone or
    changes meanwhile, `DeviceError` where the store does not answer or the disk is full.
    """
    identity = hashlib.sha256(f"{shown(found.url)} {found.size_bytes} {found.etag}".encode()).hexdigest()[:16]
    target, part, mark = (folder / name for name in (found.name, f".{found.name}.{identity}.part", f".{found.name}.{identity}"))
    if target.is_file() and mark.is_file():
        return target
    for stale in (*folder.glob(f".{glob.escape(found.name)}.*"), target):
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
    fs, path = _open(found.url)
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

        yield _attempt(read, found.url)
        start = end


def _stream(fs: Any, path: str, found: StoredObject) -> Iterator[bytes]:
    """The whole object from a web server that knows no ranges: a lost connection cannot be continued."""
    stream = _attempt(lambda: fs.open(path, "rb", block_size=0, size=found.size_bytes), found.url)
    with contextlib.closing(stream):
        while block := _attempt(lambda: stream.read(BLOCK_BYTES), found.url, num_attempts=1):
            yield block


def _is_ranged(fs: Any, path: str, found: StoredObject) -> bool:
    """Whether parts of the object can be asked for: all stores can, web servers may."""
    if _scheme(found.url) not in _WEB:
        return True

    def ask() -> bool:
        with fs.open(path, "rb", block_size=0, size=found.size_bytes, headers={"Range": "bytes=0-0"}) as stream:
            return bool(stream.r.status == 206)

    return found.size_bytes > 0 and _attempt(ask, found.url)


def _attempt(action: Callable[[], T], url: str, is_output: bool = False, num_attempts: int | None = None) -> T:
    """What `action` returns; it is tried again after failures that may pass. Other failures of a store are explained."""
    num_attempts = num_attempts or NUM_ATTEMPTS
    for number in range(1, num_attempts + 1):
        try:
            return action()
        except Exception as error:
            if not _is_of_storage(error):
                raise
            error = _unwrapped(error)
            explained = _explained(error, url, is_output)
            if explained is not None:
                raise explained from error
            if number == num_attempts:
                raise DeviceError(
                    f"{shown(url)}: the store does not answer as it should, tried {number} times ({_reason(error)}); "
                    "check the connection, and run again"
                ) from error
        time.sleep(_FIRST_PAUSE_S * 2 ** (number - 1))
    raise AssertionError("unreachable: the last attempt returns or raises")


def _is_of_storage(error: Exception) -> bool:
    return isinstance(error, OSError) or any(kind.__module__.split(".")[0] in _LIBRARIES for kind in type(error).__mro__)


def _unwrapped(error: Exception) -> Exception:
    """What happened: fsspec calls every failure of a web server a file that is not found."""
    cause = error.__cause__
    is_web = isinstance(cause, OSError) or type(cause).__module__.split(".")[0] == "aiohttp"
    return cause if isinstance(error, FileNotFoundError) and isinstance(cause, Exception) and is_web else error


def _explained(error: Exception, url: str, is_output: bool) -> CadenceError | None:
    """What to tell of a failure that another attempt would meet again; None for one that may pass."""
    where, status, kinds = shown(url), getattr(error, "status", None), {kind.__name__ for kind in type(error).__mro__}
    if isinstance(error, FileNotFoundError) or status == 404:
        if _code(error) == "NoSuchBucket" or is_output:
            failure = DeviceError if is_output else InputError
            return failure(f"{where}: there is no such bucket; make it, or correct the URL")
        return MissingObject(f"{where}: not found; check the URL")
    if kinds & {"NoCredentialsError", "PartialCredentialsError", "CredentialRetrievalError", "ProfileNotFound"}:
        return DeviceError(f"{where}: no credentials found; set AWS_PROFILE, or AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY")
    if isinstance(error, PermissionError) or status in (401, 403):
        return DeviceError(f"{where}: access denied ({_reason(error)}); check the credentials and what they may do there")
    is_refused = status is not None and 400 <= status < 500 and status not in (408, 429)
    if is_refused or getattr(error, "errno", None) in _PERMANENT_ERRNOS or "ParamValidationError" in kinds:
        return DeviceError(f"{where}: the store refuses the request ({_reason(error)}); check the URL and the region")
    return None


def _code(error: BaseException) -> str:
    """What S3 calls the failure; empty elsewhere."""
    response = getattr(error.__cause__ or error, "response", None)
    return str(response.get("Error", {}).get("Code", "")) if isinstance(response, Mapping) else ""


def _reason(error: Exception) -> str:
    """Kind and first line of a failure, without queries and users of URLs that may stand in it."""
    lines = str(error).strip().splitlines()
    text = re.sub(r"\?[^\s'\")]*", "", re.sub(r"//[^\s/@]*@", "//", lines[0] if lines else ""))
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def _scheme(url: str) -> str:
    return url.partition("://")[0].lower()


def _is_pattern(url: str) -> bool:
    return any(sign in url for sign in ("*" if _scheme(url) in _WEB else "*?["))


def _url_of(fs: Any, url: str, name: str) -> str:
    return name if is_url(name) else f"{_scheme(url)}://{name.lstrip('/')}"


def _stated(url: str, about: Mapping[str, Any]) -> StoredObject:
    etag = next(
        (about[key] for key in ("ETag", "etag", "LastModified", "Last-Modified", "mtime", "created") if about.get(key)), ""
    )
    return StoredObject(url, int(about.get("size") or 0), str(etag).strip('"'))


def _open(url: str) -> tuple[Any, str]:
    """The file system of a URL and the path in it; `ConfigError` where its package is missing or the scheme is unknown."""
    scheme = _scheme(url)
    package = _EXTRAS.get(scheme) or _PACKAGES.get(scheme) or "cadence[s3]"
    try:
        import fsspec

        fs, path = fsspec.core.url_to_fs(url, **_options(scheme))
    except ImportError as error:
        raise ConfigError(f"{shown(url)}: {scheme}:// needs a package that is not installed; pip install {package}") from error
    except ValueError as error:
        raise ConfigError(f"{shown(url)}: {scheme}:// is not known; use s3://, gs://, https:// or a path") from error
    if scheme in ("s3", "s3a"):
        fs.retries = 1  # attempts are made, counted and paused between here
    return fs, path


def _options(scheme: str) -> dict[str, Any]:
    """Timeouts, and listings that are never remembered: other processes write to the same folders."""
    if scheme in ("s3", "s3a"):
        retries = {"total_max_attempts": 1, "mode": "standard"}
        config = {"connect_timeout": CONNECT_TIMEOUT_S, "read_timeout": READ_TIMEOUT_S, "retries": retries}
        return {"config_kwargs": config, "use_listings_cache": False}
    if scheme in _WEB:
        import aiohttp

        timeout = aiohttp.ClientTimeout(total=None, sock_connect=CONNECT_TIMEOUT_S, sock_read=READ_TIMEOUT_S)
        return {"client_kwargs": {"timeout": timeout}, "use_listings_cache": False}
    return {}
