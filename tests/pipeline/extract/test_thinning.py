"""Thinning: the stated share, seeded, independent of other agents and of the clock."""

import numpy as np
import pytest

from cadence.errors import ConfigError
from pipeline.config import read_config
from pipeline.extract.thinning import ThinningConfig, is_seen, noise

TIMES_NS = np.arange(0, 20_000 * 10**9, 10**8)
CONFIG = ThinningConfig(enabled=True, seed=3, mean_gap_s=8.0, mean_burst_s=2.0)


def test_share_and_lengths_are_those_stated() -> None:
    seen = is_seen(TIMES_NS, "T0", CONFIG)
    assert seen.mean() == pytest.approx(0.2, abs=0.02)
    edges = np.flatnonzero(np.diff(seen.astype(int)))
    lengths = np.diff(edges) * 0.1
    first_is_gap = bool(seen[edges[0]])
    gaps, bursts = (lengths[::2], lengths[1::2]) if first_is_gap else (lengths[1::2], lengths[::2])
    assert gaps.mean() == pytest.approx(8.0, rel=0.1)
    assert bursts.mean() == pytest.approx(2.0, rel=0.1)
    assert gaps.std() == pytest.approx(gaps.mean(), rel=0.15)  # exponential


def test_start_falls_into_a_random_phase() -> None:
    starts = [is_seen(TIMES_NS[:1], f"agent {i}", CONFIG)[0] for i in range(1000)]
    assert np.mean(starts) == pytest.approx(0.2, abs=0.04)


def test_same_seed_same_bursts_other_seed_or_agent_others() -> None:
    seen = is_seen(TIMES_NS, "T0", CONFIG)
    assert (seen == is_seen(TIMES_NS, "T0", CONFIG)).all()
    assert (seen != is_seen(TIMES_NS, "T1", CONFIG)).any()
    assert (seen != is_seen(TIMES_NS, "T0", ThinningConfig(seed=4, mean_gap_s=8.0, mean_burst_s=2.0))).any()


def test_known_bursts_stay() -> None:
    """Seeds are quoted in published tables: the bursts of a seed must never change."""
    edges = np.flatnonzero(np.diff(is_seen(TIMES_NS, "T0", CONFIG).astype(int)))[:6]
    assert edges.tolist() == GOLDEN_EDGES


def test_shifting_time_changes_nothing() -> None:
    assert (is_seen(TIMES_NS, "T0", CONFIG) == is_seen(TIMES_NS + 1_763_073_169_920_749_554, "T0", CONFIG)).all()


def test_sampling_more_finely_keeps_the_bursts() -> None:
    assert (is_seen(TIMES_NS, "T0", CONFIG)[::10] == is_seen(TIMES_NS[::10], "T0", CONFIG)).mean() == 1.0


def test_min_interval() -> None:
    config = ThinningConfig(seed=3, mean_gap_s=8.0, mean_burst_s=2.0, min_interval_s=0.5)
    kept = np.flatnonzero(is_seen(TIMES_NS, "T0", config))
    assert (np.diff(kept) * 0.1).min() >= 0.5 - 1e-9
    assert len(kept) > 0.15 * is_seen(TIMES_NS, "T0", CONFIG).sum()


def test_noise_has_the_stated_size_and_does_not_depend_on_the_bursts() -> None:
    config = ThinningConfig(seed=3, noise_m=2.5)
    assert noise(4000, "T0", config).std() == pytest.approx(2.5, rel=0.03)
    other = ThinningConfig(seed=3, noise_m=2.5, mean_gap_s=100.0)
    assert (noise(50, "T0", config) == noise(50, "T0", other)).all()


@pytest.mark.parametrize(
    "table", [{"mean_gap_s": 0}, {"mean_burst_s": -1.0}, {"noise_m": -1}, {"seed": -1}, {"thin_from": "map"}]
)
def test_bad_settings(table: dict[str, object]) -> None:
    with pytest.raises(ConfigError):
        read_config(ThinningConfig, table)


def test_empty() -> None:
    assert is_seen(TIMES_NS[:0], "T0", CONFIG).shape == (0,)


GOLDEN_EDGES = [12, 23, 53, 66, 180, 185]
