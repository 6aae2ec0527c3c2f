"""Message paths in Foxglove's syntax: `detections[:]{score>=0.5}.bbox.center.position.x`.

The topic is not part of a path here. Fields by name (quoted where they hold other characters), `[i]` with negative indices
from the end, `[a:b]` with both ends included (as Foxglove has it, unlike Python), filters `{field==value}`
(`== != < <= > >=`, and of our own `&`: has one of these bits; several mean "and") that keep the matching items, and at the
end functions of numbers (`.@mul(1e-7)`).
A value in a filter is a number, true, false, text, or the name of a constant (`{type==KNOWN}`).

A path finds values at places: a place has a number for each slice of the path, the item's index. So values of different
paths are of one item where their places are equal, and `entities[:].id` belongs to all of `entities[:].cubes[:].pose`.
"""

import functools
import math
import operator
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

Place = tuple[int, ...]

_FIELD = re.compile(r'"([^"]+)"|([A-Za-z_][\w\-]*)')
_FUNCTION = re.compile(r"@(\w+)(?:\(\s*([^()]*?)\s*\))?")
_BRACKET = re.compile(r"\[(-?\d*)(:?)(-?\d*)\]")
_FILTER = re.compile(r"""\{\s*([A-Za-z_][\w\-.]*)\s*(==|!=|<=|>=|<|>|&)\s*("[^"]*"|'[^']*'|[^{}"']+?)\s*\}""")
_OPERATORS: Mapping[str, Callable[[Any, Any], bool]] = {
    "==": operator.eq,
    "!=": operator.ne,
    "<=": operator.le,
    ">=": operator.ge,
    "<": operator.lt,
    ">": operator.gt,
    "&": lambda value, bits: bool(value & bits),
}
_PLAIN_FUNCTIONS: Mapping[str, Callable[[float], float]] = {
    "abs": abs, "negative": operator.neg, "deg2rad": math.radians, "rad2deg": math.degrees, "round": round,
}  # fmt: skip
_FUNCTIONS_OF_TWO: Mapping[str, Callable[[float, float], float]] = {
    "add": operator.add, "sub": operator.sub, "mul": operator.mul, "div": operator.truediv,
}  # fmt: skip


class MissingFieldError(LookupError):
    """A message has no such field or item; `str(error)` names it and, where known, the fields that are there."""

    def __init__(self, what: str, parent: Any = None) -> None:
        super().__init__(what)
        self._parent = parent

    def __str__(self) -> str:
        # Only now: most of these errors end where an alternative path is tried, and are never read.
        known = field_names(self._parent)
        return f"{self.args[0]}; fields there: {', '.join(known)}" if known else str(self.args[0])


@dataclass(frozen=True)
class Field:
    """`.name`."""

    name: str

    def of(self, item: Any) -> Any:
        """The field of an item."""
        return _field(item, self.name)


@dataclass(frozen=True)
class Index:
    """`[i]`."""

    index: int

    def of(self, item: Any) -> Any:
        """The element of an array."""
        try:
            return item[self.index]
        except (IndexError, KeyError, TypeError) as error:
            raise MissingFieldError(f"no element [{self.index}]") from error


@dataclass(frozen=True)
class Function:
    """`.@name` or `.@name(number)`."""

    name: str
    function: Callable[[float], float]

    def of(self, item: Any) -> Any:
        """The number that the function makes of a number."""
        try:
            return self.function(item)
        except (TypeError, ValueError, OverflowError) as error:
            raise MissingFieldError(f"@{self.name} of something that is not a number") from error


@dataclass(frozen=True)
class Slice:
    """`[first:last]`, both included; None means from the start or to the end."""

    first: int | None
    last: int | None

    def elements(self, item: Any) -> Iterable[tuple[int, Any]]:
        """Index and value of all elements of an array in the range."""
        # Foxglove includes the last element, so Python's stop lies one behind it; behind -1 there is no stop.
        stop = None if self.last is None or self.last == -1 else self.last + 1
        try:
            return [(index, item[index]) for index in range(len(item))[self.first : stop]]
        except (KeyError, TypeError) as error:
            raise MissingFieldError("a slice of something that is not an array") from error


@dataclass(frozen=True)
class Filter:
    """`{a.b==value}`."""

    names: tuple[str, ...]
    symbol: str
    value: str | float | bool

    def keeps(self, item: Any) -> bool:
        """Whether an item matches; one without the field, or of another type, does not."""
        verdict = self.verdict(item)
        return self.symbol == "!=" if verdict is None else verdict

    def verdict(self, item: Any) -> bool | None:
        """Whether an item matches; None where it lacks the field."""
        parent = item
        try:
            for name in self.names:
                parent, item = item, _field(item, name)
        except MissingFieldError:
            return None
        is_constant = isinstance(self.value, str) and isinstance(item, int)
        return self.compares(item, self._constant(parent, item) if is_constant else self.value)

    def compares(self, item: Any, value: Any) -> bool:
        """Whether the comparison with `value` holds for the field's value `item`."""
        try:
            return bool(_OPERATORS[self.symbol](item, value))
        except TypeError:  # of another type
            return self.symbol == "!="

    def _constant(self, parent: Any, item: int) -> Any:
        """The number that the text names: a constant of the message (ROS) or a value of the field's enumeration."""
        word = str(self.value)
        if getattr(item, "name", None) == word:  # flatbuffer
            return item
        descriptor = getattr(parent, "DESCRIPTOR", None)
        known = descriptor.fields_by_name.get(self.names[-1]) if descriptor is not None else None
        if known is not None and known.enum_type is not None:
            value = known.enum_type.values_by_name.get(word)
            return self.value if value is None else value.number
        constant = None if isinstance(parent, dict) else getattr(type(parent), word, None)
        return constant if isinstance(constant, int) else self.value


Step = Field | Index | Function | Slice | Filter


@dataclass(frozen=True)
class MessagePath:
    """A parsed path; `text` as it was written."""

    text: str
    steps: tuple[Step, ...]

    @functools.cached_property
    def _chain(self) -> tuple[Callable[[Any], Any], ...] | None:
        """The steps one after the other, where each gives one value."""
        chain = tuple(step.of for step in self.steps if not isinstance(step, Slice | Filter))
        return chain if len(chain) == len(self.steps) else None

    def located(self, message: Any) -> dict[Place, Any]:
        """What the path finds in a decoded message (attributes or dicts), by place.

        Items that lack a field are left out; `MissingFieldError` where nothing is left for that reason alone.
        """
        if self._chain is not None:
            for follow in self._chain:
                message = follow(message)
            return {(): message}
        items: dict[Place, Any] = {(): message}
        missing: list[MissingFieldError] = []
        for step in self.steps:
            if isinstance(step, Filter):
                items = {place: item for place, item in items.items() if step.keeps(item)}
            else:
                items = _followed(step, items, missing)
        if not items and missing:
            raise missing[-1]
        return items

    def values(self, message: Any) -> list[Any]:
        """The values without their places; errors as in `located`."""
        return list(self.located(message).values())


def _followed(
    step: Field | Index | Function | Slice, items: dict[Place, Any], missing: list[MissingFieldError]
) -> dict[Place, Any]:
    """Where one step leads from every item; what is lacking is added to `missing`."""
    found: dict[Place, Any] = {}
    for place, item in items.items():
        try:
            if isinstance(step, Slice):
                for index, element in step.elements(item):
                    found[(*place, index)] = element
            else:
                found[place] = step.of(item)
        except MissingFieldError as error:
            missing.append(error)
    return found


def at_place(values: Mapping[Place, Any], place: Place) -> Any:
    """The value of the item at `place`, or of what holds the item; None where there is none."""
    while place not in values:
        if not place:
            return None
        place = place[:-1]
    return values[place]


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
        elif text.startswith((".@", "@"), position):
            step, position = _function(text, position + (character == "."))
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


def _function(text: str, position: int) -> tuple[Step, int]:
    match = _FUNCTION.match(text, position)
    name = match[1] if match is not None else ""
    if match is not None and match[2] is None and name in _PLAIN_FUNCTIONS:
        return Function(name, _PLAIN_FUNCTIONS[name]), match.end()
    if match is None or name not in _FUNCTIONS_OF_TWO:
        known = ", ".join([f"@{known}" for known in _PLAIN_FUNCTIONS] + [f"@{known}(number)" for known in _FUNCTIONS_OF_TWO])
        raise _wrong(text, position, f"expected one of {known}")
    try:
        operand = float(match[2] or "")
    except ValueError as error:
        raise _wrong(text, position, f"expected a number in @{name}(...)") from error
    if name == "div" and operand == 0:
        raise _wrong(text, position, "expected another number than 0")
    function = _FUNCTIONS_OF_TWO[name]
    return Function(name, lambda value: function(value, operand)), match.end()


def _bracket(text: str, position: int) -> tuple[Step, int]:
    match = _BRACKET.match(text, position)
    if match is None or "-" in (match[1], match[3]) or (not match[2] and not match[1]) or (not match[2] and match[3]):
        advice = " (variables are not known here)" if "$" in text else ""
        raise _wrong(text, position, f"expected [index], [:] or [first:last]{advice}")
    if not match[2]:
        return Index(int(match[1])), match.end()
    return Slice(int(match[1]) if match[1] else None, int(match[3]) if match[3] else None), match.end()


def _filter(text: str, position: int) -> tuple[Step, int]:
    match = _FILTER.match(text, position)
    if match is None:
        raise _wrong(text, position, 'expected a filter such as {score>=0.5} or {kind=="ship"}')
    if match[3].startswith("$"):
        raise _wrong(text, position, f"variables such as {match[3]} are not known here; expected a value")
    return Filter(tuple(match[1].split(".")), match[2], parse_literal(match[3])), match.end()


def parse_literal(text: str) -> str | float | bool:
    """The value that a filter compares with: true or false, a number, or text with or without quotes."""
    if text in ("true", "false"):
        return text == "true"
    if len(text) >= 2 and text[0] == text[-1] and text[0] in "\"'":
        return text[1:-1]
    for kind in (int, float):  # as a float a long identity would lose its last digits
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def _field(item: Any, name: str) -> Any:
    try:
        return item[name] if isinstance(item, dict) else getattr(item, name)
    except (KeyError, AttributeError) as error:
        if hasattr(item, name + "_"):  # named like a Python keyword
            return getattr(item, name + "_")
        raise MissingFieldError(f"no field {name!r}", item) from error


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
