"""The classical rivals: one model of greatest likelihood, smoothed, sampled, and nothing else."""

import dataclasses

import pytest
import torch
from fixtures.bank import as_tracks, random_windows, simulate

from cadence.bank.components import constant_velocity, ornstein_uhlenbeck
from cadence.bank.fitting import log_likelihood
from cadence.bank.rows import track_rows
from cadence.baselines.kalman import ConstantVelocityKalman, OrnsteinUhlenbeckKalman
from cadence.types import Detections, Estimator

RIVALS = [ConstantVelocityKalman(), OrnsteinUhlenbeckKalman()]
TIMES = torch.arange(12, dtype=torch.float64) * 2.0
WINDOWS = random_windows()


def test_noise_of_constant_velocity_is_found() -> None:
    tracks = simulate(constant_velocity([0.04], initial_speed=1.0), TIMES, 0.05, 80, 0)
    bank = ConstantVelocityKalman().fit(tracks, 1.0).bank
    scaled = bank.models.scaled(1.0, bank.speed_mps or 0.0)
    assert float(scaled.diffusion) == pytest.approx(0.04, rel=0.3)


def test_memory_and_speed_of_ornstein_uhlenbeck_are_found() -> None:
    true = ornstein_uhlenbeck([5.0], [1.2], [0.0])
    tracks = simulate(true, TIMES, 0.05, 80, 0)
    bank = OrnsteinUhlenbeckKalman().fit(tracks, 1.0).bank
    speed_mps = bank.speed_mps or 0.0
    scaled = bank.models.scaled(1.0, speed_mps)
    assert float(1.0 / scaled.relaxation_rate) == pytest.approx(5.0, rel=0.4)
    assert float(scaled.initial_speed) == pytest.approx(1.2, rel=0.2)
    best, of_truth = (
        float(log_likelihood(models, track_rows(tracks), 1.0, unit).sum())
        for models, unit in ((bank.models, speed_mps), (true.scaled(1.0, 1.0 / speed_mps), speed_mps))
    )
    assert best > of_truth


@pytest.mark.parametrize("rival", RIVALS, ids=lambda rival: rival.name)
def test_no_neighbour_is_likelier_than_the_fitted_model(rival: ConstantVelocityKalman) -> None:
    tracks = simulate(ornstein_uhlenbeck([5.0], [1.2], [0.0]), TIMES, 0.05, 40, 1)
    bank, rows = rival.fit(tracks, 1.0).bank, track_rows(tracks)
    assert len(bank.models) == 1 and bank.switch_rate == 0.0 and bank.temper == 1.0 and bank.speed_mps is not None
    best = float(log_likelihood(bank.models, rows, 1.0, bank.speed_mps).sum())
    for factor in (0.4, 2.5):
        changed = dataclasses.replace(bank.models, diffusion=factor * bank.models.diffusion)
        assert float(log_likelihood(changed, rows, 1.0, bank.speed_mps).sum()) < best


@pytest.mark.parametrize("rival", RIVALS, ids=lambda rival: rival.name)
def test_the_call_is_that_of_every_estimator(rival: Estimator) -> None:
    with pytest.raises(ValueError, match="fit"):
        rival.sample(WINDOWS, 2)
    fitted = rival.fit(as_tracks(WINDOWS.detections))
    found, again = fitted.sample(WINDOWS, 5), fitted.sample(WINDOWS, 5)
    assert tuple(found.position_m.shape) == (4, 5, 2, WINDOWS.num_steps, 2)
    assert torch.isfinite(found.position_m).all()
    assert torch.equal(found.position_m, again.position_m)
    assert fitted.name == rival.name


@pytest.mark.parametrize("rival", RIVALS, ids=lambda rival: rival.name)
def test_nothing_to_learn_from(rival: Estimator) -> None:
    nothing = Detections(torch.zeros(0, 1, 1), torch.zeros(0, 1, 1, 2), torch.zeros(0, 1, 1, 2, 2), torch.zeros(0, 1, 1) > 0)
    lone = as_tracks(WINDOWS.detections)
    lone = dataclasses.replace(lone, is_observed=torch.arange(7).expand(8, 1, 7) < 1)
    for tracks in (nothing, lone):
        assert torch.isfinite(rival.fit(tracks).sample(WINDOWS, 2).position_m).all()


def test_units_of_time_do_not_matter() -> None:
    tracks = as_tracks(WINDOWS.detections)
    one = OrnsteinUhlenbeckKalman().fit(tracks, 1.0).bank
    slow = dataclasses.replace(tracks, time_s=10.0 * tracks.time_s)
    ten = OrnsteinUhlenbeckKalman().fit(slow, 10.0).bank
    torch.testing.assert_close(ten.models.relaxation_rate, one.models.relaxation_rate)
    torch.testing.assert_close(ten.models.diffusion, one.models.diffusion)
