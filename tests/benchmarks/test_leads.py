"""Leads over several sets: cases with known answers."""

import dataclasses

import numpy as np
import pytest

from benchmarks.leads import averaged, count, relative_lead, resampled, verdicts
from pipeline.forecast.scores import HORIZONS, MEASURES, NUM_BINS, SHARES, EpisodeScores


def scores(per_episode: list[float], measure: str = "energy_score", windows: int = 10) -> EpisodeScores:
    """Episodes with a constant score at every horizon."""
    e = len(per_episode)
    sums = np.zeros((e, len(MEASURES), len(HORIZONS)))
    sums[:, MEASURES.index(measure)] = windows * np.array(per_episode)[:, None]
    return EpisodeScores(np.arange(e), np.full(e, windows), sums, np.zeros((e, len(SHARES))), np.zeros((e, NUM_BINS)), 1.0)


def test_the_lead_is_the_mean_over_cells_against_the_better_rival() -> None:
    own = [scores([5.0, 5.0, 5.0]), scores([9.0, 9.0])]
    first = [scores([10.0, 10.0, 10.0]), scores([10.0, 10.0])]
    second = [scores([20.0, 20.0, 20.0]), scores([9.5, 9.5])]
    found = relative_lead(own, [first, second], "energy_score", "energy_score", HORIZONS, 0, 100)
    assert found.value == pytest.approx((0.5 + (1 - 9 / 9.5)) / 2)
    assert (found.low, found.high) == pytest.approx((found.value, found.value))
    assert (found.num_values, found.num_groups) == (10, 5)


def test_the_interval_resamples_the_episodes_of_all_alike() -> None:
    """Scores differ by far between episodes, the ratio does not: the interval is narrow; else it is wide."""
    level = [1.0, 10.0, 100.0, 3.0, 30.0]
    own, rival = scores([0.8 * value for value in level]), scores(level)
    tight = relative_lead([own], [[rival]], "energy_score", "energy_score", [59, 119], 0, 200)
    assert (tight.value, tight.low, tight.high) == pytest.approx((0.2, 0.2, 0.2))
    loose = relative_lead([scores([80.0, 1.0, 2.0, 3.0, 4.0])], [[rival]], "energy_score", "energy_score", HORIZONS, 0, 200)
    assert loose.high - loose.low > 0.2
    other = dataclasses.replace(rival, episode=rival.episode + 1)
    with pytest.raises(ValueError, match="same windows"):
        relative_lead([own], [[other]], "energy_score", "energy_score", HORIZONS, 0, 10)


def test_a_rivals_own_measure_counts() -> None:
    own, rival = scores([5.0, 5.0], "displacement_error"), scores([10.0, 10.0], "paper_error")
    assert relative_lead([own], [[rival]], "displacement_error", "paper_error", [0], 0, 10).value == pytest.approx(0.5)


def test_cells_are_won_by_interval() -> None:
    rng = np.random.default_rng(0)
    noise = rng.normal(0.0, 1.0, 40)
    level = rng.uniform(10.0, 100.0, 40)
    rival = {"low": scores(list(level)), "high": scores(list(level)), "other": scores(list(level))}
    own = {
        "low": scores(list(level - 1.0 + 0.1 * noise)),
        "high": scores(list(level + noise - noise.mean())),
        "absent": scores(list(level)),
    }
    found = verdicts(own, rival, "energy_score", "energy_score", 0, 300)
    assert found == {"low": ["won"] * 5, "high": ["tied"] * 5}
    total = count(found | verdicts(rival, {"low": own["low"]}, "energy_score", "energy_score", 0, 300))
    assert (total.won, total.tied, total.lost, total.total) == (0, 5, 5, 10)


def test_trainings_are_averaged() -> None:
    parts = [scores([1.0, 2.0]), scores([3.0, 6.0])]
    mean = averaged(parts)
    assert mean.measure("energy_score")[:, 0].tolist() == [20.0, 40.0] and mean.count.tolist() == [10, 10]
    assert mean.mean("energy_score") == pytest.approx([3.0] * 5)
    with pytest.raises(ValueError, match="same windows"):
        averaged([parts[0], scores([1.0, 2.0, 3.0])])


def test_resampling_keeps_the_number_of_episodes() -> None:
    times = resampled(7, [1], 50)
    assert times.shape == (51, 7) and (times[0] == 1).all() and (times.sum(axis=1) == 7).all()
    assert np.array_equal(times, resampled(7, [1], 50)) and times[1:].std() > 0
