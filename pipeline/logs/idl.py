"""IDL of ROS 2 schemas, prepared for the parser of rosbags, which reads less than the language has."""

import itertools
import re
from typing import Final

from rosbags.interfaces.typing import Typesdict
from rosbags.typesys import get_types_from_idl

_TEXT = r'"(?:[^"\\]|\\.)*"'
_COMMENT_OR_TEXT: Final = re.compile(rf"{_TEXT}|/\*.*?\*/|//[^\n]*", re.DOTALL)
_ANNOTATION: Final = re.compile(rf'@\w+\s*\((?:[^()"]|{_TEXT})*\)')
_ENUM: Final = re.compile(r"(?:@bit_bound\s*\(\s*(?:value\s*=\s*)?(\d+)\s*\)\s*)?(?:@\w+\s*)*\benum\s+(\w+)\s*\{[^{}]*\}")
_SCOPE: Final = re.compile(rf"{_TEXT}|\bmodule\s+(\w+)\s*\{{|(?P<enum>{_ENUM.pattern})|[{{}}]")
_NOT_KNOWN: Final = re.compile(r"\b(union|bitmask|bitset|wstring|map(?=\s*<))\b|(@optional)\b")


def types_from_idl(text: str) -> Typesdict:
    """The types that a schema in IDL defines, of one file or of several; ValueError where it holds what is not known.

    Enumerations are the integers as which CDR writes them. A wide character takes two bytes (DDS-XTypes 1.3, 7.4.1).
    """
    annotated = _without_comments(text)
    plain = _ANNOTATION.sub(" ", _ENUM.sub(_as_integer, annotated))
    if found := _NOT_KNOWN.search(re.sub(_TEXT, " ", plain)):
        raise ValueError(f"its IDL has {found[0]}, which is not known")
    # Enumerations first, since a file stands before those that it includes: names are known from their definitions on.
    return get_types_from_idl("\n".join([*_enums_of(annotated), plain]))


def _without_comments(text: str) -> str:
    """The definitions and annotations alone: between files stand === and IDL: name, in them #include and comments.

    They say nothing about the bytes and cost the parser most of its time.
    """
    is_definition = (not line.startswith(("IDL: ", "#")) and set(line) != {"="} for line in text.splitlines())
    definitions = "\n".join(itertools.compress(text.splitlines(), is_definition))
    return _COMMENT_OR_TEXT.sub(lambda found: found[0] if found[0].startswith('"') else " ", definitions)


def _as_integer(enum: re.Match[str]) -> str:
    """The integer type that an enumeration is on the wire, as a definition of the same name."""
    num_bits, name = int(enum[1] or 32), enum[2]
    return f"typedef int{8 if num_bits <= 8 else 16 if num_bits <= 16 else 32} {name}"


def _enums_of(annotated: str) -> list[str]:
    """A definition of each enumeration, in its modules."""
    scopes: list[str] = []
    found = []
    for match in _SCOPE.finditer(annotated):
        if match["enum"]:
            definition = f"{_ENUM.sub(_as_integer, match['enum'])};"
            for name in reversed([scope for scope in scopes if scope]):
                definition = f"module {name} {{ {definition} }};"
            found.append(definition)
        elif match[0].endswith("{"):
            scopes.append(match[1] or "")
        elif match[0] == "}" and scopes:
            scopes.pop()
    return found
