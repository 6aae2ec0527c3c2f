"""Conditions: what their terms mean for a message and for its items."""

from types import SimpleNamespace
from typing import Any

import pytest

from pipeline.mapping.conditions import parse_conditions

MESSAGE: dict[str, Any] = {
    "fix_type": 3, "valid": True, "flags": 6, "kind": "a && b", "status": {"status": -1}, "none": None,
    "objects": [{"id": 1, "p": 0.5}, {"id": 2, "p": 0.25}, {"id": 3}],
}  # fmt: skip


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("fix_type >= 3", True),
        ("fix_type>3", False),
        ("fix_type == 3 && valid", True),
        ("fix_type == 3 && !valid", False),
        ("!valid", False),
        ("flags & 2", True),
        ("flags & 1", False),
        ('kind == "a && b" && valid', True),
        ("status.status >= 0", False),
        ("status.status < 0", True),
        ("kind > 3", False),  # of another type
        ("kind != 3", True),
    ],
)
def test_terms_about_a_message(text: str, expected: bool) -> None:
    found = [term.located(MESSAGE)[()] for term in parse_conditions(text)]
    assert all(found) is expected and None not in found


@pytest.mark.parametrize("text", ["speed > 3", "status.code == 1", "none.of_it"])
def test_a_field_that_is_not_there_is_neither_true_nor_false(text: str) -> None:
    assert parse_conditions(text)[0].located(MESSAGE) == {(): None}


def test_terms_about_items() -> None:
    (term,) = parse_conditions("objects[:].p >= 0.5")
    assert term.located(MESSAGE) == {(0,): True, (1,): False, (2,): None}
    (term,) = parse_conditions("objects[:]{id<=2}.p >= 0.5")
    assert term.located(MESSAGE) == {(0,): True, (1,): False}
    assert parse_conditions("things[:].p >= 0.5")[0].located(MESSAGE) == {}


def test_names_of_constants() -> None:
    class Fix(SimpleNamespace):
        FIX_3D = 3

    (term,) = parse_conditions("fix_type == FIX_3D")
    assert term.located(Fix(fix_type=3)) == {(): True} and term.located(Fix(fix_type=2)) == {(): False}


@pytest.mark.parametrize(
    "text",
    [
        "",
        " ",
        "a &&",
        "&& a",
        "a == ",
        "!a == 3",
        "a b",
        "a = 3",
        "a => 3",
        "a || b",
        "(a)",
        "a[:]",
        "[0]",
        "/topic.a",
        "a == $v",
    ],
)
def test_what_is_no_condition(text: str) -> None:
    with pytest.raises(ValueError) as caught:
        parse_conditions(text)
    assert "\n" not in str(caught.value)
