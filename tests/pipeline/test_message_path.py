"""Message paths: Foxglove's syntax, on mappings and on objects, and one clear line for what is wrong."""

from types import SimpleNamespace

import pytest

from pipeline.message_path import MissingFieldError, parse_path

MESSAGE = {
    "total": 4,
    "header": {"stamp": {"sec": 7, "nanosec": 5}},
    "objects": [{"id": f"o{i}", "width": 10 + 5 * i, "sub": {"ok": i % 2 == 0, "v": [i, i + 1]}} for i in range(5)],
    "odd name": {"x": 1.5},
}


def namespace(value: object) -> object:
    """The same tree with attributes in place of keys."""
    if isinstance(value, dict):
        return SimpleNamespace(**{key: namespace(item) for key, item in value.items()})
    return [namespace(item) for item in value] if isinstance(value, list) else value


@pytest.mark.parametrize("message", [MESSAGE, namespace(MESSAGE)], ids=["mapping", "object"])
@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("total", [4]),
        (".header.stamp.sec", [7]),
        ("objects[1].width", [15]),
        ("objects[-1].id", ["o4"]),
        ("objects[:].width", [10, 15, 20, 25, 30]),
        ("objects[1:2].width", [15, 20]),  # both ends included
        ("objects[-2:-1].width", [25, 30]),
        ("objects[3:].width", [25, 30]),
        ("objects[:1].width", [10, 15]),
        ("objects[:-3].width", [10, 15, 20]),
        ("objects[7:9].width", []),
        ('objects[:]{id=="o2"}.width', [20]),
        ("objects[:]{id==o2}.width", [20]),
        ("objects[:]{width>=20}{width!=25}.id", ["o2", "o4"]),
        ("objects[:]{sub.ok==true}.id", ["o0", "o2", "o4"]),
        ("objects[:]{nothing==3}.id", []),
        ("objects[:]{id>3}.id", []),
        ("objects[1:2].sub.v[:]", [1, 2, 2, 3]),
        ("objects[0].sub.v", [[0, 1]]),
    ],
)
def test_values(message: object, text: str, expected: list[object]) -> None:
    assert parse_path(text).values(message) == expected


def test_quoted_names() -> None:
    assert parse_path('"odd name".x').values(MESSAGE) == [1.5]


def test_plural_only_with_slice_or_filter() -> None:
    assert not parse_path("objects[1].width").is_plural
    assert parse_path("objects[:].width").is_plural
    assert parse_path("header{total==4}.stamp").is_plural


@pytest.mark.parametrize(
    "text", ["", "a..b", "a[", "a[]", "a[x]", "a[1:2:3]", "a[--1]", "a{b}", "a{b==}", "a b", "a.", "/topic.x"]
)
def test_wrong_paths_say_where(text: str) -> None:
    with pytest.raises(ValueError, match="message path") as caught:
        parse_path(text)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["objects[9].id", "header.stamp.secs", "total[:]", "objects.width", "total.x"])
def test_missing_fields(text: str) -> None:
    with pytest.raises(MissingFieldError):
        parse_path(text).values(MESSAGE)


def test_missing_field_names_its_neighbours() -> None:
    with pytest.raises(MissingFieldError, match="no field 'secs'; fields there: sec, nanosec"):
        parse_path("header.stamp.secs").values(MESSAGE)
