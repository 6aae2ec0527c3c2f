"""Direction finders of the world patrol: who is heard from where, how exactly, and that nothing else changes."""

import dataclasses

import numpy as np
import pytest

from cadence.worlds.patrol import PatrolConfig, simulate_patrol
from cadence.worlds.sensors import Listening, hear

SHORT = PatrolConfig(duration_s=300.0, num_agents=2)


def test_bearings_are_off_by_their_noise() -> None:
    steps = 4000
    truth = np.tile([3000.0, 4000.0], (1, steps, 1))
    sensors = np.stack([np.zeros((steps, 2)), np.tile([9000.0, 4000.0], (steps, 1)), np.full((steps, 2), 1e6)])
    listening = Listening("both", radio_rate=0.5, sigma_deg=2.0)
    found = hear(listening, truth, sensors, np.array([True, True, True]), np.random.default_rng(3))
    assert set(found.sensor.tolist()) == {0, 1}  # the third is too far away
    assert len(found) / (2 * steps) == pytest.approx(0.5, abs=0.03)
    offset = truth[0, 0] - sensors[found.sensor, 0]
    error = np.angle(np.exp(1j * (found.bearing_rad - np.arctan2(offset[:, 1], offset[:, 0]))))
    assert np.degrees(error.std()) == pytest.approx(2.0, rel=0.05) and abs(np.degrees(error.mean())) < 0.15
    assert (np.diff(found.step) >= 0).all()
    deaf = hear(listening, truth, sensors, np.array([False, True, False]), np.random.default_rng(3))
    assert set(deaf.sensor.tolist()) == {1}


def test_listening_changes_nothing_else() -> None:
    plain = simulate_patrol(SHORT, np.random.default_rng([1, 0]))
    heard = simulate_patrol(dataclasses.replace(SHORT, listening=Listening("mast", 0.8)), np.random.default_rng([1, 0]))
    assert plain.bearings is None and heard.bearings is not None and len(heard.bearings) > 0
    assert all(heard.sensor_ids[sensor].startswith("mast") for sensor in heard.bearings.sensor.tolist())
    np.testing.assert_array_equal(heard.truth_m, plain.truth_m)
    np.testing.assert_array_equal(heard.detections.position_m, plain.detections.position_m)


def test_what_nobody_can_hear_is_refused() -> None:
    with pytest.raises(ValueError, match="radio_rate must lie in"):
        Listening("mast", radio_rate=0.0)
