"""What episodes are like, and how far two sets are apart: cases with known answers."""

import numpy as np
import pytest

from benchmarks.episode_statistics import EpisodeStatistics, compare, episode_statistics, site_difference
from cadence.recordings import Recordings


def test_distances_between_samples_by_hand():
    same = {"rate": np.array([0.5, 0.7]), "gap": np.array([2.0, 4.0, 4.0])}
    one = EpisodeStatistics(np.array([1.0, 2.0]), stride=np.array([5.0, 8.0]), site=np.array([0, 1]), **same)
    two = EpisodeStatistics(np.array([2.0, 3.0]), stride=np.array([5.0, 5.0]), site=np.array([0, -1]), **same)
    found = compare(one, two)
    assert (found["length"].largest, found["length"].area) == (0.5, 1.0)
    assert found["rate"].area == 0 and found["stride"].area == 1.5 and found["gap"].chance == 1.0
    assert site_difference(one, two, 2) == 0.5


def test_statistics_by_hand():
    place = np.array([[0, 0], [3, 4], [3, 4], [10, 10], [10, 11]], dtype=np.float32)
    made = Recordings(
        60.0,
        np.array([0, 3, 5]),
        place,
        np.array([1, 0, 1, 1, 1], bool),
        np.zeros((5, 0, 2), np.float32),
        np.zeros((2, 2), np.float32),
    )
    found = episode_statistics(made, 1.0, np.array([[9.0, 9.0], [10.0, 12.0]]), 1.5)
    assert found.length.tolist() == [3, 2] and found.rate.tolist() == [pytest.approx(2 / 3), 1.0]
    assert found.gap.tolist() == [2] and found.stride.tolist() == [5, 0, 1] and found.site.tolist() == [-1, 1]
    assert (found.share_at(0, 1), found.share_at(1, 2)) == (0.0, 0.5)
