"""Where a type that is not known may keep positions."""

import json

import pytest

from pipeline.mapping.field_paths import coordinate_paths, measured_paths

ROS = (
    "std_msgs/Header header\nown_msgs/Plot[] plots\n" + "=" * 80 + "\nMSG: own_msgs/Plot\nown_msgs/Where where\nfloat64 speed\n"
    + "=" * 80 + "\nMSG: own_msgs/Where\nfloat64 x\nfloat64 y\n" + "=" * 80 + "\nMSG: std_msgs/Header\nstring frame_id\n"
)  # fmt: skip
NUMBER = {"type": "number"}


@pytest.mark.parametrize(
    ("name", "schema", "expected"),
    [
        ("own_msgs/msg/Plots", ROS, ("plots[:].where.x", "plots[:].where.y")),
        ("own_msgs/msg/Fix", "uint64 timestamp\nfloat64 lat\nfloat64 lon\nfloat32 x\nfloat32 y\n", ("lat", "lon")),
        ("own_msgs/Fix", "float64 latitude_deg\nfloat64 longitude_deg\n", ("latitude_deg", "longitude_deg")),
        ("own_msgs/msg/Text", "string data\n", None),
        (
            "own.Targets",
            json.dumps({"properties": {"t": {"items": {"properties": {"lat": NUMBER, "lng": NUMBER}}}, "x": NUMBER}}),
            ("t[:].lat", "t[:].lng"),
        ),
        ("own.Place", json.dumps({"properties": {"p": {"properties": {"x": NUMBER, "y": NUMBER}}}}), ("p.x", "p.y")),
        ("own.Any", "{}", None),
        ("own.Broken", "float64", None),
        ("own.Broken", "{", None),
    ],
)
def test_coordinates(name: str, schema: str, expected: tuple[str, str] | None) -> None:
    assert coordinate_paths(name, schema.encode()) == expected


def test_bytes_that_are_no_text() -> None:
    assert coordinate_paths("own.Binary", b"\xff\x00") is None


@pytest.mark.parametrize(
    ("schema", "expected"),
    [
        ("own_msgs/Ray[] rays\n" + "=" * 80 + "\nMSG: own_msgs/Ray\nfloat32 azimuth_deg\n", {"bearing": "rays[:].azimuth_deg"}),
        (
            "float32 elevation\nfloat32 bearing\nfloat32 range\n",
            {"range": "range", "bearing": "bearing", "elevation": "elevation"},
        ),
        ("float32 range\n", {}),
    ],
)
def test_bearings(schema: str, expected: dict[str, str]) -> None:
    assert measured_paths("own_msgs/msg/Rays", schema.encode()) == expected
