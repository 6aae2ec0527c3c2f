"""Training windows: what the network sees is what the bank says, and the answer is the truth."""

import dataclasses

import numpy as np
import pytest
import torch
from fixtures.bank import as_tracks, random_windows

from cadence.bank.bank import Bank
from cadence.network.residual_context import MAX_DETECTIONS, ResidualContext
from cadence.training.synthetic import (
    ResidualWindows,
    SyntheticConfig,
    _detections,
    join_windows,
    residual_windows,
    synthesise,
)
from cadence.worlds.kinematics import SUBSTEPS, draw_scenario, simulate_tracks

CONFIG = SyntheticConfig(history_steps=32, horizon_steps=16, num_tracks=6, num_windows=2, num_samples=4)


@pytest.fixture(scope="module")
def made() -> ResidualWindows:
    return synthesise(CONFIG, 5, 4)


def test_same_seed_same_windows(made: ResidualWindows) -> None:
    again, other = synthesise(CONFIG, 5, 4), synthesise(CONFIG, 6, 1)
    assert torch.equal(made.residual, again.residual) and torch.equal(made.sample, again.sample)
    assert not torch.equal(made.residual[: len(other)], other.residual[: len(made)])


def test_shapes(made: ResidualWindows) -> None:
    num = len(made)
    assert 0 < num <= 4 * 6 * 2
    assert tuple(made.residual.shape) == (num, 48, 2)
    assert tuple(made.sample.shape) == (num, 4, 48, 2)
    assert tuple(made.context.detections.shape) == (num, MAX_DETECTIONS, 4)
    for field in dataclasses.fields(ResidualContext):
        assert torch.isfinite(getattr(made.context, field.name).float()).all(), field.name
    assert torch.isfinite(made.residual).all() and torch.isfinite(made.sample).all()


def test_nothing_from_the_future_is_seen(made: ResidualWindows) -> None:
    age = made.context.detections[..., 0][made.context.is_observed]
    assert float(age.min()) >= 0.0 and float(age.max()) < CONFIG.history_steps
    assert bool((made.context.until[:, CONFIG.history_steps :] == CONFIG.history_steps + CONFIG.horizon_steps - 1).all())


def test_samples_of_the_bank_are_in_units_of_its_sigma(made: ResidualWindows) -> None:
    assert float(made.sample.double().square().mean().sqrt()) == pytest.approx(1.0, abs=0.15)
    assert abs(float(made.sample.mean())) < 0.1


def test_the_residual_is_the_truth() -> None:
    windows = random_windows()
    bank = Bank().fit(as_tracks(windows.detections), 1.0)
    truth = torch.randn(4, 2, windows.num_steps, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    found = residual_windows(bank, windows, truth, 3)
    posterior = bank.posterior(windows, 3)
    back = posterior.mean_m + posterior.sigma_m[..., None] * found.residual
    torch.testing.assert_close(back, truth[windows.is_active], rtol=0, atol=1e-3)


def test_windows_are_selected_and_joined(made: ResidualWindows) -> None:
    index = torch.arange(len(made))
    joined = join_windows([made[index[:3]], made[index[3:]]])
    assert torch.equal(joined.residual, made.residual)
    assert torch.equal(joined.context.detections, made.context.detections)


def test_detections_of_a_span() -> None:
    rng = np.random.default_rng(0)
    tracks = simulate_tracks(draw_scenario(rng), 2, 16, rng)
    tracks.is_detected[:] = False
    tracks.is_detected[0, [8, 9, 10, 11, 12, 16]] = True  # steps 2 (four of them), 3 and 4
    both = np.arange(2)
    upto = _detections(tracks, tracks.position, both, 2, 4)
    assert (upto.time_s[0, 0][upto.is_observed[0, 0]] * SUBSTEPS).tolist() == [0.0, 3.0, 4.0]
    after = _detections(tracks, tracks.position, both, 2, 4, after=True)
    assert (after.time_s[0, 0][after.is_observed[0, 0]] * SUBSTEPS).tolist() == [1.0, 4.0, 8.0]
    assert upto.count.tolist() == [[3], [0]]
    np.testing.assert_array_equal(upto.position_m[0, 0, 1].numpy(), tracks.position[0, 11])
