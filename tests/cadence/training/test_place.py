"""A place learned from arrays: units from the tracks, the same weights from the same seed, and something is learned."""

import numpy as np
import pytest
import torch

from cadence.metrics import energy_score
from cadence.network.place import PlaceNetworkConfig
from cadence.recordings import Recordings, cut_windows
from cadence.training.loop import OptimiserConfig
from cadence.training.place import place_config, train_place

SMALL = PlaceNetworkConfig(width=8, multipliers=(1, 2), encoder_size=8, map_channels=0)


def crossings(num: int = 12, seed: int = 0) -> Recordings:
    """Targets that go 100 m east a step, from one of two shores."""
    rng = np.random.default_rng(seed)
    tracks = [np.stack([100.0 * np.arange(150.0), np.full(150, rng.choice([0.0, 4000.0]))], axis=-1) for _ in range(num)]
    return Recordings.of_tracks(tracks, [rng.random(150) < 0.2 for _ in tracks], 30.0)


def test_recordings_of_tracks_of_different_lengths() -> None:
    rec = Recordings.of_tracks([np.zeros((3, 2)), np.ones((2, 2))], [np.array([True, False, True]), np.ones(2, bool)], 5.0)
    assert (len(rec), rec.num_episodes, rec.offset.tolist(), rec.step_s) == (2, 2, [0, 3, 5], 5.0)
    assert rec.rates().tolist() == pytest.approx([2 / 3, 1.0]) and rec.tracker_m.shape == (5, 0, 2)


def test_units_are_those_of_the_tracks() -> None:
    config = place_config(crossings())
    assert config.step_s == 30.0 and config.centre_m == (7450.0, 2000.0)
    assert config.scale_m == pytest.approx(1.05 * 7450.0) and config.max_step_m == pytest.approx(105.0)
    assert config.unit_step_m == pytest.approx(100.0 / np.sqrt(2.0))  # of two coordinates one changes
    with pytest.raises(ValueError, match="nothing moves"):
        place_config(Recordings.of_tracks([np.ones((4, 2))], [np.ones(4, bool)], 1.0))


def test_training_is_repeatable_and_learns() -> None:
    rec = crossings()
    config, losses = place_config(rec, SMALL), []
    optimiser = OptimiserConfig(learning_rate=4e-3, num_steps=60, warm_up_steps=5, ema_decay=0.9)
    before = torch.random.get_rng_state()
    model = train_place(rec, config, optimiser, 32, seed=3, on_step=lambda step, loss: losses.append(loss))
    assert torch.equal(torch.random.get_rng_state(), before) and len(losses) == 60
    short = OptimiserConfig(num_steps=2, warm_up_steps=1)
    first, again, other = (train_place(rec, config, short, 8, seed=seed).network.state_dict() for seed in (0, 0, 1))
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert any(not torch.equal(first[name], other[name]) for name in first)
    asked = cut_windows(crossings(seed=9), np.arange(8), np.full(8, 25))
    learned, untrained = (
        float(energy_score(drawn.position_m, drawn.weight, asked.truth_m)[..., 30].mean())
        for drawn in (some.sample(asked.windows, 8) for some in (model, train_place(rec, config, short, 8)))
    )
    assert np.mean(losses[-10:]) < 0.7 * np.mean(losses[:5]) and learned < 0.7 * untrained
