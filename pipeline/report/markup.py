"""The few pieces of HTML that the sections are made of. Every text goes through `escape`: logs choose their own names."""

import base64
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

import numpy as np
import numpy.typing as npt

MAX_VALUE_CHARACTERS = 400


def text(value: object) -> str:
    """A value from JSON or a log as escaped text for people; long ones are cut and say so."""
    if value is None:
        shown = "none"
    elif isinstance(value, bool):
        shown = "yes" if value else "no"
    elif isinstance(value, float):
        shown = f"{value:.6g}" if math.isfinite(value) else "not a number"
    elif isinstance(value, str):
        shown = value
    elif isinstance(value, list) and value and all(isinstance(item, str) for item in value):
        shown = ", ".join(value)
    else:
        shown = str(value) if isinstance(value, int) else json.dumps(value, ensure_ascii=False, sort_keys=True)
    if len(shown) > MAX_VALUE_CHARACTERS:
        shown = f"{shown[:MAX_VALUE_CHARACTERS]}… ({len(shown):,} characters)"
    return escape(shown)


def label(key: object) -> str:
    """A JSON key as escaped words, its unit in brackets."""
    words = str(key).removeprefix("num_")
    for unit in ("s", "ns", "m", "mps", "hz", "deg"):
        if words.endswith(f"_{unit}"):
            words = f"{words.removesuffix(f'_{unit}')} ({unit})"
    return text(words.replace("_", " "))


def section(title: str, content: str, lead: str = "", kind: str = "") -> str:
    """A card; `lead` is text, `content` is HTML."""
    opening = f'<section class="{kind}">' if kind else "<section>"
    return f"{opening}<h2>{text(title)}</h2>{f'<p>{escape(lead)}</p>' if lead else ''}{content}</section>\n"


def legend(keys: Iterable[tuple[str, str]]) -> str:
    """A list of small drawings (SVG of 26 by 16) with their words."""
    items = "".join(
        f'<li><svg width="26" height="16" aria-hidden="true">{drawing}</svg>{text(words)}</li>' for drawing, words in keys
    )
    return f'<ul class="legend">{items}</ul>'


def table(heads: Sequence[str], rows: Iterable[Sequence[str]], numeric: Sequence[int] = (), kind: str = "") -> str:
    """A table from cells that are HTML already; `numeric` columns are set to the right."""
    classes = [' class="number"' if column in numeric else "" for column in range(len(heads))]
    head = "".join(f"<th{extra}>{text(name)}</th>" for extra, name in zip(classes, heads, strict=True))
    lines = ("".join(f"<td{extra}>{cell}</td>" for extra, cell in zip(classes, row, strict=True)) for row in rows)
    body = "".join(f"<tr>{line}</tr>\n" for line in lines)
    opening = f'<table class="{kind}">' if kind else "<table>"
    return f'<div class="scroll">{opening}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def pairs(rows: Iterable[tuple[str, str]]) -> str:
    """A two-column table of names and values, both HTML already."""
    body = "".join(f'<tr><th scope="row">{name}</th><td>{value}</td></tr>\n' for name, value in rows)
    return f'<div class="scroll"><table class="pairs"><tbody>{body}</tbody></table></div>'


def flatten(value: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """Nested objects as dotted keys in their order; empty ones are left out."""
    rows: list[tuple[str, Any]] = []
    for key, item in value.items():
        if isinstance(item, Mapping):
            rows += flatten(item, f"{prefix}{key}.")
        elif item not in ([], ""):
            rows.append((f"{prefix}{key}", item))
    return rows


def as_toml(tables: Mapping[str, Mapping[str, Any]]) -> str:
    """Configuration tables as TOML that `pipeline.config` reads back to the same values; unset keys are left out."""
    lines = []
    for name, values in tables.items():
        lines.append(f"[{_toml_key(name)}]")
        lines += [f"{_toml_key(key)} = {_toml(item)}" for key, item in values.items() if item is not None]
        lines.append("")
    return "\n".join(lines)


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_toml_key(key)} = {_toml(item)}" for key, item in value.items() if item is not None) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_toml(item) for item in value) + "]"
    if isinstance(value, int | float):
        return repr(value)
    return _toml_string(str(value))


def _toml_key(key: str) -> str:
    return key if key.replace("_", "").replace("-", "").isalnum() and key.isascii() else _toml_string(key)


def _toml_string(value: str) -> str:
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def numbers_as_base64(values: npt.ArrayLike, kind: str) -> str:
    """Numbers one behind the other as `kind` (such as "<i2"): what the page's script reads as a typed array."""
    return base64.b64encode(np.ascontiguousarray(np.asarray(values).astype(kind)).tobytes()).decode("ascii")


def inline_json(value: object) -> str:
    """JSON that may stand inside a script element: no text of a log can end the element or start another."""
    dense = json.dumps(value, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return dense.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
