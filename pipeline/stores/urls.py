"""URLs as texts: what they name, and what of them may be shown. What they may hold as a secret is used and never shown."""

import re
from typing import Final
from urllib.parse import unquote, urlsplit

WEB: Final = ("http", "https")
_URL: Final = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+://")
_LIKE_URL: Final = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/")  # a path that was made of one has lost a slash
_URL_IN_TEXT: Final = re.compile(rf"""({_LIKE_URL.pattern}[^\s'"<>]+?)([:;,.)]*(?=[\s'"<>]|$))""")


def is_url(text: str) -> bool:
    """Whether `text` is a URL and not a path."""
    return _URL.match(text) is not None


def scheme_of(url: str) -> str:
    """What stands before `://`, in lower case."""
    return url.partition(":/")[0].lower()


def shown(url: str) -> str:
    """The URL without what may be secret: a user and its password, and the query, which may be a signature.

    In the name of an object `?` and `#` are letters, and in a pattern `?` stands for one: there a query has a `=`.
    """
    if not _LIKE_URL.match(url):
        return url
    url = re.sub(r"^([^/]+:/+)[^/]*@", r"\1", url)
    return re.sub(r"[?#].*$" if scheme_of(url) in WEB else r"\?[^?]*=.*$", "", url)


def masked(text: str) -> str:
    """A text with every URL in it as it may be shown, also those that a path has made of one (`https:/host`)."""
    return _URL_IN_TEXT.sub(lambda found: shown(found[1]) + found[2], text)


def url_name(url: str) -> str:
    """The last part of a URL as the name of a file."""
    path = unquote(urlsplit(shown(url)).path) if scheme_of(url) in WEB else url
    return path.rstrip("/").rpartition("/")[2]
