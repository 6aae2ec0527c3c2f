import numpy as np
import pytest

from cadence.stories import Stories


def two_stories(time_s=(0.0, 10.0, 30.0)) -> Stories:
    position_m = np.zeros((2, 1, len(time_s), 2))
    position_m[0, 0, :, 0] = time_s
    position_m[1, 0, :, 1] = time_s
    return Stories(np.array(time_s), position_m, np.array([0.25, 0.75]), ("a",))


def test_between_two_steps_a_track_is_a_straight_line():
    there = two_stories().at(np.array([0.0, 5.0, 20.0, 30.0]))
    assert there[0, 0, :, 0].tolist() == [0.0, 5.0, 20.0, 30.0]
    assert there[1, 0, :, 1].tolist() == [0.0, 5.0, 20.0, 30.0]


def test_nothing_is_said_outside_the_mission():
    assert np.isnan(two_stories().at(np.array([-1.0, 31.0]))).all()


def test_a_step_that_is_met_exactly_is_not_lost_beside_an_absence():
    stories = two_stories()
    stories.position_m[0, 0, 2] = np.nan
    there = stories.at(np.array([10.0, 11.0]))
    assert there[0, 0, 0].tolist() == [10.0, 0.0]
    assert np.isnan(there[0, 0, 1]).all()
    assert stories.is_present[0, 0].tolist() == [True, True, False]


def test_stories_of_one_moment():
    assert two_stories((0.0,)).at(np.array([0.0])).shape == (2, 1, 1, 2)


def test_an_agent_is_found_by_its_name():
    assert two_stories().agent("a") == 0
    with pytest.raises(ValueError, match="no agent 'b'; there are a"):
        two_stories().agent("b")


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"weight": np.array([0.5, 0.6])}, "sum to one"),
        ({"time_s": np.array([0.0, 10.0, 10.0])}, "increase strictly"),
        ({"position_m": np.zeros((2, 1, 2, 2))}, "position_m has shape"),
        ({"height_m": np.zeros((2, 1, 2))}, "height_m has shape"),
    ],
)
def test_shapes_and_sums_are_checked(change, complaint):
    with pytest.raises(ValueError, match=complaint):
        Stories(**{**vars(two_stories()), **change})


def test_stories_of_some_agents_are_theirs_alone():
    position_m = np.arange(24.0).reshape(2, 3, 2, 2)
    stories = Stories(np.array([0.0, 1.0]), position_m, np.array([0.5, 0.5]), ("a", "b", "c"), position_m[..., 0])
    chosen = stories.of([2, 0])
    assert chosen.agent_ids == ("c", "a") and chosen.height_m is None
    assert np.array_equal(chosen.position_m, position_m[:, [2, 0]])
