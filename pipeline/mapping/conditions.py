"""Conditions on messages: `fix_type >= 3 && lat_lon_valid`, which positions of a source are to be used.

Terms are joined by `&&` (all must hold): a message path and a comparison (`== != < <= > >=`, or `&`: has one of these bits)
with a value as in a path's filter; a path alone, which must be true; or `!path`, which must not. A term about an item
(`objects[:].existence_probability > 0.5`) decides for that item, one about the message for all of its items.
"""

import itertools
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pipeline.mapping.message_path import Field, Filter, MessagePath, MissingFieldError, Place, parse_literal, parse_path

_QUOTED_OR_BRACED = r"""\{(?:[^{}"']|"[^"]*"|'[^']*')*\}|"[^"]*"|'[^']*'"""
_AND = re.compile(rf"((?:{_QUOTED_OR_BRACED}|(?!&&).)*)(?:&&|$)", re.DOTALL)
_TERM = re.compile(rf"\s*(!?)\s*((?:{_QUOTED_OR_BRACED}|[^=!<>&\s])+)\s*(?:(==|!=|<=|>=|<|>|&)\s*(\S.*?)\s*)?", re.DOTALL)


@dataclass(frozen=True)
class Condition:
    """One term. `parent` leads to what has the field that `test` looks at; `text` as it was written."""

    text: str
    parent: MessagePath
    test: Filter

    @property
    def path(self) -> MessagePath:
        """The path of the field itself."""
        return MessagePath(self.text, (*self.parent.steps, *(Field(name) for name in self.test.names)))

    def located(self, message: Any) -> Mapping[Place, bool | None]:
        """Whether the term holds, by place; None where the field is absent; empty where not even its parent is there."""
        try:
            return {place: self.test.verdict(item) for place, item in self.parent.located(message).items()}
        except MissingFieldError:
            return {}


def parse_conditions(text: str) -> tuple[Condition, ...]:
    """The terms; `ValueError` says in one line what is wrong."""
    terms = [found[1] for found in _AND.finditer(text) if found[0]] or [""]
    if text.rstrip().endswith("&&"):
        terms.append("")
    return tuple(_parse_term(term, text) for term in terms)


def _parse_term(term: str, whole: str) -> Condition:
    found = _TERM.fullmatch(term)
    if found is None or (found[1] and found[3]):
        raise ValueError(
            f'condition {whole!r}: expected terms such as fix_type >= 3, kind == "ship", valid or !valid, not {term!r}'
        )
    path = parse_path(found[2])
    fields = itertools.takewhile(lambda step: isinstance(step, Field), reversed(path.steps))
    names = tuple(step.name for step in fields if isinstance(step, Field))[::-1]
    parent = MessagePath(found[2], path.steps[: len(path.steps) - len(names)])
    if not names:
        raise ValueError(f"condition {whole!r}: {found[2]!r} does not end in a field")
    symbol, value = (found[3], parse_literal(found[4])) if found[3] else ("==", not found[1])
    if isinstance(value, str) and value.startswith("$"):
        raise ValueError(f"condition {whole!r}: variables such as {value} are not known here; expected a value")
    return Condition(term.strip(), parent, Filter(names, symbol, value))
