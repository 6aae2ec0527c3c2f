"""What a stream turned out to be, by hand; and clutter that nobody stated."""

import numpy as np
import pytest

from benchmarks.clutter_logs import clutter_log
from cadence.association.associate import associate
from cadence.association.counts import stream_counts
from cadence.association.types import AssociationConfig, AssociationHypotheses, without_unlikely

TIME_S = np.repeat(np.arange(5.0), 2)
TWO = np.array([0, 1, 0, 1, 0, -1, 0, 1, 0, 1])
ONE = np.array([0, -1, 0, -1, 0, -1, 0, -1, 0, -1])


def test_counts_by_hand() -> None:
    found = stream_counts(AssociationHypotheses(np.stack([TWO, ONE]), np.array([0.75, 0.25]), 2), TIME_S)
    assert (found.num_agents, found.num_agents_probability) == (2, 0.75)
    assert (found.num_agents_low, found.num_agents_high) == (1, 2)
    assert found.clutter.value == pytest.approx(0.75 * 1.5 / 11 + 0.25 * 5.5 / 11)
    assert found.clutter.low <= found.clutter.value <= found.clutter.high
    assert found.detection is not None
    assert found.detection.value == pytest.approx(0.75 * 5.5 / 7 + 0.25 * 3.5 / 4)
    assert found.mean_gap_s == pytest.approx(0.75 * 8 / 7 + 0.25)


def test_without_scans_nothing_is_said_of_a_probability_of_detection() -> None:
    assert stream_counts(AssociationHypotheses(TWO[None], np.ones(1), 2), np.arange(10.0)).detection is None


def test_nobody() -> None:
    found = stream_counts(AssociationHypotheses(np.full((1, 3), -1), np.ones(1), 0), np.arange(3.0))
    assert found.num_agents == 0 and found.mean_gap_s is None and found.clutter.value > 0.8


@pytest.mark.parametrize("clutter_share", [0.0, 0.2])
def test_clutter_that_nobody_states_is_found(clutter_share: float) -> None:
    log = clutter_log("crossing", clutter_share, 0)
    kept = log.until(3000.0)
    covariance_m2 = np.broadcast_to(log.sigma_m**2 * np.eye(2), (len(kept.time_s), 2, 2))
    config = AssociationConfig(num_particles=30)
    read = associate(kept.time_s, kept.position_m, covariance_m2, kept.time_s[-1:], config, 0)
    found = stream_counts(without_unlikely(read)[0], kept.time_s)
    true_share = float((kept.origin < 0).mean())
    assert found.num_agents == 4 and found.clutter.low <= true_share <= found.clutter.high
    assert found.detection is not None and found.detection.low <= 0.4 <= found.detection.high
