import time

import numpy as np
import pytest
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from benchmarks.log_writing_usual import point_by_point
from pipeline.export.scene import Entity, Label, Lines, LineType, Spheres, encode_scene, encode_time, round_positions

TIME_NS = 1_700_000_000_250_000_000


def scene(rng, *, num_lines=5, num_points=7, z_m=12.5):
    def points(*shape):
        return np.concatenate([rng.normal(0, 400, (*shape, 2)), np.full((*shape, 1), z_m)], axis=-1)

    color = rng.uniform(0.1, 1, (num_lines, 4))
    return [
        Entity(
            "agent/Ü 1",
            lines=(Lines(points(num_lines, num_points), color, 1.5), Lines(points(num_lines, 40), color, 2.0, LineType.LIST)),
            spheres=(Spheres(points(3), 4.0, color[0]),),
            labels=(Label(points(), "Ü 1", color[1]),),
        ),
        Entity("empty", lines=(Lines(points(0, 9), color[:0], 1.5),), spheres=(Spheres(points(0), 1.0, color[0]),)),
        Entity("loop", lines=(Lines(points(1, 48), color[:1], 1.0, LineType.LOOP),)),
    ]


@pytest.mark.parametrize("num_points", [1, 2, 7, 200])
def test_bytes_equal_those_of_the_published_classes(num_points):
    entities = scene(np.random.default_rng(1), num_points=num_points)
    assert encode_scene(TIME_NS, "map", entities) == point_by_point(TIME_NS, entities).SerializeToString()


def test_flat_scene_leaves_out_z_and_still_equals():
    entities = scene(np.random.default_rng(2), z_m=0.0)
    flat = encode_scene(TIME_NS, "map", entities)
    assert SceneUpdate.FromString(flat) == point_by_point(TIME_NS, entities)
    assert len(flat) < 0.8 * len(encode_scene(TIME_NS, "map", scene(np.random.default_rng(2))))


def test_zeros_anywhere_parse_to_the_same_message():
    rng = np.random.default_rng(3)
    entities = [
        Entity("a", (Lines(np.zeros((2, 3, 3)), np.zeros((2, 4)), 1.0),), (Spheres(np.zeros((2, 3)), 1.0, np.zeros(4)),))
    ]
    entities += scene(rng)
    entities[1].lines[0].point_m[0, :, 0] = 0.0
    assert SceneUpdate.FromString(encode_scene(TIME_NS, "", entities)) == point_by_point(TIME_NS, entities, "")


def test_message_without_entities_only_deletes():
    update = SceneUpdate.FromString(encode_scene(TIME_NS, "map", []))
    assert [deletion.type for deletion in update.deletions] == [SceneEntityDeletion.ALL]
    assert not update.entities


@pytest.mark.parametrize("time_ns", [0, 1, 999_999_999, 1_000_000_000, TIME_NS])
def test_time(time_ns):
    line = SceneEntityDeletion()
    line.timestamp.ParseFromString(encode_time(time_ns))
    assert line.timestamp.ToNanoseconds() == time_ns


@pytest.mark.parametrize(
    ("reach_m", "quantum_m"), [(1024.0, 1.0), (1000.0, 1.0), (700.0, 1 / 2), (8.0, 2**-7), (2.0e6, 2048.0)]
)
def test_rounding_follows_what_is_drawn(reach_m, quantum_m):
    rounded = round_positions(np.linspace(-reach_m, reach_m, 1001), reach_m)
    assert np.all(rounded / quantum_m == np.round(rounded / quantum_m))
    assert np.max(np.abs(rounded - np.linspace(-reach_m, reach_m, 1001))) <= quantum_m / 2
    assert not np.signbit(round_positions(np.array([-1e-9]), reach_m))[0]


def test_encoding_is_much_faster_than_point_by_point():
    rng = np.random.default_rng(4)
    entities = [Entity(str(agent), scene(rng, num_lines=30, num_points=32)[0].lines) for agent in range(3)]

    def best_of(function, repeats):
        times = []
        for _ in range(repeats):
            begin = time.perf_counter()
            function()
            times.append(time.perf_counter() - begin)
        return min(times)

    fast = best_of(lambda: encode_scene(TIME_NS, "map", entities), 5)
    slow = best_of(lambda: point_by_point(TIME_NS, entities).SerializeToString(), 2)
    print(f"point by point / vectorised = {slow / fast:.0f}")
    assert slow > 5 * fast


def test_line_type_numbers_are_those_of_the_schema():
    assert [LinePrimitive.Type.Name(kind) for kind in LineType] == ["LINE_STRIP", "LINE_LOOP", "LINE_LIST"]
