"""The particle filter: its motion is found again in tracks made with it, and it follows what it is shown."""

import dataclasses

import numpy as np
import pytest
import torch

from cadence.baselines.particle import ParticleFilter, RandomTurn, _Particles
from cadence.recordings import ForecastWindows, Recordings, choose_windows, cut_windows
from cadence.types import Estimator

STEADY = RandomTurn(60.0, np.array([100.0]), 0.0, 0.0, 1.0, 0.01, 0.0)


def recorded(place_m: np.ndarray, rate: float = 0.3) -> Recordings:
    """Recordings of paths [E, T, 2]."""
    e, t = place_m.shape[:2]
    return Recordings(
        60.0,
        np.arange(e + 1) * t,
        place_m.reshape(-1, 2).astype(np.float32),
        np.random.default_rng(0).random(e * t) < rate,
        np.zeros((e * t, 0, 2), dtype=np.float32),
        np.full((e, 2), np.nan, dtype=np.float32),
    )


def simulated(motion: RandomTurn, num: int = 100, length: int = 400, seed: int = 0) -> Recordings:
    rng = np.random.default_rng(seed)
    start = _Particles(np.zeros((num, 2)), rng.uniform(-3, 3, num), rng.choice(motion.speed_m, num))
    return recorded(motion.run(start, length, rng)[0].transpose(1, 0, 2))


def straight(length: int = 150, heading: float = 0.7) -> Recordings:
    way = 100.0 * np.arange(length)
    return recorded(np.stack([way * np.cos(heading), way * np.sin(heading)], axis=1)[None], rate=0.4)


def cut(number: int = 6) -> ForecastWindows:
    rec = simulated(STEADY, 4, 100, seed=3)
    return cut_windows(rec, *choose_windows(rec, number, np.random.default_rng(1)))


def test_motion_is_found_again() -> None:
    true = RandomTurn(60.0, np.linspace(50.0, 150.0, 11), 0.01, 0.01, 1.2, 0.02, 0.0)
    found = RandomTurn.fitted(simulated(true))
    assert np.allclose(np.quantile(found.speed_m, [0.1, 0.5, 0.9]), [60.0, 100.0, 140.0], rtol=0.12)
    assert found.speed_rate == pytest.approx(0.01, rel=0.5)
    assert found.end_rate == pytest.approx(1 / 400)
    # rate, size and drift trade against each other; what they do to the heading does not
    for order in (1.0, 4.0):
        decay = [
            model.turn_rate * (1 - np.exp(-0.5 * order * model.turn_sigma**2)) + 0.5 * order * model.drift_sigma**2
            for model in (true, found)
        ]
        assert decay[1] == pytest.approx(decay[0], rel=0.25)


def test_a_steady_track_goes_on() -> None:
    rec = straight()
    windows = cut_windows(rec, np.array([0]), np.array([80]))
    found = ParticleFilter(STEADY).sample(windows.windows, 50).position_m
    error = torch.linalg.vector_norm(found.mean(1) - windows.truth_m, dim=-1)[0, 0]
    assert float(error[0]) < 200.0 and float(error[60]) < 1500.0
    way = torch.diff(found[0, :, 0], dim=1).norm(dim=-1)
    torch.testing.assert_close(way, torch.full_like(way, 100.0))


def test_forecast_starts_at_a_detection_of_now() -> None:
    windows = cut_windows(straight(), np.array([0]), np.array([0]))
    found = ParticleFilter(STEADY).sample(windows.windows, 50).position_m[0, :, 0]
    assert float(found[:, 0].norm(dim=-1).max()) < 6.0
    # nothing is known of the heading yet
    assert float(found[:, 1].mean(0).norm()) < 40.0


def test_arrived_targets_stay() -> None:
    motion = dataclasses.replace(STEADY, end_rate=1.0)
    windows = cut_windows(straight(), np.array([0]), np.array([40]))
    found = ParticleFilter(motion).sample(windows.windows, 5).position_m[0, :, 0]
    assert torch.equal(found[:, 1:], found[:, 1:2].expand(-1, 119, -1))
    assert not torch.equal(found[:, 0], found[:, 1])


def test_the_call_is_that_of_every_estimator() -> None:
    windows = cut()
    tracker = ParticleFilter.from_recordings(simulated(STEADY, 5), name="pf")
    rival: Estimator = tracker
    assert rival.fit(windows.windows.detections) is tracker and rival.name == "pf"
    found = rival.sample(windows.windows, 6)
    assert tuple(found.position_m.shape) == (6, 6, 1, 120, 2) and torch.isfinite(found.position_m).all()
    assert torch.allclose(found.weight.sum(1), torch.ones(6, dtype=found.weight.dtype))
    alone = [rival.sample(windows[i : i + 1].windows, 6).position_m for i in range(6)]
    assert torch.equal(torch.cat(alone), found.position_m)


def test_what_comes_after_the_origin_does_not_matter() -> None:
    rec = straight()
    other = dataclasses.replace(rec, position_m=rec.position_m.copy(), is_detected=rec.is_detected.copy())
    other.position_m[61:] += 999.0
    other.is_detected[61:] ^= True
    one, two = (ParticleFilter(STEADY).sample(cut_windows(r, np.array([0]), np.array([60])).windows, 4) for r in (rec, other))
    assert torch.equal(one.position_m, two.position_m)


def test_misuse_is_refused() -> None:
    windows = cut(1).windows
    with pytest.raises(ValueError, match="from the origin on"):
        ParticleFilter(dataclasses.replace(STEADY, step_s=1.0)).sample(windows, 2)
    with pytest.raises(ValueError, match="moves"):
        RandomTurn.fitted(recorded(np.zeros((2, 40, 2))))
    with pytest.raises(ValueError, match="probabilities"):
        dataclasses.replace(STEADY, turn_rate=2.0)
