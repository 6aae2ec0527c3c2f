"""URLs as texts: what they name, and what of them may be shown. What they may hold as a secret is used and never shown."""

import re
from typing import Final
from urllib.parse import unquote, urlsplit

WEB: Final = ("http", "https")
_URL: Final = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+://")


def is_url(text: str) -> bool:
    """Whether `text` is a URL and not a path."""
    return _URL.match(text) is not None


def scheme_of(url: str) -> str:
    """What stands before `://`, in lower case."""
    return url.partition("://")[0].lower()


def shown(url: str) -> str:
    """The URL without what may be secret: a user and its password, and the query of web addresses, which may be a signature."""
    url = re.sub(r"^([^/]+//)[^/@]*@", r"\1", url)
    return re.sub(r"[?#].*$", "", url) if scheme_of(url) in WEB else url


def url_name(url: str) -> str:
    """The last part of a URL as the name of a file."""
    path = unquote(urlsplit(shown(url)).path) if scheme_of(url) in WEB else url
    return path.rstrip("/").rpartition("/")[2]
