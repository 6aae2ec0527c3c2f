"""JSON and TOML from outside: whatever is wrong with such a text is a `ValueError`, nesting without end included."""

import json
import tomllib
from collections.abc import Callable
from typing import Any, TypeVar

T = TypeVar("T")


def parse_json(text: str | bytes) -> Any:
    """The value that a JSON text stands for."""
    return _not_too_deep(json.loads, text)


def parse_toml(text: str) -> dict[str, Any]:
    """The tables of a TOML text."""
    return _not_too_deep(tomllib.loads, text)


def _not_too_deep(parse: Callable[[Any], T], text: str | bytes) -> T:
    try:
        return parse(text)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error
