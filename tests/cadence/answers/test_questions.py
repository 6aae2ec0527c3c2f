"""Questions of one agent or a pair, against cases computed by hand."""

import numpy as np
import pytest
import shapely

from cadence.answers.areas import Disc, Path, Region
from cadence.answers.questions import arrive, inside, meet, nearest_m, passed
from cadence.answers.sameness import same_detections, same_tracks
from cadence.stories import Stories

SQUARE = Region(shapely.box(0, 0, 10, 10))
ALL = (0.0, 60.0)


def stories(*tracks, weight=None, agents=("a",), time_s=(0.0, 30.0, 60.0)):
    """Tracks [K, A, T, 2]; one agent's may leave out A."""
    position_m = np.array(tracks, dtype=float).reshape(len(tracks), len(agents), len(time_s), 2)
    weight = np.full(len(tracks), 1 / len(tracks)) if weight is None else np.array(weight)
    return Stories(np.array(time_s), position_m, weight, agents)


THROUGH = [(-10, 5), (20, 5), (20, 50)]
STAYS = [(5, 5), (5, 6), (6, 6)]
COMES = [(-10, 5), (-10, 5), (5, 5)]
NEVER = [(-10, 50), (20, 50), (20, 50)]


def test_inside():
    found = inside(stories(THROUGH, STAYS, COMES, NEVER, weight=[0.1, 0.2, 0.3, 0.4]), 0, SQUARE, ALL, dwell_s=20.5)
    assert found.ever.value == pytest.approx(0.6) and found.dwelt.value == pytest.approx(0.2)
    assert found.at_start.value == pytest.approx(0.2) and found.at_end.value == pytest.approx(0.5)
    # first entries at 10 s (weight .1) and at 50 s (.3); the story that begins inside has none
    assert found.first_entry_s.low == pytest.approx(10) and found.first_entry_s.high == pytest.approx(50)
    assert found.first_entry_s.num_effective == pytest.approx(0.4**2 / (0.01 + 0.09))
    assert found.left_s.median == pytest.approx(20)
    assert found.total_s.high == pytest.approx(60)


def test_a_span_of_time_cuts_the_stays():
    found = inside(stories(THROUGH), 0, SQUARE, (15.0, 60.0))
    assert found.at_start.value == 1 and found.first_entry_s is None and found.left_s.median == pytest.approx(20)
    assert inside(stories(THROUGH), 0, SQUARE, (21.0, 60.0)).ever.value == 0


def test_arrive():
    found = arrive(stories(THROUGH, STAYS, COMES, NEVER, weight=[0.1, 0.2, 0.3, 0.4]), 0, SQUARE, ALL)
    assert found.arrived.value == pytest.approx(0.4) and found.was_there.value == pytest.approx(0.2)
    assert (found.arrived_s.low, found.arrived_s.high) == (pytest.approx(10), pytest.approx(50))
    assert found.place_m == (pytest.approx(0), pytest.approx(5))
    nobody = arrive(stories(NEVER), 0, SQUARE, ALL)
    assert nobody.arrived.value == 0 and nobody.place_m is None and nobody.arrived_s is None


def test_times_are_known_as_well_as_steps_tell_them():
    """On a circle at 30 degrees a step the arc leads the chord to a border by up to its sagitta; stories that agree say so."""
    angle = np.radians(30.0) * np.arange(13)
    ring = 100.0 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    time_s = tuple(10.0 * np.arange(13.0))
    for border in (-20.0, 10.0, 45.0, 70.0):
        area = Region(shapely.box(-500, -500, border, 500))
        found = arrive(stories([tuple(point) for point in ring], time_s=time_s), 0, area, (0.0, 120.0))
        truth = np.degrees(np.arccos(border / 100.0)) / 3.0
        assert found.arrived_s.low - 0.05 <= truth <= found.arrived_s.high + 0.05
        assert 0.1 < found.arrived_s.high - found.arrived_s.low < 2.0


def test_who_appears_inside_did_not_come_over_the_border():
    appears = [(np.nan, np.nan), (5, 5), (6, 6)]
    found = arrive(stories(appears), 0, SQUARE, ALL)
    assert found.arrived.value == 0 and found.was_there.value == 0
    assert inside(stories(appears), 0, SQUARE, ALL).ever.value == 1


def test_passed():
    line = Path.of([np.array([[0.0, 0.0], [0.0, 10.0]])])  # northwards: right is east
    east, west = [(-10, 4), (20, 4), (20, 4)], [(10, 6), (-5, 6), (-5, 6)]
    back = [(-10, 2), (10, 2), (-10, 2)]
    beside = [(-10, 11), (20, 11), (20, 11)]
    found = passed(stories(east, west, back, beside), 0, line, ALL)
    assert found.passed.value == pytest.approx(0.75)
    assert found.to_right.value == pytest.approx(2 / 3)
    assert (found.passed_s.low, found.passed_s.high) == (pytest.approx(10), pytest.approx(20))
    assert (found.along_m.low, found.along_m.median, found.along_m.high) == (2, 4, 6)
    assert found.num_crossings.high == 2


def test_a_step_on_the_line_is_one_crossing():
    line = Path.of([np.array([[0.0, -5.0], [0.0, 5.0], [0.0, 10.0]])])
    found = passed(stories([(-1, 5), (0, 5), (1, 5)]), 0, line, ALL)
    assert found.num_crossings.median == 1 and found.along_m.median == pytest.approx(10)
    assert passed(stories([(-1, 5), (-2, 5), (-1, 5)]), 0, line, ALL).passed_s is None


def test_meet_between_two_steps():
    crossing = [[(-300, 0), (300, 0), (300, 0)], [(0, -300), (0, 300), (0, 300)]]
    apart = [[(-300, 0), (300, 0), (300, 0)], [(0, 900), (0, 900), (0, 900)]]
    both = stories(crossing, apart, agents=("a", "b"))
    found = meet(both, 0, 1, 100.0, 0.0, ALL)
    assert found.met.value == 0.5
    # they are 20 sqrt(2) |t - 15| apart
    assert found.met_s.median == pytest.approx(15 - 100 / (20 * np.sqrt(2)))
    assert found.lasted_s.median == pytest.approx(2 * 100 / (20 * np.sqrt(2)))
    assert found.nearest_m.low == pytest.approx(0, abs=1e-9)
    assert found.place_m == (pytest.approx(-35.355, abs=0.01), pytest.approx(-35.355, abs=0.01))
    assert meet(both, 0, 1, 100.0, 8.0, ALL).met.value == 0


def test_nearest_distance_is_that_between_steps():
    assert nearest_m(np.array([[[-1.0, 1.0], [1.0, 1.0]], [[3.0, 4.0], [3.0, 4.0]]])).tolist() == [1.0, 5.0]
    assert np.isnan(nearest_m(np.full((1, 2, 2), np.nan)))[0]


def test_two_detections_are_of_one_agent_where_the_stories_agree():
    a, b = [(0, 0), (300, 0), (600, 0)], [(0, 100), (300, 100), (600, 100)]
    swapped = [[(0, 0), (300, 50), (600, 100)], [(0, 100), (300, 50), (600, 0)]]
    both = stories([a, b], swapped, weight=[0.8, 0.2], agents=("a", "b"))
    at = np.array([0.0, 60.0]), np.array([[0.0, 0.0], [600.0, 0.0]]), np.tile(25.0 * np.eye(2), (2, 1, 1))
    found = same_detections(both, *at, clutter_density=1e-12)
    assert found.value == pytest.approx(0.8, abs=1e-6) and found.likeliest[0][0] == found.likeliest[1][0] == "a"
    lost = same_detections(both, at[0], np.array([[0.0, 0.0], [600.0, 5000.0]]), at[2], clutter_density=1e-12)
    assert lost.value == pytest.approx(0, abs=1e-9)


def test_tracks_that_are_apart_at_one_time_are_two():
    a, b = [(0, 0), (300, 0), (600, 0)], [(0, 900), (300, 900), (600, 900)]
    found = same_tracks(stories([a, b], agents=("a", "b")), 0, 1, 50.0)
    assert found.apart.value == 1 and found.overlap_s == 60 and found.gap_s is None


def test_tracks_one_after_the_other_need_a_speed():
    nan = (np.nan, np.nan)
    a, b = [(0, 0), (30, 0), nan, nan], [nan, nan, (630, 0), (660, 0)]
    found = same_tracks(stories([a, b], agents=("a", "b"), time_s=(0.0, 30.0, 60.0, 90.0)), 0, 1, 50.0)
    assert found.apart.value == 0 and found.gap_s.median == 30
    assert found.speed_mps.median == pytest.approx(20) and found.usual_mps.median == pytest.approx(1)
    assert found.as_fast.value == 0
    swapped = same_tracks(stories([a, b], agents=("a", "b"), time_s=(0.0, 30.0, 60.0, 90.0)), 1, 0, 50.0)
    assert swapped.speed_mps == found.speed_mps


def test_circles_are_areas_too():
    assert inside(stories(THROUGH), 0, Disc((5.0, 5.0), 5.0), ALL).total_s.median == pytest.approx(10)
