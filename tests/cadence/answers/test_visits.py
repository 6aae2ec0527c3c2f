"""Stays in areas, exact between steps."""

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from cadence.answers.areas import Disc, Path, Region, pieces_inside
from cadence.answers.visits import between, visits
from cadence.stories import Stories

SQUARE = Region(shapely.box(0, 0, 10, 10))
RING = Region(shapely.box(0, 0, 10, 10).difference(shapely.box(4, 4, 6, 6)))
TWO = Region(shapely.union_all([shapely.box(0, 0, 1, 10), shapely.box(9, 0, 10, 10)]))


def track(*points):
    return np.array([points], dtype=float)


def spans(found):
    return [(pytest.approx(start), pytest.approx(end)) for start, end in zip(found.start_s, found.end_s, strict=True)]


def test_a_path_crosses_an_area_between_two_steps():
    time_s = np.array([0.0, 30.0])
    assert spans(visits(time_s, track((-10, 5), (20, 5)), SQUARE)) == [(10.0, 20.0)]
    assert spans(visits(time_s, track((-10, 5), (20, 5)), RING)) == [(10.0, 14.0), (16.0, 20.0)]
    assert spans(visits(time_s, track((-10, 5), (20, 5)), TWO)) == [(10.0, 11.0), (19.0, 20.0)]
    assert spans(visits(time_s, track((-15, 0), (15, 0)), Disc((0.0, 0.0), 5.0))) == [(10.0, 20.0)]


def test_what_does_not_cross_is_never_inside():
    time_s = np.array([0.0, 1.0])
    for points in (((-10, 11), (20, 11)), ((-1, 8), (-1, 20)), ((-6, 6), (5, 17))):
        assert len(visits(time_s, track(*points), SQUARE)) == 0
    assert len(visits(time_s, track((-15, 5.001), (15, 5.001)), Disc((0.0, 0.0), 5.0))) == 0


def test_pieces_that_follow_each_other_are_one_stay():
    time_s = np.array([0.0, 1.0, 2.5, 4.0, 10.0])
    found = visits(time_s, track((5, 5), (6, 5), (6, 6), (5, 5), (5, 17)), SQUARE)
    assert spans(found) == [(0.0, pytest.approx(4 + 6 * 5 / 12))]


def test_a_track_along_the_border_and_through_corners_has_no_holes():
    found = visits(np.array([0.0, 10.0, 20.0]), track((0, 0), (10, 10), (0, 0)), SQUARE)
    assert spans(found) == [(0.0, 20.0)]
    assert visits(np.array([0.0, 1.0]), track((0, 2), (0, 4)), SQUARE).total_s[0] == 1.0  # closed: the border counts


def test_where_a_track_is_absent_it_is_nowhere():
    gap = track((5, 5), (np.nan, np.nan), (5, 5), (6, 5))
    assert spans(visits(np.arange(4.0), gap, SQUARE)) == [(2.0, 3.0)]


def test_numbers_of_each_story():
    tracks = np.concatenate([track((-10, 5), (20, 5), (-10, 5)), track((-10, 50), (20, 50), (20, 50))])
    found = visits(np.array([0.0, 30.0, 60.0]), tracks, SQUARE)
    assert found.is_any.tolist() == [True, False]
    np.testing.assert_allclose(found.total_s, [20, 0])
    np.testing.assert_allclose(found.longest_s, [10, 0])
    np.testing.assert_allclose(found.first_s, [10, np.nan])
    np.testing.assert_allclose(found.last_s, [50, np.nan])
    assert len(found.lasting(10.5)) == 0 and len(found.after(10.0)) == 1


def test_one_moment_is_a_stay_without_length():
    assert spans(visits(np.array([7.0]), track((5, 5)), SQUARE)) == [(7.0, 7.0)]


@given(
    st.lists(st.tuples(st.floats(-20, 30), st.floats(-20, 30)), min_size=2, max_size=6), st.sampled_from([SQUARE, RING, TWO])
)
def test_time_inside_is_the_length_inside_as_shapely_measures_it(points, area):
    position_m = np.array(points)
    length = np.hypot(*np.diff(position_m, axis=0).T)
    if (length < 1e-3).any():
        return
    time_s = np.concatenate([[0.0], np.cumsum(length)])  # a metre a second
    # of each segment alone: lines that lie upon each other would count once
    lines = shapely.linestrings(np.stack([position_m[:-1], position_m[1:]], axis=1))
    expected = shapely.length(shapely.intersection(lines, area.shape)).sum()
    assert visits(time_s, position_m[None], area).total_s[0] == pytest.approx(expected, abs=1e-6)


@given(st.integers(0, 10**6))
def test_a_circle_is_a_polygon_of_many_corners(seed):
    rng = np.random.default_rng(seed)
    start, end = rng.uniform(-3, 3, (2, 50, 2))
    disc = Disc((0.3, -0.2), 1.4)
    many = Region(shapely.Point(0.3, -0.2).buffer(1.4, quad_segs=2000))
    inside = [np.bincount(line, last - first, 50) for line, first, last in (pieces_inside(start, end, a) for a in (disc, many))]
    np.testing.assert_allclose(*inside, atol=2e-3)


def test_stories_are_cut_exactly():
    stories = Stories(np.array([0.0, 10.0, 20.0]), np.array([[[[0.0, 0.0], [10.0, 0.0], [10.0, 20.0]]]]), np.ones(1), ("a",))
    cut = between(stories, (0,), 5.0, 12.0)
    assert cut.time_s.tolist() == [5, 10, 12]
    assert cut.position_m[0, 0].tolist() == [[5, 0], [10, 0], [10, 4]]
    assert between(stories, (0,), -5.0, 100.0).time_s.tolist() == [0, 10, 20]
    with pytest.raises(ValueError, match="nothing is known"):
        between(stories, (0,), 21.0, 30.0)


def test_areas_without_meaning_are_refused():
    with pytest.raises(ValueError, match="Self-intersection"):
        Region(shapely.Polygon([(0, 0), (1, 1), (1, 0), (0, 1)]))
    with pytest.raises(ValueError, match="expected polygons"):
        Region(shapely.Point(0, 0))
    with pytest.raises(ValueError, match="radius"):
        Disc((0.0, 0.0), 0.0)
    with pytest.raises(ValueError, match="two different points"):
        Path.of([np.zeros((2, 2))])
    assert SQUARE.area_m2 == 100 and Disc((0.0, 0.0), 1.0).area_m2 == pytest.approx(np.pi)
