import dataclasses
import itertools

import numpy as np
import pytest

from cadence.association.associate import associate
from cadence.association.fitting import fit_habits
from cadence.association.naming import named_like
from cadence.association.particles import Stream
from cadence.association.types import CLUTTER, AssociationConfig, AssociationHypotheses, agent_probability, without_unlikely

KNOWN = AssociationConfig(num_agents=2, num_particles=40)


def covariances(number, sigma_m=1.0):
    return np.broadcast_to(sigma_m**2 * np.eye(2), (number, 2, 2)).copy()


def two_lines(num=40, distance_m=4000.0, seed=3):
    """Two agents on parallel ways at 5 m/s; one detection every 30 s of either, in random turn."""
    rng = np.random.default_rng(seed)
    time = 30.0 * np.arange(num) + rng.uniform(0.0, 20.0, num)
    origin = rng.permutation(np.arange(num) % 2)
    origin[:2] = 0, 1
    place = np.stack([5.0 * time, distance_m * origin], axis=1) + rng.normal(0.0, 1.0, (num, 2))
    return time, place, origin


def read(time, place, config=KNOWN, origins=None, **others):
    return associate(time, place, covariances(len(time)), time[-1:] if origins is None else origins, config, 0, **others)


def same_partition(label, origin):
    return np.array_equal(label[:, None] == label, origin[:, None] == origin)


def test_agents_far_apart_are_told_apart_with_certainty():
    time, place, origin = two_lines()
    for config in (KNOWN, AssociationConfig(num_particles=40)):
        (found,) = read(time, place, config)
        assert same_partition(found.label[0], origin)
        assert agent_probability(found).max(1).min() > 0.99


def test_agents_that_cross_keep_their_ways():
    """Where two straight ways cross, velocity tells who is who; the nearest agent would often be the wrong one."""
    time = 20.0 * np.arange(60)
    origin = np.arange(60) % 2
    place = np.stack([6.0 * time, np.where(origin == 0, 1.0, -1.0) * 2.0 * (time - 590.0)], axis=1)
    (found,) = read(time, place)
    assert same_partition(found.label[0], origin)


def test_what_cannot_be_known_is_said_to_be_unknown():
    """Two agents wait at one place together and part: half of the belief is in either exchange of their names."""
    time = 30.0 * np.arange(38)
    origin = np.arange(38) % 2
    way = np.where(time < 480.0, time - 480.0, np.where(time < 660.0, 0.0, time - 660.0)) * 4.0
    place = np.stack([way, np.where(origin == 0, 1.0, -1.0) * np.abs(way) * 0.5], axis=1)
    (found,) = read(time, place + np.random.default_rng(1).normal(0.0, 1.0, place.shape))
    early, late = found.label[:, :8], found.label[:, -8:]
    assert same_partition(late[0], origin[-8:])
    assert same_partition(early[0], origin[:8])
    assert 0.1 < found.weight @ (late[:, 0] == early[:, 0]) < 0.9


def test_nothing_after_an_origin_matters():
    time, place, _ = two_lines(distance_m=60.0)
    habits = fit_habits(Stream(time, place, covariances(len(time))), KNOWN, 0)
    origins = np.array([-5.0, time[9], time[19], time[-1]])
    whole = read(time, place, origins=origins, habits=habits)
    changed = place.copy()
    changed[20:] += 500.0
    cut = read(time[:25], changed[:25], origins=origins[:3], habits=habits)
    assert [item.num_detections for item in whole] == [0, 10, 20, 40]
    for one, other in zip(whole[:3], cut, strict=True):
        np.testing.assert_array_equal(one.label, other.label)
        np.testing.assert_array_equal(one.weight, other.weight)


def test_order_of_rows_and_zero_of_time_and_space_do_not_matter():
    time, place, _ = two_lines(distance_m=60.0)
    (first,) = read(time, place)
    shuffle = np.random.default_rng(0).permutation(len(time))
    (second,) = associate(time[shuffle], place[shuffle], covariances(len(time)), time[-1:], KNOWN, 0)
    np.testing.assert_array_equal(first.label, second.label)
    (third,) = associate(time + 7.0, place + np.array([3e4, -2e4]), covariances(len(time)), time[-1:] + 7.0, KNOWN, 0)
    np.testing.assert_allclose(agent_probability(first), agent_probability(third), atol=1e-4)


def test_one_agent_is_not_detected_twice_in_one_scan():
    time = np.repeat(30.0 * np.arange(12), 2)
    place = np.stack([4.0 * time, np.tile([0.0, 0.5], 12)], axis=1)
    (found,) = read(time, place)
    pairs = found.label.reshape(len(found.weight), 12, 2)
    assert ((pairs[..., 0] != pairs[..., 1]) | (pairs == CLUTTER).any(-1)).all()


def test_a_detection_that_fits_nobody_is_clutter():
    time, place, origin = two_lines()
    place[25] = [-9000.0, 30000.0]
    (found,) = read(time, place, dataclasses.replace(KNOWN, clutter_share=0.05))
    assert found.label[0, 25] == CLUTTER
    rest = np.arange(len(time)) != 25
    assert same_partition(found.label[0, rest], origin[rest])


def test_agents_come_and_go_where_their_number_is_unknown():
    time = np.arange(0.0, 3000.0, 25.0)
    is_second = time > 1500.0
    place = np.stack([3.0 * time, np.where(is_second, 20000.0, 0.0)], axis=1)
    early, late = read(time, place, AssociationConfig(num_particles=40), origins=np.array([1400.0, 3000.0]))
    assert set(early.label[0].tolist()) == {0}
    assert same_partition(late.label[0], is_second)
    assert late.num_agents == early.num_agents


def test_agents_that_are_never_likely_are_clutter():
    """Of three agents the second is likelier absent than there, at first and, with other weights, later on."""
    first = AssociationHypotheses(np.array([[0, 1], [0, 0]]), np.array([0.3, 0.7]), 3)
    last = AssociationHypotheses(np.array([[0, 1, 2], [0, 0, 2], [-1, 0, 2]]), np.array([0.5, 0.3, 0.2]), 3)
    early, late = without_unlikely([first, last])
    assert early.label.tolist() == [[0, CLUTTER], [0, 0]] and early.num_agents == late.num_agents == 2
    assert late.label.tolist() == [[0, CLUTTER, 1], [0, 0, 1], [CLUTTER, 0, 1]]
    assert late.weight.tolist() == last.weight.tolist()
    likelier = AssociationHypotheses(first.label, np.array([0.6, 0.4]), 3)
    assert [found.num_agents for found in without_unlikely([likelier, last])] == [3, 3]
    assert without_unlikely([AssociationHypotheses(np.zeros((1, 0), np.int64), np.ones(1), 0)])[0].num_agents == 0


@pytest.mark.parametrize("number", [0, 1])
@pytest.mark.parametrize("num_agents", [None, 2])
def test_streams_that_say_little_or_nothing(number, num_agents):
    config = AssociationConfig(num_agents=num_agents)
    (found,) = associate(np.zeros(number), np.zeros((number, 2)), covariances(number), np.array([1.0]), config, seed=0)
    assert found.label.shape == (len(found.weight), number)
    assert agent_probability(found).shape == (number, found.num_agents + 1)


def test_exact_detections_at_one_place_are_no_defect():
    time = np.repeat(np.arange(10.0), 2)
    (found,) = associate(time, np.ones((20, 2)), np.zeros((20, 2, 2)), time[-1:], KNOWN, seed=0)
    assert np.isfinite(found.weight).all()


def test_probabilities_by_hand():
    found = AssociationHypotheses(np.array([[0, 1, -1], [1, 1, 0]]), np.array([0.75, 0.25]), 2)
    np.testing.assert_allclose(agent_probability(found), [[0.75, 0.25, 0.0], [0.0, 1.0, 0.0], [0.25, 0.0, 0.75]])


def test_names_follow_the_greater_overlap():
    reference = np.array([0, 0, 1, 1, 2, -1])
    np.testing.assert_array_equal(named_like(np.array([2, 2, 0, 0, 1, -1, 1]), reference), [0, 0, 1, 1, 2, -1, 2])
    # an agent without overlap gets the smallest free name, also where names have been given up
    np.testing.assert_array_equal(named_like(np.array([0, 0, -1, -1, 1, 2]), reference), [0, 0, -1, -1, 2, 1])
    np.testing.assert_array_equal(named_like(np.array([0, 1, 0]), np.zeros(0, dtype=np.int64)), [0, 1, 0])


def test_names_say_who_is_where_now_after_an_exchange_long_ago():
    reference = np.tile([0, 1], 30)
    exchanged = np.where(np.arange(60) < 40, 1 - reference, reference)  # the larger part, but the earlier one
    np.testing.assert_array_equal(named_like(exchanged, reference), exchanged)
    np.testing.assert_array_equal(named_like(1 - exchanged, reference), exchanged)
    # an agent that ended long ago does not keep the name from the one that goes on with it
    other = np.concatenate([np.full(20, 3), np.full(20, 4)])
    np.testing.assert_array_equal(named_like(other, np.zeros(40, dtype=np.int64))[-1], 0)


def test_names_stay_from_origin_to_origin():
    time, place, _ = two_lines(num=30)
    found = read(time, place, origins=time[4:])
    for early, late in itertools.pairwise(found):
        np.testing.assert_array_equal(late.label[0, : early.num_detections], early.label[0])


def test_values_are_checked():
    with pytest.raises(ValueError, match="sum to one"):
        AssociationHypotheses(np.zeros((2, 1), dtype=np.int64), np.array([0.5, 0.6]), 1)
    with pytest.raises(ValueError, match=r"\[-1, 1\)"):
        AssociationHypotheses(np.ones((1, 1), dtype=np.int64), np.ones(1), 1)
    with pytest.raises(ValueError, match="not decrease"):
        Stream(np.array([1.0, 0.0]), np.zeros((2, 2)), np.zeros((2, 2, 2)))
    for wrong in ({"num_agents": 0}, {"num_particles": 0}, {"clutter_share": 1.0}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            AssociationConfig(**wrong)
