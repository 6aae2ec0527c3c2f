"""Schemas in IDL beyond what the parser of rosbags reads: enumerations, wide characters, definitions of several files."""

import struct

import pytest

from pipeline.logs.decode import UndecodableChannel, decoder_for
from pipeline.logs.idl import types_from_idl
from pipeline.logs.reader import Channel

SEPARATOR = "=" * 80


def decoded(text: str, body: bytes, name: str = "demo/msg/Plot"):
    return decoder_for(Channel(1, "/plots", "cdr", name, "ros2idl", text.encode(), 1, {}))(b"\0\1\0\0" + body)


def in_module(text: str) -> str:
    return f"module demo {{ module msg {{ {text} }}; }};"


@pytest.mark.parametrize("reference", ["Kind", "demo::msg::Kind", "::demo::msg::Kind"])
@pytest.mark.parametrize(
    ("definition", "code"),
    [
        ("enum Kind { A, B };", "i"),
        ("@bit_bound(16) enum Kind { A, @value(7) B };", "h"),
        ("@bit_bound (value=8)\n@final enum Kind { A, // { a brace\n B /* } */ };", "b"),
        ("typedef long Integer; enum Kind { A, B }; ", "i"),
    ],
)
def test_an_enumeration_is_an_integer(reference: str, definition: str, code: str) -> None:
    text = in_module(f"{definition} struct Plot {{ double x; {reference} kind; {reference} pair[2]; double y; }};")
    fixed = struct.pack(f"<d3{code}", 1.5, 1, 0, 1)
    plot = decoded(text, fixed.ljust(-(-len(fixed) // 8) * 8, b"\0") + struct.pack("<d", 2.5))
    assert (plot.x, plot.kind, plot.pair.tolist(), plot.y) == (1.5, 1, [0, 1], 2.5)


def test_an_enumeration_defined_in_a_later_file() -> None:
    """The file of the message stands first, those that it includes behind it."""
    main = in_module("struct Plot { other::msg::Kind kind; sequence<other::msg::Kind> kinds; };")
    text = f"{SEPARATOR}\nIDL: demo/msg/Plot\n{main}\n{SEPARATOR}\nIDL: other/msg/Kind\n"
    plot = decoded(f"{text}module other {{ module msg {{ enum Kind {{ A, B, C }}; }}; }};", struct.pack("<iIii", 2, 2, 0, 1))
    assert plot.kind == 2 and plot.kinds.tolist() == [0, 1]


def test_enumerations_of_one_name_in_two_modules() -> None:
    text = in_module("@bit_bound(8) enum Kind { A }; struct Inner { Kind kind; };")
    text += "module demo { module srv { enum Kind { A }; struct Outer { Kind kind; demo::msg::Inner inner; }; }; };"
    outer = decoded(text, struct.pack("<ib", 70_000, 3), "demo/srv/Outer")
    assert (outer.kind, outer.inner.kind) == (70_000, 3)


def test_octets_and_characters_are_unsigned() -> None:
    text = in_module("struct Plot { octet a; char b; octet c[2]; sequence<char> d; wchar e; };")
    plot = decoded(text, struct.pack("<4BI2BH", 200, 201, 202, 3, 2, 203, 4, 0x20AC))
    assert (plot.a, plot.b, plot.c.tolist(), plot.d.tolist(), plot.e) == (200, 201, [202, 3], [203, 4], 0x20AC)


@pytest.mark.parametrize(
    ("member", "word"),
    [
        ("wstring name;", "wstring"),
        ("@optional double z;", "@optional"),
        ("map<string, long> names;", "map"),
        ("U u; }; union U switch (long) { case 1: double x;", "union"),
    ],
)
def test_what_is_not_known_is_named(member: str, word: str) -> None:
    with pytest.raises(UndecodableChannel, match=f"its IDL has {word}, which is not known"):
        decoded(in_module(f"struct Plot {{ double x; {member} }};"), bytes(8))


def test_words_of_the_language_in_texts_and_names_do_not_matter() -> None:
    """Messages have members called map; comments and annotations say what they like."""
    text = in_module('@verbatim(text="a union { of } wstring")\nstruct Plot { @unit("map") double map; /* union */ };')
    assert decoded(text, struct.pack("<d", 4.5)).map == 4.5
    assert list(types_from_idl(text)) == ["demo/msg/Plot"]


def test_a_type_that_is_missing_is_named() -> None:
    with pytest.raises(UndecodableChannel, match="the schema does not define demo/msg/Other"):
        decoded(in_module("struct Plot { Other other; };"), bytes(8))
