import numpy as np
import pytest

from cadence.association.particles import Stream
from cadence.association.single import is_one_target
from cadence.worlds.patrol import PatrolConfig, simulate_patrol


def stream(time_s: np.ndarray, position_m: np.ndarray, sigma_m: float = 0.0) -> Stream:
    order = np.argsort(time_s, kind="stable")
    return Stream(time_s[order], position_m[order], np.broadcast_to(sigma_m**2 * np.eye(2), (len(order), 2, 2)))


def way(time_s: np.ndarray, offset_m: float = 0.0) -> np.ndarray:
    """A target at 5 m/s that turns now and then."""
    return np.stack([5.0 * time_s, 300.0 * np.sin(time_s / 120.0) + offset_m], axis=-1)


def test_bursts_of_one_target_are_one_targets() -> None:
    rng = np.random.default_rng(1)
    bursts = np.concatenate([start + 10.0 * np.arange(5) for start in (0.0, 300.0, 900.0, 1000.0)])
    assert is_one_target(stream(bursts, way(bursts)))
    assert is_one_target(stream(bursts, way(bursts) + rng.normal(0, 3.0, (20, 2)), 3.0))
    assert is_one_target(stream(bursts, way(bursts)), max_speed_mps=10.0)
    assert not is_one_target(stream(bursts, way(bursts)), max_speed_mps=4.0)


@pytest.mark.parametrize(("num_agents", "share"), [(1, 0.8), (2, 0.0), (4, 0.0)])
def test_patrols_of_one_smuggler_are_told_from_those_of_several(num_agents: int, share: float) -> None:
    found = []
    for seed in range(7):
        episode = simulate_patrol(PatrolConfig(num_agents=num_agents), np.random.default_rng(seed))
        seen = episode.detections
        if len(seen) > 20 and len(set(seen.agent.tolist())) == num_agents:
            both = Stream(episode.time_s[seen.step], seen.position_m, seen.covariance_m2)
            found.append(is_one_target(both))
    assert len(found) >= 4
    assert np.mean(found) >= share if num_agents == 1 else not any(found)


@pytest.mark.parametrize("offset_m", [60.0, 500.0, 20_000.0])
@pytest.mark.parametrize("shift_s", [0.0, 5.0, 1.0])
def test_two_targets_beside_each_other_are_not(offset_m: float, shift_s: float) -> None:
    time_s = 10.0 * np.arange(40.0)
    both = np.concatenate([time_s, time_s + shift_s])
    assert not is_one_target(stream(both, np.concatenate([way(time_s), way(time_s + shift_s, offset_m)])))


def test_two_targets_that_stand_are_not() -> None:
    rng = np.random.default_rng(2)
    who = rng.integers(0, 2, 60)
    place_m = np.array([[0.0, 0.0], [800.0, 0.0]])[who] + rng.normal(0, 5.0, (60, 2))
    assert not is_one_target(stream(10.0 * np.arange(60.0), place_m, 5.0))


def test_too_little_tells_nothing() -> None:
    for num in (0, 1, 2, 8):
        time_s = 10.0 * np.arange(float(num))
        assert not is_one_target(stream(time_s, way(time_s)))
    assert not is_one_target(stream(10.0 * np.arange(50.0), np.zeros((50, 2)), 5.0)), "all of it may be noise"
