"""Episodes in shares: rows of all sources, whole episodes kept apart."""

import numpy as np
import pytest

from cadence.errors import ConfigError
from cadence.recordings import Recordings
from pipeline.episodes.pool import EpisodePool, EpisodeSource


def recordings(lengths, first=0.0):
    total = sum(lengths)
    place = np.arange(first, first + total, dtype=np.float32)
    nobody = np.zeros((total, 0, 2), np.float32)
    goals = np.full((len(lengths), 2), np.nan, np.float32)
    offset = np.concatenate([[0], np.cumsum(lengths)])
    return Recordings(60.0, offset, np.stack([place, place], axis=1), np.ones(total, bool), nobody, goals)


def test_rows_come_by_shares_and_all_rows_of_a_source_alike():
    pool = EpisodePool((recordings([10, 30]), recordings([5], 100.0)), (3.0, 1.0))
    found = list(pool.rows(20_000, np.random.default_rng(0)))
    counts = [len(rows) for _, rows in found]
    assert sum(counts) == 20_000 and counts[0] == pytest.approx(15_000, abs=300)
    assert np.bincount(found[0][1], minlength=40) == pytest.approx(375, abs=100)
    assert found[1][0] is pool.parts[1] and set(found[1][1].tolist()) == set(range(5))
    each = [len(rows) for _, rows in pool.rows_of_each(7, np.random.default_rng(0))]
    assert each == [7, 7]


def test_a_source_without_a_row_is_left_out():
    pool = EpisodePool((recordings([10]), recordings([5])), (1.0, 1e-9))
    assert [part is pool.parts[0] for part, _ in pool.rows(50, np.random.default_rng(0))] == [True]


def test_the_last_episodes_are_kept_apart_whole():
    pool = EpisodePool((recordings([4, 5, 6, 7]), recordings([2, 3], 50.0)), (1.0, 2.0))
    kept, held_out = pool.split(0.3)
    assert [part.length.tolist() for part in kept.parts] == [[4, 5, 6], [2]]
    assert [part.length.tolist() for part in held_out.parts] == [[7], [3]]
    assert kept.shares == held_out.shares == (1.0, 2.0)
    np.testing.assert_array_equal(held_out.parts[0].position_m[:, 0], np.arange(15, 22))
    with pytest.raises(ConfigError, match="single episode"):
        EpisodePool((recordings([4]),), (1.0,)).split(0.5)


def test_shares_are_positive():
    with pytest.raises(ValueError, match="share"):
        EpisodeSource(0.0)
