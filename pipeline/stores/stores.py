"""Stores behind URLs: opened with timeouts, asked again after failures that may pass, other failures in plain words.

Everything that fsspec and the libraries below it can raise becomes one kind of failure here.
"""

import re
import time
from collections.abc import Callable, Mapping
from typing import Any, Final, TypeVar

from cadence.errors import CadenceError, ConfigError, DeviceError, InputError
from pipeline.stores.urls import WEB, scheme_of, shown

T = TypeVar("T")

NUM_ATTEMPTS: Final = 5
FIRST_PAUSE_S: Final = 0.5
CONNECT_TIMEOUT_S: Final = 10.0
READ_TIMEOUT_S: Final = 60.0
_S3: Final = ("s3", "s3a")
_PACKAGES: Final = {"gs": "gcsfs", "gcs": "gcsfs", "abfs": "adlfs", "az": "adlfs"}
_LIBRARIES: Final = ("aiobotocore", "aiohttp", "botocore", "fsspec", "ftplib", "gcsfs", "google", "s3fs")
_PERMANENT_ERRNOS: Final = (1, 22, 36, 38, 78)  # not permitted, invalid, name too long, no such function, other region


class MissingObject(InputError):
    """There is no such object or folder, where its bucket is there."""


def open_store(url: str) -> tuple[Any, str]:
    """The file system of a URL and the path in it; `ConfigError` where its package is missing or the scheme is unknown."""
    scheme = scheme_of(url)
    package = _PACKAGES.get(scheme, "cadence[s3]")
    try:
        import fsspec

        # Some stores are asked already here, before anything is wanted of them (ftp).
        fs, path = attempt(lambda: fsspec.core.url_to_fs(url, **_options(scheme)), url)
    except ImportError as error:
        raise ConfigError(f"{shown(url)}: {scheme}:// needs a package that is not installed; pip install {package}") from error
    except ValueError as error:
        raise ConfigError(f"{shown(url)}: {scheme}:// is not known; use s3://, gs://, https:// or a path") from error
    if scheme in _S3:
        fs.retries = 1  # attempts are made, counted and paused between here
    return fs, path


def _options(scheme: str) -> dict[str, Any]:
    """Timeouts, and listings that are never remembered: other processes write to the same folders."""
    if scheme in _S3:
        retries = {"total_max_attempts": 1, "mode": "standard"}
        config = {"connect_timeout": CONNECT_TIMEOUT_S, "read_timeout": READ_TIMEOUT_S, "retries": retries}
        return {"config_kwargs": config, "use_listings_cache": False}
    if scheme in WEB:
        import aiohttp

        timeout = aiohttp.ClientTimeout(total=None, sock_connect=CONNECT_TIMEOUT_S, sock_read=READ_TIMEOUT_S)
        return {"client_kwargs": {"timeout": timeout}, "use_listings_cache": False}
    return {}


def attempt(action: Callable[[], T], url: str, is_output: bool = False, num_attempts: int | None = None) -> T:
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
        time.sleep(FIRST_PAUSE_S * 2 ** (number - 1))
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
