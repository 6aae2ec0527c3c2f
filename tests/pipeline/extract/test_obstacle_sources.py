"""Obstacles from every source: TOML, GeoJSON, Metadata records, occupancy grids; and what is said where one is wrong."""

import base64
import json
import math
from pathlib import Path

import numpy as np
import pytest
import shapely
import torch
from mcap.writer import Writer
from rosbags.typesys import Stores, get_typestore

from cadence.errors import ConfigError, InputError
from pipeline.config import read_config
from pipeline.extract.obstacle_config import ObstacleSources
from pipeline.extract.obstacle_sources import collect_obstacles
from pipeline.frames import to_local
from pipeline.logs.reader import open_log
from pipeline.obstacle_file import read_obstacles, write_obstacles
from pipeline.tables import Frame

LOCAL = Frame("map")
GEOREFERENCED = Frame("mission", 50.8, -1.2)
RING = [[-1.21, 50.80], [-1.20, 50.80], [-1.20, 50.81], [-1.21, 50.80]]
SQUARE_CELLS = [[0, 0, 0, 0], [0, 100, 65, 0], [0, -1, 64, 0]]


def make_log(path: Path, records=(), messages=()):
    """A log of Metadata records and of (topic, schema, encoding, schema encoding, schema text, bytes)."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        for name, content in records:
            writer.add_metadata(name, content)
        for index, (topic, name, encoding, schema_encoding, schema, data) in enumerate(messages):
            schema_id = writer.register_schema(name, schema_encoding, schema)
            writer.add_message(writer.register_channel(topic, encoding, schema_id), index, data, index, index)
        writer.finish()
    return open_log(path)


@pytest.fixture
def empty_log(tmp_path):
    return make_log(tmp_path / "empty.mcap")


def written(path: Path, content) -> ObstacleSources:
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return ObstacleSources(files=(path,))


def pose(x=0.0, y=0.0, yaw=0.0):
    orientation = {"x": 0.0, "y": 0.0, "z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}
    return {"position": {"x": x, "y": y, "z": 0.0}, "orientation": orientation}


def occupancy_message(topic="/map", frame_id="map", cells=SQUARE_CELLS, origin=None, **more):
    info = {"resolution": 2.0, "width": len(cells[0]), "height": len(cells), "origin": origin or pose(), **more}
    data = {"header": {"frame_id": frame_id}, "info": info, "data": np.ravel(cells).tolist()}
    return (topic, "nav_msgs/msg/OccupancyGrid", "json", "jsonschema", b"{}", json.dumps(data).encode())


def foxglove_message(topic="/grid", field="occupancy", kind=7, values=((0.0, 0.9), (0.0, 0.2)), frame_id="map"):
    dtype = {1: "u1", 7: "<f4"}[kind]
    array = np.asarray(values, dtype=dtype)
    data = {
        "frame_id": frame_id, "pose": pose(10.0, 20.0), "column_count": array.shape[1], "cell_size": {"x": 3.0, "y": 5.0},
        "row_stride": array.shape[1] * array.itemsize, "cell_stride": array.itemsize,
        "fields": [{"name": field, "offset": 0, "type": kind}], "data": base64.b64encode(array.tobytes()).decode(),
    }  # fmt: skip
    return (topic, "foxglove.Grid", "json", "jsonschema", b"{}", json.dumps(data).encode())


def area(entry):
    return shapely.Polygon(entry["rings_m"][0], entry["rings_m"][1:]).area


def test_toml_in_metres_and_in_degrees(tmp_path, empty_log):
    sources = written(
        tmp_path / "zones.toml",
        """
        circles = [
          { x_m = 1.0, y_m = 2, radius_m = 30.0, name = "mast" },
          { latitude_deg = 50.81, longitude_deg = -1.2, radius_m = 40.0 },
        ]
        [[polygons]]
        points_m = [[0, 0], [10, 0], [10, 10], [0, 10]]
        holes_m = [[[4, 4], [6, 4], [6, 6], [4, 6]]]
        [[polygons]]
        points_deg = [[50.80, -1.21], [50.80, -1.20], [50.81, -1.20]]
        """,
    )
    mast, circle, square, triangle = collect_obstacles(empty_log, sources, GEOREFERENCED)
    assert mast == {"kind": "circle", "x_m": 1.0, "y_m": 2.0, "radius_m": 30.0, "name": "mast"}
    x_m, y_m = to_local(GEOREFERENCED, np.array([50.81]), np.array([-1.2]))
    assert (circle["x_m"], circle["y_m"]) == (x_m[0], y_m[0]) and 1100 < circle["y_m"] < 1120
    assert len(square["rings_m"]) == 2 and area(square) == 96
    assert triangle["rings_m"][0][1] == pytest.approx([0, 0], abs=1e-6)


def test_inline_configuration_reads_like_the_file(empty_log):
    tables = {"circles": [{"x_m": 1, "y_m": 2, "radius_m": 3}], "polygons": [{"points_m": [[0, 0], [1, 0], [0, 1]]}]}
    sources = read_config(ObstacleSources, tables, "extract.obstacles")
    assert [entry["kind"] for entry in collect_obstacles(empty_log, sources, LOCAL)] == ["circle", "polygon"]


def test_geojson(tmp_path, empty_log):
    feature = {"type": "Feature", "properties": {"name": "fort"}, "geometry": {"type": "Polygon", "coordinates": [RING]}}
    point = {
        "type": "Feature", "properties": {"radius_m": 50}, "geometry": {"type": "Point", "coordinates": [-1.2, 50.8, 7.0]}
    }  # fmt: skip
    both = {"type": "MultiPolygon", "coordinates": [[RING], [[[x + 0.1, y] for x, y in RING]]]}
    collection = {"type": "FeatureCollection", "features": [feature, point, {"type": "Feature", "geometry": both}]}
    fort, circle, first, second = collect_obstacles(empty_log, written(tmp_path / "a.geojson", collection), GEOREFERENCED)
    assert fort["name"] == "fort" and fort["rings_m"] == first["rings_m"]
    assert (circle["x_m"], circle["y_m"], circle["radius_m"]) == pytest.approx((0, 0, 50), abs=1e-6)
    assert second["rings_m"][0][0][0] - first["rings_m"][0][0][0] == pytest.approx(7050, abs=10)
    (bare,) = collect_obstacles(empty_log, written(tmp_path / "b.json", feature["geometry"]), GEOREFERENCED)
    assert bare["rings_m"] == fort["rings_m"]


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.toml", "circles = [{x_m = 1, y_m = 2, radius_m = -3}]", ["a.toml", "circles[0]"]),
        ("a.toml", "circles = [{x_m = 1, latitude_deg = 2, radius_m = 3}]", ["a.toml", "circles[0]", "x_m and y_m"]),
        ("a.toml", "circles = [{x_m = 1, y_m = 2, radius = 3}]", ["a.toml", "radius", "known keys"]),
        ("a.toml", "circles = [{x_m = nan, y_m = 2, radius_m = 3, name = 'hill'}]", ["a.toml", "circles[0].x_m"]),
        ("a.toml", "polygons = [{points_m = [[0, 0], [1, 1]]}]", ["a.toml", "polygons[0]", "fewer than 3"]),
        (
            "a.toml",
            "polygons = [{points_m = [[0, 0], [2, 2], [2, 0], [0, 2]], name = 'bow'}]",
            ["polygons[0] (bow)", "Self-intersection"],
        ),
        ("a.toml", "circles = [{x_m = 1, y_m = 2, radius_m = 0, name = 'hill'}]", ["circles[0] (hill)", "above zero"]),
        ("a.toml", "circles = 3", ["a.toml", "circles"]),
        ("a.toml", "circles = [", ["a.toml", "TOML"]),
        ("a.json", "{", ["a.json", "neither TOML"]),
        ("a.json", "[1]", ["a.json", "neither GeoJSON"]),
        ("a.json", {"version": 1, "obstacles": [{"kind": "cube"}]}, ["obstacles[0]", "cube"]),
        ("a.json", {"version": 1, "obstacles": [{"kind": "circle", "x_m": 1, "y_m": 2}]}, ["obstacles[0]", "radius_m"]),
        ("a.json", {"version": 1, "obstacles": [7]}, ["obstacles[0]"]),
        ("a.geojson", {"type": "Point", "coordinates": [1, 2]}, ["feature 0", "radius_m"]),
        ("a.geojson", {"type": "LineString", "coordinates": RING}, ["feature 0", "LineString"]),
        ("a.geojson", {"type": "Polygon", "coordinates": [[[51, 181], [51, 1], [51, 2]]]}, ["feature 0", "longitude first"]),
        ("a.geojson", {"type": "Polygon", "coordinates": [[["a", "b"]]]}, ["feature 0", "positions"]),
        ("a.geojson", {"type": "Polygon"}, ["feature 0"]),
        ("a.geojson", {"type": "FeatureCollection", "features": [{"type": "Feature", "geometry": None}]}, ["feature 0"]),
    ],
)  # fmt: skip
def test_bad_files_are_named_in_one_line(tmp_path, empty_log, name, content, words):
    sources = written(tmp_path / name, content)
    with pytest.raises(ConfigError) as caught:
        collect_obstacles(empty_log, sources, GEOREFERENCED)
    message = str(caught.value)
    assert "\n" not in message
    assert all(word in message for word in words), message


def test_absent_file_and_degrees_without_datum(tmp_path, empty_log):
    with pytest.raises(ConfigError, match=r"nowhere\.json"):
        collect_obstacles(empty_log, ObstacleSources(files=(tmp_path / "nowhere.json",)), LOCAL)
    with pytest.raises(ConfigError, match=r"a\.json: feature 0: .*extract\.datum"):
        collect_obstacles(empty_log, written(tmp_path / "a.json", {"type": "Polygon", "coordinates": [RING]}), LOCAL)


def test_metadata_of_the_prison_world(tmp_path):
    mountains = json.dumps([{"x_m": 33600.0, "y_m": 37800.0, "keep_out_radius_m": 2940.0}])
    log = make_log(tmp_path / "a.mcap", [("mission", {"mountains": mountains}), ("rosbag2", {"x": "y"})])
    expected = [{"kind": "circle", "x_m": 33600.0, "y_m": 37800.0, "radius_m": 2940.0}]
    assert collect_obstacles(log, ObstacleSources(), LOCAL) == expected
    assert collect_obstacles(log, ObstacleSources(from_log=False), LOCAL) == []
    notes = []
    assert collect_obstacles(log, ObstacleSources(), GEOREFERENCED, notes.append) == []
    assert len(notes) == 1 and "datum" in notes[0]


def test_recorded_prison_log(shared_data):
    path = next(iter(sorted((shared_data / "prison_reference" / "low").glob("*.mcap"))), None)
    if path is None:
        pytest.skip("needs ../shared/data/prison_reference")
    (mountain,) = collect_obstacles(open_log(path), ObstacleSources(), LOCAL)
    assert mountain["radius_m"] == 2940.0


def test_own_metadata_with_datum_is_moved_to_that_of_the_mission(tmp_path):
    entries = [
        {"kind": "circle", "x_m": 0.0, "y_m": 0.0, "radius_m": 5.0, "name": "rock"},
        {"kind": "polygon", "rings_m": [[[0, 0], [10, 0], [0, 10], [0, 0]]]},
    ]
    datum = {"frame_id": '"mission"', "latitude_deg": "50.81", "longitude_deg": "-1.2"}
    log = make_log(tmp_path / "a.mcap", [("cadence.obstacles", {"obstacles": json.dumps(entries), **datum})])
    circle, triangle = collect_obstacles(log, ObstacleSources(), GEOREFERENCED)
    assert (circle["x_m"], circle["y_m"]) == pytest.approx((0, 1112.4), abs=0.5) and circle["name"] == "rock"
    assert area(triangle) == pytest.approx(50, rel=1e-4)
    same = collect_obstacles(log, ObstacleSources(), Frame("mission", 50.81, -1.2))
    assert same[0]["x_m"] == 0.0 and same[0]["y_m"] == 0.0


def test_own_metadata_as_geojson(tmp_path):
    geojson = json.dumps({"type": "Polygon", "coordinates": [RING]})
    log = make_log(tmp_path / "a.mcap", [("cadence.obstacles", {"geojson": geojson})])
    assert len(collect_obstacles(log, ObstacleSources(), GEOREFERENCED)) == 1


@pytest.mark.parametrize(
    "record",
    [
        ("mission", {"mountains": "[{]"}),
        ("mission", {"mountains": '[{"x_m": 1}]'}),
        ("mission", {"mountains": "7"}),
        ("cadence.obstacles", {"obstacles": '[{"kind": "circle", "x_m": NaN, "y_m": 0, "radius_m": 1}]'}),
        ("cadence.obstacles", {"obstacles": "[7]"}),
        ("cadence.obstacles", {"obstacles": "7"}),
        ("cadence.obstacles", {"geojson": "[]"}),
        ("cadence.obstacles", {"obstacles": "[]", "latitude_deg": "x", "longitude_deg": "1"}),
    ],
)
def test_bad_metadata_is_noted_and_left_out(tmp_path, record):
    good = ("mission", {"mountains": '[{"x_m": 1, "y_m": 2, "keep_out_radius_m": 3}]'})
    notes = []
    found = collect_obstacles(make_log(tmp_path / "a.mcap", [record, good]), ObstacleSources(), LOCAL, notes.append)
    assert len(found) == 1
    assert len(notes) == (0 if "latitude_deg" in record[1] else 1)


def test_ros_grid_threshold_origin_and_yaw(tmp_path):
    log = make_log(tmp_path / "a.mcap", messages=[occupancy_message(origin=pose(100.0, 50.0, math.pi / 2))])
    (entry,) = collect_obstacles(log, ObstacleSources(), LOCAL)
    assert entry["name"] == "/map" and area(entry) == pytest.approx(2 * 2 * 2)
    # Two cells, columns 1–2 of row 1, turned left by 90°: x = 100 - 2 * (1..2), y = 50 + 2 * (1..3).
    assert shapely.Polygon(entry["rings_m"][0]).bounds == pytest.approx((96, 52, 98, 56))
    (lower,) = collect_obstacles(log, ObstacleSources(threshold=60.0), LOCAL)
    assert area(lower) == pytest.approx(12)


def test_ros_grid_as_cdr_keeps_unknown_cells_free(tmp_path):
    store = get_typestore(Stores.ROS2_HUMBLE)
    t = store.types
    origin = t["geometry_msgs/msg/Pose"](
        t["geometry_msgs/msg/Point"](1.0, 2.0, 0.0), t["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    )
    stamp = t["builtin_interfaces/msg/Time"](0, 0)
    info = t["nav_msgs/msg/MapMetaData"](stamp, 0.5, 4, 3, origin)
    header = t["std_msgs/msg/Header"](stamp, "map")
    message = t["nav_msgs/msg/OccupancyGrid"](header, info, np.array(SQUARE_CELLS, dtype=np.int8).ravel())
    name = "nav_msgs/msg/OccupancyGrid"
    data = bytes(store.serialize_cdr(message, name))
    schema = store.generate_msgdef(name, ros_version=2)[0].encode()
    log = make_log(tmp_path / "a.mcap", messages=[("/map", name, "cdr", "ros2msg", schema, data)])
    (entry,) = collect_obstacles(log, ObstacleSources(), LOCAL)
    assert shapely.Polygon(entry["rings_m"][0]).bounds == pytest.approx((1.5, 2.5, 2.5, 3.0))


def test_ring_of_cells_has_a_hole_and_separate_cells_are_separate(tmp_path):
    cells = np.zeros((5, 9), dtype=int)
    cells[:, :5] = 100
    cells[1:4, 1:4] = 0
    cells[2, 7] = 100
    log = make_log(tmp_path / "a.mcap", messages=[occupancy_message(cells=cells.tolist())])
    ring, single = sorted(collect_obstacles(log, ObstacleSources(), LOCAL), key=area, reverse=True)
    assert len(ring["rings_m"]) == 2 and area(ring) == pytest.approx(16 * 4)
    assert len(ring["rings_m"][0]) == 5, "corners only"
    assert area(single) == pytest.approx(4)


def test_touching_corners_and_large_grids_are_valid(tmp_path):
    cells = (np.random.default_rng(0).random((120, 120)) < 0.3) * 100
    log = make_log(tmp_path / "a.mcap", messages=[occupancy_message(cells=cells.tolist())])
    entries = collect_obstacles(log, ObstacleSources(), LOCAL)
    assert sum(map(area, entries)) == pytest.approx((cells > 0).sum() * 4)


def test_the_last_grid_of_a_topic_counts(tmp_path):
    log = make_log(tmp_path / "a.mcap", messages=[occupancy_message(), occupancy_message(cells=[[0, 0], [0, 0]])])
    assert collect_obstacles(log, ObstacleSources(), LOCAL) == []


def test_foxglove_grid(tmp_path):
    log = make_log(tmp_path / "a.mcap", messages=[foxglove_message()])
    (entry,) = collect_obstacles(log, ObstacleSources(), LOCAL)
    assert shapely.Polygon(entry["rings_m"][0]).bounds == pytest.approx((13, 20, 16, 25))
    bytes_log = make_log(tmp_path / "b.mcap", messages=[foxglove_message(kind=1, values=((0, 66), (64, 0)))])
    assert len(collect_obstacles(bytes_log, ObstacleSources(), LOCAL)) == 1


def test_grids_that_are_no_obstacles_are_taken_only_by_name(tmp_path):
    messages = [foxglove_message("/heat", field="temperature"), occupancy_message("/odom_map", frame_id="odom")]
    log = make_log(tmp_path / "a.mcap", messages=messages)
    notes = []
    assert collect_obstacles(log, ObstacleSources(), LOCAL, notes.append) == []
    assert len(notes) == 1 and "odom" in notes[0] and "obstacles.topics" in notes[0]
    assert len(collect_obstacles(log, ObstacleSources(topics=("/heat", "/odom_map"), from_log=False), LOCAL)) == 2
    with pytest.raises(ConfigError, match="/nowhere"):
        collect_obstacles(log, ObstacleSources(topics=("/nowhere",)), LOCAL)


def test_our_own_grids_are_no_obstacles(tmp_path):
    log = make_log(tmp_path / "a.mcap", messages=[foxglove_message("/cadence/occupancy")])
    assert collect_obstacles(log, ObstacleSources(), LOCAL) == []


@pytest.mark.parametrize("change", [{"width": 5}, {"resolution": 0.0}, {"resolution": math.nan}, {"origin": {"position": {}}}])
def test_broken_grids_are_noted_and_left_out(tmp_path, change):
    log = make_log(tmp_path / "a.mcap", messages=[occupancy_message(**change)])
    notes = []
    assert collect_obstacles(log, ObstacleSources(), LOCAL, notes.append) == []
    assert len(notes) == 1 and "/map" in notes[0]


def test_a_topic_that_is_no_grid_is_refused(tmp_path):
    log = make_log(tmp_path / "a.mcap", messages=[("/text", "std_msgs/msg/String", "json", "jsonschema", b"{}", b"{}")])
    with pytest.raises(ConfigError, match=r"/text.*std_msgs/msg/String"):
        collect_obstacles(log, ObstacleSources(topics=("/text",)), LOCAL)


def test_round_trip_through_obstacles_json(tmp_path, empty_log):
    sources = written(
        tmp_path / "a.toml",
        "circles = [{x_m = 1.5, y_m = 2, radius_m = 3}]\npolygons = [{points_m = [[0, 0], [9, 0], [0, 9]], "
        "holes_m = [[[1, 1], [2, 1], [1, 2]]]}]",
    )
    entries = collect_obstacles(empty_log, sources, LOCAL)
    path = tmp_path / "obstacles.json"
    write_obstacles(path, entries)
    assert json.loads(path.read_text()) == {"version": 1, "obstacles": entries}
    obstacles = read_obstacles(path)
    assert torch.equal(obstacles.circles, torch.tensor([[1.5, 2.0, 3.0]], dtype=torch.float64))
    assert [len(polygon) for polygon in obstacles.polygons] == [2]
    assert collect_obstacles(empty_log, ObstacleSources(files=(path,)), LOCAL) == entries
    write_obstacles(path, [])
    assert read_obstacles(path).count == 0


@pytest.mark.parametrize("text", ["{", "[]", '{"version": 2, "obstacles": []}', '{"version": 1, "obstacles": [{}]}'])
def test_unusable_obstacles_json(tmp_path, text):
    path = tmp_path / "obstacles.json"
    path.write_text(text)
    with pytest.raises(InputError, match=r"obstacles\.json"):
        read_obstacles(path)
    with pytest.raises(InputError, match="run extract first"):
        read_obstacles(tmp_path / "absent.json")
