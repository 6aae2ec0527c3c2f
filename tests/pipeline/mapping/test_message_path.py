"""Message paths: Foxglove's syntax, on mappings and on objects, and one clear line for what is wrong."""

from types import SimpleNamespace

import pytest
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from pipeline.logs.flatbuffer import EnumNumber
from pipeline.mapping.message_path import MissingFieldError, at_place, parse_path

MESSAGE = {
    "total": 4,
    "header": {"stamp": {"sec": 7, "nanosec": 5}},
    "objects": [{"id": f"o{i}", "width": 10 + 5 * i, "sub": {"ok": i % 2 == 0, "v": [i, i + 1]}} for i in range(5)],
    "odd name": {"x": 1.5},
    "big": {"id": 9007199254740993},
}
MESSAGE["objects"][1]["tag"] = 7


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
        ("objects[:].sub.v[-1]", [1, 2, 3, 4, 5]),
        ("objects[:].sub{ok==false}.v[0]", [1, 3]),  # a filter on what an item holds
        ("objects[:]{sub.ok!=true}.sub.v[:]", [1, 2, 3, 4]),
        ('objects[:]{id=="o1"}{width==15}.width', [15]),
        ("objects[:]{id=='o1'}.width", [15]),
        ('objects[:]{id!="}{"}.width', [10, 15, 20, 25, 30]),
        ("objects[:]{tag==7}.width", [15]),  # only one has a tag
        ("objects[:].tag", [7]),
        ("{total==4}.header.stamp.sec", [7]),
        ("{total==5}.header.stamp.sec", []),
        ("big{id==9007199254740993}.id", [9007199254740993]),
        ("total.@mul(0.5)", [2.0]),
        (".objects[:2].width.@sub(10).@negative", [0, -5, -10]),
        ("header.stamp.sec.@rad2deg.@deg2rad.@round", [7]),
    ],
)
def test_values(message: object, text: str, expected: list[object]) -> None:
    assert parse_path(text).values(message) == expected


def test_quoted_names() -> None:
    assert parse_path('"odd name".x').values(MESSAGE) == [1.5]


@pytest.mark.parametrize(
    "text",
    [
        "",
        "a..b",
        "a[",
        "a[]",
        "a[x]",
        "a[1:2:3]",
        "a[--1]",
        "a{b}",
        "a{b==}",
        "a b",
        "a.",
        "/topic.x",
        "a[$i]",
        "a[:]{b==$c}",
        "a.@cube",
        "a.@mul",
        "a.@mul(x)",
        "a.@div(0)",
    ],
)
def test_wrong_paths_say_where(text: str) -> None:
    with pytest.raises(ValueError, match="message path") as caught:
        parse_path(text)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["objects[9].id", "header.stamp.secs", "total[:]", "objects.width", "total.x"])
def test_missing_fields(text: str) -> None:
    with pytest.raises(MissingFieldError):
        parse_path(text).values(MESSAGE)


def test_places_tell_which_values_are_of_one_item() -> None:
    message = {"e": [{"id": "a", "c": [{"x": 1}, {"x": 2}]}, {"id": "b", "c": []}, {"id": "c", "c": [{"x": 3}]}]}
    found = parse_path("e[:].c[:].x").located(message)
    assert found == {(0, 0): 1, (0, 1): 2, (2, 0): 3}
    names = parse_path("e[:].id").located(message)
    assert [at_place(names, place) for place in found] == ["a", "a", "c"]
    assert parse_path('e[:]{id=="c"}.c[0].x').located(message) == {(2,): 3}  # filters keep an item's own number
    assert at_place({(1,): "b"}, (0, 0)) is None and at_place({(): "all"}, (3, 4)) == "all"


def test_constants_and_enumerations_by_name() -> None:
    store = get_typestore(Stores.EMPTY)
    text = "a/C[] items\n" + "=" * 80 + "\nMSG: a/C\nuint8 CAR=1\nuint8 label\n"
    store.register(get_types_from_msg(text, "a/msg/M"))
    labels = [store.types["a/msg/C"](label=label) for label in (0, 1, 1)]
    assert len(parse_path("items[:]{label==CAR}.label").values(store.types["a/msg/M"](items=labels))) == 2
    assert parse_path("items[:]{label==BUS}.label").values(store.types["a/msg/M"](items=labels)) == []
    fix = LocationFix(position_covariance_type=LocationFix.KNOWN)
    assert parse_path("{position_covariance_type==KNOWN}.latitude").values(fix) == [0.0]
    assert parse_path('{position_covariance_type=="UNKNOWN"}.latitude').values(fix) == []
    assert parse_path("{kind==SHIP}.x").values({"kind": EnumNumber(3, "SHIP"), "x": 5}) == [5]


def test_fields_named_like_a_keyword() -> None:
    assert parse_path("class").values(SimpleNamespace(class_=4)) == [4]


def test_missing_field_names_its_neighbours() -> None:
    with pytest.raises(MissingFieldError, match="no field 'secs'; fields there: sec, nanosec"):
        parse_path("header.stamp.secs").values(MESSAGE)
