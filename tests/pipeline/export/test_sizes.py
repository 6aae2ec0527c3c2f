import numpy as np
import pytest
from fixtures.mission import build_mission

from pipeline.export.occupancy import future_occupancy
from pipeline.export.playback import build_scenes
from pipeline.export.sizes import mark_sizes_m, reach_m
from pipeline.export.vertices import visible_vertices
from pipeline.results import read_hypothesis_tables

CORNER = (
    np.concatenate([np.stack([np.arange(10), np.zeros(10)], 1), np.stack([np.full(9, 9), np.arange(1, 10)], 1)])[None] * 1.0
)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    return build_scenes(read_hypothesis_tables(build_mission(tmp_path_factory.mktemp("sizes"))))


def test_marks_follow_the_agents_and_not_the_mission(scenes):
    near, far = mark_sizes_m(scenes, {}, 1e3), mark_sizes_m(scenes, {}, 1e5)
    assert near == far
    wide_m = {live.agent.agent_id: reach_m(live) for live in scenes[0].live}
    assert near["T0"] == pytest.approx(0.01 * wide_m["T0"], rel=0.2)
    assert mark_sizes_m(scenes, {"T0": 6.0}, 1e3)["T0"] == 6.0
    spacing_m = mark_sizes_m(scenes, {"T0": 1e4}, 1e3)["T0"]
    assert 5.0 < spacing_m < 0.3 * wide_m["T0"], "however inaccurate, no larger than a quarter of the way to the neighbour"


def test_cells_follow_the_agents_as_far_as_there_may_be_so_many(scenes):
    live = scenes[0].live
    found = future_occupancy(live, 2048)
    futures_m = [np.ptp(one.position_m[:, one.window.origin_index :], axis=(0, 1)).max() for one in live]
    assert 0.5 <= found.cell_m / (np.median(futures_m) / 96) <= 2.0
    assert max(future_occupancy(live, 16).probability.shape) <= 16


def test_vertices_stand_where_a_line_would_stray():
    wavy = np.concatenate([CORNER, CORNER + 0.01 * np.sin(np.arange(19.0))[:, None]])
    assert [np.flatnonzero(row).tolist() for row in visible_vertices(wavy, 4, 0.1)] == [[0, 4, 9, 18]] * 2
    for tolerance_m in (0.02, 0.005, 0.0):
        is_vertex = visible_vertices(wavy, 4, tolerance_m)
        for track, kept in zip(wavy, is_vertex, strict=True):
            dense = np.concatenate([np.linspace(a, b, 4001) for a, b in zip(track[kept][:-1], track[kept][1:], strict=True)])
            away_m = np.linalg.norm(track[:, None] - dense, axis=-1).min(axis=1)
            assert away_m.max() <= tolerance_m + 2e-3
    assert is_vertex[1].all()


def test_a_target_that_stands_needs_no_vertices():
    assert visible_vertices(np.zeros((2, 9, 2)), 4, 0.0).sum() == 2 * 3
    assert visible_vertices(np.zeros((1, 1, 2)), 0, 0.0).sum() == 1
