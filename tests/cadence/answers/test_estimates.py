"""Probabilities and laws with their Monte Carlo error."""

import math

import numpy as np
import pytest

from cadence.answers.estimates import law, probability, quantiles, wilson
from cadence.resampling import effective_number


def test_of_300_stories_without_it_less_than_one_per_cent_is_said():
    weight = np.full(300, 1 / 300)
    none, every = probability(weight, np.zeros(300, bool)), probability(weight, np.ones(300, bool))
    assert none.value == 0 and none.low == 0 and none.high < 0.01
    assert none.high == pytest.approx(1 - 0.05 ** (1 / 300))
    assert (every.low, every.high) == (pytest.approx(1 - none.high), 1)


def test_wilson_by_hand():
    low, high = wilson(0.5, 100)
    assert (low, high) == (pytest.approx(0.4038, abs=1e-4), pytest.approx(0.5962, abs=1e-4))


def test_unequal_weights_tell_less():
    weight = np.array([0.5, 0.3, 0.1, 0.1])
    found = probability(weight, np.array([True, False, True, False]))
    assert found.value == pytest.approx(0.6)
    assert found.num_effective == pytest.approx(1 / (0.25 + 0.09 + 0.01 + 0.01))
    assert found.high - found.low > 2 * (wilson(0.6, 100)[1] - 0.6)


def test_stories_without_weight_do_not_decide():
    found = probability(np.array([0.5, 0.5, 0.0]), np.array([True, True, False]))
    assert found.value == 1 and found.high == 1


def test_no_stories_know_nothing():
    found = probability(np.zeros(0), np.zeros(0, bool))
    assert math.isnan(found.value) and (found.low, found.high) == (0, 1)
    assert effective_number(np.zeros(3)) == 0 and law(np.ones(2), np.full(2, np.nan)) is None


def test_intervals_hold_the_probability_as_often_as_they_say():
    rng = np.random.default_rng(0)
    for truth in (0.003, 0.1, 0.5, 0.97):
        weight = np.full(300, 1 / 300)
        found = [probability(weight, rng.random(300) < truth) for _ in range(2000)]
        assert np.mean([each.low <= truth <= each.high for each in found]) > 0.93


def test_law_of_a_normal_number():
    rng = np.random.default_rng(1)
    found = [law(np.full(300, 1 / 300), rng.normal(size=300)) for _ in range(400)]
    assert np.mean([each.low for each in found]) == pytest.approx(-1.645, abs=0.03)
    assert np.mean([each.high for each in found]) == pytest.approx(1.645, abs=0.03)
    assert 0.92 < np.mean([each.median_low <= 0 <= each.median_high for each in found]) < 0.98


def test_quantiles_respect_weights():
    value = np.array([3.0, 1.0, 2.0])
    assert quantiles(np.array([0.2, 0.2, 0.6]), value, np.array([0.5])) == pytest.approx(2.0)
    assert quantiles(np.array([1.0, 1e-9, 1e-9]), value, np.array([0.5, 0.9])) == pytest.approx(3.0, abs=1e-6)
