"""Message paths in Foxglove's syntax: `detections[:]{score>=0.5}.bbox.center.position.x`.

The topic is not part of a path here. Fields by name (quoted where they hold other characters), `[i]` with negative indices
from the end, `[a:b]` with both ends included (as Foxglove has it, unlike Python), and filters `{field==value}`
(`== != < <= > >=`) that keep the matching items. A path gives a list: one value, or one an item after a slice.
"""

import operator
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

_FIELD = re.compile(r'"([^"]+)"|([A-Za-z_][\w\-]*)')
_BRACKET = re.compile(r"\[(-?\d*)(:?)(-?\d*)\]")
_FILTER = re.compile(r"\{\s*([A-Za-z_][\w\-.]*)\s*(==|!=|<=|>=|<|>)\s*([^{}]+?)\s*\}")
_OPERATORS: Mapping[str, Callable[[Any, Any], bool]] = {
    "==": operator.eq,
    "!=": operator.ne,
    "<=": operator.le,
    ">=": operator.ge,
    "<": operator.lt,
    ">": operator.gt,
}


class MissingFieldError(LookupError):
    """A message has no such field or item; `str(error)` names it and, where known, the fields that are there."""


@dataclass(frozen=True)
class Field:
    """`.name`."""

    name: str

    def apply(self, items: list[Any]) -> list[Any]:
        """The field of every item."""
        return [_field(item, self.name) for item in items]


@dataclass(frozen=True)
class Index:
    """`[i]`."""

    index: int

    def apply(self, items: list[Any]) -> list[Any]:
        """The element of every item, which must be an array."""
        try:
            return [item[self.index] for item in items]
        except (IndexError, KeyError, TypeError) as error:
            raise MissingFieldError(f"no element [{self.index}]") from error


@dataclass(frozen=True)
class Slice:
    """`[first:last]`, both included; None means from the start or to the end."""

    first: int | None
    last: int | None

    def apply(self, items: list[Any]) -> list[Any]:
        """All elements in the range, of all items, in order."""
        # Foxglove includes the last element, so Python's stop lies one behind it; behind -1 there is no stop.
        stop = None if self.last is None or self.last == -1 else self.last + 1
        try:
            return [element for item in items for element in item[self.first : stop]]
        except (KeyError, TypeError) as error:
            raise MissingFieldError("a slice of something that is not an array") from error


@dataclass(frozen=True)
class Filter:
    """`{a.b==value}`."""

    names: tuple[str, ...]
    symbol: str
    value: str | float | bool

    def apply(self, items: list[Any]) -> list[Any]:
        """The items that match; one without the field, or of another type, does not."""
        return [item for item in items if self._matches(item)]

    def _matches(self, item: Any) -> bool:
        try:
            for name in self.names:
                item = _field(item, name)
            return bool(_OPERATORS[self.symbol](item, self.value))
        except (MissingFieldError, TypeError):
            return self.symbol == "!="


Step = Field | Index | Slice | Filter


@dataclass(frozen=True)
class MessagePath:
    """A parsed path; `text` as it was written."""

    text: str
    steps: tuple[Step, ...]

    @property
    def is_plural(self) -> bool:
        """Whether the path may give any number of values (it holds a slice or a filter)."""
        return any(isinstance(step, Slice | Filter) for step in self.steps)

    def values(self, message: Any) -> list[Any]:
        """What the path finds in a decoded message (attributes or dicts); `MissingFieldError` where it leads nowhere."""
        items = [message]
        for step in self.steps:
            items = step.apply(items)
        return items


def parse_path(text: str) -> MessagePath:
    """The parsed path; `ValueError` says in one line what is wrong and where."""
    if text.startswith("/"):
        raise ValueError(f"message path {text!r}: leave the topic out, it has its own key; for example header.stamp")
    steps: list[Step] = []
    position = 0
    while position < len(text):
        character = text[position]
        if character == "[":
            step, position = _bracket(text, position)
        elif character == "{":
            step, position = _filter(text, position)
        elif character == "." or position == 0:
            step, position = _name(text, position + (character == "."))
        else:
            raise _wrong(text, position, "expected '.', '[' or '{'")
        steps.append(step)
    if not steps:
        raise ValueError("message path is empty; for example pose.position.x")
    return MessagePath(text, tuple(steps))


def _name(text: str, position: int) -> tuple[Step, int]:
    match = _FIELD.match(text, position)
    if match is None:
        raise _wrong(text, position, "expected a field name")
    return Field(match[1] or match[2]), match.end()


def _bracket(text: str, position: int) -> tuple[Step, int]:
    match = _BRACKET.match(text, position)
    if match is None or "-" in (match[1], match[3]) or (not match[2] and not match[1]) or (not match[2] and match[3]):
        raise _wrong(text, position, "expected [index], [:] or [first:last]")
    if not match[2]:
        return Index(int(match[1])), match.end()
    return Slice(int(match[1]) if match[1] else None, int(match[3]) if match[3] else None), match.end()


def _filter(text: str, position: int) -> tuple[Step, int]:
    match = _FILTER.match(text, position)
    if match is None:
        raise _wrong(text, position, 'expected a filter such as {score>=0.5} or {kind=="ship"}')
    return Filter(tuple(match[1].split(".")), match[2], _literal(match[3])), match.end()


def _literal(text: str) -> str | float | bool:
    if text in ("true", "false"):
        return text == "true"
    if len(text) >= 2 and text[0] == text[-1] and text[0] in "\"'":
        return text[1:-1]
    try:
        return float(text)
    except ValueError:
        return text


def _field(item: Any, name: str) -> Any:
    try:
        return item[name] if isinstance(item, dict) else getattr(item, name)
    except (KeyError, AttributeError) as error:
        known = field_names(item)
        hint = f"; fields there: {', '.join(known)}" if known else ""
        raise MissingFieldError(f"no field {name!r}{hint}") from error


def field_names(item: Any) -> list[str]:
    """The names of the fields of a decoded message, for advice; empty where they cannot be listed."""
    if isinstance(item, dict):
        return [str(name) for name in item]
    descriptor = getattr(item, "DESCRIPTOR", None)
    if descriptor is not None:
        return [field.name for field in descriptor.fields]
    names = getattr(item, "__slots__", None) or getattr(item, "__dict__", {})
    return [str(name) for name in names if not str(name).startswith("_")]


def _wrong(text: str, position: int, expected: str) -> ValueError:
    return ValueError(f"message path {text!r}: {expected} at character {position + 1}")
